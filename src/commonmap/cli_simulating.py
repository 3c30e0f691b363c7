"""The commands that make up robots and places: demo, simulate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from commonmap.cli_options import (
    ConfigFile,
    MaxHeight,
    Metric,
    Quiet,
    Resolution,
    Seed,
    read_settings,
)
from commonmap.cli_words import REFUSED, say_errors, say_match
from commonmap.errors import InputError


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
    settings = read_settings(config, metric, max_height, resolution, None, seed)
    import shutil

    import numpy as np

    from commonmap import cli_results
    from commonmap.cli_progress import noting, telling
    from commonmap.demo import BASE_LOG, DRAFT_LOG, run_demo

    cli_results.check_folder(out)
    names = (f"drone ({BASE_LOG})", f"ground robot ({DRAFT_LOG})")
    note = "Simulated raw logs; the maps were made of them by LOAM, which was not told the truth."
    with (
        noting(quiet),
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
    settings = read_settings(None, None, None, None, None, seed)
    if scene is not None and world is not None:
        raise InputError("--scene and --world both say what place it is; give one of them")
    import numpy as np

    from commonmap.cli_progress import noting, telling
    from commonmap.sim.recording import MARGIN
    from commonmap.sim.simulate import write_simulation
    from commonmap.sim.world_file import read_world

    with noting(quiet), telling(quiet=quiet) as progress:
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
