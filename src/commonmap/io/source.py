"""What every reader asks first: is it a file, how large is it, what its first bytes look like."""

from __future__ import annotations

import contextlib
import io
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from commonmap.errors import CommonmapError, InputError

PathLike = str | os.PathLike[str]

log = logging.getLogger("commonmap")
"""Where readers say what they did to the data (points dropped, units converted)."""

HEAD_BYTES = 4096

SIGNATURES: tuple[tuple[bytes, str], ...] = (
    (b"LASF", "LAS/LAZ"),
    (b"ply\n", "PLY"),
    (b"ply\r", "PLY"),
    (b"# .PCD", "PCD"),
    (b"# Octomap OcTree binary file", "OctoMap .bt"),
    (b"# Octomap OcTree file", "OctoMap .ot"),
    (b"\x93NUMPY", "NPY"),
    (b"PK\x03\x04", "NPZ"),
    (b"ASTM-E57", "E57"),
    (b"#ROSBAG", "ROS 1 bag"),
    (b"SQLite format 3", "SQLite (ROS 2 bag)"),
    (b"\x89MCAP", "MCAP"),
    (b"\xd4\xc3\xb2\xa1", "pcap"),
    (b"\xa1\xb2\xc3\xd4", "pcap"),
    (b"\x4d\x3c\xb2\xa1", "pcap"),
    (b"\xa1\xb2\x3c\x4d", "pcap"),
    (b"\x0a\x0d\x0d\x0a", "pcapng"),
    (b"\x1f\x8b", "gzip"),
    (b"7z\xbc\xaf", "7-Zip"),
    (b"II*\x00", "TIFF"),
    (b"MM\x00*", "TIFF"),
    (b"II+\x00", "TIFF"),
    (b"glTF", "glTF"),
    (b"\x89PNG", "PNG"),
    (b"\xff\xd8\xff", "JPEG"),
    (b"\x89HDF", "HDF5"),
    (b"%PDF", "PDF"),
    (b"\x7fELF", "program"),
    (b"<!DOCTYPE", "HTML"),
    (b"<html", "HTML"),
    (b"<?xml", "XML"),
    (b"version https://git-lfs", "Git LFS pointer"),
    (b"P5", "PGM"),
)
"""First bytes and the name of the format that begins so."""


def look(path: PathLike) -> tuple[Path, int, bytes]:
    """Return (path, size in bytes, first bytes) of a file that can be read and is not empty."""
    path = Path(path)
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder; a file was expected")
        if not path.exists():
            raise InputError(f"there is no file {path}")
        if not path.is_file():
            raise InputError(f"{path} is not a regular file")
        size = path.stat().st_size
        with open(path, "rb") as file:
            head = file.read(HEAD_BYTES)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}: {reason(error)}") from None
    if not head:
        raise InputError(f"{path} is empty (0 bytes)")
    return path, size, head


class _Bounded(io.BufferedReader):
    """A file that makes room for no more bytes than it has left, whatever is asked of it."""

    def __init__(self, raw: io.FileIO):
        super().__init__(raw)
        self._size = raw.seek(0, io.SEEK_END)
        raw.seek(0)

    def read(self, size: int | None = -1) -> bytes:
        """Return up to `size` bytes."""
        if size is None or size < 0:
            return super().read()
        return super().read(min(size, max(self._size - self.tell(), 0)))


def open_bounded(path: PathLike) -> io.BufferedReader:
    """Return a file opened for a parser that believes the lengths it reads in it."""
    return _Bounded(io.FileIO(path))


def recognise(head: bytes) -> str | None:
    """Return the name of the format that a file's first bytes show, None where they show none."""
    for signature, name in SIGNATURES:
        if head.startswith(signature):
            return name
    for line in head.splitlines():
        if line.startswith((b"VERSION ", b"FIELDS ", b"COLUMNS ")):
            return "PCD"
        if line and not line.startswith(b"#"):
            break
    return None


def looks_like(head: bytes) -> str:
    """Return a phrase for an error: what the first bytes look like."""
    name = recognise(head)
    if name is not None:
        return f"its first bytes look like {name}"
    if is_text(head):
        line = head.split(b"\n", 1)[0].strip()[:40].decode("ascii", "replace")
        return f"it begins with the text {line!r}"
    return f"its first bytes are {head[:8].hex(' ')}, of no format known here"


def is_text(head: bytes) -> bool:
    """Return whether the bytes can be text: no NUL and few control characters."""
    controls = sum(1 for byte in head if byte < 32 and byte not in b"\t\n\r\f\x1a")
    return b"\0" not in head and controls * 100 <= len(head)


@contextlib.contextmanager
def parsing(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a parser raises on damaged bytes into an `InputError` with the file's name.

    Errors of commonmap, and interrupts, pass through. (A panic of a Rust library arrives as a
    `BaseException` of its own; it counts as a parser's error.)
    """
    try:
        yield
    except (CommonmapError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except MemoryError:
        raise InputError(f"{path}: too large for the memory of this machine") from None
    except Exception as error:
        raise InputError(f"{path} cannot be read as {kind}: {reason(error)}") from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise InputError(f"{path} cannot be read as {kind}: it is damaged") from error


def reason(error: BaseException) -> str:
    """Return an exception's text as part of a sentence, on one line."""
    text: Any = error.strerror if isinstance(error, OSError) and error.strerror else error
    words = " ".join(str(text).split()).rstrip(".")
    return words[:200] if words else type(error).__name__
