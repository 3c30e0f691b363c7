"""Damaged files for tests and benchmarks: what is damaged, how, and what a reader may do then."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from commonmap.io.logs import iter_scans, open_log, read_acceleration, read_poses
from commonmap.io.trajectory import write_trajectory
from commonmap.sim.logs import write_kitti, write_mcap, write_pcap
from commonmap.types import Trajectory
from lidar_scans import vlp16_scans
from log_files import write_bag1, write_mcap_zstd, write_ng, write_sqlite

SPARSE = vlp16_scans(2, every=150, start=1_700_000_000.0)
"""Turns of some 200 points, so that a damaged file is read in milliseconds."""

POSES = Trajectory(np.linspace(1_700_000_000.0, 1_700_000_000.2, 5), np.tile(np.eye(4), (5, 1, 1)))


def _zstd(path: Path) -> None:
    write_mcap_zstd(path, SPARSE)


def _files(path: Path, suffix: str) -> None:
    """Write a folder of two clouds as .pcd, .ply or .bin, with their times."""
    from commonmap.io import write_cloud
    from commonmap.types import Cloud

    path.mkdir()
    for i, scan in enumerate(SPARSE):
        file = path / f"{i:06d}{suffix}"
        if suffix == ".bin":
            np.column_stack([scan.xyz, scan.intensity]).astype("<f4").tofile(file)
        else:
            xyz, intensity = scan.xyz.astype(np.float64), scan.intensity / np.float32(255)
            write_cloud(file, Cloud(xyz=xyz, intensity=intensity, time=scan.time))
    (path / "times.txt").write_text("0.0\n0.1\n")


def _kitti_poses(path: Path) -> None:
    path.mkdir()
    (path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 5)
    (path / "times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(5)))
    (path / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")


LOGS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "pcap": ("a.pcap", lambda p: write_pcap(p, SPARSE[:1])),
    "pcap dual": ("a.pcap", lambda p: write_pcap(p, SPARSE[:1], returns="dual")),
    "pcapng": ("a.pcapng", lambda p: write_ng(p, SPARSE[:1])),
    "mcap": ("a.mcap", lambda p: write_mcap(p, SPARSE, poses=POSES)),
    "mcap zstd": ("a.mcap", _zstd),
    "bag": ("a.bag", lambda p: write_bag1(p, SPARSE)),
    "bag bz2": ("a.bag", lambda p: write_bag1(p, SPARSE, compression="BZ2")),
    "bag lz4 packets": (
        "a.bag",
        lambda p: write_bag1(p, SPARSE[:1], compression="LZ4", packets=True),
    ),
    "db3": ("a.db3", lambda p: write_sqlite(p, SPARSE)),
    "scans": ("k", lambda p: write_kitti(p, SPARSE)),
    "files bin": ("b", lambda p: _files(p, ".bin")),
    "files pcd": ("c", lambda p: _files(p, ".pcd")),
    "files ply": ("d", lambda p: _files(p, ".ply")),
}
"""Kind of log -> (name of a file or folder, what writes it there)."""

POSE_FILES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "tum": ("a.tum", lambda p: write_trajectory(p, POSES)),
    "kitti poses": ("e", _kitti_poses),
}
"""Kind of file with poses -> the same."""


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a copy that was cut, or in which bytes were changed, lost, or replaced by noise."""
    if not data:
        return data
    how = rng.integers(0, 6)
    changed = bytearray(data)
    if how == 0:
        return bytes(changed[: rng.integers(0, len(changed))])
    if how == 1:
        for _ in range(rng.integers(1, 20)):
            changed[rng.integers(0, len(changed))] ^= 1 << rng.integers(0, 8)
        return bytes(changed)
    if how == 2:
        # lengths live near the start and the end
        at = int(rng.integers(0, min(400, len(changed))))
        at = at if rng.uniform() < 0.5 else len(changed) - 1 - at
        changed[at : at + 4] = rng.integers(0, 256, 4, dtype=np.uint8).tobytes()
        return bytes(changed)
    if how == 3:
        a, b = sorted(rng.integers(0, len(changed), 2).tolist())
        return bytes(changed[:a] + changed[b:])
    if how == 4:
        at = int(rng.integers(0, len(changed)))
        n = int(rng.integers(1, 200))
        changed[at : at + n] = rng.integers(0, 256, n, dtype=np.uint8).tobytes()
        return bytes(changed)
    # a true beginning, then noise
    keep = int(rng.integers(0, 64))
    noise = rng.integers(0, 256, int(rng.integers(0, 2000)), dtype=np.uint8).tobytes()
    return bytes(changed[:keep]) + noise


class Victim:
    """A file or folder, whole and damaged by turns: `damage` changes one file of it in place."""

    def __init__(self, path: Path):
        self.path = path
        files = sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]
        self._whole = [(file, file.read_bytes()) for file in files]
        self._last = 0

    def damage(self, i: int, rng: np.random.Generator) -> None:
        """Put back what was damaged last, and damage the i-th file."""
        file, whole = self._whole[self._last]
        file.write_bytes(whole)
        self._last = i % len(self._whole)
        file, whole = self._whole[self._last]
        file.write_bytes(damage(whole, rng))

    def read(self) -> bytes:
        """Return the bytes of the damaged file."""
        return self._whole[self._last][0].read_bytes()


def jobs_on_log(path: Path, *, keep_partial: bool) -> list[Callable[[], object]]:
    """Return all that the commands do with a log."""
    return [
        lambda: open_log(path, keep_partial=keep_partial),
        lambda: [len(scan.xyz) for scan in iter_scans(path, keep_partial=keep_partial)],
        lambda: read_poses(path),
        lambda: read_acceleration(path),
    ]


def jobs_on_poses(path: Path) -> list[Callable[[], object]]:
    """Return all that the commands do with a file of poses."""
    return [lambda: read_poses(path / "poses.txt" if path.is_dir() else path)]
