"""Damaged logs: cut short, bytes changed, noise. Readers yield scans or raise a known error."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from commonmap.errors import CommonmapError
from commonmap.io.logs import iter_scans, read_poses
from commonmap.io.velodyne import PACKET_BYTES, TurnReader
from commonmap.sim.logs import velodyne_packets, write_kitti, write_mcap, write_pcap
from commonmap.types import Trajectory
from lidar_scans import vlp16_scans
from log_files import write_bag1, write_ng, write_sqlite

N = int(os.environ.get("COMMONMAP_FUZZ", "40"))
"""Damaged copies of each file; the issue's 10,000 are run by hand."""

SLOW = 5.0
"""Seconds no file of this size may take, on a busy machine."""

SPARSE = vlp16_scans(2, every=150, start=1_700_000_000.0)
POSES = Trajectory(np.linspace(1_700_000_000.0, 1_700_000_000.2, 5), np.tile(np.eye(4), (5, 1, 1)))


def _zstd(path: Path) -> None:
    write_mcap(path, SPARSE)
    from log_files import write_mcap_zstd

    path.unlink()
    write_mcap_zstd(path, SPARSE)


MAKERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "pcap": ("a.pcap", lambda p: write_pcap(p, SPARSE)),
    "pcap dual": ("a.pcap", lambda p: write_pcap(p, SPARSE[:1], returns="dual")),
    "pcapng": ("a.pcapng", lambda p: write_ng(p, SPARSE[:1])),
    "mcap": ("a.mcap", lambda p: write_mcap(p, SPARSE, poses=POSES)),
    "mcap zstd": ("a.mcap", _zstd),
    "bag": ("a.bag", lambda p: write_bag1(p, SPARSE)),
    "bag bz2": ("a.bag", lambda p: write_bag1(p, SPARSE, compression="BZ2")),
    "bag lz4 packets": (
        "a.bag",
        lambda p: write_bag1(p, SPARSE, compression="LZ4", packets=True),
    ),
    "db3": ("a.db3", lambda p: write_sqlite(p, SPARSE)),
    "kitti": ("k", lambda p: write_kitti(p, SPARSE)),
}


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a copy that was cut, or in which bytes were changed, or replaced by noise."""
    how = rng.integers(0, 5)
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
    at = int(rng.integers(0, len(changed)))
    n = int(rng.integers(1, 200))
    changed[at : at + n] = rng.integers(0, 256, n, dtype=np.uint8).tobytes()
    return bytes(changed)


def read_all(path: Path, keep_partial: bool) -> None:
    """Read scans and poses; let nothing but known errors out, in bounded time."""
    start = time.monotonic()
    for job in (
        lambda: [len(scan.xyz) for scan in iter_scans(path, keep_partial=keep_partial)],
        lambda: read_poses(path),
    ):
        try:
            job()
        except CommonmapError as error:
            assert "\n" not in str(error)
            assert len(str(error)) < 1000
    assert time.monotonic() - start < SLOW


@pytest.mark.parametrize("kind", MAKERS)
def test_damaged_logs_raise_known_errors(kind: str, tmp_path: Path) -> None:
    name, write = MAKERS[kind]
    path = tmp_path / name
    write(path)
    assert sum(len(scan.xyz) for scan in iter_scans(path)) > 0
    rng = np.random.default_rng(sum(kind.encode()))
    for i in range(N):
        if path.is_dir():
            victim = sorted(f for f in path.rglob("*") if f.is_file())[i % 7]
            copy = tmp_path / "copy"
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(path, copy)
            target = copy / victim.relative_to(path)
        else:
            victim, target = path, tmp_path / f"copy{path.suffix}"
            copy = target
        target.write_bytes(damage(victim.read_bytes(), rng))
        read_all(copy, keep_partial=bool(i % 2))


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.binary(max_size=400), suffix=st.sampled_from([".pcap", ".bag", ".mcap", ".db3"]),
       head=st.sampled_from([b"", b"\xd4\xc3\xb2\xa1", b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n",
                             b"\x0a\x0d\x0d\x0a", b"SQLite format 3\0"]))  # fmt: skip
def test_noise_raises_known_errors(
    data: bytes, suffix: str, head: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("noise", numbered=True) / f"noise{suffix}"
    path.write_bytes(head + data)
    for keep_partial in (False, True):
        with pytest.raises(CommonmapError):
            list(iter_scans(path, keep_partial=keep_partial))


@pytest.mark.parametrize("model", [0x21, 0x22, 0x24, 0x23, 0x28, 0xA1])
def test_packets_of_noise_are_read_or_left_out(model: int) -> None:
    rng = np.random.default_rng(model)
    reader = TurnReader(Path("noise"))
    base = bytearray(next(velodyne_packets(SPARSE[0]))[1])
    for i in range(4 * N):
        packet = bytearray(rng.integers(0, 256, PACKET_BYTES, dtype=np.uint8).tobytes())
        for block in range(12):
            packet[100 * block : 100 * block + 2] = base[:2]
            azimuth = int(rng.integers(0, 36000)) if i % 3 else (480 * i + 40 * block) % 36000
            packet[100 * block + 2 : 100 * block + 4] = azimuth.to_bytes(2, "little")
        stamp = int(rng.integers(0, 3_600_000_000)) if i % 5 == 0 else 1327 * i
        packet[1200:1204] = stamp.to_bytes(4, "little")
        packet[1205] = model
        try:
            scan = reader.push(1327e-6 * i, bytes(packet))
        except CommonmapError:
            reader = TurnReader(Path("noise"))
            continue
        if scan is not None:
            assert np.isfinite(scan.xyz).all()
            assert len(scan.xyz) == len(scan.time) == len(scan.ring)


def test_scans_of_the_fixture_are_small() -> None:
    # the loops above rest on it: a turn is 76 packets whatever it holds
    assert all(len(scan.xyz) < 300 for scan in SPARSE)
    assert replace(SPARSE[0]).stamp == 1_700_000_000.0
