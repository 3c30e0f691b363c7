"""`commonmap study`: one command an experiment. Each imports what it uses when it runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

study_app = typer.Typer(
    help="Experiments that answer a question with figures and tables of their own run.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@study_app.callback(invoke_without_command=True)
def _root(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


@study_app.command("paper")
def paper_command(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for figures and tables.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scene and the sensors' noise.")] = 1,
    scenes: Annotated[
        int, typer.Option(help="Test the claims on so many further scenes, without odometry.")
    ] = 0,
    records: Annotated[
        Path | None,
        typer.Option(help="File of raw records of these scenes: added to, not measured again."),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Length of the raw logs, at most.")] = 60.0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
) -> int:
    """Run the source paper's experiment, draw its figures, and test its claims.

    Raw logs of a VLP-16 on a drone and on a ground robot, LOAM, octrees, height maps under 1 m,
    the three Shannon-entropy metrics at every pose of 10 m areas, and the common map.
    """
    from commonmap import cli_results
    from commonmap.cli_progress import telling
    from commonmap.study.paper import study_paper
    from commonmap.study.paper_tables import TITLES, verdict

    if records is not None:
        cli_results.check_file(records)
    with telling(quiet=quiet) as progress:
        study = study_paper(
            out, seed=seed, scenes=scenes, records=records, seconds=seconds, progress=progress
        )
    if not quiet:
        run = study.run
        for name, found in run.whole.items():
            right = sum(answers[name].right for answers in run.found)
            print(
                f"{TITLES[name]}: {found.score:.4f}, {found.metres:.2f} m and "
                f"{math.degrees(found.radians):.1f} degrees from the truth; "
                f"{right} of {len(run.areas)} areas right; {found.seconds:.1f} s"
            )
        print(verdict(study.rows))
        print(f"written: {out}/ ({', '.join(study.files)})")
    return 0


@study_app.command("metrics")
def metrics_command(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for records and tables.")],
    scheduler: Annotated[
        str | None, typer.Option(help="Dask scheduler, tcp://host:port; else this machine.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes on this machine; one a core if not given.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="48 pairs instead of 1152.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of places, conditions and noise.")] = 1,
    report_only: Annotated[
        bool, typer.Option("--report-only", help="Tables and figures of what is recorded.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
) -> int:
    """Find out which metric finds the right pose where: all of them on simulated pairs.

    Records are written once, a file a place; the same command goes on where it was interrupted.
    """
    from commonmap.cli_progress import telling
    from commonmap.study.metrics_report import write_report
    from commonmap.study.metrics_run import run_study

    with telling(quiet=quiet) as progress:
        if not report_only:
            run_study(
                out, seed=seed, quick=quick, scheduler=scheduler, workers=workers, progress=progress
            )
        summary = write_report(out)
    if not quiet:
        print(summary)
    return 0


@study_app.command("real")
def real_command(
    base: Annotated[Path, typer.Argument(metavar="BASE", help="The map whose frame stays.")],
    draft: Annotated[Path, typer.Argument(metavar="DRAFT", help="The map to be cut and placed.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for records and the table.")],
    truth: Annotated[
        Path | None,
        typer.Option(help="True T_base_draft, 4 x 4 numbers; else the files share a frame."),
    ] = None,
    origin: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="X Y Z", help="Point of the files' frame the truth is about."),
    ] = (0.0, 0.0, 0.0),
    draws: Annotated[int, typer.Option(help="Crops of each size and height range.")] = 4,
    resolution: Annotated[
        float | None, typer.Option(help="Cell, metres; from the data unless given.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the crops and their motions.")] = 1,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
) -> int:
    """Place crops of a real draft, moved at random, with every metric of the table.

    A record a crop is kept in DIR/records: a study that was interrupted goes on where it was.
    """
    import numpy as np

    from commonmap.cli_progress import telling
    from commonmap.errors import InputError
    from commonmap.io import read_map
    from commonmap.io.atomic import writing
    from commonmap.mapping.points import points_of
    from commonmap.study.real_pair import make_table, read_motion, study_real, tabulate

    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; a folder for the records was expected")
    if not out.absolute().parent.is_dir():
        raise InputError(f"there is no folder {out.absolute().parent}")
    T_base_draft = np.eye(4) if truth is None else read_motion(truth)
    with telling(quiet=quiet) as progress:
        progress("read the maps")
        target, source = (
            points_of(read_map(path), path.name) - np.array(origin) for path in (base, draft)
        )
        records = study_real(
            target, source, T_base_draft, out / "records", seed=seed, draws=draws,
            cell=resolution, progress=progress,
        )  # fmt: skip
    table = make_table(tabulate(records))
    with writing(out / "real.md") as part:
        part.write_text("\n".join(table) + "\n", encoding="utf-8")
    if not quiet:
        print("\n".join(table))
    return 0
