"""What the commands write and read back: match.json, the folder of a run, the transform as text."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.config import Config
from commonmap.errors import InputError, OutputError
from commonmap.frames import check_T, from_rotation
from commonmap.io.atomic import told_as, writing, writing_folder
from commonmap.io.formats import write_map
from commonmap.io.nav2 import write_nav2_map
from commonmap.io.raster import write_geotiff
from commonmap.io.trajectory import write_trajectory
from commonmap.merging.products import CommonMap, Map
from commonmap.odometry import TrajectoryErrors
from commonmap.pipeline_logs import RobotMap, describe_robot, move_trajectory
from commonmap.report.odometry import Way, odometry_section
from commonmap.report.page import write_report
from commonmap.report.pose import static_transform_command, to_json
from commonmap.types import Areas, Cloud, DriftField, Float64s, Match
from commonmap.version import __version__

COVARIANCE_ORDER = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")

ENTRIES = (
    "match.json", "config.json", "report.html", "common.ot", "common.laz", "height_map.tif",
    "map.pgm", "map.yaml", "transform.txt", "base.laz", "draft.laz", "truth.json",
    "odometry.json", "base_trajectory.tum", "draft_trajectory.tum",
)  # fmt: skip
"""Every name a run or a demo may leave in its folder, and so may replace there."""

HEIGHT_LAYERS = (
    "ground", "highest", "height", "highest_target", "highest_source", "seen_by", "conflict",
    "free_height",
)  # fmt: skip
"""Bands of height_map.tif, in this order."""

MAX_JSON = 1 << 26
"""Bytes of a match.json that are read at most."""


def match_to_dict(
    match: Match, *, config: Config, names: tuple[str, str], n_points: tuple[int, int]
) -> dict[str, Any]:
    """Return a match as plain values for match.json.

    Matrices are nested lists, row by row. Later versions add keys and do not rename these.
    """
    return {
        "accepted": match.accepted,
        "reason": match.reason,
        "T_target_source": _rows(match.T_target_source),
        "confidence": match.confidence,
        "covariance": _rows(match.covariance),
        "covariance_order": list(COVARIANCE_ORDER),
        "covariance_centre": _rows(match.covariance_centre),
        "overlap": match.overlap,
        "score": match.score,
        "decoy_score": match.decoy_score,
        "rivals": [
            {"T": _rows(rival.T_target_source), "score": rival.score, "overlap": rival.overlap}
            for rival in match.rivals
        ],
        "metric": match.metric,
        "timings": dict(match.timings),
        "version": __version__,
        "target": {"name": names[0], "size": n_points[0]},
        "source": {"name": names[1], "size": n_points[1]},
        "T_level_target": _rows(match.T_level_target),
        "T_level_source": _rows(match.T_level_source),
        "evidence": dict(match.evidence),
        "areas": None if match.areas is None else _areas_to_dict(match.areas),
        "config": config.to_dict(),
    }


def _areas_to_dict(areas: Areas) -> dict[str, Any]:
    """Return the draft by areas as plain values."""
    drift = areas.drift
    return {
        "size": areas.size,
        "agreeing": areas.agreeing,
        "reason": areas.reason,
        "before": areas.before,
        "gain": areas.gain,
        "gain_z": areas.gain_z,
        "drift": None
        if drift is None
        else {
            "T_grid_source": _rows(drift.T_grid_source),
            "corner": _rows(drift.corner),
            "spacing": drift.spacing,
            "motion": _rows(drift.motion),
        },
        "items": [
            {
                "centre": _rows(area.centre),
                "T_target_source": _rows(area.T_target_source),
                "accepted": area.accepted,
                "confidence": area.confidence,
                "reason": area.reason,
                "score": area.score,
                "agrees": area.agrees,
                "drift": _rows(area.drift),
                "weight": area.weight,
            }
            for area in areas.items
        ],
    }


def read_pose(path: Path) -> Float64s:
    """Return `T_target_source` of an accepted match.json; anything else raises `InputError`."""
    values = _read_match(path)
    if values["accepted"] is not True:
        reason = str(values.get("reason", "")).removeprefix("refused: ")[:500]
        raise InputError(f"{path} is a refused match, which gives no common map ({reason})")
    try:
        T = np.asarray(values["T_target_source"], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{path}: T_target_source must be four rows of four numbers") from None
    return check_T(T, f"{path}: T_target_source")


def read_drift(path: Path) -> DriftField | None:
    """Return the correction that a match.json holds, None where it holds none."""
    areas = _read_match(path).get("areas")
    if not isinstance(areas, dict) or areas.get("drift") is None:
        return None
    try:
        values = areas["drift"]
        field = DriftField(
            check_T(values["T_grid_source"], f"{path}: T_grid_source"),
            np.asarray(values["corner"], dtype=np.float64),
            float(values["spacing"]),
            np.asarray(values["motion"], dtype=np.float64),
        )
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"{path}: areas.drift must hold T_grid_source, corner, spacing and motion in numbers"
        ) from None
    shape = field.motion.shape
    whole = np.isfinite(field.motion).all() and np.isfinite(field.corner).all()
    if field.corner.shape != (2,) or len(shape) != 3 or shape[2] != 4 or min(shape) < 2:
        raise InputError(
            f"{path}: areas.drift needs a corner of 2 numbers and motions (nx, ny, 4); "
            f"{field.corner.shape} and {shape} came"
        )
    if not whole or not np.isfinite(field.spacing) or field.spacing <= 0:
        raise InputError(f"{path}: areas.drift must hold finite numbers and a spacing above 0")
    return field


def _read_match(path: Path) -> dict[str, Any]:
    """Return the values of a match.json; anything else raises `InputError`."""
    try:
        if path.stat().st_size > MAX_JSON:
            raise InputError(f"{path} is too large for a match.json")
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not the JSON that `commonmap match` writes: {error}") from None
    if not isinstance(values, dict) or "accepted" not in values or "T_target_source" not in values:
        raise InputError(
            f"{path} is not a match: it must hold accepted and T_target_source, as written by "
            "`commonmap match`"
        )
    return values


def write_json(path: Path, values: object) -> None:
    """Write strict JSON, whole or not at all."""
    with writing(path) as part:
        part.write_text(to_json(values), encoding="utf-8")


def write_run(
    folder: Path, *, target: Map, source: Map, match: Match, common: CommonMap | None,
    config: Config, names: tuple[str, str], notes: Sequence[str] = (),
    error: tuple[float, float] | None = None,
    robots: tuple[RobotMap | None, RobotMap | None] = (None, None),
    errors: tuple[TrajectoryErrors | None, TrajectoryErrors | None] = (None, None),
) -> list[str]:  # fmt: skip
    """Write all results of a run into a folder and return their names; see `ENTRIES`.

    robots: what became of the raw logs, where inputs were some. errors: of their trajectories, and
    error: (metres, radians) of the answer, where the truth is known.
    """
    sizes = (_size(target), _size(source))
    values = match_to_dict(match, config=config, names=names, n_points=sizes)
    write_json(folder / "match.json", values)
    write_json(folder / "config.json", config.to_dict())
    written = ["match.json", "config.json"]
    if common is not None and match.T_target_source is not None:
        crs = target.crs if isinstance(target, Cloud) else None
        write_map(folder / "common.ot", common.leaves)
        write_map(folder / "common.laz", common.cloud)
        heights = common.heights
        layers = {name: heights[name] for name in HEIGHT_LAYERS}
        write_geotiff(
            folder / "height_map.tif", layers, origin=heights.origin, cell=heights.cell, crs=crs
        )
        navigation = common.navigation
        write_nav2_map(
            folder / "map", navigation["occupancy"], origin=navigation.origin, cell=navigation.cell
        )
        with writing(folder / "transform.txt") as part:
            text = transform_text(match.T_target_source, common.octree_origin, names)
            part.write_text(text, encoding="utf-8")
        written += [
            "common.ot", "common.laz", "height_map.tif", "map.pgm", "map.yaml", "transform.txt",
        ]  # fmt: skip
    ways = _ways(match, names, robots, errors)
    written += _write_robots(folder, ways)
    write_report(
        folder / "report.html", target=target, source=source, match=match, config=config,
        common=common, names=names, notes=notes, error=error, sections=[odometry_section(ways)],
    )  # fmt: skip
    return [*written, "report.html"]


def _ways(
    match: Match, names: tuple[str, str], robots: tuple[RobotMap | None, RobotMap | None],
    errors: tuple[TrajectoryErrors | None, TrajectoryErrors | None],
) -> list[Way]:  # fmt: skip
    """Return the robots that handed in logs, their ways in the base's frame where it is known."""
    T = {"base": np.eye(4), "draft": match.T_target_source}
    ways = []
    for part, name, robot, error in zip(("base", "draft"), names, robots, errors, strict=True):
        if robot is not None:
            T_base_map = T[part]
            moved = None if T_base_map is None else move_trajectory(T_base_map, robot.trajectory)
            ways.append(Way(name, part, robot, moved, error))
    return ways


def _write_robots(folder: Path, ways: Sequence[Way]) -> list[str]:
    """Write map, way and health of the robots that handed in logs; return the names of the files.

    The maps are in the robots' own frames; so is the way of a draft that was refused.
    """
    written = []
    told: dict[str, Any] = {}
    for way in ways:
        write_map(folder / f"{way.part}.laz", way.robot.cloud)
        trajectory = way.trajectory or way.robot.trajectory
        write_trajectory(folder / f"{way.part}_trajectory.tum", trajectory)
        frame = "the draft's own map" if way.trajectory is None else "base"
        told[way.part] = {
            "name": way.name,
            "trajectory_frame": frame,
            "directions_frame": f"the {way.part}'s own map",
            **describe_robot(way.robot, way.errors),
        }
        written += [f"{way.part}.laz", f"{way.part}_trajectory.tum"]
    if told:
        write_json(folder / "odometry.json", told)
        written.append("odometry.json")
    return written


def transform_text(
    T_target_source: Float64s, octree_origin: Float64s, names: tuple[str, str]
) -> str:
    """Return the transform for people and for ROS 2: comments, commands, the matrix."""
    base, draft = frame_ids(names)
    rows = "\n".join("# " + " ".join(f"{value:.17g}" for value in row) for row in T_target_source)
    text = (
        f"# {names[1]} (the draft) in the frame of {names[0]} (the base): p_base = T p_draft\n"
        f"{rows}\n\n"
        f"{static_transform_command(T_target_source, base, draft)}\n"
    )
    if octree_origin.any():
        T_target_octree = from_rotation(np.eye(3), octree_origin)
        text += (
            "\n# The coordinates of the base are too large for an octree's keys and for 32-bit\n"
            f"# floats. common.ot lies in a frame moved to {octree_origin.tolist()} of the base;\n"
            "# use that frame as the fixed frame of viewers. map.yaml keeps its origin in the\n"
            "# frame of the base, in full; programs that hold it in 32 bits lose decimetres.\n"
            f"{static_transform_command(T_target_octree, base, base + '_octree')}\n"
        )
    return text


def frame_ids(names: tuple[str, str]) -> tuple[str, str]:
    """Return names of frames for ROS, of letters, digits and underscores, made of file names."""
    base, draft = (
        re.sub(r"\W+", "_", Path(name).stem, flags=re.ASCII).strip("_") for name in names
    )
    if base and draft and base != draft and base[0].isalpha() and draft[0].isalpha():
        return base, draft
    return "base_map", "draft_map"


def check_folder(path: Path) -> None:
    """Raise `OutputError` where a folder of results could not be written, before any work."""
    real = Path(os.path.realpath(path))
    if real.exists() and not real.is_dir():
        raise OutputError(f"cannot write the folder {path}: a file of that name is there")
    holder = real if real.exists() else real.parent
    if not holder.is_dir():
        raise OutputError(f"cannot write the folder {path}: there is no folder {holder}")
    if not os.access(holder, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write the folder {path}: permission denied")


def check_file(path: Path) -> None:
    """Raise `OutputError` where a file could not be written, before any work."""
    real = Path(os.path.realpath(path))
    if real.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder")
    if not real.parent.is_dir():
        raise OutputError(f"cannot write {path}: there is no folder {real.parent}")
    if not os.access(real.parent, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write {path}: permission denied")


@contextmanager
def results_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder to fill; when the block ends its files stand in `path`.

    Results of an earlier run there are replaced, all of them, so that no two runs mix; other
    files in the folder stay. When the block fails nothing has changed.
    """
    real = Path(os.path.realpath(path))
    own = not real.is_dir() or set(os.listdir(real)) <= set(ENTRIES)
    if own:
        with writing_folder(path, replaces=ENTRIES) as part:
            yield part
        return
    try:
        part = Path(tempfile.mkdtemp(prefix=".commonmap-", dir=real))
        try:
            with told_as(part, real):
                yield part
            fresh = os.listdir(part)
            for name in fresh:
                os.replace(part / name, real / name)
            for name in set(ENTRIES) - set(fresh):
                (real / name).unlink(missing_ok=True)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OutputError(f"cannot write the folder {path}: {reason}") from error


def _rows(array: Float64s | None) -> Any:
    return None if array is None else np.asarray(array).tolist()


def _size(map_: Map) -> int:
    """Return the points of a cloud or the leaves of an octree."""
    return len(map_.xyz) if isinstance(map_, Cloud) else len(map_.keys)
