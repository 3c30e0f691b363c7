"""The commands that make a map of a log: odometry, octree."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from commonmap.cli_options import (
    Deskewed,
    KeepPartial,
    Model,
    OdometryMethod,
    Quiet,
)
from commonmap.cli_words import say_errors
from commonmap.errors import InputError


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
    from commonmap.cli_progress import noting, telling
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
    with noting(quiet), telling(quiet=quiet) as progress:
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
    from commonmap.cli_progress import noting, telling

    cli_results.check_file(out)
    cli_octree.check_name(out)
    tree = cli_octree.make_tree(
        resolution, l_occ=l_occ, l_free=l_free, l_min=l_min, l_max=l_max, threads=threads
    )
    options = cli_octree.Options(
        max_range, discretize, poses, origin, topic, keep_partial, model, deskewed
    )
    with noting(quiet), telling(quiet=quiet) as progress:
        told = cli_octree.fill(tree, source, options, progress)
        progress("write the octree")
        told += cli_octree.write(tree, out, pruned=not lazy)
    if not quiet:
        for line in told:
            print(line)
        print(f"written: {out}")
    return 0
