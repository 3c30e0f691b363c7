"""Poses from elsewhere: TUM and KITTI files, odometry topics and /tf of a bag.

All come back as the pose of the lidar in a fixed frame, `T_map_sensor`. Where a topic tells of
another frame of the robot (`base_link`), the way from there to the lidar is taken from /tf_static.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.errors import InputError
from commonmap.frames import check_T, from_quaternion, invert
from commonmap.io.logs.livox import read_custom
from commonmap.io.logs.record import Options, Topic, shown
from commonmap.io.logs.rosbag import (
    LIVOX,
    POINTS,
    POSE_TYPES,
    TF,
    Message,
    cloud_of,
    decode,
    is_bag_folder,
    iter_messages,
    open_rosbag,
)
from commonmap.io.source import PathLike, is_text, log, look, looks_like, parsing
from commonmap.io.trajectory import read_trajectory
from commonmap.types import Float64s, Trajectory

POSE_FILES = ("poses.txt", "trajectory.tum", "truth.tum", "poses.tum")
"""Names of files with poses in a folder of scans, or in the one around it."""

Edges = dict[str, tuple[str, list[float], list[Float64s], bool]]
"""Child frame -> parent frame, times, T_parent_child, whether it never moves."""


def read_poses(
    path: PathLike, *, topic: str | None = None, times: Float64s | None = None,
    sensor: str | None = None, fixed: str | None = None, beside: PathLike | None = None,
    keep_partial: bool = False,
) -> Trajectory:  # fmt: skip
    """Return the poses of the lidar that a file, a folder of scans or a bag holds.

    path: a TUM file (8 numbers a line), a KITTI poses file (12 a line), a folder with one of these,
        or a bag.
    topic: of a bag, where it has several with poses; `/tf` follows the frames from `fixed` to
        `sensor`.
    times: (M,) seconds of the poses of a KITTI file, which has none; its `times.txt` if None. Where
        a `calib.txt` with `Tr` lies beside it, poses of the camera become poses of the lidar.
    sensor: frame of the lidar; None takes that of the bag's scans. fixed: frame of the map; None
        takes the one that has no parent. beside: the folder of the log, whose `times.txt` and
        `calib.txt` are taken where none lie beside a KITTI file.
    keep_partial: of a bag that is truncated or damaged, what can be read.
    """
    path = Path(path)
    if path.is_dir() and not is_bag_folder(path):
        files = pose_files(path)
        if len(files) != 1:
            raise InputError(
                f"{path} should hold one file of poses ({', '.join(POSE_FILES)}); {len(files)} came"
            )
        path, beside = Path(files[0]), path
    if is_bag_folder(path) or path.suffix.lower() in (".bag", ".mcap", ".db3"):
        return _from_bag(path, topic, sensor, fixed, keep_partial)
    if topic is not None:
        raise InputError(f"{path} is no bag: it has no topic {topic!r}")
    path, _, head = look(path)
    if not is_text(head):
        raise InputError(f"{path} should hold poses (TUM or KITTI), but {looks_like(head)}")
    rows = (row.strip() for row in head.decode("utf-8", "replace").splitlines())
    first = next((row for row in rows if row and not row.startswith("#")), "")
    if len(first.replace(",", " ").split()) == 12:
        return read_kitti_poses(path, times=times, beside=beside)
    return read_trajectory(path)


def pose_files(path: Path) -> tuple[str, ...]:
    """Return the files with poses that belong to a folder of scans."""
    places = [path, path.parent] if path.name in ("velodyne", "data") else [path]
    found = (place / name for place in places for name in POSE_FILES)
    return tuple(str(file) for file in found if file.is_file())


def read_kitti_poses(
    path: PathLike, *, times: Float64s | None = None, beside: PathLike | None = None
) -> Trajectory:
    """Return the poses of a KITTI file: the upper 3 rows of T_first_now, row by row.

    times: (M,) seconds; None takes `times.txt` beside the file. Where `calib.txt` beside it has
    `Tr` (T_camera_lidar), the poses are those of the left camera and are turned into the lidar's.
    beside: a folder where these two are looked for as well (KITTI keeps all poses in one place).
    """
    places = [Path(path).parent, *([] if beside is None else [Path(beside)])]
    path, _, _ = look(path)
    with parsing(path, "KITTI poses"):
        rows = [line.split() for line in path.read_text("ascii").splitlines() if line.strip()]
        if any(len(row) != 12 for row in rows) or not rows:
            raise InputError(f"{path} must hold 12 numbers a line (KITTI poses)")
        table = np.array(rows, dtype=np.float64)
    T = np.tile(np.eye(4), (len(table), 1, 1))
    T[:, :3, :] = table.reshape(-1, 3, 4)
    for i in (0, len(T) - 1):
        check_T(T[i], f"pose {i} of {path}")
    if times is None:
        listed = next((p / "times.txt" for p in places if (p / "times.txt").is_file()), None)
        if listed is None:
            raise InputError(f"{path} has no times, and there is no times.txt beside it")
        with parsing(listed, "a list of times"):
            times = np.array(listed.read_text("ascii").split(), dtype=np.float64)
    if len(times) != len(T) or not (np.diff(times) > 0).all() or not np.isfinite(times).all():
        raise InputError(f"{path} holds {len(T)} poses; {len(times)} rising times are expected")
    calibration = next((p / "calib.txt" for p in places if (p / "calib.txt").is_file()), None)
    if calibration is not None:
        T_camera_lidar = _read_calibration(calibration)
        if T_camera_lidar is not None:
            T = invert(T_camera_lidar) @ T @ T_camera_lidar
            log.warning("%s: poses of the camera, turned into the lidar's by %s", path, calibration)
    return Trajectory(time=np.asarray(times, dtype=np.float64), T_map_sensor=T)


def _read_calibration(path: Path) -> Float64s | None:
    with parsing(path, "a KITTI calibration"):
        for line in path.read_text("ascii").splitlines():
            name, _, values = line.partition(":")
            if name in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):
                T = np.eye(4)
                T[:3] = np.array(values.split(), dtype=np.float64).reshape(3, 4)
                return check_T(T, f"{name} of {path}")
    return None


def _from_bag(
    path: Path, topic: str | None, sensor: str | None, fixed: str | None, keep_partial: bool
) -> Trajectory:
    record = open_rosbag(path, Options(keep_partial=keep_partial))
    chosen = _choose(path, [t for t in record.topics if t.holds == "poses"], topic)
    if sensor is None:
        sensor = frame_of_scans(path, record.topics, record.topic, keep_partial=keep_partial)
    if chosen.type in TF:
        return _from_tf(path, record.topics, sensor, fixed, keep_partial)
    times: list[float] = []
    motions: list[Float64s] = []
    child = ""
    for message in iter_messages(path, [chosen.name], keep_partial=keep_partial):
        with parsing(path, f"{shown(chosen.type)} of {shown(chosen.name)}"):
            child, time, T = _pose_of(message)
        if not times or time > times[-1]:
            times.append(time)
            motions.append(T)
    if not times:
        raise InputError(f"{path}: topic {shown(chosen.name)} holds no poses")
    T_map_child = np.array(motions)
    if child and sensor and child != sensor:
        edges = edges_of(path, record.topics, only_static=True, keep_partial=keep_partial)
        T_child_sensor = still_motion(edges, child, sensor)
        if T_child_sensor is None:
            log.warning(
                "%s: the poses are of %s, the scans of %s, and no /tf_static joins them; they are "
                "taken for one frame", path, shown(child), shown(sensor),
            )  # fmt: skip
        else:
            T_map_child = T_map_child @ T_child_sensor
    return Trajectory(time=np.array(times), T_map_sensor=T_map_child)


def _choose(path: Path, topics: list[Topic], wanted: str | None) -> Topic:
    names = ", ".join(f"{shown(t.name)} ({shown(t.type)})" for t in topics) or "none"
    if wanted is not None:
        for topic in topics:
            if topic.name in (wanted, "/" + wanted):
                return topic
        raise InputError(f"{path} has no poses in a topic {wanted}; those with poses: {names}")
    direct = [topic for topic in topics if topic.type in POSE_TYPES]
    if len(direct) == 1:
        return direct[0]
    moving = [topic for topic in topics if topic.type in TF and "static" not in topic.name]
    if not direct and len(moving) == 1:
        return moving[0]
    raise InputError(f"{path}: give the topic with the poses (--poses TOPIC); it has {names}")


def frame_of_scans(
    path: Path, topics: Iterable[Topic], chosen: str | None, *, keep_partial: bool = False
) -> str | None:
    """Return the frame of the first scan of a bag, of one topic or of any."""
    for topic in topics:
        if topic.holds == "scans" and chosen in (None, topic.name):
            for message in iter_messages(path, [topic.name], keep_partial=keep_partial):
                with parsing(path, f"{shown(topic.type)} of {shown(topic.name)}"):
                    if topic.type in LIVOX:
                        return read_custom(message.data, is_ros1=message.is_ros1).frame
                    decoded = decode(message)
                    if topic.type == POINTS:
                        return cloud_of(decoded).frame
                    return str(decoded.header.frame_id)
    return None


def _pose_of(message: Message) -> tuple[str, float, Float64s]:
    """Return (child frame, time, T_parent_child) of a message with one pose."""
    decoded = decode(message)
    time = _time(decoded.header)
    child = str(getattr(decoded, "child_frame_id", ""))
    if message.type.endswith("TransformStamped"):
        return child, time, _transform(decoded.transform)
    pose = decoded.pose.pose if hasattr(decoded.pose, "pose") else decoded.pose
    return child, time, _motion(pose.position, pose.orientation)


def _transform(transform: Any) -> Float64s:
    return _motion(transform.translation, transform.rotation)


def _motion(t: Any, q: Any) -> Float64s:
    quaternion = np.array([q.x, q.y, q.z, q.w], dtype=np.float64)
    position = np.array([t.x, t.y, t.z], dtype=np.float64)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) < 0.01 or not np.isfinite(position).all():
        raise InputError(f"a pose must be finite, its quaternion of length 1; {length:g} came")
    return from_quaternion(position, quaternion)


def _time(header: Any) -> float:
    return float(header.stamp.sec) + float(header.stamp.nanosec) * 1e-9


def edges_of(
    path: Path, topics: Iterable[Topic], *, only_static: bool = False, keep_partial: bool = False
) -> Edges:
    """Return the frames of /tf and /tf_static."""
    names = [t.name for t in topics if t.type in TF and (not only_static or "static" in t.name)]
    edges: Edges = {}
    for message in iter_messages(path, names, keep_partial=keep_partial) if names else ():
        with parsing(path, f"TFMessage of {shown(message.topic)}"):
            transforms = decode(message).transforms
            for item in transforms:
                child = str(item.child_frame_id).lstrip("/")
                parent = str(item.header.frame_id).lstrip("/")
                static = "static" in message.topic
                edge = edges.setdefault(child, (parent, [], [], static))
                time = _time(item.header)
                if edge[0] == parent and (not edge[1] or (time > edge[1][-1] and not static)):
                    edge[1].append(time)
                    edge[2].append(_transform(item.transform))
    return edges


def _chain(edges: Edges, frame: str, top: str | None = None) -> list[str]:
    """Return the frames from `frame` up to `top`, or to the one without parent."""
    chain = [frame]
    while chain[-1] in edges and chain[-1] != top:
        parent = edges[chain[-1]][0]
        if parent in chain:
            raise InputError(f"the frames of /tf go in a circle at {shown(parent)}")
        chain.append(parent)
    return chain


def still_motion(edges: Edges, a: str, b: str) -> Float64s | None:
    """Return T_a_b of two frames that never move against each other, None where unknown."""
    a, b = a.lstrip("/"), b.lstrip("/")
    up_a, up_b = _chain(edges, a), _chain(edges, b)
    shared = next((frame for frame in up_a if frame in up_b), None)
    if shared is None:
        return None
    T = []
    for chain in (up_a, up_b):
        T_shared_frame = np.eye(4)
        for frame in chain[: chain.index(shared)]:
            T_shared_frame = edges[frame][2][0] @ T_shared_frame
        T.append(T_shared_frame)
    result: Float64s = invert(T[0]) @ T[1]
    return result


def _from_tf(
    path: Path, topics: Iterable[Topic], sensor: str | None, fixed: str | None, keep_partial: bool
) -> Trajectory:
    edges = edges_of(path, topics, keep_partial=keep_partial)
    if sensor is None or sensor.lstrip("/") not in edges:
        raise InputError(
            f"{path}: /tf does not tell where {shown(str(sensor))} is; it has "
            f"{', '.join(map(shown, sorted(edges)[:20]))}"
        )
    chain = _chain(edges, sensor.lstrip("/"), None if fixed is None else fixed.lstrip("/"))
    if fixed is not None and chain[-1] != fixed.lstrip("/"):
        raise InputError(
            f"{path}: /tf leads from {shown(sensor)} to {shown(chain[-1])}, not to {fixed}"
        )
    moving = [frame for frame in chain[:-1] if not edges[frame][3]]
    if not moving:
        raise InputError(
            f"{path}: between {shown(chain[-1])} and {shown(sensor)} nothing moves in /tf"
        )
    densest = max(moving, key=lambda frame: len(edges[frame][1]))
    times = np.array(edges[densest][1])
    for frame in moving:
        known = edges[frame][1]
        if len(known) > 1:
            times = times[(times >= known[0]) & (times <= known[-1])]
    if not len(times):
        raise InputError(
            f"{path}: the frames of /tf between {chain[-1]} and {sensor} share no time"
        )
    T_map_sensor = np.tile(np.eye(4), (len(times), 1, 1))
    for frame in chain[:-1]:
        _, known, motions, static = edges[frame]
        step = (
            np.broadcast_to(motions[0], (len(times), 4, 4))
            if static or len(known) == 1
            else interpolate(Trajectory(np.array(known), np.array(motions)), times)
        )
        T_map_sensor = step @ T_map_sensor
    return Trajectory(time=times, T_map_sensor=T_map_sensor)


def interpolate(trajectory: Trajectory, times: Float64s) -> Float64s:
    """Return the motions (K, 4, 4) at `times`: linear in position, slerp in rotation."""
    from scipy.spatial.transform import Rotation, Slerp

    T = np.tile(np.eye(4), (len(times), 1, 1))
    known = trajectory.T_map_sensor
    slerp = Slerp(trajectory.time, Rotation.from_matrix(known[:, :3, :3]))
    T[:, :3, :3] = slerp(times).as_matrix()
    for axis in range(3):
        T[:, axis, 3] = np.interp(times, trajectory.time, known[:, axis, 3])
    return T
