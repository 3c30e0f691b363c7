"""The lidar model against the VLP-16 manual, and scans against geometry done by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from commonmap.errors import InputError
from commonmap.frames import from_rotation
from commonmap.sim.mesh import MATERIALS, Mesh, box, join
from commonmap.sim.scanning import (
    RayCaster,
    firing_pattern,
    place_points,
    scan_world,
    sensor_positions,
    split_scans,
    turn_stamps,
)
from commonmap.sim.terrain import Terrain
from commonmap.sim.vlp16 import LIDARS, VLP16, LidarModel, find_lidar
from commonmap.sim.world import World
from commonmap.types import Float64s, Trajectory

EXACT = replace(VLP16, range_sigma=0.0, range_step=1e-6, drop_out=0.0, sensitive_range=1e6)
"""A VLP-16 that makes no errors."""


def world_of(*meshes: Mesh) -> World:
    """Return a world of these meshes; its terrain is only a placeholder."""
    mesh = join(meshes)
    flat = Terrain(np.array([-100.0, -100.0]), 100.0, np.zeros((3, 3), dtype=np.float32))
    owner = np.zeros(len(mesh.faces), dtype=np.int32)
    return World("test", 200.0, flat, mesh.vertices, mesh.faces, mesh.material, owner, ())


def moving(
    velocity: tuple[float, float, float], yaw_rate: float = 0.0, seconds: float = 1.0
) -> Trajectory:
    """Return a steady motion that starts at the origin, facing x."""
    time = np.linspace(0.0, seconds, 51)
    T = np.tile(np.eye(4), (51, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(yaw_rate * time, [0, 0, 1])).as_matrix()
    T[:, :3, 3] = np.outer(time, velocity)
    return Trajectory(time, T)


def test_vlp16_table_is_that_of_the_manual() -> None:
    # VLP-16 user manual, table 9-1: laser ID 0 to 15, degrees and millimetres
    degrees = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
    millimetres = [
        11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2,
    ]  # fmt: skip
    np.testing.assert_allclose(np.degrees(VLP16.elevation), degrees, atol=1e-12)
    np.testing.assert_allclose(VLP16.height_offset * 1e3, millimetres, atol=1e-12)
    assert VLP16.ring.tolist() == [0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15]


def test_vlp16_fires_at_the_times_of_the_manual() -> None:
    # section 9.4: offset = 55.296 us * sequence + 2.304 us * data point; figure 9-9 lists the sums
    time, _, laser = firing_pattern(VLP16)
    microseconds = 1e6 * time.reshape(-1, 16)
    assert microseconds[0, 1] == pytest.approx(2.304)
    assert microseconds[0, 15] == pytest.approx(34.560)
    assert microseconds[1, 0] == pytest.approx(55.296)
    assert microseconds[3, 7] == pytest.approx(182.016)
    assert microseconds[23, 15] == pytest.approx(1306.368)
    assert laser[:17].tolist() == [*range(16), 0]
    assert VLP16.sequences_per_turn == 1808
    assert np.all(np.diff(time) > 0)


def test_head_turns_clockwise_and_starts_forward() -> None:
    time, direction, laser = firing_pattern(VLP16)
    first = direction[0]
    assert first[1] == pytest.approx(0.0, abs=1e-9)
    assert first[0] == pytest.approx(np.cos(np.radians(15)))
    assert first[2] == pytest.approx(-np.sin(np.radians(15)))
    quarter = int(np.argmin(np.abs(time - 0.025)))  # 10 turns a second: to the right, -y
    assert direction[quarter, 1] / np.cos(VLP16.elevation[laser[quarter]]) < -0.9999
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0)


@pytest.mark.parametrize(
    ("name", "channels", "per_turn", "lowest_deg", "highest_deg"),
    [
        ("vlp16", 16, 1808, -15.0, 15.0),
        ("hdl32", 32, 2170, -30.6667, 10.6667),
        ("os1-64", 64, 1024, -22.5, 22.5),
        ("os1-128", 128, 1024, -22.5, 22.5),
    ],
)
def test_lidar_table(
    name: str, channels: int, per_turn: int, lowest_deg: float, highest_deg: float
) -> None:
    model = LIDARS[name]
    assert (model.name, model.n_channels, model.sequences_per_turn) == (name, channels, per_turn)
    assert np.degrees(model.elevation.min()) == pytest.approx(lowest_deg, abs=1e-3)
    assert np.degrees(model.elevation.max()) == pytest.approx(highest_deg, abs=1e-3)
    assert sorted(model.ring.tolist()) == list(range(channels))
    assert model.fire_time.max() <= model.sequence_period


def test_unknown_lidar_names_those_there_are() -> None:
    with pytest.raises(InputError, match=r"vlp16, hdl32.*'vlp17' came"):
        find_lidar("vlp17")
    with pytest.raises(InputError, match="rate"):
        replace(VLP16, rate=0.0)


def test_ranges_to_a_plane_are_exact() -> None:
    wall = box([7.0, -40.0, -40.0], [8.0, 40.0, 40.0], "concrete")
    returns = scan_world(
        RayCaster(world_of(wall)), moving((0, 0, 0)), EXACT, np.array([0.1]),
        rng=np.random.default_rng(0),
    )  # fmt: skip
    assert len(returns.xyz) > 8000
    np.testing.assert_allclose(returns.xyz[:, 0], 7.0, atol=2e-4)
    # and each return lies on its own channel, seen from its own laser
    elevation = np.sort(VLP16.elevation)[returns.ring]
    offset = VLP16.height_offset[np.argsort(VLP16.elevation)][returns.ring]
    level = np.hypot(returns.xyz[:, 0], returns.xyz[:, 1])
    np.testing.assert_allclose(np.arctan2(returns.xyz[:, 2] - offset, level), elevation, atol=2e-6)
    # at its own time: azimuth = -2 pi 10 Hz t
    azimuth = np.arctan2(returns.xyz[:, 1], returns.xyz[:, 0])
    expected = -2 * np.pi * 10.0 * (returns.time - 0.1)
    np.testing.assert_allclose(np.cos(azimuth - expected), 1.0, atol=1e-9)


def test_moving_sensor_distorts_and_true_poses_undo_it() -> None:
    walls = join(
        [
            box([12.0, -40.0, -40.0], [13.0, 40.0, 40.0], "concrete"),
            box([-40.0, 9.0, -40.0], [40.0, 10.0, 40.0], "concrete"),
        ]
    )
    trajectory = moving((5.0, 1.0, 0.3), yaw_rate=1.0)
    returns = scan_world(
        RayCaster(world_of(walls)), trajectory, EXACT, turn_stamps(trajectory, EXACT),
        rng=np.random.default_rng(0), azimuth_decimation=8,
    )  # fmt: skip
    placed = place_points(trajectory, returns.time, returns.xyz)
    on_first = np.abs(placed[:, 0] - 12.0)
    on_second = np.abs(placed[:, 1] - 9.0)
    assert np.minimum(on_first, on_second).max() < 2e-3
    # without deskewing, each turn put down with the pose of its start, walls bend
    start = np.floor(returns.time * 10.0 + 1e-9) / 10.0
    bent = place_points(trajectory, np.minimum(start, 0.99), returns.xyz)
    near = np.minimum(np.abs(bent[:, 0] - 12.0), np.abs(bent[:, 1] - 9.0))
    assert np.quantile(near, 0.9) > 0.3


def test_noise_and_steps_are_as_told() -> None:
    noisy = replace(EXACT, range_sigma=0.03, range_step=0.002)
    shell = box([-6.0, -6.0, -6.0], [6.0, 6.0, 6.0], "concrete")
    world = world_of(shell)
    still = moving((0, 0, 0))
    stamps = np.array([0.0, 0.1, 0.2])
    caster = RayCaster(world)
    truth = scan_world(caster, still, EXACT, stamps, rng=np.random.default_rng(0))
    seen = scan_world(caster, still, noisy, stamps, rng=np.random.default_rng(0))
    offset = VLP16.height_offset[np.argsort(VLP16.elevation)]
    lift = np.stack([0 * truth.time, 0 * truth.time, offset[truth.ring]], axis=1)
    assert len(truth.xyz) == len(seen.xyz) == 3 * 1808 * 16
    ranges = np.linalg.norm(seen.xyz - lift, axis=1)
    error = ranges - np.linalg.norm(truth.xyz - lift, axis=1)
    assert error.mean() == pytest.approx(0.0, abs=5e-4)
    assert error.std() == pytest.approx(0.03, rel=0.1)
    steps = ranges / 0.002
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)


def test_returns_are_lost_at_random_by_range_and_by_incidence() -> None:
    ground = box([-90.0, -90.0, -2.0], [90.0, 90.0, -1.0], "asphalt")
    still = moving((0, 0, 0))
    stamps = np.arange(5) / 10.0
    caster = RayCaster(world_of(ground))
    every = scan_world(caster, still, EXACT, stamps, rng=np.random.default_rng(0))
    some = scan_world(caster, still, VLP16, stamps, rng=np.random.default_rng(0))
    shares = [float(np.sum(some.ring == k) / np.sum(every.ring == k)) for k in range(8)]
    assert 0.99 < shares[0] <= 1.0  # 3.9 m away, 15 deg to the ground
    assert 0.95 < shares[5] < shares[0]  # 11.5 m, 5 deg
    assert 0.05 < shares[6] < 0.5  # 19 m, 3 deg
    assert shares[7] < 0.01  # 57 m, 1 deg
    assert every.ring.max() == 7  # the others look up
    random = replace(EXACT, drop_out=0.2)
    fewer = scan_world(caster, still, random, stamps, rng=np.random.default_rng(0))
    assert len(fewer.xyz) / len(every.xyz) == pytest.approx(0.8, abs=0.01)


def test_range_limits_hold() -> None:
    near = box([0.4, -0.05, -1.0], [0.45, 0.05, 1.0], "concrete")
    far = box([101.0, -50.0, -50.0], [102.0, 50.0, 50.0], "concrete")
    good = box([-50.0, -20.0, -50.0], [-49.0, 20.0, 50.0], "concrete")
    caster = RayCaster(world_of(near, far, good))
    seen = scan_world(
        caster, moving((0, 0, 0)), EXACT, np.array([0.0]), rng=np.random.default_rng(0)
    )
    assert len(seen.xyz) > 100
    np.testing.assert_allclose(seen.xyz[:, 0], -49.0, atol=1e-3)


def test_placing_points_agrees_with_scipy() -> None:
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0.0, 10.0, 20))
    turns = Rotation.random(20, rng=rng)
    T = np.stack(
        [
            from_rotation(R, t)
            for R, t in zip(turns.as_matrix(), rng.normal(size=(20, 3)), strict=True)
        ]
    )
    trajectory = Trajectory(time, T)
    at = rng.uniform(time[0], time[-1], 500)
    xyz = rng.normal(size=(500, 3)) * 20
    R = Slerp(time, turns)(at)
    positions = np.stack([np.interp(at, time, T[:, k, 3]) for k in range(3)], axis=1)
    np.testing.assert_allclose(
        place_points(trajectory, at, xyz), R.apply(xyz) + positions, atol=1e-4
    )
    np.testing.assert_allclose(sensor_positions(trajectory, at), positions)
    with pytest.raises(InputError, match="within the trajectory"):
        place_points(trajectory, at + 10.0, xyz)


def test_ray_caster_agrees_with_every_triangle_by_hand() -> None:
    rng = np.random.default_rng(5)
    corners = rng.uniform(-5, 5, (60, 1, 3)) + rng.normal(0, 1.5, (60, 3, 3))
    mesh = Mesh(
        corners.reshape(-1, 3).astype(np.float32),
        np.arange(180, dtype=np.int32).reshape(-1, 3),
        np.zeros(60, dtype=np.uint8),
    )
    origins = rng.uniform(-2, 2, (400, 3)).astype(np.float32)
    directions = rng.normal(size=(400, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    distance, face, cosine = RayCaster(world_of(mesh)).cast(origins, directions)
    expected, by, facing = nearest_triangle(mesh, origins, directions)
    np.testing.assert_array_equal(face, by)
    met = face >= 0
    assert 100 < met.sum() < 400
    np.testing.assert_allclose(distance[met], expected[met], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(cosine[met], facing[met], atol=1e-4)
    assert np.isinf(distance[~met]).all()


def nearest_triangle(
    mesh: Mesh, origins: np.ndarray, directions: np.ndarray
) -> tuple[Float64s, np.ndarray, Float64s]:
    """Return distance, triangle and |cosine| of what each ray meets first (Moeller, Trumbore)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    o, d = origins[:, None].astype(np.float64), directions[:, None].astype(np.float64)
    p = np.cross(d, c - a)
    det = ((b - a) * p).sum(-1)
    s = o - a
    u = (s * p).sum(-1) / det
    q = np.cross(s, b - a)
    v = (d * q).sum(-1) / det
    t = ((c - a) * q).sum(-1) / det
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
    by = np.where(np.isfinite(t).any(axis=1), t.argmin(axis=1), -1)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return t.min(axis=1), by, np.abs((normal[by] * directions).sum(axis=1))


def test_scans_are_split_by_turn() -> None:
    shell = box([-6.0, -6.0, -6.0], [6.0, 6.0, 6.0], "concrete")
    trajectory = moving((1.0, 0.0, 0.0))
    stamps = turn_stamps(trajectory, VLP16)
    assert len(stamps) == 9 or len(stamps) == 10
    returns = scan_world(
        RayCaster(world_of(shell)), trajectory, VLP16, stamps, rng=np.random.default_rng(1),
        azimuth_decimation=16,
    )  # fmt: skip
    scans = list(split_scans(returns, stamps))
    assert [scan.stamp for scan in scans] == stamps.tolist()
    assert sum(len(scan.xyz) for scan in scans) == len(returns.xyz)
    for scan in scans:
        assert scan.stamp <= scan.time.min() and scan.time.max() < scan.stamp + 0.1
        assert np.all(np.diff(scan.time) > 0)
        assert scan.xyz.dtype == np.float32 and scan.ring.dtype == np.uint16
    # the phase of the decimation changes, so that no direction is left out for good
    angle = [np.arctan2(scan.xyz[0, 1], scan.xyz[0, 0]) for scan in scans]
    assert len(np.unique(np.round(angle, 5))) == len(scans)


def test_brighter_materials_send_back_more() -> None:
    dark = box([5.0, -30.0, -30.0], [6.0, 30.0, 30.0], "asphalt")
    light = box([-6.0, -30.0, -30.0], [-5.0, 30.0, 30.0], "paint")
    returns = scan_world(
        RayCaster(world_of(dark, light)), moving((0, 0, 0)), VLP16, np.array([0.0]),
        rng=np.random.default_rng(0),
    )  # fmt: skip
    ahead = np.abs(returns.xyz[:, 1]) < 1.0
    front, back = ahead & (returns.xyz[:, 0] > 0), ahead & (returns.xyz[:, 0] < 0)
    assert returns.intensity[back].mean() > 3 * returns.intensity[front].mean()
    assert returns.intensity.min() >= 0 and returns.intensity.max() <= 255
    assert len(MATERIALS) == len(set(MATERIALS))


def test_decimation_below_one_is_refused() -> None:
    model: LidarModel = VLP16
    caster = RayCaster(world_of(box([5, 5, 5], [6, 6, 6], "wood")))
    with pytest.raises(InputError, match="azimuth_decimation"):
        scan_world(
            caster, moving((0, 0, 0)), model, np.array([0.0]), rng=np.random.default_rng(0),
            azimuth_decimation=0,
        )  # fmt: skip
