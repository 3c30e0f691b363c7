"""Two robots in one place: truth, what only one of them sees, overlap, drift, tilt, seeds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from commonmap.errors import InputError, OutputError
from commonmap.frames import angle, apply, fit_motion, from_rotation, from_xyz_yaw, invert
from commonmap.io.las import read_las
from commonmap.sim.drift import add_drift, relative_error
from commonmap.sim.missions import Area, drive, flight_level, fly
from commonmap.sim.pairs import Pair, measure_overlap, simulate_pair
from commonmap.sim.routes import free_space
from commonmap.sim.scanning import RayCaster
from commonmap.sim.simulate import tell_truth, write_simulation
from commonmap.sim.world import GROUND, World
from commonmap.sim.worlds import build_world
from commonmap.types import Float64s, Trajectory


@pytest.fixture(scope="module")
def pair() -> Pair:
    return simulate_pair("paper", rng=np.random.default_rng(21), seed_world=5, draft_size=40.0)


@pytest.fixture(scope="module")
def world() -> World:
    return build_world("paper", np.random.default_rng(8), size=50.0)


def in_world(pair: Pair) -> tuple[Float64s, Float64s]:
    """Return target and source points in the frame of the world."""
    return (
        apply(pair.T_world_target, pair.target.xyz),
        apply(pair.T_world_source, pair.source.xyz),
    )


def surface_distance(world: World, points: Float64s) -> Float64s:
    """Return the distance of each point to the nearest triangle: the slow way, few points."""
    a, b, c = (world.vertices[world.faces[:, k]].astype(np.float64) for k in range(3))
    low = np.minimum(np.minimum(a, b), c) - 0.5
    high = np.maximum(np.maximum(a, b), c) + 0.5
    found = np.full(len(points), np.inf)
    for i, p in enumerate(points):
        near = ((p > low) & (p < high)).all(axis=1)
        if near.any():
            found[i] = _to_triangles(p, a[near], b[near], c[near]).min()
    return found


def _to_triangles(p: Float64s, a: Float64s, b: Float64s, c: Float64s) -> Float64s:
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    off = ((p - a) * normal).sum(axis=1)
    foot = p - off[:, None] * normal
    inside = np.ones(len(a), dtype=bool)
    nearest = np.full(len(a), np.inf)
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(v - u, foot - u) * normal).sum(axis=1) >= 0
        share = ((p - u) * (v - u)).sum(axis=1) / np.maximum(((v - u) ** 2).sum(axis=1), 1e-12)
        on_edge = u + np.clip(share, 0, 1)[:, None] * (v - u)
        nearest = np.minimum(nearest, np.linalg.norm(p - on_edge, axis=1))
    return np.where(inside, np.abs(off), nearest)


def test_points_lie_on_the_world_through_the_truth(pair: Pair) -> None:
    rng = np.random.default_rng(0)
    T_world_source = pair.T_world_target @ pair.T_target_source
    for T, cloud in ((pair.T_world_target, pair.target), (T_world_source, pair.source)):
        some = cloud.xyz[rng.choice(len(cloud.xyz), 400, replace=False)]
        off = surface_distance(pair.world, apply(T, some))
        assert np.median(off) < 0.025  # range noise of 2 cm, seen at a slant
        assert np.quantile(off, 0.98) < 0.1


def test_truth_puts_the_source_on_the_target(pair: Pair) -> None:
    rng = np.random.default_rng(0)
    tree = cKDTree(pair.target.xyz)
    some = pair.source.xyz[rng.choice(len(pair.source.xyz), 5000, replace=False)]
    right, _ = tree.query(apply(pair.T_target_source, some))
    turned = pair.T_target_source @ _about(some.mean(axis=0), np.radians(5))
    wrong, _ = tree.query(apply(turned, some))
    assert np.median(right) < 0.1
    assert np.mean(right < 0.2) > np.mean(wrong < 0.2) + 0.15
    # each map has its own frame
    assert np.linalg.norm(pair.T_target_source[:2, 3]) > 1.0
    assert angle(pair.T_target_source[:3, :3]) > np.radians(1)


def _about(centre: Float64s, yaw: float) -> Float64s:
    T = from_rotation(np.eye(3), centre)
    return T @ from_xyz_yaw(0, 0, 0, yaw) @ invert(T)


def test_each_robot_sees_what_the_other_cannot(pair: Pair) -> None:
    target, source = in_world(pair)
    canopies = [thing for thing in pair.world.objects if thing.kind == "canopy"]
    below = {"target": 0, "source": 0}
    on_top = {"target": 0, "source": 0}
    for thing in canopies:
        roof = _roof_height(pair.world, thing.vertices)
        c, s = np.cos(thing.yaw), np.sin(thing.yaw)
        for name, points in (("target", target), ("source", source)):
            dx, dy = (points[:, :2] - thing.centre[:2]).T
            a, b = thing.footprint
            under = (np.abs(c * dx + s * dy) < a / 2 - 1.2) & (
                np.abs(c * dy - s * dx) < b / 2 - 1.2
            )
            above_ground = points[:, 2] - pair.world.height(points[:, :2])
            below[name] += int((under & (above_ground > 0.15) & (above_ground < 1.2)).sum())
            on_top[name] += int((under & (np.abs(points[:, 2] - roof) < 0.05)).sum())
    assert len(canopies) >= 3
    assert below["source"] > 300 and below["target"] < 0.05 * below["source"]
    assert on_top["target"] > 300 and on_top["source"] < 0.05 * on_top["target"]


def _roof_height(world: World, vertices: tuple[int, int]) -> float:
    """Return the height of the roof's upper side: its corners are the widest of the structure."""
    v = world.vertices[slice(*vertices)]
    return float(v[:8, 2].max())


def test_cloud_carries_rays_and_times(pair: Pair) -> None:
    for cloud, known in (
        (pair.target, pair.target_trajectory),
        (pair.source, pair.source_trajectory),
    ):
        assert cloud.origin is not None and cloud.time is not None and cloud.intensity is not None
        assert len(cloud.xyz) == len(cloud.origin) == len(cloud.time) == len(cloud.intensity)
        away = np.linalg.norm(cloud.xyz - cloud.origin, axis=1)
        assert away.min() > 0.4 and away.max() < 100.1
        k = np.searchsorted(known.time, cloud.time[::1000])
        step = np.linalg.norm(cloud.origin[::1000] - known.T_map_sensor[k, :3, 3], axis=1)
        assert step.max() < 0.15
    assert pair.source.origin is not None
    assert np.linalg.norm(pair.source.xyz - pair.source.origin, axis=1).max() <= 40.1


def test_same_seed_same_pair() -> None:
    pairs = [
        simulate_pair(
            "paper", rng=np.random.default_rng(3), size=40.0, drift=0.01, change=0.2,
            azimuth_decimation=16,
        )
        for _ in range(2)
    ]  # fmt: skip
    assert pairs[0].source.xyz.tobytes() == pairs[1].source.xyz.tobytes()
    assert pairs[0].target.xyz.tobytes() == pairs[1].target.xyz.tobytes()
    assert pairs[0].T_target_source.tobytes() == pairs[1].T_target_source.tobytes()
    other = simulate_pair("paper", rng=np.random.default_rng(4), size=40.0, azimuth_decimation=16)
    assert other.seed_world != pairs[0].seed_world
    assert other.source.xyz.shape != pairs[0].source.xyz.shape


@pytest.mark.parametrize("asked", [0.2, 0.5])
def test_overlap_is_as_asked(asked: float) -> None:
    pair = simulate_pair(
        "paper", rng=np.random.default_rng(6), size=50.0, overlap=asked, azimuth_decimation=8
    )
    assert pair.overlap == pytest.approx(asked, abs=0.03)
    target, source = in_world(pair)
    assert measure_overlap(target, source) == pytest.approx(pair.overlap, abs=0.01)
    assert pair.border is not None
    assert (target[:, :2] @ pair.border[:2]).max() < pair.border[2] + 0.01
    # the base keeps the larger part of the place
    assert np.ptp(target[:, 0]) * np.ptp(target[:, 1]) > 0.4 * 50.0**2


def test_overlap_by_hand() -> None:
    source = np.array([[0.1, 0.1, 0], [0.2, 0.2, 9], [0.6, 0.1, 0], [1.1, 0.1, 0], [-0.1, 0.1, 0]])
    target = np.array([[0.4, 0.4, 5], [1.4, 0.4, 0], [9.0, 9.0, 0]])
    assert measure_overlap(target, source) == 0.5  # cells 0 and 2 of -1, 0, 1, 2


def test_tilt_is_as_asked() -> None:
    pair = simulate_pair(
        "paper", rng=np.random.default_rng(6), size=40.0, tilt=0.02, azimuth_decimation=32
    )
    up = pair.T_world_source[:3, :3] @ [0, 0, 1]
    assert np.arccos(up[2]) == pytest.approx(0.02, abs=1e-6)
    assert pair.T_world_target[2, 2] == pytest.approx(1.0)


def test_changed_places_differ_only_in_things(pair: Pair) -> None:
    changed = simulate_pair(
        "paper", rng=np.random.default_rng(6), size=40.0, change=0.3, azimuth_decimation=32
    )
    assert changed.world is not changed.source_world
    assert changed.world.terrain is changed.source_world.terrain
    assert pair.world is pair.source_world


def test_drift_is_the_share_that_is_asked_and_smooth() -> None:
    mission = fly(
        build_world("field", np.random.default_rng(1), size=60.0),
        Area(0, 0, 60, 60), np.random.default_rng(2),
    )  # fmt: skip
    for share in (0.002, 0.01):
        known = add_drift(mission.sensor, mission.distance, share, np.random.default_rng(3))
        assert relative_error(mission.sensor, known, mission.distance) == pytest.approx(share)
        np.testing.assert_array_equal(known.T_map_sensor[0], mission.sensor.T_map_sensor[0])
        off = np.linalg.norm((known.T_map_sensor - mission.sensor.T_map_sensor)[:, :3, 3], axis=1)
        assert np.abs(np.diff(off)).max() < 4 * share * 0.2  # a pose lasts 0.02 s, about 0.08 m
        R = known.T_map_sensor[:, :3, :3]
        turned = [
            angle(a.T @ b)
            for a, b in zip(R[::500], mission.sensor.T_map_sensor[::500, :3, :3], strict=True)
        ]
        assert turned[0] == pytest.approx(0.0, abs=1e-7)
        assert 0.01 * share < max(turned) < 5 * share
        np.testing.assert_allclose(
            R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12
        )
    same = add_drift(mission.sensor, mission.distance, 0.0, np.random.default_rng(3))
    assert same is mission.sensor


def test_relative_error_by_hand() -> None:
    time = np.arange(101.0)
    T = np.tile(np.eye(4), (101, 1, 1))
    T[:, 0, 3] = time
    longer = T.copy()
    longer[:, 0, 3] *= 1.01
    error = relative_error(Trajectory(time, T), Trajectory(time, longer), time)
    assert error == pytest.approx(0.01)


def test_with_drift_the_truth_is_the_best_rigid_motion() -> None:
    pair = simulate_pair(
        "paper", rng=np.random.default_rng(9), size=50.0, drift=0.01, azimuth_decimation=16
    )
    true = _true_source(pair)
    placed = apply(pair.T_world_source, pair.source.xyz)
    best = np.sqrt(((placed - true) ** 2).sum(axis=1).mean())
    assert 0.02 < best < 1.0
    for k in range(6):  # no small motion makes it better
        for step in (0.02, -0.02):
            push = from_xyz_yaw(0, 0, 0, 0.0)
            if k < 3:
                push[k, 3] = step
            else:
                push = from_rotation(Rotation.from_rotvec(step / 10 * np.eye(3)[k - 3]).as_matrix())
            centre = from_rotation(np.eye(3), true.mean(axis=0))
            moved = apply(centre @ push @ invert(centre), placed)
            assert np.sqrt(((moved - true) ** 2).sum(axis=1).mean()) > best


def _true_source(pair: Pair) -> Float64s:
    """Return where the source's points truly are, from its poses alone."""
    assert pair.source.time is not None
    known, true = pair.source_trajectory, pair.source_mission.sensor
    k = np.searchsorted(known.time, pair.source.time)
    T = true.T_map_sensor[k] @ invert(known.T_map_sensor[k])
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], pair.source.xyz) + T[:, :3, 3])


def test_fit_motion_recovers_a_motion() -> None:
    rng = np.random.default_rng(0)
    T = from_rotation(Rotation.random(rng=rng).as_matrix(), [3.0, -2.0, 1.0])
    points = rng.normal(size=(50, 3)) * [5, 5, 0.1]
    np.testing.assert_allclose(fit_motion(apply(T, points), points), T, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"overlap": 0.0}, "overlap must lie above 0 and up to 1"),
        ({"change": 2.0}, "share of changed objects"),
        ({"lidar_source": "radar"}, "lidar must be one of"),
    ],
)
def test_bad_options_are_told(options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        simulate_pair("paper", rng=np.random.default_rng(0), size=30.0, **options)


# ---------------------------------------------------------------- missions


def test_ground_robot_stays_clear_and_on_the_ground(world: World) -> None:
    mission = drive(world, Area(0, 0, 40, 40), np.random.default_rng(1))
    body = mission.body.T_map_sensor
    xy = body[:, :2, 3]
    assert mission.distance[-1] > 40.0
    above = body[:, 2, 3] - world.height(xy)
    assert np.abs(above).max() < 0.12
    # the nose rises where the ground ahead is higher, the left side where the left is
    for column, reach in ((0, 0.35), (1, 0.3)):
        axis = body[:, :3, column]
        rise = world.height(xy + reach * axis[:, :2]) - world.height(xy - reach * axis[:, :2])
        assert np.corrcoef(axis[:, 2], rise)[0, 1] > 0.6
    up = mission.sensor.T_map_sensor[:, :3, 3] - body[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 0.8, atol=1e-9)
    assert np.arccos(body[:, 2, 2]).max() < np.radians(25)
    # nothing stands within 0.35 m, at half the height of the robot, in 16 directions
    heading = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    fan = np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1).astype(np.float32)
    at = body[::25, :3, 3] + [0, 0, 0.7]
    origins = np.repeat(at, 16, axis=0).astype(np.float32)
    distance, face, _ = RayCaster(world).cast(origins, np.tile(fan, (len(at), 1)))
    thing = (face >= 0) & (world.face_object[face] != GROUND)
    assert distance[thing].min() > 0.35
    # it faces where it goes, and no faster than it should
    step = np.diff(xy, axis=0) * 50.0
    assert np.hypot(*step.T).max() < 1.35
    fast = np.hypot(*step.T) > 0.8
    forward = np.einsum("ij,ij->i", step[fast], body[:-1][fast][:, :2, 0])
    assert np.median(forward / np.hypot(*step[fast].T)) > 0.98


def test_drone_stays_above_all_things_and_looks_down(world: World) -> None:
    area = Area(0, 0, 40, 30, 0.4)
    mission = fly(world, area, np.random.default_rng(1), height=18.0, pitch=np.radians(75))
    T = mission.sensor.T_map_sensor
    assert T[:, 2, 3].min() > world.vertices[:, 2].max() + 1.0
    level = flight_level(world, area, 18.0)
    assert T[:, 2, 3].mean() == pytest.approx(level - 0.15, abs=0.5)
    ahead = T[:, :3, 0]  # the sensor's x axis points 75 deg down
    assert np.degrees(np.arcsin(-ahead[:, 2])).mean() == pytest.approx(75, abs=2)
    body = mission.body.T_map_sensor
    lean = np.degrees(np.arccos(np.clip(body[:, 2, 2], -1, 1)))
    assert 0.5 < lean.mean() < 5.0
    # rows at most the height apart cover the area
    xy = T[:, :2, 3]
    c, s = np.cos(-0.4), np.sin(-0.4)
    along, across = xy @ [c, -s], xy @ [s, c]
    assert np.ptp(along) > 34 and np.ptp(across) > 14


def test_free_space_by_hand(world: World) -> None:
    clearance, origin, cell = free_space(world)
    assert clearance.shape == (100, 100) and cell == 0.5
    for thing in world.objects:
        i, j = np.floor((thing.centre[:2] - origin) / cell).astype(int)
        if thing.kind in ("tree", "boxes", "car", "wall"):
            assert clearance[i - 1 : i + 2, j - 1 : j + 2].min() == 0.0
    assert clearance.max() < 25 and (clearance > 1.0).mean() > 0.3


# ---------------------------------------------------------------- files


def test_simulation_as_files(tmp_path: Path) -> None:
    folder = tmp_path / "sim"
    pair = write_simulation(
        folder, "paper", np.random.default_rng(31), size=40.0, scans_every=40, azimuth_decimation=8,
        drift=0.0, overlap=0.5,
    )  # fmt: skip
    assert sorted(entry.name for entry in folder.iterdir()) == ["truth.json", "uav", "ugv"]
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["seed"] == 31 and truth["kind"] == "paper"
    np.testing.assert_array_equal(truth["T_target_source"], pair.T_target_source)
    for robot, cloud, known, lidar_frame in (
        ("uav", pair.target, pair.target_trajectory, truth["T_world_target"]),
        ("ugv", pair.source, pair.source_trajectory, truth["T_world_source"]),
    ):
        written = read_las(folder / robot / "cloud.laz")
        assert len(written.xyz) == len(cloud.xyz)
        np.testing.assert_allclose(written.xyz, cloud.xyz, atol=0.0006)
        assert written.origin is not None and cloud.origin is not None
        np.testing.assert_allclose(written.origin, cloud.origin, atol=1e-3)
        poses = np.loadtxt(folder / robot / "poses.tum")
        true = np.loadtxt(folder / robot / "truth.tum")
        assert poses.shape == true.shape == (len(known.time), 8)
        T_world_map = np.array(lidar_frame)
        np.testing.assert_allclose(apply(T_world_map, poses[:, 1:4]), true[:, 1:4], atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(poses[:, 4:], axis=1), 1.0, atol=1e-6)
        bins = sorted((folder / robot / "scans").glob("*.bin"))
        assert len(bins) >= 3
        _check_scan(bins[len(bins) // 2], known, cKDTree(cloud.xyz))

    _check_border(folder, np.array(truth["border"]), pair.target_mission.sensor)


def _check_border(folder: Path, border: Float64s, true: Trajectory) -> None:
    """No scan of the drone reaches over the border of its map."""
    seen = 0
    for path in (folder / "uav" / "scans").glob("*.bin"):
        xyz = np.fromfile(path, dtype="<f4").reshape(-1, 4)[:, :3]
        rows = np.load(path.with_suffix(".npy"), allow_pickle=False)
        T = true.T_map_sensor[np.searchsorted(true.time, rows["time"])]
        placed = np.einsum("nij,nj->ni", T[:, :2, :3], xyz) + T[:, :2, 3]
        assert (placed @ border[:2]).max() < border[2] + 0.2
        seen += len(xyz)
    assert seen > 1000


def _check_scan(path: Path, known: Trajectory, tree: cKDTree) -> None:
    """A scan, read without our code and put down with the written poses, lies on the cloud."""
    columns = np.fromfile(path, dtype="<f4").reshape(-1, 4)
    rows = np.load(path.with_suffix(".npy"), allow_pickle=False)
    assert len(columns) == len(rows) > 100
    assert np.ptp(rows["time"]) < 0.1 and rows["ring"].max() <= 15
    k = np.searchsorted(known.time, rows["time"])
    T = known.T_map_sensor[k]
    placed = np.einsum("nij,nj->ni", T[:, :3, :3], columns[:, :3]) + T[:, :3, 3]
    near = np.linalg.norm(columns[:, :3], axis=1) < 30.0
    away, _ = tree.query(placed[near])
    assert np.median(away) < 0.25


def test_simulation_replaces_its_own_folder_only(tmp_path: Path) -> None:
    folder = tmp_path / "sim"
    options: dict[str, Any] = {"size": 30.0, "scans_every": 0}
    write_simulation(folder, "paper", np.random.default_rng(1), **options)
    first = (folder / "truth.json").read_text()
    write_simulation(folder, "paper", np.random.default_rng(2), **options)
    assert (folder / "truth.json").read_text() != first
    assert not (folder / "uav" / "scans").exists()
    foreign = tmp_path / "mine"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("x")
    with pytest.raises(OutputError, match=r"thesis\.txt"):
        write_simulation(foreign, "paper", np.random.default_rng(1), **options)
    assert [entry.name for entry in tmp_path.iterdir() if "part" in entry.name] == []
    with pytest.raises(InputError, match="scans_every"):
        write_simulation(folder, "paper", np.random.default_rng(1), scans_every=-1)


def test_truth_is_plain_json(pair: Pair) -> None:
    rng = np.random.default_rng(77)
    truth = json.loads(json.dumps(tell_truth(pair, rng), allow_nan=False))
    assert truth["seed"] == 77 and truth["seed_world"] == 5
    assert np.array(truth["T_target_source"]).shape == (4, 4)
