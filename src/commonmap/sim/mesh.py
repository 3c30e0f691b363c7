"""Triangle meshes and the solids that simulated worlds are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap.types import Float32s, Float64s

REFLECTIVITY: dict[str, float] = {
    "soil": 0.25,
    "grass": 0.45,
    "asphalt": 0.14,
    "leaf": 0.50,
    "bark": 0.30,
    "concrete": 0.35,
    "brick": 0.40,
    "metal": 0.30,
    "paint": 0.60,
    "wood": 0.40,
    "stone": 0.30,
    "glass": 0.04,
    "rubber": 0.08,
}
"""Share of near-infrared light (905 nm) that a surface sends back, by name of the material."""

MATERIALS = tuple(REFLECTIVITY)
"""Names of the materials; the place of a name is the number that a face carries."""

BURIED = 2.0
"""How far solids reach below their own ground level, metres, so that none floats on a slope."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles. vertices: (V, 3) float32 metres; faces: (F, 3) int32; material: (F,) uint8."""

    vertices: Float32s
    faces: NDArray[np.int32]
    material: NDArray[np.uint8]


def make_mesh(vertices: ArrayLike, faces: ArrayLike, material: str) -> Mesh:
    """Return a mesh of one material."""
    triangles = np.asarray(faces, dtype=np.int32).reshape(-1, 3)
    number = np.full(len(triangles), MATERIALS.index(material), dtype=np.uint8)
    return Mesh(np.asarray(vertices, dtype=np.float32).reshape(-1, 3), triangles, number)


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Return the meshes as one, in their order."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([m.faces + np.int32(s) for m, s in zip(meshes, starts, strict=False)]),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def shifted(mesh: Mesh, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Mesh:
    """Return the mesh turned by `yaw` about its z axis, then shifted."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = mesh.vertices @ R.T + np.array([x, y, z])
    return Mesh(moved.astype(np.float32), mesh.faces, mesh.material)


def box(low: ArrayLike, high: ArrayLike, material: str) -> Mesh:
    """Return an axis-aligned closed box between two corners."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    corner = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    faces = [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ]  # fmt: skip
    return make_mesh(a + corner * (b - a), faces, material)


def slab(length: float, width: float, z_low: float, z_high: float, material: str) -> Mesh:
    """Return a box centred on the z axis, from `z_low` to `z_high`."""
    half = np.array([length / 2, width / 2])
    return box([*-half, z_low], [*half, z_high], material)


def frustum(
    bottom: tuple[float, float], top: tuple[float, float], z_low: float, z_high: float,
    material: str, *, shift: float = 0.0,
) -> Mesh:  # fmt: skip
    """Return a box whose top (length, width) differs from its bottom; `shift` moves it along x."""
    signs = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
    low = np.column_stack([signs * bottom, np.full(4, z_low)])
    high = np.column_stack([signs * top + [shift, 0.0], np.full(4, z_high)])
    return Mesh(
        np.concatenate([low, high]).astype(np.float32),
        *_box_faces(material),
    )


def _box_faces(material: str) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    unit = box([0, 0, 0], [1, 1, 1], material)
    return unit.faces, unit.material


def tube(
    start: ArrayLike, end: ArrayLike, r_start: float, r_end: float, material: str, *, sides: int = 8
) -> Mesh:
    """Return a closed tapered cylinder between two points."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = (b - a) / np.linalg.norm(b - a)
    u = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.outer(np.cos(angle), u) + np.outer(np.sin(angle), v)
    vertices = np.concatenate([a + r_start * ring, b + r_end * ring, a[None], b[None]])
    i = np.arange(sides)
    j = (i + 1) % sides
    n = np.full(sides, 2 * sides)
    faces = np.concatenate(
        [
            np.column_stack([i, j, i + sides]),
            np.column_stack([j, j + sides, i + sides]),
            np.column_stack([j, i, n]),
            np.column_stack([i + sides, j + sides, n + 1]),
        ]
    )
    return make_mesh(vertices, faces, material)


def lathe(profile: Sequence[tuple[float, float]], material: str, *, sides: int = 16) -> Mesh:
    """Return the surface that a profile of (radius, z) makes when it turns about the z axis."""
    r, z = np.asarray(profile, dtype=np.float64).T
    angle = 2 * np.pi * np.arange(sides) / sides
    rings = np.stack(
        [
            np.outer(r, np.cos(angle)),
            np.outer(r, np.sin(angle)),
            np.repeat(z[:, None], sides, axis=1),
        ],
        axis=-1,
    )
    i, j = np.meshgrid(np.arange(len(r) - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    # a ring of no radius is a pole: one of the two triangles of each of its cells has no area
    lower = np.stack([a, b, a + sides], axis=-1)[r[:-1] > 0]
    upper = np.stack([b, b + sides, a + sides], axis=-1)[r[1:] > 0]
    faces = np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])
    return make_mesh(rings, faces, material)


def gable(
    length: float, width: float, eave: float, ridge: float, overhang: float, material: str
) -> Mesh:
    """Return a pitched roof (two slopes, ridge along x) of 0.15 m thickness, with closed gables."""
    x, y = length / 2 + overhang, width / 2 + overhang
    low = eave - overhang * (ridge - eave) / (width / 2)
    t = 0.15
    section = [(-y, low), (0.0, ridge), (y, low), (y, low + t), (0.0, ridge + t), (-y, low + t)]
    vertices = [(s * x, a, b) for s in (-1, 1) for a, b in section]
    faces: list[tuple[int, int, int]] = []
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, i + 6), (j, j + 6, i + 6)]
    for o in (0, 6):
        faces += [
            (o, o + 1, o + 4),
            (o, o + 4, o + 5),
            (o + 1, o + 2, o + 3),
            (o + 1, o + 3, o + 4),
        ]
    inner = length / 2
    start = len(vertices)
    for s in (-1, 1):
        vertices += [(s * inner, -width / 2, eave), (s * inner, width / 2, eave)]
        vertices += [(s * inner, 0.0, ridge)]
    faces += [(start, start + 1, start + 2), (start + 3, start + 4, start + 5)]
    return make_mesh(vertices, faces, material)


def leaves(centres: Float64s, size: float, rng: np.random.Generator, material: str) -> Mesh:
    """Return one triangle of circumradius about `size` at each centre (N, 3), turned at random."""
    n = len(centres)
    u = rng.standard_normal((n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.standard_normal((n, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    r = size * rng.uniform(0.7, 1.3, (n, 1, 1))
    angle = 2 * np.pi * np.arange(3) / 3
    ring = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    vertices = centres[:, None] + r * ring
    return make_mesh(vertices, np.arange(3 * n).reshape(-1, 3), material)


def boulder(radius: float, rng: np.random.Generator, material: str) -> Mesh:
    """Return a lumpy stone, flattened, half in the ground."""
    n_rings, sides = 7, 12
    polar = np.linspace(0.0, np.pi, n_rings)
    lumps = rng.uniform(0.75, 1.2, (n_rings, sides))
    lumps[0] = lumps[0].mean()
    lumps[-1] = lumps[-1].mean()
    across = np.sin(polar) * radius
    across[[0, -1]] = 0.0  # the poles, exactly
    stone = lathe(
        list(zip(across.tolist(), (np.cos(polar) * radius).tolist(), strict=True)),
        material,
        sides=sides,
    )
    stretch = np.array([rng.uniform(0.8, 1.3), rng.uniform(0.8, 1.3), rng.uniform(0.6, 1.0)])
    vertices = stone.vertices * lumps.reshape(-1, 1) * stretch
    return Mesh(vertices.astype(np.float32), stone.faces, stone.material)
