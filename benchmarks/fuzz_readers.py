"""Damaged files, 10,000 a reader: known errors only, no hang, no allocation beyond the file's size.

    python benchmarks/fuzz_readers.py                     # all kinds: about 12 minutes
    python benchmarks/fuzz_readers.py --kinds pcap mcap   # only these; the record keeps the others
    python benchmarks/fuzz_readers.py -n 200

Files of a few kilobytes are written as the tests write them, cut short, or bytes of them changed,
taken away or replaced by noise, and read in this process. It may use no more address space than it
had before, and `ROOM` bytes: an allocation that a damaged length asks for, and the file does not
warrant, fails and is counted as `beyond`; an error other than the package's own is counted as
`other_errors`. Files that do either are kept in `benchmarks/records/fuzz_kept`. Seconds are those
of the slowest file: of the processor, and on the wall, where other jobs share the machine. Raw
figures go to `benchmarks/records/fuzz_readers.json`.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from commonmap.errors import CommonmapError
from fuzzing import LOGS, POSE_FILES, Victim, jobs_on_log, jobs_on_poses
from test_io_fuzz import FILES

RECORDS = Path(__file__).parent / "records"
ROOM = 64 << 20
"""Bytes that reading a file of a few kilobytes may take, libraries' own buffers included."""

Jobs = Callable[[int], Sequence[Callable[[], object]]]


def prepare(kind: str, folder: Path) -> tuple[Path, Jobs]:
    """Write the whole file of a kind; return its path and what is to be done with the i-th."""
    if kind in LOGS:
        name, write = LOGS[kind]
        path = folder / name
        write(path)
        return path, lambda i: jobs_on_log(path, keep_partial=bool(i // 2 % 2))
    if kind in POSE_FILES:
        name, write = POSE_FILES[kind]
        path = folder / name
        write(path)
        return path, lambda i: jobs_on_poses(path)
    suffix, make, read = FILES[kind.removeprefix("map ")]
    path = folder / f"map{suffix}"
    path.write_bytes(make())
    return path, lambda i: [lambda: read(path)]


def memory(name: str) -> int:
    """Return a figure of /proc/self/status in bytes."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    found = re.search(rf"^{name}:\s+(\d+) kB", text, re.MULTILINE)
    return int(found.group(1)) * 1024 if found else 0


def fuzz(kind: str, n: int, seed: int, kept: Path) -> dict[str, Any]:
    """Return what reading n damaged files of a kind came to."""
    rng = np.random.default_rng([seed, *kind.encode()])
    errors: Counter[str] = Counter()
    slowest = slowest_wall = grown = 0.0
    n_read = n_slow = beyond = others = 0
    with tempfile.TemporaryDirectory(dir="/dev/shm") as name:
        path, jobs = prepare(kind, Path(name))
        size = sum(f.stat().st_size for f in [path, *path.rglob("*")] if f.is_file())
        for i in range(3):  # what is loaded and compiled at first use is no part of the files
            for job in jobs(2 * i):
                with_known_errors(job)
        victim = Victim(path)
        start = memory("VmRSS")
        old = resource.getrlimit(resource.RLIMIT_AS)
        for i in range(n):
            victim.damage(i, rng)
            if i % 50 == 0:
                resource.setrlimit(resource.RLIMIT_AS, (memory("VmSize") + ROOM, old[1]))
                Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
            wall, cpu = time.perf_counter(), time.process_time()
            told = [with_known_errors(job) for job in jobs(i)]
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            errors.update(t for t in told if t is not None)
            n_read += told[min(1, len(told) - 1)] is None
            far = any(t and ("memory" in t or "length in it" in t) for t in told)
            other = any(t and t.startswith("OTHER") for t in told)
            beyond, others = beyond + far, others + other
            if far or other:
                kept.mkdir(parents=True, exist_ok=True)
                (kept / f"{kind} {i}{path.suffix}").write_bytes(victim.read())
            n_slow += cpu > 1.0
            slowest, slowest_wall = max(slowest, cpu), max(slowest_wall, wall)
            if i % 50 == 49:
                grown = max(grown, memory("VmHWM") - start)
        resource.setrlimit(resource.RLIMIT_AS, old)
    return {
        "kind": kind, "bytes": size, "inputs": n, "read": n_read, "seed": seed,
        "known_errors": dict(errors.most_common(12)), "other_errors": others, "beyond": beyond,
        "over_1_s": n_slow, "slowest_cpu_s": round(slowest, 4),
        "slowest_wall_s": round(slowest_wall, 3), "grown_mb": round(grown / 2**20, 1),
    }  # fmt: skip


def with_known_errors(job: Callable[[], object]) -> str | None:
    """Return what an error of the package says, without names and numbers; None where none came."""
    try:
        job()
    except CommonmapError as error:
        text = re.sub(r"/dev/shm/[^\s;,:()]*", "FILE", str(error))
        if "\n" in text or len(text) > 1000:
            return f"OTHER: an error of more than a line: {text[:70]!r}"
        text = re.sub(r"'[^']*'|\d[\d.e+-]*", "_", text)
        return f"{type(error).__name__}: {text[:70]}"
    except Exception as error:  # what this benchmark is to find
        return f"OTHER {type(error).__name__}: {error}"[:90]
    return None


def main() -> int:
    """Run, print a line a kind, write the record."""
    kinds = [*LOGS, *POSE_FILES, *(f"map {kind}" for kind in FILES)]
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--kinds", nargs="+", choices=kinds, default=kinds)
    parser.add_argument("-n", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=RECORDS / "fuzz_readers.json")
    args = parser.parse_args()
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    old = json.loads(args.output.read_text(encoding="utf-8")) if args.output.is_file() else {}
    rows = {row["kind"]: row for row in old.get("rows", [])}
    for kind in args.kinds:
        begin = time.process_time()
        rows[kind] = fuzz(kind, args.n, args.seed, args.output.parent / "fuzz_kept")
        row = {k: v for k, v in rows[kind].items() if k != "known_errors"}
        print(json.dumps(row), f"{time.process_time() - begin:.0f} s", flush=True)
        values = {
            "command": "python benchmarks/fuzz_readers.py", "room_mb": ROOM >> 20,
            "rows": [rows[kind] for kind in kinds if kind in rows],
        }  # fmt: skip
        args.output.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
