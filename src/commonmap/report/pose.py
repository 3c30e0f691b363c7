"""A motion and its uncertainty in the words that people use: metres and degrees."""

from __future__ import annotations

import json
import math
import re
import warnings
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from commonmap.frames import quaternion
from commonmap.types import Float64s


@dataclass(frozen=True)
class PoseFigures:
    """Position in metres and turn in degrees of a source's frame in the target's.

    Rotations are applied roll (about x) first, then pitch (y), then yaw (z), about fixed axes.
    """

    x: float
    y: float
    z: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float


@dataclass(frozen=True)
class SigmaFigures:
    """One standard deviation: metres along x, y, z and degrees about x, y, z."""

    x: float
    y: float
    z: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


def pose_figures(T_target_source: Float64s) -> PoseFigures:
    """Return position and angles of a motion (4, 4)."""
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # at a pitch of 90 degrees roll is set to zero, which is fine
        yaw, pitch, roll = Rotation.from_matrix(T_target_source[:3, :3]).as_euler(
            "ZYX", degrees=True
        )
    x, y, z = (float(v) for v in T_target_source[:3, 3])
    return PoseFigures(x, y, z, float(yaw), float(pitch), float(roll))


def sigma_figures(covariance: Float64s) -> SigmaFigures:
    """Return the standard deviations of a (6, 6) covariance in the order of `Match.covariance`."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return SigmaFigures(*(float(s) for s in sigma[:3]), *(math.degrees(s) for s in sigma[3:]))


def static_transform_command(T_target_source: Float64s, frame_id: str, child_frame_id: str) -> str:
    """Return the one-line command of ROS 2 that publishes the motion.

    tf2 reads `child_frame_id` as the frame whose points the motion takes into `frame_id`:
    exactly `T_target_source` with the target's frame as parent.
    """
    qx, qy, qz, qw = quaternion(T_target_source)
    x, y, z = T_target_source[:3, 3]
    options = {"x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
    words = " ".join(f"--{name} {_plain(value)}" for name, value in options.items())
    return (
        f"ros2 run tf2_ros static_transform_publisher {words} "
        f"--frame-id {frame_id} --child-frame-id {child_frame_id}"
    )


def to_json(value: object) -> str:
    """Return strict JSON (a number that is not finite becomes null), a row of numbers on a line."""
    text = json.dumps(_strict(value), indent=2, allow_nan=False, ensure_ascii=False)
    rows = re.sub(r'\[\n([^\[\]{}"]*)\n *\]', lambda m: f"[{' '.join(m[1].split())}]", text)
    return rows + "\n"


def _plain(value: float) -> str:
    """Return a number without exponent, with the digits that tell it from its neighbours."""
    return str(np.format_float_positional(float(value) + 0.0, trim="-"))


def _strict(value: object) -> object:
    if isinstance(value, dict):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if isinstance(value, np.ndarray):
        return _strict(value.tolist())
    if isinstance(value, np.generic):
        return _strict(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
