"""Folders of scans, one file each: KITTI `.bin`, `.pcd`, `.ply`.

Of a KITTI folder, `times.txt` (one line a scan, seconds) may lie in it or beside its `velodyne`.
Without times, scans are taken to follow each other at 10 Hz; the user is told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from commonmap.errors import InputError
from commonmap.io import scans as own
from commonmap.io.logs.derive import Seam, find_seam, rings_of, times_of
from commonmap.io.logs.pointcloud2 import are_returns
from commonmap.io.logs.poses import pose_files
from commonmap.io.logs.record import Log, Options, Teller
from commonmap.io.source import log, parsing
from commonmap.types import Float64s, Progress, Scan, no_progress

LOOKED_AT = 8
"""Scans that tell whether those of a folder were deskewed."""

RATE = 10.0
"""Scans a second where nothing says it."""

SUFFIXES = (".bin", ".pcd", ".ply")


def is_own_folder(path: Path) -> bool:
    """Return whether a folder is one of `write_scans`, with time and ring of each point."""
    return path.is_dir() and all((path / name).exists() for name in own.ENTRIES)


def scan_files(path: Path) -> list[Path]:
    """Return the files of a folder that hold scans, in the order of their names."""
    if not path.is_dir():
        return []
    for place in (path, path / "velodyne", path / "velodyne_points" / "data", path / "data"):
        for suffix in SUFFIXES:
            files = [f for f in place.glob(f"*{suffix}") if f.is_file()] if place.is_dir() else []
            if files:
                return sorted(files, key=lambda f: (_number(f), f.name))
    return []


def _number(file: Path) -> int:
    digits = "".join(c for c in file.stem if c.isdigit())
    return int(digits[-18:]) if digits else 0


def open_own(path: Path, _: Options) -> Log:
    """Return what a folder of `write_scans` holds."""
    times = own.scan_times(path)
    return Log(
        path=path, kind="KITTI folder (velodyne, time, ring)", n_scans=len(times),
        time_span=(float(times[0]), float(times[-1])), poses=pose_files(path),
    )  # fmt: skip


def iter_own(record: Log, options: Options, progress: Progress = no_progress) -> Iterator[Scan]:
    """Yield the scans of a folder of `write_scans`."""
    path = record.path
    stamps = own.scan_times(path)
    if not options.keep_partial:
        own.check_complete(path, len(stamps))
    n = 0
    for i, stamp in enumerate(stamps):
        progress(f"reading {path.name}", i / len(stamps))
        try:
            scan = own.read_scan(path, i, float(stamp))
        except InputError as error:
            if not options.keep_partial:
                raise
            log.warning("%s; the scan is left out", error)
            continue
        n += 1
        yield scan
    if not n:
        raise InputError(f"{path}: none of its {len(stamps)} scans can be read")


def open_folder(path: Path, _: Options) -> Log:
    """Return what a folder of files, a scan each, holds."""
    files = scan_files(path)
    if not files:
        raise InputError(f"{path} holds no scans: no .bin, .pcd or .ply, and no ROS 2 bag")
    times = _times(path, files)
    suffix = files[0].suffix.lower()
    return Log(
        path=path, kind=f"folder of {suffix}", n_scans=len(files),
        time_span=None if times is None else (float(times[0]), float(times[-1])),
        poses=pose_files(path),
    )  # fmt: skip


def iter_folder(record: Log, options: Options, progress: Progress = no_progress) -> Iterator[Scan]:
    """Yield the scans of a folder of files, a scan each."""
    path = record.path
    files = scan_files(path)
    teller = Teller(path)
    stamps = _times(path, files)
    if stamps is None:
        teller.tell(f"it has no times.txt: scans are taken to come {RATE:g} times a second")
        stamps = np.arange(len(files)) / RATE
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0 / RATE
    if options.deskewed is None and not _has_times(files[0]):
        options = replace(options, deskewed=_look_deskewed(files, teller))
    n = 0
    for i, (file, stamp) in enumerate(zip(files, stamps, strict=True)):
        progress(f"reading {path.name}", i / len(files))
        try:
            scan = _read(file, float(stamp), period, options, teller)
        except InputError as error:
            if not options.keep_partial:
                raise
            log.warning("%s; the scan is left out", error)
            continue
        if scan is not None:
            n += 1
            yield scan
    if not n:
        raise InputError(f"{path}: none of its {len(files)} scans has a point")


def _has_times(file: Path) -> bool:
    """Return whether the points of a file have times of their own."""
    if file.suffix.lower() == ".bin":
        return False
    from commonmap.io.formats import read_cloud

    try:
        return read_cloud(file).time is not None
    except InputError:
        return False


def _look_deskewed(files: list[Path], teller: Teller) -> bool:
    """Return whether some of the scans show, at one azimuth, the seam of a turn deskewed."""
    seams: list[Seam] = []
    chosen = files[:: max(1, len(files) // LOOKED_AT)][:LOOKED_AT]
    for file in chosen:
        try:
            scan = _read(file, 0.0, 0.1, Options(deskewed=True), Teller(file, silent=True))
        except InputError:
            continue
        seam = None if scan is None else find_seam(scan.xyz, scan.ring)
        if seam is not None:
            seams.append(seam)
    if len(seams) < 3:
        return False
    azimuth = np.array([seam.azimuth for seam in seams])
    close = np.abs(np.angle(np.exp(1j * (azimuth[:, None] - azimuth)))) < np.radians(2.0)
    if close.sum(axis=1).max() < max(3, 0.6 * len(seams)):
        return False
    where = np.degrees(azimuth[int(close.sum(axis=1).argmax())])
    teller.tell(
        f"its points were moved to one moment (the scans break at {where:.0f} deg): each has the "
        "time of its scan"
    )
    return True


def _times(path: Path, files: list[Path]) -> Float64s | None:
    """Return the stamps (M,) of the files, seconds, None where there are none."""
    places = [files[0].parent / "times.txt", files[0].parent.parent / "times.txt"]
    if path not in (files[0].parent, files[0].parent.parent):
        places.append(path / "times.txt")
    for place in places:
        if place.is_file():
            stamps = own.scan_times(place.parent)
            if len(stamps) != len(files):
                raise InputError(f"{place} has {len(stamps)} times for {len(files)} scans")
            return stamps
    numbers = [file.stem.replace("_", ".") for file in files]
    with_dot = [_seconds(number) for number in numbers]
    if all(value is not None for value in with_dot):
        values = np.array(with_dot, dtype=np.float64)
        # names that are times since 1970 in seconds or nanoseconds, as many exporters write
        if values.min() > 1e17:
            values = values * 1e-9
        if values.min() > 1e8 and (np.diff(values) > 0).all() and np.diff(values).max() < 100.0:
            return values
    return None


def _seconds(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _read(file: Path, stamp: float, period: float, options: Options, teller: Teller) -> Scan | None:
    time: Float64s | None = None
    if file.suffix.lower() == ".bin":
        size = file.stat().st_size
        if size % own.POINT_BYTES:
            raise InputError(
                f"{file} is truncated: it has {size} bytes, not a multiple of {own.POINT_BYTES}"
            )
        with parsing(file, "a KITTI scan"):
            points = np.fromfile(file, dtype="<f4").reshape(-1, 4)
        xyz, intensity = np.ascontiguousarray(points[:, :3], np.float32), points[:, 3]
    else:
        from commonmap.io.formats import read_cloud

        cloud = read_cloud(file)
        xyz = cloud.xyz.astype(np.float32)
        intensity = np.zeros(len(xyz), np.float32) if cloud.intensity is None else cloud.intensity
        time = cloud.time
    kept = are_returns(xyz)
    if not kept.any():
        return None
    xyz, timed = xyz[kept], time is not None
    teller.tell("its points name no channel: it is told from their order or elevation")
    ring = rings_of(xyz)
    if time is not None and not options.deskewed:
        time = time[kept]
        time = time if abs(float(time.min())) > 10.0 else stamp + time
    elif options.deskewed:
        time = np.full(len(xyz), stamp)
    else:
        teller.tell(
            "its points have no time: it is told from their azimuth (say deskewed, --deskewed, if "
            "they were moved to one moment)"
        )
        time = times_of(xyz, ring, stamp, period)
    return Scan(
        xyz=xyz, time=time, ring=ring, intensity=intensity[kept].astype(np.float32),
        stamp=float(time.min()), timed=timed,
    )  # fmt: skip
