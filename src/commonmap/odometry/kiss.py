"""KISS-ICP (Vizzo et al. 2023, RA-L) as a row of the table, for comparison (an extra)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from commonmap.odometry.records import Odometry
from commonmap.types import Float64s, Progress, Scan, Trajectory, no_progress


def estimate_kiss_icp(
    scans: Iterable[Scan],
    *,
    voxel: float | None = None,
    max_range: float = 100.0,
    deskew: bool = True,
    progress: Progress = no_progress,
) -> Odometry:
    """Return the trajectory by KISS-ICP with its default settings.

    voxel: metres; its own default is `max_range / 100`. Poses are for the end of each turn, to
    which it deskews, or for its stamp where `deskew` is off.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.config.config import (
        AdaptiveThresholdConfig,
        DataConfig,
        MappingConfig,
        RegistrationConfig,
    )
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig(
        out_dir="",
        data=DataConfig(max_range=max_range, min_range=0.5, deskew=deskew),
        mapping=MappingConfig(voxel_size=max_range / 100.0 if voxel is None else voxel),
        registration=RegistrationConfig(max_num_threads=1),
        adaptive_threshold=AdaptiveThresholdConfig(),
    )
    icp = KissICP(config)
    moments: list[float] = []
    poses: list[Float64s] = []
    progress("odometry")
    for scan in scans:
        first, last = float(scan.time.min()), float(scan.time.max())
        share = (scan.time - first) / max(last - first, 1e-9)
        icp.register_frame(scan.xyz.astype(np.float64), share if deskew else np.zeros(0))
        moments.append(last if deskew else scan.stamp)
        poses.append(np.array(icp.last_pose))
    trajectory = Trajectory(np.array(moments), np.array(poses))
    return Odometry("kiss-icp", trajectory, (), deskewed=not deskew)
