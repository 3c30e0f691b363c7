"""Worlds from files: a user's own mesh, or a real cloud from the air turned into a surface.

    world = read_world("yard.glb")
    world = read_world("tile.laz", size=150.0)
    pair = simulate_pair(world, rng=np.random.default_rng(7))

The place is a square about the middle of what the file holds, in metres. Nothing in it is movable.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import ndimage

from commonmap.errors import EmptyMapError, InputError
from commonmap.io import read_cloud
from commonmap.io.meshes import MESH_READERS, has_faces, read_mesh
from commonmap.io.source import PathLike
from commonmap.mapping.ground import Ground, find_ground, typical_spacing
from commonmap.sim.mesh import MATERIALS, Mesh, join, make_mesh
from commonmap.sim.terrain import Terrain
from commonmap.sim.world import GROUND, World, WorldObject
from commonmap.types import Bools, Float64s

SMALLEST, LARGEST = 20.0, 1000.0
"""Metres, edge of a world."""

FROM_CLOUD = 150.0
"""Metres, edge of the square that is taken from a cloud unless told: a tile may span kilometres."""

MARGIN = 5.0
"""Metres that the ground goes on beyond the border of the place."""

NODE = 0.5
"""Metres between the nodes of the ground."""

LEAST_GROUND = 0.6
"""Share of the place that must have a surface at all, so that a robot can stand on it."""

MAX_LAYERS = 12
"""Surfaces one above the other that are looked through for the ground."""

STANDS = 0.5
"""Metres above ground from which a cell of a cloud becomes a thing."""

MAX_SPIKE = 15.0
"""Metres by which a cell of a cloud may stand above all its neighbours; more is a stray point."""


def read_world(path: PathLike, *, size: float | None = None) -> World:
    """Return the place that a file holds: .obj, .glb or .ply with faces, else a cloud.

    size: metres, edge of the square about the middle; by default all of a mesh's shorter side, and
    `FROM_CLOUD` of a cloud. Raises InputError where it is no place: too small (another unit than
    metres), too large, without ground.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if size is not None and not SMALLEST <= size <= LARGEST:
        raise InputError(
            f"the size of a world must lie in {SMALLEST:g} to {LARGEST:g} m; {size:g} came"
        )
    if suffix in MESH_READERS and (suffix != ".ply" or has_faces(path)):
        mesh = read_mesh(path)
        return world_of_mesh(
            mesh.vertices, np.asarray(mesh.faces, np.int32), size=size, name=path.stem
        )
    return world_of_cloud(read_cloud(path).xyz, size=size, name=path.stem)


def world_of_mesh(
    vertices: Float64s, faces: np.ndarray[tuple[int, int], np.dtype[np.int32]], *,
    size: float | None = None, name: str = "mesh",
) -> World:  # fmt: skip
    """Return the place of a mesh. vertices: (V, 3) metres, z up; faces: (F, 3)."""
    corners = vertices[np.unique(faces)]
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = _choose_size(low, high, size, "mesh")
    middle = 0.5 * (low + high)
    local = np.asarray(vertices - [*middle[:2], low[2]], np.float32)
    reach = 0.5 * size + MARGIN
    kept = (np.abs(local[faces][:, :, :2]).min(axis=1) <= reach).all(axis=1)
    mesh = make_mesh(local, faces[kept], "concrete")
    points = _surfaces(mesh, reach)
    side = np.floor(2.0 * reach / NODE)
    seen = np.unique(np.floor((points[:, :2] + reach) / NODE).astype(np.int64), axis=0)
    if len(seen) < LEAST_GROUND * side**2 * (min(1.0, size / (2 * reach))) ** 2:
        raise InputError(
            f"only {100 * len(seen) / side**2:.0f} % of the {size:.0f} m of this mesh have a "
            "surface; a world needs ground that a robot can drive on"
        )
    return _assemble(name, size, find_ground(points, cell=NODE), mesh)


def world_of_cloud(xyz: Float64s, *, size: float | None = None, name: str = "cloud") -> World:
    """Return the place of an (N, 3) cloud from the air, metres: ground, and a column for each cell
    in which something stands, as high as its highest point."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    if size is None:
        size = min(FROM_CLOUD, float((high - low)[:2].min()))
    size = _choose_size(low, high, size, "cloud")
    middle = 0.5 * (low + high)
    reach = 0.5 * size + MARGIN
    local = xyz - [*middle[:2], 0.0]
    local = local[(np.abs(local[:, :2]) <= reach).all(axis=1)]
    if len(local) < 100:
        raise EmptyMapError(
            f"the middle {size:.0f} m of the cloud hold {len(local)} points; a world needs 100"
        )
    cell = max(NODE, 1.5 * typical_spacing(local))
    ground = find_ground(local)
    local[:, 2] -= float(np.median(ground.z))
    ground = Ground(ground.origin, ground.cell, ground.z - np.median(ground.z), ground.seen)
    n = int(np.ceil(2.0 * reach / cell))
    index = np.minimum(np.floor((local[:, :2] + reach) / cell).astype(int), n - 1)
    above = ground.height_above(local)
    top = np.zeros((n, n))
    np.maximum.at(top, (index[:, 0], index[:, 1]), above)
    beside = np.ones((3, 3), bool)
    beside[1, 1] = False
    top = np.minimum(top, ndimage.maximum_filter(top, footprint=beside) + MAX_SPIKE)
    terrain = _terrain(ground, size)
    things = _columns(top, top >= STANDS, terrain, -reach, cell)
    return _assemble(name, size, terrain, join([terrain.mesh("grass"), *things]), bare=True)


def _choose_size(low: Float64s, high: Float64s, size: float | None, what: str) -> float:
    """Return the edge of the place, or raise where the file holds no place of that size."""
    extent = (high - low)[:2]
    least = float(extent.min())
    if not np.isfinite(extent).all() or float((high - low)[2]) > LARGEST:
        raise InputError(f"the {what} is {float((high - low)[2]):.3g} high; a world is in metres")
    if least < SMALLEST:
        raise InputError(
            f"the {what} spans {extent[0]:.3g} x {extent[1]:.3g}; a world is in metres and at "
            f"least {SMALLEST:g} m wide"
        )
    if size is None:
        size = least
    if size > least:
        raise InputError(f"the {what} spans {extent[0]:.3g} x {extent[1]:.3g} m; {size:g} came")
    if size > LARGEST:
        raise InputError(
            f"the {what} spans {extent[0]:.3g} x {extent[1]:.3g}; a world is in metres and at "
            f"most {LARGEST:g} m wide (--size takes the middle of it)"
        )
    return size


def _surfaces(mesh: Mesh, reach: float) -> Float64s:
    """Return where vertical lines half a node apart meet the mesh, (N, 3), all layers of it."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, mesh.vertices, mesh.faces)
    axis = np.arange(-reach, reach, 0.5 * NODE) + 0.25 * NODE + 1e-3
    x, y = np.meshgrid(axis, axis, indexing="ij")
    top = float(mesh.vertices[:, 2].max()) + 1.0
    start = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, top)]).astype(np.float32)
    down = np.array([0.0, 0.0, -1.0], np.float32)
    found = [np.zeros((0, 3))]
    for _ in range(MAX_LAYERS):
        if len(start) == 0:
            break
        rays = np.broadcast_to(down, start.shape).copy()
        hit = scene.run(start, rays, output=True)
        met = hit["geomID"] >= 0
        start = start[met]
        start[:, 2] -= hit["tfar"][met]
        found.append(start.astype(np.float64))
        start = start - np.array([0.0, 0.0, 0.01], np.float32)
    points = np.concatenate(found)
    if len(points) < 3:
        raise InputError("nothing of this mesh lies under its middle; a world needs ground")
    return points


def _terrain(ground: Ground, size: float) -> Terrain:
    """Return a ground as the nodes that a simulated robot drives on."""
    reach = 0.5 * size + MARGIN
    axis = -reach + NODE * np.arange(int(np.ceil(2.0 * reach / NODE)) + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    z = ground.height_at(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
    return Terrain(np.array([axis[0], axis[0]]), NODE, np.asarray(z, np.float32))


def _columns(top: Float64s, raised: Bools, terrain: Terrain, low: float, cell: float) -> list[Mesh]:
    """Return closed columns on the raised cells, from 1 m under the ground to their top."""
    i, j = np.nonzero(raised)
    if len(i) == 0:
        return []
    at = np.asarray(low + (np.column_stack([i, j]) + 0.5) * cell, np.float64)
    base = terrain.height(at)
    unit = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
    vertices = np.empty((len(i), 8, 3))
    vertices[:, :, :2] = at[:, None] + (unit[:, :2] - 0.5) * cell
    vertices[:, :, 2] = np.where(unit[:, 2] > 0, (base + top[i, j])[:, None], base[:, None] - 1.0)
    sides = np.array(
        [
            [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
            [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
        ]
    )  # fmt: skip
    faces = 8 * np.arange(len(i))[:, None, None] + sides
    return [make_mesh(vertices, faces, "concrete")]


def _assemble(
    name: str, size: float, ground: Ground | Terrain, mesh: Mesh, *, bare: bool = False
) -> World:
    """Return the world of a mesh. bare: its first faces and vertices are those of the terrain."""
    terrain = ground if isinstance(ground, Terrain) else _terrain(ground, size)
    nodes = terrain.mesh("soil")
    vertices, faces = mesh.vertices, mesh.faces
    n_ground = len(nodes.faces) if bare else 0
    if not bare:  # the nodes come first in every world; the mesh has a ground of its own
        vertices = np.concatenate([nodes.vertices, vertices])
        faces = np.asarray(faces + np.int32(len(nodes.vertices)))
    owner = np.zeros(len(faces), np.int32)
    owner[:n_ground] = GROUND
    own = vertices[len(nodes.vertices) :]
    things: tuple[WorldObject, ...] = ()
    if len(own):
        extent = np.asarray(own.max(axis=0) - own.min(axis=0), np.float64)
        things = (
            WorldObject(
                name, False, np.zeros(3), 0.0, extent, (size, size), False,
                (len(nodes.vertices), len(vertices)), (n_ground, len(faces)),
            ),
        )  # fmt: skip
    assert mesh.material.max() < len(MATERIALS)
    return World(name, size, terrain, vertices, faces, mesh.material, owner, things)
