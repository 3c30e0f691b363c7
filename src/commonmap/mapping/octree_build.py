"""From the turns of a lidar, or a cloud, to an octree: ray by ray, each turn deskewed.

    tree = Octree(0.1)
    insert_log(iter_scans("drone.pcap"), tree, estimate(iter_scans("drone.pcap")))
    insert_cloud(read_cloud("drone.laz"), tree)          # rays where origins are known

The tree lies in the frame of the poses (of the cloud), less `shift`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap.errors import EmptyMapError, InputError
from commonmap.mapping.octree import Octree
from commonmap.odometry import Odometry, PlaceableTurns, georeference
from commonmap.types import Cloud, Float64s, Progress, Scan, Trajectory, no_progress

TURN = 0.1
"""Seconds of a cloud's points that count as one scan: the turn of a lidar."""

NO_SHIFT = np.zeros(3)


def insert_log(
    scans: Iterable[Scan],
    tree: Octree,
    odometry: Odometry,
    *,
    max_range: float = -1.0,
    discretize: bool = False,
    shift: Float64s = NO_SHIFT,
    n_scans: int | None = None,
    progress: Progress = no_progress,
) -> int:
    """Insert every turn of a log into `tree`; return how many were left out.

    Every ray begins where the sensor was at its own moment. A turn is left out where its pose is
    only a guess or not known, and where odometry was lost too long between it and the longest part
    (`odometry.PlaceableTurns`).
    scans: all turns of the log, read once. odometry: the poses of the sensor.
    max_range, discretize: as of `Octree.insert`. shift: (3,) metres, taken from all coordinates.
    n_scans: how many there are, where known, for the progress.
    """
    progress("insert the turns")
    n_points = 0
    turns = PlaceableTurns(odometry, scans)
    for cloud in georeference(turns, odometry.trajectory):
        assert cloud.origin is not None
        tree.insert(
            cloud.origin - shift, cloud.xyz - shift, max_range=max_range, discretize=discretize
        )
        n_points += len(cloud.xyz)
        progress("insert the turns", min(turns.n / n_scans, 1.0) if n_scans else 0.0)
    if n_points == 0:
        raise EmptyMapError(
            f"an octree needs points; none of {turns.n} turns has any at a known pose"
        )
    return turns.n_left_out


def insert_cloud(
    cloud: Cloud,
    tree: Octree,
    *,
    origin: ArrayLike | None = None,
    poses: Trajectory | None = None,
    max_range: float = -1.0,
    discretize: bool = False,
    shift: Float64s = NO_SHIFT,
    progress: Progress = no_progress,
) -> bool:
    """Insert the points of a cloud into `tree`; return whether their rays were known.

    Rays begin at `origin` (3,) metres, one place for all; or where the sensor was by `poses` at the
    time of each point; or at the cloud's own origins. With none of these the points are ends of
    no rays: occupied voxels, a hit for each point, nothing free, and neither
    max_range nor discretize.
    Points with times go in turn by turn, others as one scan.
    """
    finite = np.isfinite(cloud.xyz).all(axis=1)
    if not finite.any():
        raise EmptyMapError("an octree needs points; the cloud holds no finite one")
    starts = _origins(cloud, origin, poses)
    xyz = cloud.xyz - shift
    if starts is None:
        if max_range >= 0 or discretize:
            option = "max_range" if max_range >= 0 else "discretize"
            raise InputError(
                f"{option} needs to know where the sensor was, and this cloud does not say:"
                " give an origin, or poses"
            )
        progress("insert the points")
        tree.update(xyz[finite], occupied=True)
        return False
    turns = list(_turns(cloud, np.flatnonzero(finite)))
    for number, turn in enumerate(turns):
        tree.insert(starts[turn] - shift, xyz[turn], max_range=max_range, discretize=discretize)
        progress("insert the points", (number + 1) / len(turns))
    return True


def _origins(
    cloud: Cloud, origin: ArrayLike | None, poses: Trajectory | None
) -> NDArray[np.floating] | None:
    """Return where each ray begins, (N, 3), or None where nothing tells."""
    if origin is not None and poses is not None:
        raise InputError("origin and poses both say where the sensor was; give one of them")
    if origin is not None:
        place = np.asarray(origin, np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise InputError(f"origin must be x, y, z in metres; {origin!r} came")
        return np.broadcast_to(place, cloud.xyz.shape)
    if poses is not None:
        return _along(cloud, poses)
    return cloud.origin


def _along(cloud: Cloud, poses: Trajectory) -> Float64s:
    """Return the sensor's position (N, 3) at the time of each point, between poses on a line."""
    if cloud.time is None:
        raise InputError("poses tell the rays of a cloud only by time, and its points have none")
    first, last = float(np.nanmin(cloud.time)), float(np.nanmax(cloud.time))
    if first < poses.time[0] - TURN or last > poses.time[-1] + TURN:
        raise InputError(
            f"poses must cover the cloud ({first:.3f} to {last:.3f} s); they are of"
            f" {poses.time[0]:.3f} to {poses.time[-1]:.3f} s"
        )
    places = poses.T_map_sensor[:, :3, 3]
    columns = [np.interp(cloud.time, poses.time, places[:, axis]) for axis in range(3)]
    return np.column_stack(columns)


def _turns(cloud: Cloud, chosen: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield the chosen points turn by turn; all at once where points have no time."""
    if cloud.time is None:
        yield chosen
        return
    order = chosen[np.argsort(cloud.time[chosen], kind="stable")]
    turn = np.floor((cloud.time[order] - cloud.time[order[0]]) / TURN)
    yield from np.split(order, np.flatnonzero(np.diff(turn)) + 1)
