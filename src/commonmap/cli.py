"""The commands. Each imports what it uses when it runs, so that `--help` answers at once.

Exit codes: 0 done (a match: accepted), 2 bad input, 3 the match was refused, 130 interrupted.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

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
)
from commonmap.cli_study import study_app
from commonmap.cli_words import in_words, say_errors, say_match
from commonmap.errors import CommonmapError, InputError
from commonmap.version import __version__

if TYPE_CHECKING:
    from commonmap.cli_logs import Input
    from commonmap.config import Config
    from commonmap.types import Cloud, Leaves

USAGE_ERROR: Any = typer.BadParameter.__mro__[2]
"""What click raises for a wrong command line; newer releases of typer bring their own click."""

REFUSED = 3
INTERRUPTED = 130

app = typer.Typer(
    name="commonmap",
    help="One common map from what a drone's lidar and a ground robot's lidar saw of one place.",
    epilog="Exit codes: 0 accepted or done, 2 bad input, 3 refused, 130 interrupted.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(study_app, name="study")


def main() -> NoReturn:
    """Run the command line: a known error becomes one line on stderr and its exit code."""
    signal.signal(signal.SIGTERM, _terminate)
    try:
        code = app(standalone_mode=False)
        sys.stdout.flush()
        if code == INTERRUPTED:  # newer releases of typer catch the interrupt themselves
            raise KeyboardInterrupt
    except CommonmapError as error:
        _fail(str(error), error.exit_code)
    except USAGE_ERROR as error:
        context = getattr(error, "ctx", None)
        hint = f" (see `{context.command_path} --help`)" if context is not None else ""
        _fail(error.format_message().rstrip(".") + hint, 2)
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted; nothing was written", INTERRUPTED)
    except SystemError as error:
        # An interrupt that comes while compiled code takes its arguments arrives wrapped
        if not _comes_of_interrupt(error):
            raise
        _fail("interrupted; nothing was written", INTERRUPTED)
    except BrokenPipeError:
        # Whoever read our output has gone: that is no error of ours
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    sys.exit(code if isinstance(code, int) else 0)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and end.")] = False,
) -> None:
    if version:
        print(f"commonmap {__version__}")
    elif context.invoked_subcommand is None:
        print(context.get_help())


@app.command("run")
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
    settings = _settings(config, metric, max_height, resolution, level, seed, scheduler, area, rays)
    from commonmap import cli_results, pipeline
    from commonmap.cli_progress import telling

    cli_results.check_folder(out)
    with _notes(quiet), telling(quiet=quiet) as progress:
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


@app.command("match")
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
    settings = _settings(config, metric, max_height, resolution, level, seed, scheduler, area, rays)
    from commonmap import cli_results, pipeline
    from commonmap.cli_progress import telling
    from commonmap.report.pose import to_json

    if out is not None:
        cli_results.check_file(out)
    with _notes(quiet), telling(quiet=quiet) as progress:
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


@app.command("merge")
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
    settings = _settings(config, None, None, resolution, None, None)
    settings = settings.with_values(merge={"mode": mode})
    from commonmap import cli_results, pipeline
    from commonmap.cli_progress import telling
    from commonmap.io.formats import find_writer, write_map

    holds = find_writer(out).holds
    cli_results.check_file(out)
    T_target_source = cli_results.read_pose(match)
    with _notes(quiet), telling(quiet=quiet) as progress:
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


@app.command("odometry")
def odometry_command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Raw log: pcap, bag, mcap, folder.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Trajectory of the lidar (TUM).")],
    cloud: Annotated[
        Path | None, typer.Option("--cloud", help="Map of the log: .laz .las .ply .pcd ...")
    ] = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="True poses (TUM, KITTI): print the errors.")
    ] = None,
    odometry: OdometryMethod = None,
    poses: Annotated[
        Path | None, typer.Option("--poses", help="Known poses: TUM, KITTI, bag, or topic.")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Topic of the scans.")] = None,
    model: Model = None,
    deskewed: Deskewed = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> int:
    """Find the way of the lidar of a raw log, and its level, deskewed map."""
    from commonmap import cli_logs, cli_results
    from commonmap.cli_progress import telling
    from commonmap.io.atomic import writing_all
    from commonmap.io.formats import find_writer, write_map
    from commonmap.io.logs import read_poses
    from commonmap.io.trajectory import write_trajectory
    from commonmap.odometry import compare

    if not log.exists():
        raise InputError(f"there is no file or folder {log}")
    for path in (out, cloud):
        if path is not None:
            cli_results.check_file(path)
    if cloud is not None and find_writer(cloud).holds != "cloud":
        raise InputError(f"--cloud is a file of points; {cloud} came")
    options = cli_logs.LogOptions(odometry, poses, topic, keep_partial, model, deskewed)
    options.chosen()
    with _notes(quiet), telling(quiet=quiet) as progress:
        known = None if truth is None else read_poses(truth)
        robot = cli_logs.take_log(log, options, progress)
        errors = None if known is None else compare(robot.trajectory, known)
        progress("write the results")
        with writing_all(out, *([] if cloud is None else [cloud])) as parts:
            write_trajectory(parts[0], robot.trajectory)
            for part in parts[1:]:
                write_map(part, robot.cloud)
    if not quiet:
        print(
            f"{robot.n_turns} turns, {robot.way:.1f} m; lost in {robot.odometry.n_lost}, "
            f"degenerate in {robot.odometry.n_degenerate}"
        )
        if errors is not None:
            say_errors("trajectory", errors)
        print("written: " + ", ".join(str(path) for path in (out, cloud) if path is not None))
    return 0


@app.command("octree")
def octree_command(
    source: Annotated[
        Path, typer.Argument(metavar="LOG_OR_CLOUD", help="Raw log of a lidar, or a cloud.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Octree to write: .ot or .bt.")],
    resolution: Annotated[float, typer.Option(help="Voxel size, metres.")] = 0.1,
    max_range: Annotated[
        float | None, typer.Option(help="Longer rays free up to here and hit nothing, metres.")
    ] = None,
    discretize: Annotated[
        bool,
        typer.Option("--discretize", help="One ray a voxel of each turn, to its centre: faster."),
    ] = False,
    poses: Annotated[
        Path | None, typer.Option("--poses", help="Known poses (TUM, KITTI, bag); else by LOAM.")
    ] = None,
    origin: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Of a cloud: where the sensor stood; else ends alone."),
    ] = None,
    l_occ: Annotated[
        float | None, typer.Option("--l-occ", help="Log-odds of a hit.", show_default="0.847")
    ] = None,
    l_free: Annotated[
        float | None, typer.Option("--l-free", help="Log-odds of a miss.", show_default="-0.405")
    ] = None,
    l_min: Annotated[
        float | None, typer.Option("--l-min", help="Least log-odds.", show_default="-2")
    ] = None,
    l_max: Annotated[
        float | None, typer.Option("--l-max", help="Greatest log-odds.", show_default="3.511")
    ] = None,
    lazy: Annotated[
        bool, typer.Option("--lazy", help="Leave voxels unpruned, as OctoMap's lazy mode (.ot).")
    ] = False,
    threads: Annotated[int, typer.Option(help="Threads; the file is the same for any.")] = 1,
    topic: Annotated[str | None, typer.Option(help="Raw log: topic of the scans.")] = None,
    model: Model = None,
    deskewed: Deskewed = None,
    keep_partial: KeepPartial = False,
    quiet: Quiet = False,
) -> int:
    """Map a raw log or a cloud into an octree: occupied, free, unknown (Hornung et al. 2013)."""
    from commonmap import cli_octree, cli_results
    from commonmap.cli_progress import telling

    cli_results.check_file(out)
    cli_octree.check_name(out)
    tree = cli_octree.make_tree(
        resolution, l_occ=l_occ, l_free=l_free, l_min=l_min, l_max=l_max, threads=threads
    )
    options = cli_octree.Options(
        max_range, discretize, poses, origin, topic, keep_partial, model, deskewed
    )
    with _notes(quiet), telling(quiet=quiet) as progress:
        told = cli_octree.fill(tree, source, options, progress)
        progress("write the octree")
        told += cli_octree.write(tree, out, pruned=not lazy)
    if not quiet:
        for line in told:
            print(line)
        print(f"written: {out}")
    return 0


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the results.")] = Path(
        "demo-out"
    ),
    scene: Annotated[str, typer.Option(help="Kind of place to simulate.")] = "paper",
    seconds: Annotated[float, typer.Option(help="Length of the logs, at most.")] = 60.0,
    metric: Metric = None,
    max_height: MaxHeight = None,
    resolution: Resolution = None,
    seed: Seed = None,
    config: ConfigFile = None,
    quiet: Quiet = False,
) -> int:
    """Simulate the raw logs of two robots, make their common map, say how far from the truth."""
    settings = _settings(config, metric, max_height, resolution, None, seed)
    import shutil

    import numpy as np

    from commonmap import cli_results
    from commonmap.cli_progress import telling
    from commonmap.demo import BASE_LOG, DRAFT_LOG, run_demo

    cli_results.check_folder(out)
    names = (f"drone ({BASE_LOG})", f"ground robot ({DRAFT_LOG})")
    note = "Simulated raw logs; the maps were made of them by LOAM, which was not told the truth."
    with (
        _notes(quiet),
        telling(quiet=quiet) as progress,
        cli_results.results_folder(out) as part,
    ):
        logs = part / "logs"
        logs.mkdir()
        shown = run_demo(
            logs, rng=np.random.default_rng(settings.seed), scene=scene, seconds=seconds,
            config=settings, progress=progress,
        )  # fmt: skip
        shutil.rmtree(logs)
        error = None if shown.metres is None else (shown.metres, shown.radians or 0.0)
        progress("write the results")
        truth = {
            "T_target_source": shown.T_target_source, "seed": settings.seed, "scene": scene,
            "seconds": seconds, "map_errors": shown.map_errors,
        }  # fmt: skip
        cli_results.write_json(part / "truth.json", truth)
        cli_results.write_run(
            part, target=shown.base.cloud, source=shown.draft.cloud, match=shown.result.match,
            common=shown.result.common, config=settings, names=names, notes=[note], error=error,
            robots=(shown.base, shown.draft), errors=shown.errors,
        )  # fmt: skip
    if not quiet:
        print(note)
        for name, errors in zip(names, shown.errors, strict=True):
            say_errors(name, errors)
        say_match(shown.result.match)
        if error is not None:
            print(f"from the truth: {error[0]:.3f} m, {math.degrees(error[1]):.3f} degrees")
        print(f"report: {(out / 'report.html').resolve()}")
    return 0 if shown.result.match.accepted else REFUSED


@app.command("simulate")
def simulate_command(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for logs, poses and truth.")],
    scene: Annotated[str | None, typer.Option(help="Kind of place; paper unless told.")] = None,
    world: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Your own place: .obj .glb .ply, or an airborne cloud."),
    ] = None,
    size: Annotated[float | None, typer.Option(help="Edge of the place, metres.")] = None,
    logs: Annotated[
        str, typer.Option(help="Raw logs to write: pcap, mcap, kitti, joined by commas, or none.")
    ] = "pcap,mcap,kitti",
    seconds: Annotated[
        float | None, typer.Option(help="Length of the raw logs, at most; else the whole way.")
    ] = None,
    overlap: Annotated[float, typer.Option(help="Share of the draft that the base covers.")] = 1.0,
    drift: Annotated[float, typer.Option(help="Error of the poses, share of the way.")] = 0.003,
    tilt_deg: Annotated[float, typer.Option(help="Tilt of the draft's frame, degrees.")] = 0.0,
    change: Annotated[float, typer.Option(help="Share of things moved between visits.")] = 0.0,
    seed: Seed = None,
    quiet: Quiet = False,
) -> int:
    """Simulate a drone and a ground robot in one place and write what they recorded.

    Each robot's folder holds its raw logs, its map with drifting poses, and its true poses.
    """
    settings = _settings(None, None, None, None, None, seed)
    if scene is not None and world is not None:
        raise InputError("--scene and --world both say what place it is; give one of them")
    import numpy as np

    from commonmap.cli_progress import telling
    from commonmap.sim.recording import MARGIN
    from commonmap.sim.simulate import write_simulation
    from commonmap.sim.world_file import read_world

    with _notes(quiet), telling(quiet=quiet) as progress:
        place = scene or "paper" if world is None else read_world(world, size=size)
        pair = write_simulation(
            out, place, np.random.default_rng(settings.seed), overlap=overlap, drift=drift,
            tilt=math.radians(tilt_deg), change=change, scans_every=0, seconds=seconds,
            logs=[] if logs == "none" else logs.split(","), margin=MARGIN, progress=progress,
            size=size if world is None else None,
        )  # fmt: skip
    if not quiet:
        print(f"overlap: {100 * pair.overlap:.0f} % of the draft")
        print(f"written: {out}/ (uav, ugv, truth.json)")
    return 0


@app.command("info")
def info_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A cloud, an octree or scans.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    quiet: Quiet = False,
) -> int:
    """Say what is in a file: kind, points, extent, resolution, CRS, time span."""
    from commonmap.io.describe import describe
    from commonmap.report.pose import to_json

    with _notes(quiet):
        values = describe(file)
    if as_json:
        print(to_json(values), end="")
        return 0
    width = max(len(name) for name in values)
    for name, value in values.items():
        print(f"{name.replace('_', ' '):<{width}}  {in_words(value)}")
    return 0


@app.command("metrics")
def metrics_command() -> int:
    """List the similarity metrics."""
    from commonmap.metrics.table import METRICS

    width = max(len(name) for name in METRICS)
    for name, row in sorted(METRICS.items(), key=lambda item: item[0] != "evidence"):
        better = "more is better" if row.maximise else "less is better"
        default = ", the default" if name == "evidence" else ""
        print(f"{name:<{width}}  {row.title} ({row.family}; {better}{default})")
    return 0


def _settings(
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


@contextmanager
def _notes(quiet: bool) -> Iterator[None]:
    """Print what readers note about a file (points left out, units) as lines on stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("note: %(message)s"))
    told: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        # A log is read twice: once for the way, once for the map
        text = record.getMessage()
        fresh = text not in told
        told.add(text)
        return fresh

    handler.addFilter(is_new)
    logger = logging.getLogger("commonmap")
    handler.setLevel(logging.ERROR if quiet else logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _comes_of_interrupt(error: BaseException) -> bool:
    """Return whether an interrupt is among the causes of an error."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause is not None


def _fail(message: str, code: int) -> NoReturn:
    line = " ".join(message.split())
    print(f"commonmap: {line}", file=sys.stderr)
    sys.exit(code)


def _terminate(signum: int, frame: FrameType | None) -> None:
    """Turn a request to end into an exception, so that unfinished files are cleared away."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
