"""Trajectories in TUM format and folders of scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from commonmap.errors import InputError, OutputError
from commonmap.io import describe, iter_scans, read_trajectory, write_scans, write_trajectory
from commonmap.types import Scan, Trajectory


def test_a_trajectory_literally(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_text(
        "# timestamp x y z qx qy qz qw\n1700000000.25 470600.5 2 3 0 0 0.7071067811865476 "
        "0.7071067811865476\n\n1700000000.35 1 2 3 0 0 0 1\n"
    )
    trajectory = read_trajectory(path)
    assert trajectory.time.tolist() == [1700000000.25, 1700000000.35]
    quarter = np.array(
        [[0, -1, 0, 470600.5], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    )  # x turns to y
    np.testing.assert_allclose(trajectory.T_map_sensor[0], quarter, atol=1e-15)
    np.testing.assert_array_equal(trajectory.T_map_sensor[1][:3, :3], np.eye(3))


def test_a_trajectory_comes_back(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, :3] = Rotation.random(40, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(size=(40, 3)) * 1e5
    time = np.cumsum(rng.uniform(0.01, 0.1, 40)) + 1.7e9
    write_trajectory(tmp_path / "poses.txt", Trajectory(time=time, T_map_sensor=T))
    back = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_array_equal(back.time, time)
    np.testing.assert_array_equal(back.T_map_sensor[:, :3, 3], T[:, :3, 3])
    np.testing.assert_allclose(back.T_map_sensor, T, rtol=0, atol=1e-14)


GOOD = "1 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "2 0 0 0 0 0 1\n", "line 2: a pose is 8 numbers .* 7 came"),
        (GOOD + "# x\n2 0 0 0 0 0 0 one\n", "line 3: numbers were expected"),
        (GOOD + "2 0 0 nan 0 0 0 1\n", "line 2: a number is not finite"),
        (GOOD + "1 0 0 0 0 0 0 1\n", "line 2: time does not rise"),
        (GOOD + "2 0 0 0 0 0 0 1.1\n", "line 2: the quaternion is not of length 1"),
        (GOOD + "2 0 0 0 0 0 0 0\n", "line 2: the quaternion is not of length 1"),
        ("# nothing\n", "holds no poses"),
    ],
)
def test_trajectories_that_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "poses.tum"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_trajectory(path)


def test_bytes_are_no_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_bytes(b"LASF" + bytes(300))
    with pytest.raises(InputError, match="look like LAS/LAZ"):
        read_trajectory(path)
    path.write_bytes(GOOD.encode() + b"\xff\xfe\n")
    with pytest.raises(InputError, match="cannot be read as a TUM trajectory"):
        read_trajectory(path)


@pytest.mark.parametrize(
    ("time", "T"),
    [
        (np.array([1.0]), np.zeros((2, 4, 4))),
        (np.array([]), np.zeros((0, 4, 4))),
        (np.array([2.0, 1.0]), np.tile(np.eye(4), (2, 1, 1))),
        (np.array([1.0]), np.full((1, 4, 4), np.nan)),
    ],
)
def test_trajectories_that_are_not_written(tmp_path: Path, time: np.ndarray, T: np.ndarray) -> None:
    with pytest.raises(InputError):
        write_trajectory(tmp_path / "poses.tum", Trajectory(time=time, T_map_sensor=T))
    assert list(tmp_path.iterdir()) == []


# --- scans ------------------------------------------------------------------------------------


def some_scans(n: int = 3) -> list[Scan]:
    rng = np.random.default_rng(0)
    scans = []
    for index in range(n):
        n_points = 10 * index + 5
        stamp = 1.7e9 + 0.1 * index
        scans.append(
            Scan(
                xyz=rng.normal(size=(n_points, 3)).astype(np.float32),
                time=stamp + np.sort(rng.uniform(0, 0.1, n_points)),
                ring=rng.integers(0, 16, n_points).astype(np.uint16),
                intensity=rng.uniform(0, 255, n_points).astype(np.float32),
                stamp=stamp,
            )
        )
    return scans


def test_scans_come_back_exactly(tmp_path: Path) -> None:
    scans = some_scans()
    assert write_scans(tmp_path / "log", iter(scans)) == 3
    back = list(iter_scans(tmp_path / "log"))
    assert len(back) == 3
    for want, got in zip(scans, back, strict=True):
        assert got.stamp == want.stamp
        for name in ("xyz", "time", "ring", "intensity"):
            assert getattr(got, name).dtype == getattr(want, name).dtype
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


def test_the_layout_is_that_of_kitti(tmp_path: Path) -> None:
    scans = some_scans()
    write_scans(tmp_path / "log", scans)
    points = np.fromfile(tmp_path / "log" / "velodyne" / "000001.bin", dtype="<f4").reshape(-1, 4)
    np.testing.assert_array_equal(points[:, :3], scans[1].xyz)
    np.testing.assert_array_equal(points[:, 3], scans[1].intensity)
    times = (tmp_path / "log" / "times.txt").read_text().split()
    assert [float(word) for word in times] == [scan.stamp for scan in scans]
    assert describe(tmp_path / "log") | {"bytes": 0} == {
        "path": str(tmp_path / "log"),
        "kind": "scans",
        "format": "KITTI folder (velodyne, time, ring)",
        "bytes": 0,
        "scans": 3,
        "points_first": 5,
        "rings": len(set(scans[0].ring.tolist())),
        "time_span": [1.7e9, 1.7e9 + 0.2],
    }


def test_points_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    scan = some_scans(1)[0]
    scan.xyz[2] = np.nan
    scan.time[4] = np.nan
    write_scans(tmp_path / "log", [scan])
    (back,) = iter_scans(tmp_path / "log")
    np.testing.assert_array_equal(back.xyz, np.delete(scan.xyz, [2, 4], axis=0))
    np.testing.assert_array_equal(back.ring, np.delete(scan.ring, [2, 4]))


def test_a_fault_within_the_scans_leaves_nothing(tmp_path: Path) -> None:
    first, second, _ = some_scans()
    with pytest.raises(InputError, match="the stamp of scan 1 does not rise"):
        write_scans(tmp_path / "log", [second, first])
    with pytest.raises(InputError, match="there are no scans"):
        write_scans(tmp_path / "log", [])
    assert list(tmp_path.iterdir()) == []
    write_scans(tmp_path / "log", [first])
    write_scans(tmp_path / "log", [first, second])  # an earlier log is replaced
    assert len(list(iter_scans(tmp_path / "log"))) == 2
    (tmp_path / "log" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"already holds other files \(notes.txt\)"):
        write_scans(tmp_path / "log", [first])


def test_folders_that_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder"):
        iter_scans(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"it has no times\.txt"):
        iter_scans(tmp_path)
    log = tmp_path / "log"
    write_scans(log, some_scans())
    (log / "ring" / "000002.npy").unlink()
    with pytest.raises(InputError, match=r"ring/000002\.npy is missing"):
        iter_scans(log)
    np.save(log / "ring" / "000002.npy", np.zeros(7, dtype=np.uint16))
    scans = iter_scans(log)
    next(scans), next(scans)
    with pytest.raises(InputError, match="must hold 25 values of uint16"):
        next(scans)
    data = (log / "velodyne" / "000000.bin").read_bytes()
    (log / "velodyne" / "000000.bin").write_bytes(data[:-3])
    with pytest.raises(InputError, match="truncated: it has 77 bytes, not a multiple of 16"):
        next(iter_scans(log))
    (log / "times.txt").write_text("2\n1\n3\n")
    with pytest.raises(InputError, match="rising times"):
        iter_scans(log)
