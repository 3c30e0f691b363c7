"""Logs and clouds into octrees, and the command that does it: rays, turns, options, interrupts."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from commonmap import cli
from commonmap.errors import EmptyMapError, InputError
from commonmap.frames import apply, from_xyz_yaw
from commonmap.io.formats import write_map
from commonmap.io.octomap import read_octree, write_octree
from commonmap.io.trajectory import write_trajectory
from commonmap.mapping.octree import Octree, log_odds, octree_from_points, probability
from commonmap.mapping.octree_build import insert_cloud, insert_log
from commonmap.odometry import Odometry, PlaceableTurns, ScanHealth
from commonmap.sim.logs import write_kitti
from commonmap.sim.missions import Area, drive
from commonmap.sim.scanning import RayCaster, scan_world, split_scans, turn_stamps
from commonmap.sim.vlp16 import VLP16
from commonmap.sim.worlds import build_world
from commonmap.types import Cloud, Float64s, Scan, Trajectory
from octree_oracles import room_scan, voxels_of

START = np.array([0.0, 0.0, 1.5])
ALONG_X = [[x + 0.5, 0.5, 0.5] for x in range(5)]
HIT, MISS = log_odds(0.7), log_odds(0.4)


def line(n: int = 4, speed: float = 10.0) -> Trajectory:
    """Return poses every 0.1 s from 0 s on, along x, not turning."""
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = speed * 0.1 * np.arange(n)
    return Trajectory(np.linspace(0.0, 0.1 * (n - 1), n), T)


def scan_of(xyz: object, time: list[float], stamp: float) -> Scan:
    n = len(time)
    return Scan(
        np.asarray(xyz, np.float32).reshape(n, 3), np.array(time), np.arange(n, dtype=np.uint16),
        np.ones(n, np.float32), stamp,
    )  # fmt: skip


def known(trajectory: Trajectory) -> Odometry:
    return Odometry("poses", trajectory, ())


def room_log(n: int, speed: float = 0.5) -> tuple[list[Scan], Trajectory]:
    """Return turns of a sensor in a room that goes along x between turns, and its poses."""
    rng = np.random.default_rng(4)
    scans, T = [], np.tile(np.eye(4), (n + 1, 1, 1))
    share = np.tile(np.arange(300) / 300, 16)
    for k in range(n):
        origin = START + np.array([speed * 0.1 * k, 0, 0])
        ray = room_scan(origin, rng) - origin
        kept = np.linalg.norm(ray, axis=1) < 30
        scans.append(
            Scan(
                ray[kept].astype(np.float32), 100.0 + 0.1 * (k + share[kept]),
                np.repeat(np.arange(16), 300)[kept].astype(np.uint16),
                np.ones(int(kept.sum()), np.float32), 100.0 + 0.1 * k,
            )
        )  # fmt: skip
    T[:, :3, 3] = START + np.outer(0.1 * speed * np.arange(n + 1), [1, 0, 0])
    return scans, Trajectory(np.linspace(100.0, 100.0 + 0.1 * n, n + 1), T)


def test_each_ray_begins_where_the_sensor_was_at_its_moment() -> None:
    # 10 m/s: a point 2 m to the left at 0.05 s is seen from x = 0.5, one at 0.15 s from x = 1.5
    scans = [
        scan_of([[0, 2, 0]], [0.05], 0.0),
        scan_of([[0, 2, 0], [0, 2, 0]], [0.15, 0.25], 0.1),
    ]
    tree = Octree(1.0)
    told: list[tuple[str, float]] = []
    left_out = insert_log(
        scans, tree, known(line()), shift=np.array([-10.0, -0.5, -0.5]), n_scans=2,
        progress=lambda step, share=0.0: told.append((step, share)),
    )  # fmt: skip
    assert left_out == 0
    got = {k: float(v) for k, v in voxels_of(tree.leaves()).items()}
    assert got == {
        (32778 + x, 32768 + y, 32768): float(HIT if y == 2 else MISS)
        for x in range(3)
        for y in range(3)
    }
    assert [share for _, share in told] == [0.0, 0.5, 1.0]


def test_turns_at_no_known_pose_are_left_out() -> None:
    scans = [scan_of([[0, 2, 0]], [0.1 * k + 0.05], 0.1 * k) for k in range(4)]
    scans.append(scan_of([[0, 2, 0]], [7.0], 7.0))
    health = [ScanHealth(0.1 * k, 100, 1.0, 0.01, np.zeros((0, 6)), k == 1) for k in range(4)]
    tree = Octree(1.0)
    assert insert_log(scans, tree, Odometry("loam", line(), tuple(health))) == 2
    assert sorted(tree.occupied_centres()[:, 0].tolist()) == [0.5, 2.5, 3.5]
    with pytest.raises(EmptyMapError, match="none of 1 turns"):
        insert_log(scans[4:], Octree(1.0), known(line()))


def test_only_the_longest_part_that_holds_together_is_mapped() -> None:
    scans = [scan_of([[0, 2, 0]], [0.1 * k + 0.05], 0.1 * k) for k in range(14)]
    lost = [*[False] * 3, *[True] * 6, *[False] * 5]  # lost for long: how both parts lie is a guess
    health = [
        ScanHealth(0.1 * k, 100, 1.0, 0.01, np.zeros((0, 6)), gone) for k, gone in enumerate(lost)
    ]
    tree = Octree(1.0)
    odometry = Odometry("loam", line(14), tuple(health))
    assert insert_log(scans, tree, odometry) == 9
    assert sorted(tree.occupied_centres()[:, 0].tolist()) == [9.5, 10.5, 11.5, 12.5, 13.5]
    turns = PlaceableTurns(odometry, scans, every=2)
    assert [scan.stamp for scan in turns] == pytest.approx([1.0, 1.2])
    assert (turns.n, turns.n_left_out, turns.n_apart, turns.sound) == (14, 9, 3, range(9, 14))


def test_a_cloud_without_origins_gives_ends_alone() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (500, 3))
    xyz[3] = np.nan
    tree = Octree(0.25)
    assert not insert_cloud(Cloud(xyz), tree)
    assert voxels_of(tree.leaves()) == voxels_of(octree_from_points(xyz, 0.25))
    with pytest.raises(InputError, match="max_range needs"):
        insert_cloud(Cloud(xyz), Octree(0.25), max_range=3.0)
    with pytest.raises(EmptyMapError, match="finite"):
        insert_cloud(Cloud(xyz[3:4]), Octree(0.25))


@pytest.mark.parametrize("how", ["origin", "own", "poses"])
def test_the_rays_of_a_cloud(how: str) -> None:
    # two points of one turn on one ray: the hit of the nearer stands; 0.2 s later it is freed
    xyz = np.array([[2.5, 0.5, 0.5], [4.5, 0.5, 0.5], [np.nan, 0, 0], [4.5, 0.5, 0.5]])
    time = np.array([0.0, 0.01, 0.02, 0.2])
    start = np.array([0.5, 0.5, 0.5])
    poses = line(4, speed=0.0)
    poses.T_map_sensor[:, :3, 3] = start
    tree = Octree(1.0)
    if how == "origin":
        assert insert_cloud(Cloud(xyz, time=time), tree, origin=start)
    elif how == "own":
        own = np.tile(start, (4, 1)).astype(np.float32)
        assert insert_cloud(Cloud(xyz, time=time, origin=own), tree)
    else:
        assert insert_cloud(Cloud(xyz, time=time), tree, poses=poses)
    low, high = np.float32(MISS + MISS), np.float32(HIT + HIT)
    expected = [low, low, HIT + MISS, low, high]
    assert np.allclose(tree.log_odds_at(ALONG_X), expected, atol=1e-6)


def test_points_without_times_are_one_scan() -> None:
    xyz = np.array([[2.5, 0.5, 0.5], [4.5, 0.5, 0.5]])
    tree = Octree(1.0)
    insert_cloud(Cloud(xyz), tree, origin=(0.5, 0.5, 0.5), max_range=3.0)
    values = tree.log_odds_at(ALONG_X)
    assert values[:3].tolist() == [MISS, MISS, HIT] and np.isnan(values[3:]).all()


def test_poses_that_tell_no_rays_are_refused() -> None:
    xyz = np.zeros((2, 3))
    with pytest.raises(InputError, match="have none"):
        insert_cloud(Cloud(xyz), Octree(1.0), poses=line())
    with pytest.raises(InputError, match="must cover"):
        insert_cloud(Cloud(xyz, time=np.array([0.0, 9.0])), Octree(1.0), poses=line())
    with pytest.raises(InputError, match="one of them"):
        insert_cloud(Cloud(xyz), Octree(1.0), poses=line(), origin=(0, 0, 0))
    with pytest.raises(InputError, match="x, y, z"):
        insert_cloud(Cloud(xyz), Octree(1.0), origin=(0, np.nan, 0))


def test_probabilities_and_log_odds_belong_together() -> None:
    assert probability(0.0) == 0.5
    assert log_odds(probability(-2.0)) == np.float32(-2.0)


# The command


def pose_near(sensor: Trajectory, time: float) -> Float64s:
    """Return the pose of the sensor that is nearest in time."""
    pose: Float64s = sensor.T_map_sensor[np.argmin(np.abs(sensor.time - time))]
    return pose


def call(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["commonmap", "octree", *map(str, words)])
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as caught:
            cli.main()
    finally:
        signal.signal(signal.SIGTERM, before)
    return int(caught.value.code or 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a log, its poses and a cloud."""
    folder = tmp_path_factory.mktemp("log")
    scans, poses = room_log(12)
    write_kitti(folder / "log", scans)
    write_trajectory(folder / "poses.tum", poses)
    write_map(folder / "cloud.ply", Cloud(scans[0].xyz.astype(np.float64) + START))
    return folder


def test_a_log_with_poses_becomes_the_octree_of_its_turns(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    common = (folder / "log", "--poses", folder / "poses.tum", "--resolution", 0.2)
    out = tmp_path / "map.ot"
    options = ("--max-range", 10, "--l-occ", 0.85, "--l-free", -0.4, "--l-min", -2, "--l-max", 3.5)
    assert call(monkeypatch, *common, *options, "-o", out) == 0
    told = capsys.readouterr()
    assert "12 of 12 turns" in told.out and "insert the turns" in told.err
    scans, poses = room_log(12)
    tree = Octree(
        0.2, hit=probability(0.85), miss=probability(-0.4), clamp_min=probability(-2.0),
        clamp_max=probability(3.5),
    )  # fmt: skip
    insert_log(scans, tree, known(poses), max_range=10.0)
    write_octree(tmp_path / "expected.ot", tree.leaves())
    assert out.read_bytes() == (tmp_path / "expected.ot").read_bytes()
    assert read_octree(out).log_odds.min() == np.float32(-2.0)
    # unpruned, on two threads, and silent
    assert call(monkeypatch, *common, *options, "-o", out, "--lazy", "--threads", 2, "-q") == 0
    write_octree(tmp_path / "expected.ot", tree.leaves(pruned=False))
    assert out.read_bytes() == (tmp_path / "expected.ot").read_bytes()
    told = capsys.readouterr()
    assert told.out == told.err == ""
    # one ray a voxel
    assert call(monkeypatch, *common, *options, "-o", out, "--discretize", "-q") == 0
    few = Octree(
        0.2, hit=probability(0.85), miss=probability(-0.4), clamp_min=probability(-2.0),
        clamp_max=probability(3.5),
    )  # fmt: skip
    insert_log(scans, few, known(poses), max_range=10.0, discretize=True)
    write_octree(tmp_path / "expected.ot", few.leaves())
    assert out.read_bytes() == (tmp_path / "expected.ot").read_bytes()
    assert few.count_nodes() != tree.count_nodes()


def test_a_log_without_poses_is_mapped_by_odometry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(2)
    world = build_world("paper", rng)
    mission = drive(world, Area(0.0, 0.0, 30.0, 30.0), rng, max_length=20.0)
    stamps = turn_stamps(mission.sensor, VLP16)[:20]
    seen = scan_world(RayCaster(world), mission.sensor, VLP16, stamps, rng=rng)
    write_kitti(tmp_path / "log", split_scans(seen, stamps))
    write_trajectory(tmp_path / "true.tum", mission.sensor)
    common = (tmp_path / "log", "--resolution", 0.2, "--max-range", 30, "-q", "-o")
    assert call(monkeypatch, *common, tmp_path / "map.bt") == 0
    assert call(monkeypatch, *common, tmp_path / "true.bt", "--poses", tmp_path / "true.tum") == 0
    ours, true = read_octree(tmp_path / "map.bt"), read_octree(tmp_path / "true.bt")
    # the frame of odometry is level and begins where the lidar was: its place and yaw there
    first = pose_near(mission.sensor, float(np.mean(stamps[0] + np.array([0.0, 0.1]))))
    yaw = float(np.arctan2(first[1, 0], first[0, 0]))
    placed = apply(
        from_xyz_yaw(first[0, 3], first[1, 3], first[2, 3], yaw), ours.centres()[ours.occupied]
    )
    off = cKDTree(true.centres()[true.occupied]).query(placed)[0]
    assert (off < 0.4).mean() > 0.9
    assert ours.occupied.sum() > 1000 and (~ours.occupied).sum() > 1000


def test_a_cloud_is_ends_alone_or_rays_from_one_place(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    common = (folder / "cloud.ply", "--resolution", 0.2, "-o", tmp_path / "map.ot")
    assert call(monkeypatch, *common) == 0
    assert "nothing is free" in capsys.readouterr().out
    assert read_octree(tmp_path / "map.ot").occupied.all()
    assert call(monkeypatch, *common, "--origin", 0, 0, 1.5) == 0
    assert "nothing is free" not in capsys.readouterr().out
    leaves = read_octree(tmp_path / "map.ot")
    assert (~leaves.occupied).sum() > 1000


def test_a_cloud_in_large_coordinates_gets_a_moved_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    xyz = np.array([[512_345.05, 4_912_345.05, 100.05], [512_355.05, 4_912_345.05, 100.05]])
    write_map(tmp_path / "utm.laz", Cloud(xyz))
    assert call(monkeypatch, tmp_path / "utm.laz", "-o", tmp_path / "map.ot") == 0
    assert "moved to [512400.0, 4912300.0, 0.0]" in capsys.readouterr().out
    leaves = read_octree(tmp_path / "map.ot")
    assert np.allclose(sorted(leaves.centres()[:, 0]), [-54.95, -44.95], atol=0.06)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["log", "-o", "map.laz"], ".ot or .bt"),
        (["none.pcap", "-o", "map.ot"], "there is no file"),
        (["log", "-o", "map.ot", "--resolution", "0"], "resolution"),
        (["log", "-o", "map.ot", "--l-free", "0.4"], "--l-free"),
        (["log", "-o", "map.ot", "--l-occ", "nan"], "--l-occ"),
        (["log", "-o", "map.ot", "--max-range", "-1"], "--max-range"),
        (["log", "-o", "map.ot", "--origin", "0", "0", "0"], "--origin"),
        (["log", "-o", "map.ot", "--threads", "0"], "threads"),
        (["cloud.ply", "-o", "map.ot", "--topic", "a"], "--topic"),
        (["cloud.ply", "-o", "map.ot", "--poses", "poses.tum"], "have none"),
        (["cloud.ply", "-o", "map.ot", "--max-range", "9"], "max_range needs"),
        (["cloud.ply", "-o", "map.ot", "--discretize"], "discretize needs"),
        (["cloud.ply", "-o", "map.ot", "--deskewed"], "--deskewed"),
        (
            ["cloud.ply", "-o", "map.ot", "--origin", "0", "0", "9000", "--max-range", "9"],
            "none does",
        ),
        (["map.bt", "-o", "map.ot"], "octree already"),
        (["log", "-o", "nowhere/map.ot"], "nowhere"),
    ],
)
def test_a_fault_is_told_in_one_line_and_nothing_is_written(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str], words: list[str], said: str,
) -> None:  # fmt: skip
    write_octree(folder / "map.bt", octree_from_points(np.zeros((1, 3)), 0.1))
    monkeypatch.chdir(tmp_path)
    inputs = ("log", "cloud.ply", "poses.tum", "map.bt")
    placed = [str(folder / word) if word in inputs else word for word in words]
    assert call(monkeypatch, *placed, "-q") == 2
    told = capsys.readouterr()
    assert told.out == "" and said in told.err and len(told.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_leaves_the_older_file_as_it_was(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.ot"
    out.write_bytes(b"older")
    listening = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from commonmap.cli import main; main()"
    )
    words = ["octree", folder / "log", "--poses", folder / "poses.tum", "--resolution", 0.01]
    command = [sys.executable, "-c", listening, *map(str, words), "-o", str(out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for told in process.stderr:
        if "insert the turns" in told:
            break
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "interrupted; nothing was written" in err
    assert out.read_bytes() == b"older" and list(tmp_path.iterdir()) == [out]
