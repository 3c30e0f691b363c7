"""Damaged logs: cut short, bytes changed, noise. Readers yield scans or raise a known error."""

from __future__ import annotations

import contextlib
import os
import resource
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from commonmap.errors import CommonmapError
from commonmap.io.logs import iter_scans
from commonmap.io.velodyne import PACKET_BYTES, TurnReader
from commonmap.sim.logs import velodyne_packets
from fuzzing import LOGS, POSE_FILES, SPARSE, Victim, jobs_on_log, jobs_on_poses

N = int(os.environ.get("COMMONMAP_FUZZ", "40"))
"""Damaged copies of each file here; `benchmarks/fuzz_readers.py` reads 10,000 and measures."""

SLOW = 5.0
"""Seconds no file of this size may take, on a busy machine."""

DATA = 6 << 30
"""Bytes of address space of the process: a length that is believed without a look breaks it."""


def run_all(jobs: Sequence[Callable[[], object]]) -> None:
    """Run jobs on a damaged file; let nothing but known errors out, in bounded time."""
    start = time.monotonic()
    for job in jobs:
        try:
            job()
        except CommonmapError as error:
            assert "\n" not in str(error)
            assert len(str(error)) < 1000
    assert time.monotonic() - start < SLOW


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    old = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (DATA, old[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, old)


@pytest.mark.parametrize("kind", LOGS)
def test_damaged_logs_raise_known_errors(kind: str, tmp_path: Path) -> None:
    name, write = LOGS[kind]
    path = tmp_path / name
    write(path)
    assert sum(len(scan.xyz) for scan in iter_scans(path)) > 0
    rng = np.random.default_rng(sum(kind.encode()))
    victim = Victim(path)
    for i in range(N):
        victim.damage(i, rng)
        run_all(jobs_on_log(path, keep_partial=bool(i // 2 % 2)))


@pytest.mark.parametrize("kind", POSE_FILES)
def test_damaged_poses_raise_known_errors(kind: str, tmp_path: Path) -> None:
    name, write = POSE_FILES[kind]
    path = tmp_path / name
    write(path)
    for job in jobs_on_poses(path):
        job()
    rng = np.random.default_rng(sum(kind.encode()))
    victim = Victim(path)
    for i in range(N):
        victim.damage(i, rng)
        run_all(jobs_on_poses(path))


@pytest.mark.parametrize("column", ["name", "type"])
def test_a_database_without_the_text_of_a_topic(column: str, tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    LOGS["db3"][1](path)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        table = "topics"
        sql = database.execute("SELECT sql FROM sqlite_master WHERE name = ?", [table]).fetchone()
        database.execute("PRAGMA writable_schema = ON")
        loose = sql[0].replace(" NOT NULL", "")
        database.execute("UPDATE sqlite_master SET sql = ? WHERE name = ?", [loose, table])
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute(f"UPDATE {table} SET {column} = NULL")
    for keep_partial in (False, True):
        run_all(jobs_on_log(path, keep_partial=keep_partial))


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
