"""Simulated places: whole meshes, things on the ground, seeds that differ, crowns with gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap.errors import InputError
from commonmap.sim.mesh import MATERIALS, Mesh, box, frustum, gable, lathe, slab, tube
from commonmap.sim.objects import OBJECTS
from commonmap.sim.scanning import RayCaster
from commonmap.sim.terrain import Terrain, roll_terrain
from commonmap.sim.world import GROUND, Site, World, change
from commonmap.sim.worlds import WORLDS, build_world

SIZES = {"paper": 50.0, "city": 80.0, "village": 80.0, "forest": 40.0, "industrial": 90.0}


@pytest.fixture(scope="module")
def worlds() -> dict[str, World]:
    return {
        kind: build_world(kind, np.random.default_rng(11), size=SIZES.get(kind)) for kind in WORLDS
    }


@pytest.mark.parametrize("kind", WORLDS)
def test_mesh_is_whole(kind: str, worlds: dict[str, World]) -> None:
    world = worlds[kind]
    assert world.vertices.dtype == np.float32 and world.faces.dtype == np.int32
    assert np.isfinite(world.vertices).all()
    assert world.faces.min() == 0 and world.faces.max() == len(world.vertices) - 1
    assert len(world.faces) == len(world.face_material) == len(world.face_object)
    assert world.face_material.max() < len(MATERIALS)
    assert world.face_object[0] == GROUND
    for number, thing in enumerate(world.objects):
        v, f = slice(*thing.vertices), slice(*thing.faces)
        assert (world.face_object[f] == number).all()
        assert thing.vertices[0] <= world.faces[f].min()
        assert world.faces[f].max() < thing.vertices[1]
        extent = np.ptp(world.vertices[v], axis=0)
        np.testing.assert_allclose(thing.size, extent, atol=1e-4)
    assert len({thing.kind for thing in world.objects}) >= 4


@pytest.mark.parametrize("kind", WORLDS)
def test_things_stand_on_the_ground(kind: str, worlds: dict[str, World]) -> None:
    world = worlds[kind]
    for thing in world.objects:
        points = world.vertices[slice(*thing.vertices)].astype(np.float64)
        above = points[:, 2] - world.height(points[:, :2])
        assert above.min() < 0.12, f"a {thing.kind} floats by {above.min():.2f} m"
        assert above.max() > 0.1, f"a {thing.kind} is buried"


@pytest.mark.parametrize("kind", WORLDS)
def test_same_seed_same_place_other_seed_other_place(kind: str, worlds: dict[str, World]) -> None:
    world = worlds[kind]
    again = build_world(kind, np.random.default_rng(11), size=SIZES.get(kind))
    assert world.vertices.tobytes() == again.vertices.tobytes()
    assert world.faces.tobytes() == again.faces.tobytes()
    other = build_world(kind, np.random.default_rng(12), size=SIZES.get(kind))
    here = np.array([thing.centre[:2] for thing in world.objects])
    there = np.array([thing.centre[:2] for thing in other.objects])
    nearest = np.sqrt(((here[:, None] - there[None]) ** 2).sum(axis=2)).min(axis=1)
    assert np.mean(nearest < 0.05) < 0.05  # no thing stands where one stood
    assert np.abs(world.terrain.z - other.terrain.z).mean() > 0.05


def test_height_is_that_of_the_triangles() -> None:
    terrain = roll_terrain(np.random.default_rng(3), size=30.0, relief=1.0, roughness=0.2)
    site = Site("bare", 30.0, terrain, "soil")
    xy = np.random.default_rng(4).uniform(-15, 15, (2000, 2))
    origins = np.column_stack([xy, np.full(2000, 50.0)]).astype(np.float32)
    down = np.tile([0, 0, -1], (2000, 1)).astype(np.float32)
    distance, face, _ = RayCaster(site.finish()).cast(origins, down)
    assert (face >= 0).all()
    met = 50.0 - distance
    np.testing.assert_allclose(met, terrain.height(origins[:, :2].astype(float)), atol=2e-4)


def test_height_by_hand() -> None:
    terrain = Terrain(np.array([10.0, 20.0]), 2.0, np.array([[0, 1], [4, 9]], dtype=np.float32))
    # corners, the middle of the diagonal, one point on each of the two triangles
    xy = np.array([[10, 20], [12, 20], [10, 22], [11, 21], [11.5, 20.5], [10.5, 21.5]])
    np.testing.assert_allclose(terrain.height(xy), [0, 4, 1, 4.5, 4.25, 2.75], atol=1e-5)
    outside = np.array([[0.0, 20.0], [50.0, 50.0]])
    np.testing.assert_allclose(terrain.height(outside), [0.0, 9.0], atol=1e-4)


def test_tilted_things_lie_on_the_slope_and_others_stand_upright() -> None:
    axis = np.arange(-15.0, 15.1, 0.5)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    slope = Terrain(np.array([-15.0, -15.0]), 0.5, (0.2 * x - 0.1 * y).astype(np.float32))
    normal = np.array([-0.2, 0.1, 1.0]) / np.linalg.norm([-0.2, 0.1, 1.0])
    for kind, upright in (("container", False), ("lamp", True)):
        site = Site("slope", 30.0, slope, "soil")
        assert site.put(kind, OBJECTS[kind](np.random.default_rng(0)), 2.0, -3.0, 0.7)
        world = site.finish()
        (thing,) = world.objects
        np.testing.assert_allclose(thing.centre, [2.0, -3.0, 0.7], atol=1e-5)
        corners = world.vertices[slice(*thing.vertices)] - thing.centre
        if upright:
            assert np.hypot(*corners[:16, :2].T).max() < 0.1  # the post
        else:
            off = corners @ normal
            np.testing.assert_allclose(np.unique(np.round(off, 3)), [-0.3, 2.59], atol=2e-3)


def test_relief_and_slope_are_as_asked() -> None:
    rng = np.random.default_rng(5)
    spread = [
        roll_terrain(rng, size=200.0, relief=1.5, wavelength=(10.0, 40.0)).z.std() for _ in range(8)
    ]
    assert np.mean(spread) == pytest.approx(1.5, rel=0.15)
    plane = roll_terrain(rng, size=60.0, relief=0.0, slope=np.radians(12.0), roughness=0.0)
    steepest = np.hypot(*np.gradient(plane.z.astype(float), plane.cell))
    np.testing.assert_allclose(np.degrees(np.arctan(steepest)), 12.0, atol=0.01)


def test_light_comes_through_crowns(worlds: dict[str, World]) -> None:
    world = worlds["forest"]
    n = 20000
    rng = np.random.default_rng(6)
    trees = [thing for thing in world.objects if thing.kind in ("tree", "conifer")]
    assert len(trees) > 25
    at = np.array([trees[k].centre for k in rng.integers(len(trees), size=n)])
    xy = at[:, :2] + rng.normal(0.0, 1.0, (n, 2))
    origins = np.column_stack([xy, np.full(n, 60.0)]).astype(np.float32)
    down = np.tile([0, 0, -1], (n, 1)).astype(np.float32)
    _, face, _ = RayCaster(world).cast(origins, down)
    ground = np.mean(world.face_object[face] == GROUND)
    leaf = np.mean(world.face_material[face] == MATERIALS.index("leaf"))
    assert 0.2 < ground < 0.75
    assert leaf > 0.2


def test_change_moves_the_share_that_is_asked(worlds: dict[str, World]) -> None:
    world = worlds["paper"]
    later = change(world, 0.3, np.random.default_rng(7))
    n_ground = int((world.face_object == GROUND).sum())
    assert world.faces[:n_ground].tobytes() == later.faces[:n_ground].tobytes()
    assert world.terrain is later.terrain
    stays = {(t.kind, *np.round(t.centre, 3)) for t in later.objects}
    same = [(t.kind, *np.round(t.centre, 3)) in stays for t in world.objects if t.movable]
    assert 1 - np.mean(same) == pytest.approx(0.3, abs=0.5 / len(same) + 1e-9)
    for thing in world.objects:
        if not thing.movable:
            assert (thing.kind, *np.round(thing.centre, 3)) in stays
    # what stays has kept its triangles where they were
    before = {tuple(np.round(t.centre, 3)): t for t in world.objects}
    for thing in later.objects:
        old = before.get(tuple(np.round(thing.centre, 3)))
        if old is not None and old.kind == thing.kind and old.vertices != thing.vertices:
            np.testing.assert_allclose(
                world.vertices[slice(*old.vertices)],
                later.vertices[slice(*thing.vertices)],
                atol=1e-4,
            )


def test_no_change_is_the_same_place_and_bad_shares_are_refused(worlds: dict[str, World]) -> None:
    assert change(worlds["paper"], 0.0, np.random.default_rng(0)) is worlds["paper"]
    with pytest.raises(InputError, match=r"0 to 1; 1\.5 came"):
        change(worlds["paper"], 1.5, np.random.default_rng(0))


def test_paper_scene_has_what_the_paper_names(worlds: dict[str, World]) -> None:
    kinds = {thing.kind for thing in worlds["paper"].objects}
    assert {"tree", "canopy", "wall", "boxes", "car", "mushroom", "table", "taper"} <= kinds
    assert WORLDS["paper"].size == 60.0


@given(seed=st.integers(0, 2**31), kind=st.sampled_from(sorted(OBJECTS)))
@settings(max_examples=60, deadline=None)
def test_models_are_about_their_origin(seed: int, kind: str) -> None:
    model = OBJECTS[kind](np.random.default_rng(seed))
    v = model.mesh.vertices
    assert np.isfinite(v).all() and v[:, 2].min() < 0.1 < v[:, 2].max() < 20.0
    assert model.mesh.faces.max() < len(v)
    corners = v[model.mesh.faces].astype(np.float64)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    assert (area > 0).all()
    assert max(model.footprint) < 12.0


def _roof() -> Mesh:
    """Return a pitched roof without the two sheets that close its gables, the last faces."""
    roof = gable(8.0, 5.0, 3.0, 5.0, 0.4, "wood")
    return Mesh(roof.vertices, roof.faces[:-2], roof.material[:-2])


@pytest.mark.parametrize(
    "solid",
    [
        box([-1, -2, 0], [1, 2, 3], "wood"),
        slab(2.0, 3.0, 0.0, 1.0, "wood"),
        frustum((2.0, 2.0), (1.0, 0.5), 0.0, 2.0, "wood"),
        tube([0, 0, 0], [1, 1, 2], 0.5, 0.2, "wood"),
        _roof(),
    ],
)
def test_solids_have_no_holes(solid: Mesh) -> None:
    edges = np.sort(solid.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


def test_lathe_is_round() -> None:
    dome = lathe([(2.0, 0.0), (1.0, 1.0)], "metal", sides=8)
    assert dome.vertices.shape == (16, 3) and dome.faces.shape == (16, 3)
    cone = lathe([(2.0, 0.0), (0.0, 1.0)], "metal", sides=8)
    assert cone.faces.shape == (8, 3)
    np.testing.assert_allclose(np.hypot(*dome.vertices[:8, :2].T), 2.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        ({"kind": "moon"}, "paper, city, village, forest, industrial, field; 'moon' came"),
        ({"kind": "paper", "size": 5.0}, "20 to 1000 m; 5 came"),
        ({"kind": "paper", "relief": -1.0}, "0 to 20 m; -1 came"),
    ],
)
def test_bad_requests_are_told(call: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        build_world(rng=np.random.default_rng(0), **call)  # type: ignore[arg-type]
