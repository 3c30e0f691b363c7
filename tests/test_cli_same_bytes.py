"""The answer in match.json is the same to the byte, run by run and for any number of threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from commonmap.io import write_cloud
from commonmap.sim.pairs import simulate_pair
from commonmap.types import Cloud

MATCH = """
import sys
from commonmap.matching import match
match.WORKERS = int(sys.argv.pop(1))
from commonmap.cli import main
main()
"""
"""The command with so many threads of its own."""


def answer_of(base: Path, draft: Path, out: Path, threads: int) -> bytes:
    """Return match.json without its timings, every number with all its digits."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    words = ["match", str(base), str(draft), "-o", str(out), "-q"]
    command = [sys.executable, "-c", MATCH, str(threads), *words]
    done = subprocess.run(
        command, env=os.environ | {name: str(threads) for name in names}, capture_output=True
    )
    assert done.returncode in (0, 3), done.stderr.decode()  # accepted or refused
    values = json.loads(out.read_text())
    assert values.pop("timings")
    assert values["evidence"]["evidence"] > 0.0
    return json.dumps(values).encode()


def test_runs_and_threads_give_the_same_bytes(tmp_path: Path) -> None:
    # drift, tilt and moved things
    pair = simulate_pair(
        "village", rng=np.random.default_rng(77), overlap=0.45, drift=0.003, tilt=0.01, change=0.3,
        max_points=500_000,
    )  # fmt: skip
    base, draft = tmp_path / "base.ply", tmp_path / "draft.ply"
    write_cloud(base, Cloud(pair.target.xyz))
    write_cloud(draft, Cloud(pair.source.xyz))
    first, again, one = (
        answer_of(base, draft, tmp_path / f"{n}.json", threads)
        for n, threads in enumerate((2, 2, 1))
    )
    assert first == again
    assert first == one
