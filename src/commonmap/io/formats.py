"""The map files that can be read and written, one row each, and the choice among them.

A file is chosen by its suffix, and its first bytes must agree: a `.ply` that is really LAS is told
as such and not guessed at.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, cast

from commonmap.errors import InputError, MissingExtraError
from commonmap.io.columns import Column
from commonmap.io.source import PathLike, is_text, look, looks_like, recognise
from commonmap.types import Cloud, Leaves

Map = Cloud | Leaves
Holds = Literal["cloud", "octree"]


class WriteCloud(Protocol):
    """Writes a cloud; `extra` holds more columns, name -> (N,) numbers."""

    def __call__(
        self, path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None
    ) -> None:
        """Write `cloud` to `path`, whole or not at all."""


@dataclass(frozen=True)
class Reader:
    """A format that can be read.

    suffixes: in lower case, with the dot. holds: what `load` returns. content: the name that
    `source.recognise` gives such files, None for plain text. load, version: from a path to the
    map, and to a line that names the version of the format. needs: modules to be installed, which
    come with the extra `extra` of the package (None: with the package itself).
    """

    name: str
    suffixes: tuple[str, ...]
    holds: Holds
    content: tuple[str, ...] | None
    load: Callable[[Path], Map]
    version: Callable[[Path], str]
    needs: tuple[str, ...] = ()
    extra: str | None = None

    def available(self) -> str | None:
        """Return None where the reader can be used, else why not."""
        return _missing(self.name, self.needs, self.extra)


@dataclass(frozen=True)
class Writer:
    """A format that can be written. store: an octree's or a cloud's writer, by `holds`."""

    name: str
    suffixes: tuple[str, ...]
    holds: Holds
    store: Callable[..., None]
    needs: tuple[str, ...] = ()
    extra: str | None = None

    def available(self) -> str | None:
        """Return None where the writer can be used, else why not."""
        return _missing(self.name, self.needs, self.extra)


def _missing(name: str, needs: tuple[str, ...], extra: str | None) -> str | None:
    absent = [module for module in needs if importlib.util.find_spec(module) is None]
    if not absent:
        return None
    package = f"commonmap[{extra}]" if extra else " ".join(absent)
    return f"{name} needs {', '.join(absent)}: pip install '{package}'"


def _load_las(path: Path) -> Cloud:
    from commonmap.io.las import read_las

    return read_las(path)


def _load_ply(path: Path) -> Cloud:
    from commonmap.io.ply import read_ply

    return read_ply(path)


def _load_pcd(path: Path) -> Cloud:
    from commonmap.io.pcd import read_pcd

    return read_pcd(path)


def _load_xyz(path: Path) -> Cloud:
    from commonmap.io.text import read_xyz

    return read_xyz(path)


def _load_npy(path: Path) -> Cloud:
    from commonmap.io.numpy_files import read_npy

    return read_npy(path)


def _load_npz(path: Path) -> Cloud:
    from commonmap.io.numpy_files import read_npz

    return read_npz(path)


def _load_octree(path: Path) -> Leaves:
    from commonmap.io.octomap import read_octree

    return read_octree(path)


def _version_las(path: Path) -> str:
    from commonmap.io.las import las_version

    return las_version(path)


def _version_ply(path: Path) -> str:
    from commonmap.io.ply import ply_version

    return ply_version(path)


def _version_pcd(path: Path) -> str:
    from commonmap.io.pcd import pcd_version

    return pcd_version(path)


def _version_xyz(path: Path) -> str:
    from commonmap.io.text import text_version

    return text_version(path)


def _version_npy(path: Path) -> str:
    from commonmap.io.numpy_files import npy_version

    return npy_version(path)


def _version_octree(path: Path) -> str:
    head = look(path)[2]
    return "OctoMap .bt (binary)" if b"binary" in head[:40] else "OctoMap .ot (full)"


def _store_las(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    from commonmap.io.las import write_las

    write_las(path, cloud, extra=extra)


def _store_ply(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    from commonmap.io.ply import write_ply

    write_ply(path, cloud, extra=extra)


def _store_pcd(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    from commonmap.io.pcd import write_pcd

    write_pcd(path, cloud, extra=extra)


def _store_xyz(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    from commonmap.io.text import write_xyz

    write_xyz(path, cloud, extra=extra)


def _store_npy(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    from commonmap.io.numpy_files import write_npy

    write_npy(path, cloud, extra=extra)


def _store_npz(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    from commonmap.io.numpy_files import write_npz

    write_npz(path, cloud, extra=extra)


def _store_octree(path: PathLike, leaves: Leaves) -> None:
    from commonmap.io.octomap import write_octree

    write_octree(Path(path), leaves)


_LAS_NEEDS = ("laspy", "lazrs")
_TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", ".pts")
_OCTOMAP = ("OctoMap .bt", "OctoMap .ot")

READERS: tuple[Reader, ...] = (
    Reader("LAS/LAZ", (".las", ".laz"), "cloud", ("LAS/LAZ",), _load_las, _version_las, _LAS_NEEDS),
    Reader("PLY", (".ply",), "cloud", ("PLY",), _load_ply, _version_ply),
    Reader("PCD", (".pcd",), "cloud", ("PCD",), _load_pcd, _version_pcd),
    Reader("XYZ/CSV", _TEXT_SUFFIXES, "cloud", None, _load_xyz, _version_xyz),
    Reader("NPY", (".npy",), "cloud", ("NPY",), _load_npy, _version_npy),
    Reader("NPZ", (".npz",), "cloud", ("NPZ",), _load_npz, _version_npy),
    Reader("OctoMap", (".bt", ".ot"), "octree", _OCTOMAP, _load_octree, _version_octree),
)

WRITERS: tuple[Writer, ...] = (
    Writer("LAS/LAZ", (".las", ".laz"), "cloud", _store_las, _LAS_NEEDS),
    Writer("PLY", (".ply",), "cloud", _store_ply),
    Writer("PCD", (".pcd",), "cloud", _store_pcd),
    Writer("XYZ/CSV", (".xyz", ".txt", ".csv"), "cloud", _store_xyz),
    Writer("NPY", (".npy",), "cloud", _store_npy),
    Writer("NPZ", (".npz",), "cloud", _store_npz),
    Writer("OctoMap", (".bt", ".ot"), "octree", _store_octree),
)


def find_reader(path: PathLike) -> Reader:
    """Return the reader of a file, or raise why there is none.

    Its suffix must be known and its first bytes must be those of that format.
    """
    path, _, head = look(path)
    suffix = path.suffix.lower()
    reader = next((row for row in READERS if suffix in row.suffixes), None)
    if reader is None:
        raise InputError(
            f"{path} has no suffix of a map file that can be read ({suffixes(READERS)}); "
            f"{looks_like(head)}"
        )
    content = recognise(head)
    if reader.content is None:
        agrees = (content is None and is_text(head)) or head[:2] in (b"\xff\xfe", b"\xfe\xff")
    else:
        agrees = content in reader.content
    if not agrees:
        raise InputError(f"{path} should be {reader.name} by its suffix, but {looks_like(head)}")
    _require_available(reader)
    return reader


def find_writer(path: PathLike, holds: Holds | None = None) -> Writer:
    """Return the writer for the suffix of `path`, or raise `InputError` listing what there is.

    holds: what is to be written; None for anything. Callers check this before a long job.
    """
    suffix = Path(path).suffix.lower()
    rows = [row for row in WRITERS if holds in (None, row.holds)]
    writer = next((row for row in rows if suffix in row.suffixes), None)
    if writer is None:
        what = {"cloud": "a cloud", "octree": "an octree", None: "a map"}[holds]
        raise InputError(f"{path}: {what} is written to a file ending in {suffixes(rows)}")
    _require_available(writer)
    return writer


def read_map(path: PathLike) -> Map:
    """Return the map in a file: a `Cloud`, or the `Leaves` of an octree.

    Every fault of the file raises an `InputError` of one sentence; what was left out or converted
    is told to the logger `commonmap`.
    """
    return find_reader(path).load(Path(path))


def read_cloud(path: PathLike) -> Cloud:
    """Return the cloud in a file; an octree raises `InputError`."""
    reader = find_reader(path)
    if reader.holds != "cloud":
        rows = [row for row in READERS if row.holds == "cloud"]
        raise InputError(f"{path} holds an octree; a cloud was expected ({suffixes(rows)})")
    return cast(Cloud, reader.load(Path(path)))


def write_map(path: PathLike, map_: Map) -> None:
    """Write a cloud or the leaves of an octree in the format that the suffix names."""
    if isinstance(map_, Leaves):
        find_writer(path, "octree").store(path, map_)
    else:
        find_writer(path, "cloud").store(path, map_)


def write_cloud(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    """Write a cloud in the format that the suffix names. extra: more columns, name -> (N,)."""
    cast(WriteCloud, find_writer(path, "cloud").store)(path, cloud, extra=extra)


def suffixes(rows: tuple[Reader, ...] | tuple[Writer, ...] | list[Reader] | list[Writer]) -> str:
    """Return the suffixes of the rows of a table, as a list in words."""
    return " ".join(suffix for row in rows for suffix in row.suffixes)


def _require_available(row: Reader | Writer) -> None:
    missing = row.available()
    if missing is not None:
        raise MissingExtraError(missing)
