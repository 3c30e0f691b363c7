"""The errors a user can cause, each told in one sentence: what was expected and what came."""

from __future__ import annotations


class CommonmapError(Exception):
    """A known failure. The command line prints its text as one line and exits with `exit_code`."""

    exit_code = 2


class InputError(CommonmapError):
    """A file, an array or an option is not what the software needs."""


class UnitsError(InputError):
    """Coordinates that cannot be metres (degrees, millimetres, feet by mistake)."""


class EmptyMapError(InputError):
    """Too little is left to work with: no finite points, no structure above ground, one cell."""


class OutputError(CommonmapError):
    """A result could not be written (disk full, no permission, no such folder)."""


class MissingExtraError(CommonmapError):
    """An optional dependency is not installed; the text holds the command that installs it."""
