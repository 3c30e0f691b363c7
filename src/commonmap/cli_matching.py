"""The commands that place one map on another: run, match, merge."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from commonmap.cli_options import (
    Area,
    Base,
    ConfigFile,
    Deskewed,
    Draft,
    KeepPartial,
    Level,
    MaxHeight,
    Metric,
    Model,
    OdometryMethod,
    Poses,
    Quiet,
    Rays,
    Resolution,
    Scheduler,
    Seed,
    Topic,
    read_settings,
)
from commonmap.cli_words import REFUSED, say_match
from commonmap.errors import InputError

if TYPE_CHECKING:
    from commonmap.cli_logs import Input
    from commonmap.types import Cloud, Leaves


def run_command(
    base: Base,
    draft: Draft,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the results.")] = Path("out"),
    metric: Metric = None,
    max_height: MaxHeight = None,
    resolution: Resolution = None,
    level: Level = None,
    rays: Rays = False,
    area: Area = None,
    seed: Seed = None,
    config: ConfigFile = None,
    scheduler: Scheduler = None,
    odometry: OdometryMethod = None,
    poses: Poses = None,
    topic: Topic = None,
    model: Model = None,
    deskewed: Deskewed = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> int:
    """Match two maps and, where the match is accepted, merge them: all results in one folder.

    BASE and DRAFT are maps (clouds, octrees) or raw logs of a lidar (pcap, bag, mcap, folder).
    """
    settings = read_settings(
        config, metric, max_height, resolution, level, seed, scheduler, area, rays
    )
    from commonmap import cli_results, pipeline
    from commonmap.cli_progress import noting, telling

    cli_results.check_folder(out)
    with noting(quiet), telling(quiet=quiet) as progress:
        target, source = _take_both(
            base, draft, progress, method=odometry, poses=poses or [], topics=topic or [],
            model=model, deskewed=deskewed, keep_partial=keep_partial,
        )  # fmt: skip
        result = pipeline.run(target.map, source.map, config=settings, progress=progress)
        progress("write the results")
        with cli_results.results_folder(out) as part:
            names = cli_results.write_run(
                part, target=target.map, source=source.map, match=result.match,
                common=result.common, config=settings, names=(base.name, draft.name),
                robots=(target.robot, source.robot),
            )  # fmt: skip
    if not quiet:
        say_match(result.match)
        print(f"written: {out}/ ({', '.join(names)})")
    return 0 if result.match.accepted else REFUSED


def match_command(
    base: Base,
    draft: Draft,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Where to write match.json; else to stdout.")
    ] = None,
    metric: Metric = None,
    max_height: MaxHeight = None,
    resolution: Resolution = None,
    level: Level = None,
    rays: Rays = False,
    area: Area = None,
    seed: Seed = None,
    config: ConfigFile = None,
    scheduler: Scheduler = None,
    odometry: OdometryMethod = None,
    poses: Poses = None,
    topic: Topic = None,
    model: Model = None,
    deskewed: Deskewed = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> int:
    """Find the pose of DRAFT in BASE's frame, with an honest yes or no.

    BASE and DRAFT are maps (clouds, octrees) or raw logs of a lidar (pcap, bag, mcap, folder).
    """
    settings = read_settings(
        config, metric, max_height, resolution, level, seed, scheduler, area, rays
    )
    from commonmap import cli_results, pipeline
    from commonmap.cli_progress import noting, telling
    from commonmap.report.pose import to_json

    if out is not None:
        cli_results.check_file(out)
    with noting(quiet), telling(quiet=quiet) as progress:
        target, source = _take_both(
            base, draft, progress, method=odometry, poses=poses or [], topics=topic or [],
            model=model, deskewed=deskewed, keep_partial=keep_partial,
        )  # fmt: skip
        found = pipeline.match_maps(target.map, source.map, config=settings, progress=progress)
    values = cli_results.match_to_dict(
        found, config=settings, names=(base.name, draft.name),
        n_points=(_size(target.map), _size(source.map)),
    )  # fmt: skip
    if out is None:
        print(to_json(values), end="")
    else:
        cli_results.write_json(out, values)
        if not quiet:
            say_match(found)
            print(f"written: {out}")
    return 0 if found.accepted else REFUSED


def merge_command(
    base: Base,
    draft: Draft,
    match: Annotated[Path, typer.Option("--match", help="match.json of `commonmap match`.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Common map: .ot .bt (octree) .ply .pcd .las .laz.")
    ],
    resolution: Resolution = None,
    mode: Annotated[
        str | None,
        typer.Option("--mode", help="Of two opinions on a voxel: add, keep-target, occupied-wins."),
    ] = None,
    config: ConfigFile = None,
    quiet: Quiet = False,
) -> int:
    """Merge two maps whose match is known into one file, in BASE's frame."""
    settings = read_settings(config, None, None, resolution, None, None)
    settings = settings.with_values(merge={"mode": mode})
    from commonmap import cli_results, pipeline
    from commonmap.cli_progress import noting, telling
    from commonmap.io.formats import find_writer, write_map

    holds = find_writer(out).holds
    cli_results.check_file(out)
    T_target_source = cli_results.read_pose(match)
    with noting(quiet), telling(quiet=quiet) as progress:
        target, source = _read_both(base, draft, progress)
        source = pipeline.correct(source, cli_results.read_drift(match))
        common = pipeline.merge_maps(
            target, source, T_target_source, config=settings, progress=progress
        )
        progress("write the common map")
        write_map(out, common.leaves if holds == "octree" else common.cloud)
    if not quiet:
        if holds == "octree" and common.octree_origin.any():
            print(
                f"the octree's frame is moved to {common.octree_origin.tolist()} of the base, "
                "whose coordinates are too large for an octree"
            )
        print(f"written: {out}")
    return 0


def _read_both(base: Path, draft: Path, progress: Any) -> tuple[Cloud | Leaves, Cloud | Leaves]:
    from commonmap.io.formats import read_map

    for path in (base, draft):
        if not path.exists():
            raise InputError(f"there is no file {path}")
    progress(f"read {base.name}")
    target = read_map(base)
    progress(f"read {draft.name}")
    return target, read_map(draft)


def _take_both(base: Path, draft: Path, progress: Any, **options: Any) -> tuple[Input, Input]:
    """Return both inputs as maps; raw logs go through odometry first."""
    from commonmap import cli_beside, cli_logs

    for path in (base, draft):
        if not path.exists():
            raise InputError(f"there is no file {path}")
    each = cli_logs.options_of_both([base, draft], **options)
    for one in each:
        one.chosen()
    return cli_beside.take_both([base, draft], each, progress)


def _size(map_: Cloud | Leaves) -> int:
    from commonmap.types import Cloud

    return len(map_.xyz) if isinstance(map_, Cloud) else len(map_.keys)
