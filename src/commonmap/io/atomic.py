"""Files that appear whole or not at all: written beside their place, then renamed into it.

    with writing(path) as part:
        part.write_bytes(...)

`part` lies in the folder of `path` and keeps its suffix. When the block ends, the data is flushed
to the disk and the file takes its name in one step; when the block fails, or is interrupted,
nothing is left behind and an older file of that name is untouched. What the system refuses
(disk full, no permission, no such folder) becomes an `OutputError` of one sentence.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

from commonmap.errors import OutputError

PathLike = str | os.PathLike[str]


@contextlib.contextmanager
def writing(path: PathLike) -> Iterator[Path]:
    """Yield the path to write to; when the block ends the file stands at `path`."""
    with writing_all(path) as (part,):
        yield part


@contextlib.contextmanager
def writing_all(*paths: PathLike) -> Iterator[tuple[Path, ...]]:
    """Yield one path to write to for each of `paths`; all files appear, or none does.

    Raises `OutputError` where the system refuses, or where the block did not write one of them.
    """
    targets = [_target(Path(path)) for path in paths]
    parts = tuple(_beside(target, "part") for target in targets)
    first = targets[0] if targets else Path()
    try:
        try:
            with contextlib.ExitStack() as named:
                for part, target in zip(parts, targets, strict=True):
                    named.enter_context(told_as(part, target))
                yield parts
            for part, target in zip(parts, targets, strict=True):
                if not part.is_file():
                    raise OutputError(f"cannot write {target}: nothing was written")
                _flush(part)
            _rename_all(parts, targets)
        finally:
            for part in parts:
                part.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {first}: {_reason(error)}") from error


@contextlib.contextmanager
def writing_folder(path: PathLike, *, replaces: Collection[str] = ()) -> Iterator[Path]:
    """Yield an empty folder to fill; when the block ends it stands at `path`.

    A folder that is already there is replaced if it holds nothing but entries named in
    `replaces` (what an earlier run wrote); any other raises `OutputError`.
    """
    target = Path(os.path.realpath(path))
    _require_parent(target)
    if target.exists() and not target.is_dir():
        raise OutputError(f"cannot write the folder {target}: a file of that name is there")
    try:
        foreign = sorted(set(os.listdir(target)) - set(replaces)) if target.exists() else []
        if foreign:
            raise OutputError(
                f"cannot write the folder {target}: it already holds other files ({foreign[0]})"
            )
        part, old = _beside(target, "part"), _beside(target, "old")
        try:
            part.mkdir()
            with told_as(part, target):
                yield part
            if target.exists():
                os.rename(target, old)
            try:
                os.rename(part, target)
            except BaseException:
                if old.exists():
                    os.rename(old, target)
                raise
        finally:
            for leftover in (part, old):
                if leftover.exists():
                    shutil.rmtree(leftover, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"cannot write the folder {target}: {_reason(error)}") from error


@contextlib.contextmanager
def told_as(part: Path, target: Path) -> Iterator[None]:
    """Name a file of a folder that is being written as it would be called in the end."""
    try:
        yield
    except OutputError as error:
        raise OutputError(str(error).replace(str(part), str(target))) from error


def _target(path: Path) -> Path:
    """Return the real place of a file to write, or raise why it cannot be one."""
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder")
    if target.exists() and not target.is_file():
        raise OutputError(f"cannot write {path}: it is not a regular file")
    _require_parent(target)
    return target


def _require_parent(target: Path) -> None:
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {target}: there is no folder {target.parent}")


def _beside(target: Path, word: str) -> Path:
    """Return an unused hidden name in the same folder, with the same suffix, not too long."""
    stem = f".{target.stem[:80]}.{secrets.token_hex(4)}.{word}"
    return target.with_name(stem + target.suffix[:40])


def _flush(part: Path) -> None:
    with open(part, "r+b") as file:
        os.fsync(file.fileno())


def _rename_all(parts: tuple[Path, ...], targets: list[Path]) -> None:
    """Rename all, or put back what stood there before and raise."""
    if len(parts) == 1:
        os.replace(parts[0], targets[0])
        return
    done: list[tuple[Path, Path | None]] = []
    try:
        for part, target in zip(parts, targets, strict=True):
            old = _beside(target, "old") if target.exists() else None
            if old is not None:
                os.rename(target, old)
            done.append((target, old))
            os.replace(part, target)
    except BaseException:
        for target, old in done:
            target.unlink(missing_ok=True)
            if old is not None:
                os.rename(old, target)
        raise
    for _, old in done:
        if old is not None:
            old.unlink(missing_ok=True)


def _reason(error: OSError) -> str:
    if error.strerror is None and "requested and" in str(error):
        return "no space left on device"  # so NumPy says how many items it could not write
    return (error.strerror or str(error) or type(error).__name__).lower()
