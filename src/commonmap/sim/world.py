"""A simulated place: ground, things on it, and what changes between two visits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.sim.mesh import Mesh
from commonmap.sim.objects import OBJECTS, Model
from commonmap.sim.terrain import Terrain
from commonmap.types import Bools, Float32s, Float64s

GROUND = -1
"""The object number of the faces of the ground."""


@dataclass(frozen=True, eq=False)
class WorldObject:
    """One thing in a world.

    kind: its name. movable: whether `change` may touch it.
    centre: (3,) metres, where its own ground level stands. yaw: radians.
    size: (3,) metres, extent of its mesh along x, y, z of the world.
    footprint: (length, width) metres of the ground that it keeps for itself.
    tilts: whether it lies on the slope.
    vertices, faces: the stretch of the world's arrays that belongs to it, (start, stop).
    """

    kind: str
    movable: bool
    centre: Float64s
    yaw: float
    size: Float64s
    footprint: tuple[float, float]
    tilts: bool
    vertices: tuple[int, int]
    faces: tuple[int, int]


@dataclass(frozen=True, eq=False)
class World:
    """A place as triangles, frame: x, y about the middle of the place, z up.

    vertices: (V, 3) float32 metres; faces: (F, 3) int32.
    face_material: (F,) uint8, a place in `mesh.MATERIALS`.
    face_object: (F,) int32, a place in `objects`, or -1 for the ground.
    size: metres; the place is the square `[-size/2, size/2]` in x and y.
    """

    name: str
    size: float
    terrain: Terrain
    vertices: Float32s
    faces: NDArray[np.int32]
    face_material: NDArray[np.uint8]
    face_object: NDArray[np.int32]
    objects: tuple[WorldObject, ...]

    def height(self, xy: Float64s) -> Float64s:
        """Return the height of the bare ground under each of (N, 2) points, metres."""
        return self.terrain.height(xy)


class Site:
    """A place while it is being built: keeps the ground, what stands on it and what is taken.

    The one thing here that changes in place; `finish` returns the frozen world.
    """

    def __init__(
        self, name: str, size: float, terrain: Terrain, ground: str, *, cell: float = 0.25
    ):
        self.name, self.size, self.terrain, self.ground = name, size, terrain, ground
        self.cell = cell
        n = int(np.ceil(size / cell))
        self.taken: Bools = np.zeros((n, n), dtype=bool)
        self.standing: list[tuple[str, bool, Model, float, float, float]] = []

    def _cells(
        self, x: float, y: float, yaw: float, footprint: tuple[float, float], margin: float
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], bool]:
        """Return the cells under a turned rectangle, and whether all of it is inside the place."""
        a, b = footprint[0] / 2 + margin, footprint[1] / 2 + margin
        c, s = np.cos(yaw), np.sin(yaw)
        reach = np.array([abs(c) * a + abs(s) * b, abs(s) * a + abs(c) * b])
        centre = np.array([x, y]) + self.size / 2
        n = len(self.taken)
        low = np.floor((centre - reach) / self.cell).astype(int)
        high = np.ceil((centre + reach) / self.cell).astype(int) + 1
        inside = bool((low >= 0).all() and (high <= n).all())
        low, high = np.clip(low, 0, n), np.clip(high, 0, n)
        i, j = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij")
        dx, dy = (i + 0.5) * self.cell - centre[0], (j + 0.5) * self.cell - centre[1]
        under = (np.abs(c * dx + s * dy) <= a) & (np.abs(c * dy - s * dx) <= b)
        return i[under], j[under], inside

    def put(
        self, kind: str, model: Model, x: float, y: float, yaw: float, *,
        margin: float = 0.3, movable: bool | None = None, force: bool = False,
    ) -> bool:  # fmt: skip
        """Put a model at a place, if its footprint and `margin` round it are free; say if so.

        force: put it there whatever stands there.
        """
        i, j, inside = self._cells(x, y, yaw, model.footprint, margin)
        if not force and (not inside or self.taken[i, j].any()):
            return False
        i, j, _ = self._cells(x, y, yaw, model.footprint, 0.0)
        self.taken[i, j] = True
        if movable is None:
            movable = kind in OBJECTS
        self.standing.append((kind, movable, model, float(x), float(y), float(yaw)))
        return True

    def keep_free(self, x: float, y: float, yaw: float, footprint: tuple[float, float]) -> None:
        """Let nothing be put on a turned rectangle (a street, a yard)."""
        i, j, _ = self._cells(x, y, yaw, footprint, 0.0)
        self.taken[i, j] = True

    def scatter(
        self, kind: str, n: int, rng: np.random.Generator, *,
        build: Callable[[np.random.Generator], Model] | None = None,
        x: tuple[float, float] | None = None, y: tuple[float, float] | None = None,
        yaw: float | None = None, margin: float = 0.5, tries: int = 30,
    ) -> int:  # fmt: skip
        """Put up to `n` things of one kind at random free places; return how many found one.

        build: makes each of them; the row of `OBJECTS` unless given.
        x, y: metres, the rectangle to stay in; the whole place unless given.
        yaw: radians; any unless given.
        """
        build = OBJECTS[kind] if build is None else build
        found = 0
        for _ in range(n):
            model = build(rng)
            reach = max(0.0, self.size / 2 - 0.5 * max(model.footprint) - margin - 2 * self.cell)
            for _ in range(tries):
                at = rng.uniform(*(x or (-reach, reach))), rng.uniform(*(y or (-reach, reach)))
                turn = rng.uniform(0.0, 2 * np.pi) if yaw is None else yaw
                if self.put(kind, model, *at, turn, margin=margin):
                    found += 1
                    break
        return found

    def finish(self) -> World:
        """Return the world as built so far."""
        pieces = [
            (kind, movable, model.mesh, model.footprint, model.tilts, x, y, yaw)
            for kind, movable, model, x, y, yaw in self.standing
        ]
        return _assemble(self.name, self.size, self.terrain, self.terrain.mesh(self.ground), pieces)


Piece = tuple[str, bool, Mesh, tuple[float, float], bool, float, float, float]
"""kind, movable, mesh about the origin, footprint, tilts, x, y, yaw."""


def _assemble(
    name: str, size: float, terrain: Terrain, ground: Mesh, pieces: Sequence[Piece]
) -> World:
    """Return the world of a ground mesh and pieces put on it."""
    vertices, faces, materials = [ground.vertices], [ground.faces], [ground.material]
    owner = [np.full(len(ground.faces), GROUND, dtype=np.int32)]
    n_vertices, n_faces = len(ground.vertices), len(ground.faces)
    objects = []
    for number, (kind, movable, mesh, footprint, tilts, x, y, yaw) in enumerate(pieces):
        T = _rest(terrain, x, y, yaw, footprint, tilts)
        placed = (mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        objects.append(
            WorldObject(
                kind, movable, T[:3, 3].copy(), yaw,
                (placed.max(axis=0) - placed.min(axis=0)).astype(np.float64), footprint, tilts,
                (n_vertices, n_vertices + len(placed)), (n_faces, n_faces + len(mesh.faces)),
            )
        )  # fmt: skip
        vertices.append(placed)
        faces.append(mesh.faces + np.int32(n_vertices))
        materials.append(mesh.material)
        owner.append(np.full(len(mesh.faces), number, dtype=np.int32))
        n_vertices += len(placed)
        n_faces += len(mesh.faces)
    return World(
        name, size, terrain, np.concatenate(vertices), np.concatenate(faces),
        np.concatenate(materials), np.concatenate(owner), tuple(objects),
    )  # fmt: skip


def _rest(
    terrain: Terrain, x: float, y: float, yaw: float, footprint: tuple[float, float], tilts: bool
) -> Float64s:
    """Return T_world_object (4, 4) of a thing at rest on the ground."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    a, b = footprint[0] / 2, footprint[1] / 2
    local = np.array([[a, b], [a, -b], [-a, b], [-a, -b], [0.0, 0.0]])
    z = terrain.height(local @ R[:2, :2].T + [x, y])
    T = np.eye(4)
    T[:3, 3] = x, y, z[:4].mean() if max(footprint) > 1.0 else z[4]
    if tilts:
        along = np.array([2 * a, 0.0, (z[0] + z[1] - z[2] - z[3]) / 2])
        across = np.array([0.0, 2 * b, (z[0] + z[2] - z[1] - z[3]) / 2])
        if b < 0.5:  # too narrow to say: stays upright across
            across[2] = 0.0
        up = np.cross(along, across)
        up /= np.linalg.norm(up)
        along /= np.linalg.norm(along)
        R = R @ np.column_stack([along, np.cross(up, along), up])
    T[:3, :3] = R
    return T


def change(world: World, share: float, rng: np.random.Generator) -> World:
    """Return the place at a later visit: `share` of its movable things moved, removed or new.

    Of the things that change, 0.4 are moved to another place, 0.3 are removed, and 0.3 are
    replaced by a new thing of the same kind elsewhere.
    """
    if not 0.0 <= share <= 1.0:
        raise InputError(f"share of changed objects must lie in 0 to 1; {share} came")
    movable = [i for i, thing in enumerate(world.objects) if thing.movable]
    n = round(share * len(movable))
    if n == 0:
        return world
    chosen = rng.choice(np.array(movable), n, replace=False)
    fate = {int(i): float(rng.uniform()) for i in chosen}
    site = Site(world.name, world.size, world.terrain, "soil")
    pieces: list[Piece] = []
    moving: list[Piece] = []
    for number, thing in enumerate(world.objects):
        x, y, _ = thing.centre
        mesh = _own_mesh(world, thing)
        piece = (
            thing.kind, thing.movable, mesh, thing.footprint, thing.tilts, float(x), float(y),
            thing.yaw,
        )  # fmt: skip
        if number not in fate:
            pieces.append(piece)
            site.keep_free(x, y, thing.yaw, thing.footprint)
        elif fate[number] < 0.4:
            moving.append(piece)
        elif fate[number] >= 0.7:
            model = OBJECTS[thing.kind](rng)
            moving.append((thing.kind, True, model.mesh, model.footprint, model.tilts, x, y, 0.0))
    for kind, can_move, mesh, footprint, tilts, *_ in moving:
        reach = world.size / 2 - 0.5 * max(footprint) - 1.0
        for _ in range(60):
            x, y = rng.uniform(-reach, reach, 2)
            yaw = float(rng.uniform(0.0, 2 * np.pi))
            if site.put(kind, Model(mesh, footprint, tilts), x, y, yaw, margin=0.3):
                pieces.append((kind, can_move, mesh, footprint, tilts, float(x), float(y), yaw))
                break
    own = world.face_object == GROUND
    n_ground = int(own.sum())
    n_nodes = world.terrain.z.size
    ground = Mesh(world.vertices[:n_nodes], world.faces[:n_ground], world.face_material[:n_ground])
    return _assemble(world.name, world.size, world.terrain, ground, pieces)


def _own_mesh(world: World, thing: WorldObject) -> Mesh:
    """Return the mesh of one thing about its own origin, as it was before it was put down."""
    x, y, _ = thing.centre
    T = _rest(world.terrain, float(x), float(y), thing.yaw, thing.footprint, thing.tilts)
    v, f = slice(*thing.vertices), slice(*thing.faces)
    local = (world.vertices[v].astype(np.float64) - T[:3, 3]) @ T[:3, :3]
    faces = world.faces[f] - np.int32(thing.vertices[0])
    return Mesh(local.astype(np.float32), faces, world.face_material[f])
