"""Trajectories in TUM format: `timestamp x y z qx qy qz qw`, one pose a line."""

from __future__ import annotations

from typing import Any

import numpy as np

from commonmap.errors import InputError
from commonmap.io.atomic import writing
from commonmap.io.source import PathLike, is_text, look, looks_like, parsing
from commonmap.types import Float64s, Trajectory

QUATERNION_TOLERANCE = 0.01
"""How far the length of a quaternion may be from 1 before it is no rotation."""


def read_trajectory(path: PathLike) -> Trajectory:
    """Return the poses of a TUM file: time in seconds (rising), position in metres, xyzw.

    Lines that begin with `#` are comments. A row that is not eight finite numbers, time that does
    not rise, or a quaternion that is not of length 1 raises `InputError` with the line's number.
    """
    path, _, head = look(path)
    if not is_text(head):
        raise InputError(f"{path} should be a TUM trajectory, but {looks_like(head)}")
    rows: list[list[float]] = []
    lines: list[int] = []
    with parsing(path, "a TUM trajectory"), open(path, encoding="utf-8-sig") as file:
        for number, line in enumerate(file, start=1):
            words = line.replace(",", " ").split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) != 8:
                raise InputError(
                    f"{path}, line {number}: a pose is 8 numbers (timestamp x y z qx qy qz qw); "
                    f"{len(words)} came"
                )
            try:
                rows.append([float(word) for word in words])
            except ValueError:
                raise InputError(
                    f"{path}, line {number}: numbers were expected; {line.strip()[:60]!r} came"
                ) from None
            lines.append(number)
    if not rows:
        raise InputError(f"{path} holds no poses")
    table = np.array(rows, dtype=np.float64)
    _require(np.isfinite(table).all(axis=1), lines, f"{path}, line %d: a number is not finite")
    rising = np.concatenate([[True], np.diff(table[:, 0]) > 0])
    _require(rising, lines, f"{path}, line %d: time does not rise")
    length = np.linalg.norm(table[:, 4:], axis=1)
    unit = np.abs(length - 1.0) <= QUATERNION_TOLERANCE
    _require(unit, lines, f"{path}, line %d: the quaternion is not of length 1")
    return Trajectory(time=table[:, 0], T_map_sensor=_motions(table[:, 1:4], table[:, 4:]))


def write_trajectory(path: PathLike, trajectory: Trajectory) -> None:
    """Write a TUM file; every number has as many digits as bring it back exactly."""
    time = np.asarray(trajectory.time, dtype=np.float64)
    T = np.asarray(trajectory.T_map_sensor, dtype=np.float64)
    if time.ndim != 1 or T.shape != (len(time), 4, 4) or not len(time):
        raise InputError(
            f"{path}: a trajectory is (M,) times and (M, 4, 4) motions; "
            f"{time.shape} and {T.shape} came"
        )
    if not (np.isfinite(time).all() and np.isfinite(T).all() and (np.diff(time) > 0).all()):
        raise InputError(f"{path}: a trajectory needs rising times and finite motions")
    from commonmap.frames import quaternion

    table = np.concatenate([time[:, None], T[:, :3, 3], quaternion(T)], axis=1) + 0.0
    with writing(path) as part, open(part, "w", encoding="ascii", newline="\n") as file:
        file.write("# timestamp x y z qx qy qz qw\n")
        file.writelines(" ".join(map(repr, row)) + "\n" for row in table.tolist())


def _motions(t: Float64s, q: Float64s) -> Float64s:
    from scipy.spatial.transform import Rotation

    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(q).as_matrix()
    T[:, :3, 3] = t
    return T


def _require(good: Any, lines: list[int], message: str) -> None:
    """Raise with the number of the first line where `good`, (M,) bool, is false."""
    if not np.all(good):
        raise InputError(message % lines[int(np.argmin(good))])
