"""What `commonmap octree` does between its options and the file it writes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from commonmap import cli_logs
from commonmap.errors import EmptyMapError, InputError
from commonmap.io.formats import read_map
from commonmap.io.logs import read_poses
from commonmap.io.octomap import write_octree
from commonmap.mapping.octree import Octree, probability
from commonmap.mapping.octree_build import insert_cloud, insert_log
from commonmap.merging.products import choose_octree_origin
from commonmap.types import KEY_ORIGIN, Cloud, Float64s, LeafParts, Leaves, Progress

LIDAR_REACH = 300.0
"""Metres around the sensor that a turn's points may lie in."""


@dataclass(frozen=True)
class Options:
    """What is known of the rays, and wanted of them.

    max_range: metres. discretize: one ray a voxel. poses: file of the sensor's poses. origin: of a
    cloud, where the sensor stood. topic, keep_partial, model, deskewed: of a log, see
    `cli_logs.LogOptions`.
    """

    max_range: float | None = None
    discretize: bool = False
    poses: Path | None = None
    origin: tuple[float, float, float] | None = None
    topic: str | None = None
    keep_partial: bool = False
    model: str | None = None
    deskewed: bool | None = None

    @property
    def reach(self) -> float:
        """The maximal range as `Octree.insert` takes it: negative for none."""
        return -1.0 if self.max_range is None else self.max_range

    def check(self, *, is_log: bool) -> None:
        """Raise where an option does not fit the input."""
        if self.max_range is not None and not (
            math.isfinite(self.max_range) and self.max_range > 0
        ):
            raise InputError(f"--max-range must be metres above 0; {self.max_range:g} came")
        if is_log and self.origin is not None:
            raise InputError("--origin is for a cloud; a log says where its sensor was")
        if is_log:
            return
        for option, given in (
            ("--topic", self.topic is not None), ("--keep-partial", self.keep_partial),
            ("--model", self.model is not None), ("--deskewed", self.deskewed is not None),
        ):  # fmt: skip
            if given:
                raise InputError(f"{option} is for raw logs; this is a cloud")


def check_name(out: Path) -> None:
    """Raise where the file to write would be no octree."""
    if out.suffix.lower() not in (".ot", ".bt"):
        raise InputError(f"an octree is written as .ot or .bt; the file is called {out.name}")


def make_tree(
    resolution: float,
    *,
    l_occ: float | None,
    l_free: float | None,
    l_min: float | None,
    l_max: float | None,
    threads: int,
) -> Octree:
    """Return an empty octree; log-odds that are None are OctoMap's."""
    given = {
        "hit": ("--l-occ", l_occ, 1.0), "miss": ("--l-free", l_free, -1.0),
        "clamp_min": ("--l-min", l_min, -1.0), "clamp_max": ("--l-max", l_max, 1.0),
    }  # fmt: skip
    chosen = {}
    for name, (option, value, sign) in given.items():
        if value is None:
            continue
        if not 0.0 < sign * value <= 20.0:
            least, most = ("0", "20") if sign > 0 else ("-20", "0")
            raise InputError(f"{option} is log-odds between {least} and {most}; {value:g} came")
        chosen[name] = probability(value)
    return Octree(resolution, threads=threads, **chosen)


def fill(tree: Octree, source: Path, options: Options, progress: Progress) -> list[str]:
    """Insert a log or a cloud into an empty octree; return what the user should know, as lines."""
    if not source.exists():
        raise InputError(f"there is no file or folder {source}")
    if cli_logs.is_log(source):
        options.check(is_log=True)
        told = _fill_from_log(tree, source, options, progress)
        _require_some(tree)
        return told
    options.check(is_log=False)
    progress(f"read {source.name}")
    cloud = read_map(source)
    if isinstance(cloud, Leaves):
        raise InputError(f"{source} is an octree already; a log or a cloud was expected")
    told = _fill_from_cloud(tree, cloud, options, progress)
    _require_some(tree)
    return told


def _require_some(tree: Octree) -> None:
    """Raise where nothing that was inserted lies in the octree."""
    if not any(len(part.depth) for part in tree.leaf_parts(pruned=False)):
        reach = KEY_ORIGIN * tree.resolution
        raise EmptyMapError(
            "an octree needs rays that begin within its reach, or points that lie there"
            f" ({reach:g} m from its origin at {tree.resolution:g} m voxels); none does"
        )


def write(tree: Octree, out: Path, *, pruned: bool) -> list[str]:
    """Write the octree part by part; return a line on what it holds."""
    parts = tree.leaf_parts(pruned=pruned)
    tally = np.zeros(3)

    def counted() -> Iterator[Leaves]:
        tally[:] = 0.0
        for part in parts:
            volume, occupied = part.sizes() ** 3, part.occupied
            tally[:] += len(volume), volume[occupied].sum(), volume[~occupied].sum()
            yield part

    write_octree(out, LeafParts(tree.resolution, counted))
    return [
        f"{tally[0]:.0f} leaves, {tree.memory_bytes() / 1e6:.0f} MB in memory; "
        f"{tally[1]:.1f} m3 occupied, {tally[2]:.1f} m3 free"
    ]


def _fill_from_log(tree: Octree, path: Path, options: Options, progress: Progress) -> list[str]:
    how = cli_logs.LogOptions(
        None, options.poses, options.topic, options.keep_partial, options.model, options.deskewed
    )
    robot = cli_logs.take_log(path, how, progress)
    places = robot.trajectory.T_map_sensor[:, :3, 3]
    reach = LIDAR_REACH if options.max_range is None else min(LIDAR_REACH, options.max_range)
    shift = _choose_shift(np.vstack([places - reach, places + reach]), tree)
    left_out = insert_log(
        how.scans(path), tree,
        robot.odometry, max_range=options.reach, discretize=options.discretize, shift=shift,
        n_scans=how.open(path).n_scans,
        progress=progress,
    )  # fmt: skip
    told = f"{robot.n_turns - left_out} of {robot.n_turns} turns over {robot.way:.1f} m"
    return [told, *_moved(shift)]


def _fill_from_cloud(tree: Octree, cloud: Cloud, options: Options, progress: Progress) -> list[str]:
    finite = np.isfinite(cloud.xyz).all(axis=1)
    if not finite.any():
        raise EmptyMapError("an octree needs points; the cloud holds no finite one")
    shift = _choose_shift(cloud.xyz[finite], tree)
    poses = None if options.poses is None else read_poses(options.poses)
    rays = insert_cloud(
        cloud, tree, origin=options.origin, poses=poses, max_range=options.reach,
        discretize=options.discretize, shift=shift, progress=progress,
    )  # fmt: skip
    told = f"{int(finite.sum())} points"
    if not rays:
        told += "; where the sensor was is not known (--origin, --poses): nothing is free"
    return [told, *_moved(shift)]


def _choose_shift(xyz: Float64s, tree: Octree) -> Float64s:
    """Return what to take from coordinates so that they fit the octree's keys, (3,) metres."""
    return choose_octree_origin(xyz, tree.resolution)


def _moved(shift: Float64s) -> list[str]:
    if not shift.any():
        return []
    return [
        f"the octree's frame is moved to {shift.tolist()}: these coordinates are too large for an"
        " octree"
    ]
