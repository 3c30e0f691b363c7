"""The command line: its commands by name, its exit codes, and what becomes of errors.

Each command imports what it uses when it runs, so that `--help` answers at once.

Exit codes: 0 done (a match: accepted), 2 bad input, 3 the match was refused, 130 interrupted.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from commonmap.cli_mapping import octree_command, odometry_command
from commonmap.cli_matching import match_command, merge_command, run_command
from commonmap.cli_options import Quiet
from commonmap.cli_simulating import demo_command, simulate_command
from commonmap.cli_study import study_app
from commonmap.cli_words import in_words
from commonmap.errors import CommonmapError
from commonmap.version import __version__

USAGE_ERROR: Any = typer.BadParameter.__mro__[2]
"""What click raises for a wrong command line; newer releases of typer bring their own click."""

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


app.command("run")(run_command)
app.command("match")(match_command)
app.command("merge")(merge_command)
app.command("odometry")(odometry_command)
app.command("octree")(octree_command)
app.command("demo")(demo_command)
app.command("simulate")(simulate_command)


@app.command("info")
def info_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A cloud, an octree or scans.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    quiet: Quiet = False,
) -> int:
    """Say what is in a file: kind, points, extent, resolution, CRS, time span."""
    from commonmap.cli_progress import noting
    from commonmap.io.describe import describe
    from commonmap.report.pose import to_json

    with noting(quiet):
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
