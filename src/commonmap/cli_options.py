"""The arguments and options that several commands share, and the configuration they make."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from commonmap.config import Config

Base = Annotated[
    Path, typer.Argument(metavar="BASE", help="The map whose frame stays (the drone's).")
]
Draft = Annotated[Path, typer.Argument(metavar="DRAFT", help="The map to be placed (the robot's).")]
Metric = Annotated[str | None, typer.Option(help="Similarity metric; see `commonmap metrics`.")]
MaxHeight = Annotated[
    float | None, typer.Option(help="Use only what is less than this above ground, metres.")
]
Rays = Annotated[
    bool,
    typer.Option(
        "--rays", help="What rays saw free, and no more, counts as known (logs, octrees)."
    ),
]
Resolution = Annotated[float | None, typer.Option(help="Cell and voxel size, metres.")]
Level = Annotated[str | None, typer.Option(metavar="auto|off", help="Level maps without gravity.")]
Area = Annotated[
    float | None,
    typer.Option(metavar="METRES", help="Match each area of the draft by itself; find its drift."),
]
Seed = Annotated[int | None, typer.Option(help="Seed where chance enters.")]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="Configuration, .json or .toml; options win over it."),
]
OdometryMethod = Annotated[
    str | None,
    typer.Option("--odometry", metavar="loam|poses|kiss-icp", help="Raw logs: how to find poses."),
]
Poses = Annotated[
    list[Path] | None,
    typer.Option(
        "--poses", help="Raw logs: known poses (TUM, KITTI, bag, topic), one a log, in order."
    ),
]
Topic = Annotated[
    list[str] | None, typer.Option("--topic", help="Raw logs: topic of the scans, one a log.")
]
KeepPartial = Annotated[
    bool, typer.Option("--keep-partial", help="Raw logs: keep what can be read of a damaged one.")
]
Model = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Raw packets that do not say it: model of the Velodyne."),
]
Deskewed = Annotated[
    bool | None,
    typer.Option(
        "--deskewed/--not-deskewed",
        help="Raw logs without times: whether each turn was moved to one moment.",
        show_default="looked for",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tcp://HOST:PORT", help="Search on the workers of a Dask scheduler."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]


def read_settings(
    file: Path | None, metric: str | None, max_height: float | None, resolution: float | None,
    level: str | None, seed: int | None, scheduler: str | None = None,
    area: float | None = None, rays: bool = False,
) -> Config:  # fmt: skip
    """Return the configuration of a file with the options of the command line on top."""
    from dataclasses import replace

    from commonmap.config import Config, read_config

    config = (read_config(file) if file is not None else Config()).with_values(
        grid={"resolution": resolution, "max_height": max_height, "rays": rays or None},
        level={"mode": level},
        search={"metric": metric},
        areas={"size": area},
        compute={"scheduler": scheduler},
    )
    if metric is not None:
        from commonmap.metrics.table import find_metric

        find_metric(metric)
    return config if seed is None else replace(config, seed=seed)
