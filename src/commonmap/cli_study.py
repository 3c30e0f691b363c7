"""`commonmap study`: one command an experiment. Each imports what it uses when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from commonmap.errors import InputError

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
    seed: Annotated[int, typer.Option(help="Seed of the scene and the sensors' noise.")] = 1,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
) -> int:
    """Run the source paper's experiment and test its claims."""
    raise InputError(f"the paper's experiment is not there yet; nothing is written to {out}")


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
