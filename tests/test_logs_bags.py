"""ROS bags written with rosbags, folders, poses: round trips, topics, truncation."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from commonmap.errors import CommonmapError, InputError, MissingExtraError
from commonmap.frames import from_xyz_yaw, invert
from commonmap.io import describe, write_trajectory
from commonmap.io.logs import LOGS, find_log, iter_scans, open_log, read_poses
from commonmap.io.logs.derive import find_seam
from commonmap.sim.logs import LAYOUTS, write_kitti, write_mcap, write_pcap
from commonmap.types import Cloud, Float64s, Scan, Trajectory
from lidar_scans import vlp16_scans
from log_files import (
    clouds,
    header,
    ros2_store,
    velodyne_scan,
    write_bag1,
    write_bag2,
    write_mcap_zstd,
    write_sqlite,
)

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
SCANS = vlp16_scans(4, every=6)


def assert_same(got: Scan, wanted: Scan, *, time: float = 5e-7) -> None:
    """Assert that points, channels and intensities are exact, and times within `time` seconds."""
    np.testing.assert_array_equal(got.xyz, wanted.xyz)
    np.testing.assert_array_equal(got.ring, wanted.ring)
    np.testing.assert_array_equal(got.intensity, wanted.intensity)
    np.testing.assert_allclose(got.time, wanted.time, rtol=0, atol=time)
    assert got.stamp == (wanted.stamp if time == 0.0 else got.time.min())


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "xyz"])
@pytest.mark.parametrize("name", ["log.mcap", "bag"])
def test_simulated_bags_come_back(tmp_path: Path, layout: str, name: str) -> None:
    path = tmp_path / name
    assert write_mcap(path, SCANS, layout=layout) == 4
    record = open_log(path)
    assert (record.kind, record.topic, record.n_scans) == ("ROS 2 bag", "/points", 4)
    assert record.time_span == pytest.approx((1_700_000_000.1, 1_700_000_000.4))
    for got, wanted in zip(iter_scans(path), SCANS, strict=True):
        assert_same(got, wanted)


def test_points_alone_come_back_with_what_geometry_tells(tmp_path: Path) -> None:
    full = vlp16_scans(2)
    write_mcap(tmp_path / "a.mcap", full, layout="xyz")
    for got, wanted in zip(iter_scans(tmp_path / "a.mcap"), full, strict=True):
        np.testing.assert_array_equal(got.xyz, wanted.xyz)
        np.testing.assert_array_equal(got.ring, wanted.ring)
        np.testing.assert_allclose(got.time, wanted.time, atol=1e-4)


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_ros1_bags(tmp_path: Path, compression: str | None) -> None:
    write_bag1(tmp_path / "a.bag", SCANS, compression=compression)
    assert open_log(tmp_path / "a.bag").kind == "ROS 1 bag"
    for got, wanted in zip(iter_scans(tmp_path / "a.bag"), SCANS, strict=True):
        assert_same(got, wanted)


def test_ros2_bags_of_other_kinds(tmp_path: Path) -> None:
    write_sqlite(tmp_path / "a.db3", SCANS)
    write_mcap_zstd(tmp_path / "b.mcap", SCANS)
    for name in ("a.db3", "b.mcap"):
        for got, wanted in zip(iter_scans(tmp_path / name), SCANS, strict=True):
            assert_same(got, wanted)


def test_raw_packets_in_bags(tmp_path: Path) -> None:
    scans = vlp16_scans(2, every=4)
    write_bag1(tmp_path / "a.bag", scans, packets=True)
    store = ros2_store()
    kind = "velodyne_msgs/msg/VelodyneScan"
    messages = [
        ("/velodyne_packets", kind, round((s.stamp + 0.1) * 1e9), velodyne_scan(store, s))
        for s in scans
    ]
    bag = write_bag2(tmp_path / "b", messages)
    write_pcap(tmp_path / "c.pcap", scans)
    wanted = list(iter_scans(tmp_path / "c.pcap"))
    for path in (tmp_path / "a.bag", bag, bag.parent):
        for got, scan in zip(iter_scans(path), wanted, strict=True):
            np.testing.assert_array_equal(got.xyz, scan.xyz)
            np.testing.assert_array_equal(got.time, scan.time)


def test_topics_are_chosen_or_named(tmp_path: Path) -> None:
    write_bag1(tmp_path / "a.bag", SCANS[:1], topics=("/front", "/rear"))
    path = tmp_path / "a.bag"
    with pytest.raises(InputError, match=r"several topics .*give topic \(--topic\): it has /front"):
        iter_scans(path)
    assert len(list(iter_scans(path, topic="/rear"))) == 1
    assert len(list(iter_scans(path, topic="rear"))) == 1
    with pytest.raises(InputError, match=r"has no topic /top; it has /front .*, /rear"):
        iter_scans(path, topic="/top")
    assert open_log(path).topic is None
    write_mcap(tmp_path / "b.mcap", SCANS[:1], poses=drive())
    with pytest.raises(InputError, match=r"/odom holds nav_msgs/msg/Odometry, no scans"):
        iter_scans(tmp_path / "b.mcap", topic="/odom")
    assert open_log(tmp_path / "b.mcap").poses == ("/odom",)
    only = write_bag2(tmp_path / "c", [("/tf", *tf_messages(drive(), "odom", "lidar")[0][1:])])
    with pytest.raises(InputError, match=r"no topic with scans; it has /tf \(tf2_msgs"):
        iter_scans(only)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_truncated_bags(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / name
    many = vlp16_scans(60, every=6)
    write_bag1(path, many) if name == "a.bag" else write_mcap(path, many)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * 0.7)])
    with pytest.raises(InputError, match=r"cannot be opened as a ROS bag .*truncated or damaged"):
        iter_scans(path)
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        back = list(iter_scans(path, keep_partial=True))
    assert 10 < len(back) < 60 and "damaged after" in caplog.text
    for got, wanted in zip(back, many, strict=False):
        assert_same(got, wanted)


def test_a_bag_damaged_in_its_middle(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    write_bag1(path, vlp16_scans(60, every=6), compression="BZ2")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 50] = b"\0" * 50
    path.write_bytes(data)
    with pytest.raises(InputError, match="cannot be read as a ROS bag"):
        list(iter_scans(path))
    assert len(list(iter_scans(path, keep_partial=True))) > 5


def test_wrong_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file or folder"):
        iter_scans(tmp_path / "none.bag")
    (tmp_path / "a.bag").write_bytes(b"\x89PNG" + b"\0" * 50)
    with pytest.raises(InputError, match=r"a.bag should be a ROS bag, but .* look like PNG"):
        iter_scans(tmp_path / "a.bag")
    (tmp_path / "a.txt").write_bytes(b"hello")
    with pytest.raises(InputError, match=r"is no log: it begins with the text 'hello'; a log is"):
        iter_scans(tmp_path / "a.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no scans; a log is"):
        iter_scans(tmp_path / "empty")
    assert find_log(tmp_path / "a.txt") is None


def test_progress_rises(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", SCANS)
    write_pcap(tmp_path / "a.pcap", SCANS)
    write_kitti(tmp_path / "k", SCANS)
    for name in ("a.mcap", "a.pcap", "k"):
        shares: list[float] = []

        def note(step: str, share: float = 0.0, shares: list[float] = shares) -> None:
            assert step.startswith("reading ")
            shares.append(share)

        list(iter_scans(tmp_path / name, progress=note))
        assert shares == sorted(shares) and shares[0] >= 0 and 0.5 < shares[-1] <= 1


def test_the_table_says_what_it_needs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert list(LOGS) == ["pcap", "ros1", "ros2", "scans", "files"]
    assert all(row.available() is None for row in LOGS.values())
    write_mcap(tmp_path / "a.mcap", SCANS[:1])
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert LOGS["ros1"].available() == "ros1 needs rosbags: pip install rosbags"
    with pytest.raises(MissingExtraError, match="pip install rosbags"):
        iter_scans(tmp_path / "a.mcap")


def test_info_of_logs(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", SCANS, poses=drive())
    write_pcap(tmp_path / "a.pcap", SCANS)
    values = describe(tmp_path / "a.mcap")
    assert values["kind"] == "scans" and values["scans"] == 4 and values["rings"] == 16
    assert values["topic"] == "/points" and values["poses"] == ["/odom"]
    values = describe(tmp_path / "a.pcap")
    assert values["scans"] == 4 and values["topic"] == "192.168.1.201:2368"
    assert values["time_span"] == pytest.approx([1_700_000_000.0, 1_700_000_000.4], abs=0.01)


# folders


def test_own_folders_come_back_exactly(tmp_path: Path) -> None:
    write_kitti(tmp_path / "k", SCANS)
    for got, wanted in zip(iter_scans(tmp_path / "k"), SCANS, strict=True):
        assert_same(got, wanted, time=0.0)
    with pytest.raises(InputError, match="it has no topics"):
        iter_scans(tmp_path / "k", topic="/points")


def test_bare_folders_of_every_kind(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    from commonmap.io import write_cloud

    full = vlp16_scans(2, start=5.0)
    for kind in (".bin", ".pcd", ".ply"):
        folder = tmp_path / kind[1:] / "velodyne"
        folder.mkdir(parents=True)
        for i, scan in enumerate(full):
            if kind == ".bin":
                np.column_stack([scan.xyz, scan.intensity]).astype("<f4").tofile(
                    folder / f"{i:06d}.bin"
                )
            else:
                cloud = Cloud(scan.xyz.astype(np.float64), intensity=scan.intensity)
                write_cloud(folder / f"{i:06d}{kind}", cloud)
        (folder.parent / "times.txt").write_text("5.0\n5.1\n")
        for path in (folder, folder.parent):
            for got, wanted in zip(iter_scans(path), full, strict=True):
                np.testing.assert_array_equal(got.xyz, wanted.xyz)
                np.testing.assert_array_equal(got.ring, wanted.ring)
                np.testing.assert_array_equal(got.intensity, wanted.intensity)
                np.testing.assert_allclose(got.time, wanted.time, atol=1e-4)
        (still, _) = iter_scans(folder, deskewed=True)
        assert set(still.time.tolist()) == {5.0}
    assert "have no time" in caplog.text
    (folder.parent / "times.txt").write_text("5.0\n")
    with pytest.raises(InputError, match="1 times for 2 scans"):
        iter_scans(folder)


def test_a_scan_cut_short_is_left_out_if_asked(tmp_path: Path) -> None:
    for i, scan in enumerate(SCANS):
        np.column_stack([scan.xyz, scan.intensity]).astype("<f4").tofile(tmp_path / f"{i}.bin")
    (tmp_path / "2.bin").write_bytes(b"\0" * 17)
    with pytest.raises(InputError, match=r"2.bin is truncated: it has 17 bytes"):
        list(iter_scans(tmp_path))
    assert len(list(iter_scans(tmp_path, keep_partial=True))) == 3


def test_file_names_that_are_times(tmp_path: Path) -> None:
    for scan, name in zip(SCANS, ("1700000000.00", "1700000000.10"), strict=False):
        np.column_stack([scan.xyz, scan.intensity]).astype("<f4").tofile(tmp_path / f"{name}.bin")
    stamps = [scan.stamp for scan in iter_scans(tmp_path, deskewed=True)]
    assert stamps == pytest.approx([1_700_000_000.0, 1_700_000_000.1], abs=1e-6)


@pytest.mark.skipif(not (SHARED / "lidar-log").is_dir(), reason="no shared data beside the project")
def test_real_scans_of_64_beams() -> None:
    scans = iter_scans(SHARED / "lidar-log" / "scans", deskewed=False)
    for scan, _ in zip(scans, range(3), strict=False):
        assert 120_000 < len(scan.xyz) < 125_000
        assert len(np.unique(scan.ring)) == 64
        assert 0.0999 < np.ptp(scan.time) <= 0.1
        elevation = np.arctan2(scan.xyz[:, 2], np.hypot(scan.xyz[:, 0], scan.xyz[:, 1]))
        middle = [np.median(elevation[scan.ring == k]) for k in range(64)]
        assert (np.diff(middle) > 0).all()
        assert np.degrees(middle[0]) == pytest.approx(-23.7, abs=0.5)
        # within a channel, time follows the order of the file
        follows = [np.mean(np.diff(scan.time[scan.ring == k]) >= 0) for k in range(64)]
        assert min(follows) > 0.98


@pytest.mark.skipif(not (SHARED / "lidar-log").is_dir(), reason="no shared data beside the project")
def test_real_scans_are_found_to_be_deskewed(caplog: pytest.LogCaptureFixture) -> None:
    scan = next(iter_scans(SHARED / "lidar-log" / "scans"))
    assert set(scan.time.tolist()) == {0.0}
    assert "moved to one moment (the scans break at" in caplog.text


def on_flat_ground(step: float, *, deskewed: bool) -> Scan:
    """Return a turn of 32 channels over a plane 1.7 m below, moving `step` m along x in it."""
    share = np.tile(np.arange(1800) / 1800, 32)
    ring = np.repeat(np.arange(32), 1800).astype(np.uint16)
    down = np.radians(np.linspace(25.0, 5.0, 32))[ring]
    azimuth = np.pi - 2 * np.pi * share
    reach = 1.7 / np.tan(down)
    xyz = np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), -1.7 + 0 * reach])
    if deskewed:
        xyz[:, 0] += step * (share - 0.5)
    n = len(ring)
    return Scan(xyz.astype(np.float32), share, ring, np.ones(n, np.float32), 0.0)


def test_a_seam_is_found_only_where_points_were_moved() -> None:
    moved = on_flat_ground(0.8, deskewed=True)
    seam = find_seam(moved.xyz, moved.ring)
    assert seam is not None
    assert abs(np.degrees(seam.azimuth)) == pytest.approx(180.0, abs=1.0)
    assert abs(seam.jump) == pytest.approx(0.8, abs=0.05)
    for scan in (on_flat_ground(0.8, deskewed=False), on_flat_ground(0.05, deskewed=True)):
        assert find_seam(scan.xyz, scan.ring) is None


# poses


def drive() -> Trajectory:
    """Return a turning, climbing drive: 11 poses over the time of the scans."""
    time = 1_700_000_000.0 + np.linspace(0.0, 0.5, 11)
    T = np.array([from_xyz_yaw(10 * s, 2 * s * s, 0.5 * s, 0.8 * s) for s in np.linspace(0, 1, 11)])
    return Trajectory(time, T)


def transform(store: Any, parent: str, child: str, time: float, T: Float64s) -> Any:
    t, q = T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat()
    types = store.types
    return types["geometry_msgs/msg/TransformStamped"](
        header=header(store, round(time * 1e9), parent), child_frame_id=child,
        transform=types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](*map(float, t)),
            rotation=types["geometry_msgs/msg/Quaternion"](*map(float, q)),
        ),
    )  # fmt: skip


def tf_messages(
    poses: Trajectory, parent: str, child: str, topic: str = "/tf"
) -> list[tuple[str, str, int, Any]]:
    store = ros2_store()
    kind = "tf2_msgs/msg/TFMessage"
    return [
        (topic, kind, round(time * 1e9),
         store.types[kind](transforms=[transform(store, parent, child, time, T)]))
        for time, T in zip(poses.time.tolist(), poses.T_map_sensor, strict=True)
    ]  # fmt: skip


def assert_poses(got: Trajectory, time: NDArray[np.float64], T: Float64s) -> None:
    np.testing.assert_allclose(got.time, time, atol=1e-6)
    np.testing.assert_allclose(got.T_map_sensor, T, atol=1e-9)


def test_odometry_of_the_lidar(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", SCANS, poses=drive())
    assert_poses(read_poses(tmp_path / "a.mcap"), drive().time, drive().T_map_sensor)


def test_tf_through_a_moving_and_a_still_frame(tmp_path: Path) -> None:
    T_base_lidar = from_xyz_yaw(0.2, -0.1, 0.9, np.pi / 2)
    base = Trajectory(drive().time, drive().T_map_sensor @ invert(T_base_lidar))
    still = Trajectory(drive().time[:1], T_base_lidar[None])
    T_map_odom = from_xyz_yaw(100.0, 50.0, 0.0, 1.0)
    fixed = Trajectory(drive().time[[0, -1]], np.array([T_map_odom] * 2))
    messages = [
        *tf_messages(still, "base_link", "lidar", "/tf_static"),
        *tf_messages(base, "odom", "base_link"),
        *tf_messages(fixed, "map", "odom"),
        *clouds(SCANS),
    ]
    bag = write_bag2(tmp_path / "a", sorted(messages, key=lambda m: m[2]))
    assert_poses(read_poses(bag), drive().time, T_map_odom @ drive().T_map_sensor)
    assert_poses(read_poses(bag, fixed="odom"), drive().time, drive().T_map_sensor)
    assert_poses(read_poses(bag, fixed="odom", sensor="base_link"), base.time, base.T_map_sensor)
    with pytest.raises(InputError, match="does not tell where camera is; it has base_link, lidar"):
        read_poses(bag, sensor="camera")
    with pytest.raises(InputError, match="leads from lidar to map, not to earth"):
        read_poses(bag, fixed="earth")


def test_odometry_of_the_base_is_turned_into_the_lidars(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    T_base_lidar = from_xyz_yaw(0.2, -0.1, 0.9, np.pi / 2)
    still = Trajectory(drive().time[:1], T_base_lidar[None])
    store = ros2_store()
    kind = "geometry_msgs/msg/TransformStamped"
    base = [
        ("/vicon", kind, round(time * 1e9), transform(store, "world", "base", time, T))
        for time, T in zip(drive().time.tolist(), drive().T_map_sensor, strict=True)
    ]
    with_static = write_bag2(
        tmp_path / "a", [*tf_messages(still, "base", "lidar", "/tf_static"), *base, *clouds(SCANS)]
    )
    wanted = drive().T_map_sensor @ T_base_lidar
    assert_poses(read_poses(with_static), drive().time, wanted)
    assert "taken for one frame" not in caplog.text
    without = write_bag2(tmp_path / "b", [*base, *clouds(SCANS)])
    assert_poses(read_poses(without), drive().time, drive().T_map_sensor)
    assert "the poses are of base, the scans of lidar" in caplog.text


def test_pose_files(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "a.tum", drive())
    assert_poses(read_poses(tmp_path / "a.tum"), drive().time, drive().T_map_sensor)
    rows = drive().T_map_sensor[:, :3].reshape(-1, 12)
    kitti = tmp_path / "poses.txt"
    np.savetxt(kitti, rows)
    with pytest.raises(InputError, match="there is no times"):
        read_poses(kitti)
    assert_poses(read_poses(kitti, times=drive().time), drive().time, drive().T_map_sensor)
    with pytest.raises(InputError, match="holds 11 poses; 3 rising times are expected"):
        read_poses(kitti, times=np.arange(3.0))
    (tmp_path / "times.txt").write_text("\n".join(map(repr, drive().time.tolist())))
    assert_poses(read_poses(kitti), drive().time, drive().T_map_sensor)


def test_kitti_poses_of_the_camera(tmp_path: Path) -> None:
    # x right, y down, z forward in the camera; the lidar 0.27 m behind and 0.08 m above it
    T_camera_lidar = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
    forward = np.eye(4)
    forward[2, 3] = 3.0  # the camera moves 3 m along its z
    rows = [" ".join(map(repr, T[:3].ravel().tolist())) for T in (np.eye(4), forward)]
    (tmp_path / "poses.txt").write_text("\n".join(rows) + "\n")
    calibration = " ".join(map(repr, T_camera_lidar[:3].ravel().tolist()))
    (tmp_path / "calib.txt").write_text(f"P0: {'0 ' * 12}\nTr: {calibration}\n")
    got = read_poses(tmp_path / "poses.txt", times=np.array([0.0, 0.1]))
    np.testing.assert_allclose(got.T_map_sensor[1], from_xyz_yaw(3.0, 0.0, 0.0, 0.0), atol=1e-12)


@pytest.mark.parametrize("text", ["1 2 3\n", "1 0 0 0 0 1 0 0 0 0 1 x\n", "", "0 " * 12 + "\n"])
def test_bad_pose_files(tmp_path: Path, text: str) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(CommonmapError):
        read_poses(tmp_path / "poses.txt", times=np.array([0.0]))


def test_a_circle_of_frames_is_told(tmp_path: Path) -> None:
    messages = [*tf_messages(drive(), "a", "b"), *tf_messages(drive(), "b", "a")]
    bag = write_bag2(tmp_path / "a", messages)
    with pytest.raises(InputError, match="go in a circle"):
        read_poses(bag, sensor="a")
