"""A folder of scans, as measured by a turning lidar, in the layout of the KITTI odometry set:

    times.txt              one line a scan: time of its first firing, seconds
    velodyne/000000.bin    float32 little endian: x y z intensity of each point, sensor frame
    time/000000.npy        float64 (N,): when each point was measured, seconds, clock of the log
    ring/000000.npy        uint16 (N,): the channel of each point, lowest first

`times.txt` and `velodyne/` are those of KITTI, so its readers open the folder; `time/` and
`ring/` are what KITTI leaves out. A folder without them cannot be read as `Scan`s.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.io.atomic import writing_folder
from commonmap.io.numpy_files import read_array
from commonmap.io.source import PathLike, look, open_bounded, parsing
from commonmap.types import Scan

ENTRIES = ("times.txt", "velodyne", "time", "ring")
POINT_BYTES = 16


def write_scans(folder: PathLike, scans: Iterable[Scan]) -> int:
    """Write scans to a folder, whole or not at all, and return how many.

    A folder written earlier is replaced; one that holds anything else raises `OutputError`.
    """
    stamps: list[float] = []
    with writing_folder(folder, replaces=ENTRIES) as part:
        for name in ENTRIES[1:]:
            (part / name).mkdir()
        for index, scan in enumerate(scans):
            _check(scan, index, stamps, folder)
            stamps.append(float(scan.stamp))
            points = np.empty((len(scan.xyz), 4), dtype="<f4")
            points[:, :3] = scan.xyz
            points[:, 3] = scan.intensity
            points.tofile(part / "velodyne" / f"{index:06d}.bin")
            np.save(part / "time" / f"{index:06d}.npy", scan.time.astype("<f8"))
            np.save(part / "ring" / f"{index:06d}.npy", scan.ring.astype("<u2"))
        if not stamps:
            raise InputError(f"{folder} is not written: there are no scans")
        (part / "times.txt").write_text("".join(f"{stamp!r}\n" for stamp in stamps), "ascii")
    return len(stamps)


def iter_scans(folder: PathLike) -> Iterator[Scan]:
    """Yield the scans of a folder in the order of time, one at a time.

    Points without finite coordinates are left out. The first fault raises `InputError`; that the
    folder is complete is checked before the first scan is returned.
    """
    folder = Path(folder)
    stamps = scan_times(folder)
    check_complete(folder, len(stamps))
    return (read_scan(folder, index, float(stamp)) for index, stamp in enumerate(stamps))


def check_complete(folder: Path, n_scans: int) -> None:
    """Raise where a file of one of the scans is not there."""
    for index in range(n_scans):
        for part in _files(folder, index):
            if not part.is_file():
                raise InputError(f"{folder}: {part.relative_to(folder)} is missing")


def scan_times(folder: PathLike) -> NDArray[np.float64]:
    """Return the stamps (M,) of the scans of a folder, seconds, rising."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}")
    if not (folder / "times.txt").is_file():
        raise InputError(f"{folder} is no folder of scans: it has no times.txt")
    path, _, _ = look(folder / "times.txt")
    with parsing(path, "a list of times"):
        words = path.read_text("ascii").split()
        stamps = np.array([float(word) for word in words], dtype=np.float64)
    if not len(stamps) or not np.isfinite(stamps).all() or (np.diff(stamps) <= 0).any():
        raise InputError(f"{path} must hold rising times in seconds, one a line")
    return stamps


def _files(folder: Path, index: int) -> tuple[Path, Path, Path]:
    name = f"{index:06d}"
    return (
        folder / "velodyne" / f"{name}.bin",
        folder / "time" / f"{name}.npy",
        folder / "ring" / f"{name}.npy",
    )


def read_scan(folder: Path, index: int, stamp: float) -> Scan:
    """Return one scan of a folder. Points without finite coordinates are left out."""
    bin_path, time_path, ring_path = _files(folder, index)
    for part in (bin_path, time_path, ring_path):
        if not part.is_file():
            raise InputError(f"{folder}: {part.relative_to(folder)} is missing")
    size = bin_path.stat().st_size
    if size % POINT_BYTES:
        raise InputError(
            f"{bin_path} is truncated: it has {size} bytes, not a multiple of {POINT_BYTES}"
        )
    with parsing(bin_path, "a scan"):
        points = np.fromfile(bin_path, dtype="<f4").reshape(-1, 4)
    time = _column(time_path, np.dtype("<f8"), len(points))
    ring = _column(ring_path, np.dtype("<u2"), len(points))
    finite = np.isfinite(points).all(axis=1) & np.isfinite(time)
    points = points[finite]
    return Scan(
        xyz=np.ascontiguousarray(points[:, :3], dtype=np.float32),
        time=time[finite].astype(np.float64),
        ring=ring[finite].astype(np.uint16),
        intensity=np.ascontiguousarray(points[:, 3], dtype=np.float32),
        stamp=stamp,
    )


def _column(path: Path, dtype: np.dtype[Any], n: int) -> NDArray[Any]:
    with parsing(path, "NPY"):
        array = np.empty(0, dtype)
        if n:
            with open_bounded(path) as file:
                array = read_array(file, path.stat().st_size, path)
        if array.shape != (n,) or array.dtype != dtype:
            raise InputError(
                f"{path} must hold {n} values of {dtype}; {array.dtype} of shape {array.shape} came"
            )
        return np.array(array)


def _check(scan: Scan, index: int, stamps: list[float], folder: PathLike) -> None:
    n = len(scan.xyz)
    shapes = (scan.xyz.shape, scan.time.shape, scan.ring.shape, scan.intensity.shape)
    if shapes != ((n, 3), (n,), (n,), (n,)):
        raise InputError(f"{folder}: scan {index} has arrays of unequal length: {shapes}")
    if not math.isfinite(scan.stamp) or (stamps and scan.stamp <= stamps[-1]):
        raise InputError(f"{folder}: the stamp of scan {index} does not rise ({scan.stamp})")
