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
