"""Point lists as text (XYZ, CSV, TXT, ASC, PTS): delimiter, header and comments are found out."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from commonmap.errors import EmptyMapError, InputError
from commonmap.io.atomic import writing
from commonmap.io.columns import Column, cloud_of, columns_of, require_xyz
from commonmap.io.source import PathLike, is_text, look, looks_like, parsing
from commonmap.types import Cloud, Float64s

COMMENTS = ("#", "//", "%", "!")
HEAD_LINES = 200
MAX_LINE = 1 << 16


class Layout(NamedTuple):
    """How a text is laid out.

    skip: bytes before the first row of numbers. delimiter: None for white space. columns: name
    here -> index. n_columns: of the first row. n_claimed: rows that the first line says.
    """

    skip: int
    delimiter: str | None
    columns: dict[str, int]
    n_columns: int
    n_claimed: int | None
    crs: str | None


def read_xyz(path: PathLike) -> Cloud:
    """Return the points of a text with one point a line.

    Numbers are separated by commas, semicolons, tabs or blanks. Lines that begin with `#`, `//`,
    `%` or `!` are comments. With a header row the columns are taken by name (x y z, and colour,
    intensity, time where named); without one the first three columns are x, y, z. A first line
    that is a single number is the count of points (PTS).
    """
    path, _, head = look(path)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path} is text in UTF-16; save it as UTF-8")
    if not is_text(head):
        raise InputError(f"{path} should hold one point a line as text, but {looks_like(head)}")
    with parsing(path, "a list of points"), open(path, "rb") as file:
        layout = _find_layout(file, path)
        file.seek(layout.skip)
        rows = read_rows(
            file,
            path,
            n_columns=layout.n_columns,
            delimiter=layout.delimiter,
            use=tuple(layout.columns.values()),
            comments="#",
            max_rows=None,
        )
    if layout.n_claimed is not None and len(rows) < layout.n_claimed:
        raise InputError(
            f"{path} is truncated: its first line says {layout.n_claimed} points, {len(rows)} came"
        )
    columns: dict[str, Column] = {name: rows[:, i] for i, name in enumerate(layout.columns)}
    return cloud_of(columns, path, crs=layout.crs)


def text_version(path: Path) -> str:
    """Return how the text is laid out: "text, comma, 5 columns"."""
    path, _, _ = look(path)
    with parsing(path, "a list of points"), open(path, "rb") as file:
        layout = _find_layout(file, path)
    names = {None: "blanks", ",": "comma", ";": "semicolon", "\t": "tab"}
    return f"text, {names[layout.delimiter]}, {layout.n_columns} columns"


def write_xyz(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    """Write a text with a header row: comma separated for `.csv`, else blanks.

    Every number has as many digits as bring it back exactly.
    """
    path = Path(path)
    columns = columns_of(cloud, extra, path)
    for i, axis in enumerate("xyz"):
        columns[axis] = cloud.xyz[:, i]
    delimiter = "," if path.suffix.lower() == ".csv" else " "
    with writing(path) as part, open(part, "w", encoding="utf-8", newline="\n") as file:
        if cloud.crs is not None:
            file.write("# crs " + " ".join(cloud.crs.split()) + "\n")
        file.write(delimiter.join(columns) + "\n")
        for start in range(0, len(cloud.xyz), 100_000):
            block = [c[start : start + 100_000] for c in columns.values()]
            words = [[str(value) for value in column] for column in block]
            file.writelines(delimiter.join(row) + "\n" for row in zip(*words, strict=True))


def read_rows(
    file: BinaryIO,
    path: Path,
    *,
    n_columns: int,
    delimiter: str | None = None,
    use: tuple[int, ...] | None = None,
    comments: str | None = None,
    max_rows: int | None,
) -> Float64s:
    """Return the rows of numbers that follow in `file`, (N, columns), as float64.

    use: indices of the columns to return, None for all. Raises `InputError` naming the fault
    where a row is short or holds anything else.
    """
    text = io.TextIOWrapper(file, encoding="utf-8", errors="replace", newline=None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows = np.loadtxt(
                text,
                dtype=np.float64,
                comments=comments,
                delimiter=delimiter,
                usecols=use,
                ndmin=2,
                max_rows=max_rows,
            )
    except (ValueError, OverflowError) as error:
        words = " ".join(str(error).split()).split(";")[0].rstrip(".")
        raise InputError(f"{path}: a row does not hold the numbers expected ({words})") from None
    finally:
        text.detach()
    if rows.size == 0:
        return np.empty((0, len(use) if use else n_columns))
    if use is None and rows.shape[1] != n_columns:
        raise InputError(f"{path}: rows hold {rows.shape[1]} numbers; {n_columns} were expected")
    return rows


def _find_layout(file: BinaryIO, path: Path) -> Layout:
    """Read the first lines and find out what they mean."""
    count: int | None = None
    crs: str | None = None
    names: list[str] | None = None
    comment_names: list[str] | None = None
    for _ in range(HEAD_LINES):
        start = file.tell()
        raw = file.readline(MAX_LINE)
        if not raw:
            break
        line = raw.decode("utf-8-sig" if start == 0 else "utf-8", "replace").strip()
        if not line:
            continue
        comment = next((c for c in COMMENTS if line.startswith(c)), None)
        if comment is not None:
            words = line.lstrip("#/%!").split()
            if words[:1] == ["crs"]:
                crs = " ".join(words[1:])
            elif names is None:
                comment_names = _split(" ".join(words), _delimiter(" ".join(words)))
            continue
        delimiter = _delimiter(line)
        words = _split(line, delimiter)
        if len(words) == 1 and count is None and words[0].isascii() and words[0].isdigit():
            count = int(words[0])
            continue
        if names is not None or all(_is_number(word) for word in words[:3]):
            return _layout(start, delimiter, words, names, comment_names, count, crs, path)
        if line.lower().startswith("ncols"):
            raise InputError(f"{path} is an ESRI grid, not a list of points")
        first = line.split(";" if delimiter == ";" else None)[0]
        if first.count(",") == 1 and all(map(_is_number, first.replace(",", " ").split())):
            raise InputError(f"{path} has decimal commas ({first}); write decimal points")
        names = words
    raise EmptyMapError(f"{path} holds no points")


def _layout(
    start: int,
    delimiter: str | None,
    words: list[str],
    names: list[str] | None,
    comment_names: list[str] | None,
    count: int | None,
    crs: str | None,
    path: Path,
) -> Layout:
    if names is not None:
        columns = require_xyz(names, path)
        if max(columns.values()) >= len(words):
            raise InputError(
                f"{path}: its header names {len(names)} columns, rows have {len(words)}"
            )
    else:
        columns = {axis: i for i, axis in enumerate("xyz")}
        if comment_names is not None and len(comment_names) == len(words):
            lowered = [name.lower() for name in comment_names]
            if {"x", "y", "z"} <= set(lowered):
                columns = require_xyz(comment_names, path)
        if len(words) < 3:
            raise InputError(f"{path}: rows hold x, y and z or more; {len(words)} came")
    return Layout(start, delimiter, columns, len(words), count, crs)


def _delimiter(line: str) -> str | None:
    """Return the delimiter of a line, None for white space."""
    for candidate in (";", "\t", ","):
        if candidate in line and len(_split(line, candidate)) >= 2:
            return candidate
    return None


def _split(line: str, delimiter: str | None) -> list[str]:
    words = [word.strip() for word in line.split(delimiter)]
    return words[:-1] if delimiter and words and not words[-1] else words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
