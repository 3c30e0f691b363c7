"""Records that survive an interruption: a JSON line each, added and never rewritten.

A file whose name ends in `.xz` is packed.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return all records of a file, oldest first; none where there is no file."""
    if not path.exists():
        return []
    with _opener(path)(path, "rt", encoding="utf-8") as lines:
        return [json.loads(line) for line in lines]


def add_lines(path: Path, records: Iterable[dict[str, Any]]) -> None:
    """Add records at the end of a file, which is made where there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with _opener(path)(path, "at", encoding="utf-8") as out:
        out.writelines(json.dumps(record) + "\n" for record in records)


def _opener(path: Path) -> Any:
    return lzma.open if path.suffix == ".xz" else open
