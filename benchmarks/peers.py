"""commonmap against its peers on the same pairs.

    python benchmarks/peers.py                         # runs what has no record yet, then the table
    python benchmarks/peers.py run --peers kiss-matcher akay-k --python /path/to/other/python
    python benchmarks/peers.py run --again             # everything anew: all times in one run
    python benchmarks/peers.py table                   # writes the tables into README and docs

Every run is a process of its own on one core, with a limit of 120 s of CPU time. Its answer goes,
with all that is known about it, as one line into `records/peers.jsonl.xz`; lines are added and
never rewritten. `--python` names a second interpreter for the peers whose libraries this one lacks
(`pip install kiss-matcher open3d map-closures small_gicp` there). Who can run nowhere is skipped,
and the reason is shown. The pairs (`peers_pairs.py`) are made once and kept in `--folder`.

A best pose counts as found within (1 m, 2 deg), (0.5 m, 5 deg) or (0.3 m, 0.5 deg) of the truth at
the middle of the draft. An accepted answer outside the first is wrong, as is any on another place.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from peers_methods import CPU_LIMIT, PEERS
from peers_pairs import KINDS, Case, checksum, make_cases
from record_lines import add_lines, read_lines

from commonmap.frames import difference
from commonmap.io.atomic import writing

HERE = Path(__file__).resolve().parent
RECORDS = HERE / "records" / "peers.jsonl.xz"
PAGES = (HERE.parent / "README.md", HERE.parent / "docs" / "peers.md")
WITHIN = {"1 m, 2°": (1.0, 2.0), "0.5 m, 5°": (0.5, 5.0), "0.3 m, 0.5°": (0.3, 0.5)}
RIGHT = WITHIN["1 m, 2°"]
OURS = "commonmap"
ONE_THREAD = {n: "1" for n in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")}
Record = dict[str, Any]


def find_interpreters(names: Iterable[str], other: str | None) -> dict[str, str]:
    """Return the interpreter that runs each peer; say why for those that none can run."""
    interpreters: dict[str, str] = {}
    reasons: dict[str, str] = {}
    for python in [sys.executable, *([other] if other else [])]:
        done = subprocess.run(
            [python, HERE / "peers_methods.py"], capture_output=True, text=True, check=True
        )
        for name, reason in json.loads(done.stdout).items():
            if not reason:
                interpreters.setdefault(name, python)
            reasons[name] = reason
    for name in names:
        if name not in interpreters:
            print(f"skipped: {name}: {reasons[name]}", file=sys.stderr)
    return {name: interpreters[name] for name in names if name in interpreters}


def run(case: Case, name: str, python: str) -> Record:
    """Return the record of one peer on one pair."""
    record: Record = {
        "case": case.name, "family": case.family, "label": case.label, "peer": name,
        "conditions": case.conditions, "points": checksum(case), "settings": PEERS[name].settings,
        "accepts": PEERS[name].accepts, "commit": commit(), "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 1),
    }  # fmt: skip
    done = subprocess.run(
        [python, HERE / "peers_methods.py", name, case.base, case.draft],
        capture_output=True, text=True, env=os.environ | ONE_THREAD,
    )  # fmt: skip
    if done.returncode == -24:  # SIGXCPU
        return record | {"failed": f"more than {CPU_LIMIT} s of CPU time", "accepted": False}
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [""])[-1]
        return record | {"failed": f"exit {done.returncode}: {last}"[:300], "accepted": False}
    return record | judge(case, json.loads(done.stdout))


def judge(case: Case, answer: Record) -> Record:
    """Return an answer with its errors: metres and degrees, before and after refinement."""
    if case.truth is None:
        return answer
    truth, errors = np.array(case.truth), {}
    for key, suffix in (("T", ""), ("T_raw", "_raw")):
        metres, radians = difference(np.array(answer[key]), truth, case.centre)
        errors |= {"metres" + suffix: metres, "degrees" + suffix: float(np.degrees(radians))}
    return answer | errors


def commit() -> str:
    """Return the revision of the sources that are imported: PEERS_COMMIT, or git's."""
    if "PEERS_COMMIT" in os.environ:
        return os.environ["PEERS_COMMIT"]
    shown = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=HERE, capture_output=True, text=True
    )
    return shown.stdout.strip() or "unknown"


def read_records() -> list[Record]:
    """Return all records, oldest first."""
    return read_lines(RECORDS)


def key_of(case: str, name: str, revision: str) -> tuple[str, str, str]:
    """Return what makes a run the same as another; only our own depends on the revision."""
    return case, name, revision if name == OURS else ""


def run_all(folder: Path, peers: list[str], other: str | None, *, again: bool) -> None:
    """Append a record for each case and peer that has none; our own needs one of this revision.

    again: also where there is one.
    """
    interpreters = find_interpreters(peers, other)
    cases = make_cases(folder)
    done = {key_of(r["case"], r["peer"], r["commit"]) for r in read_records() if not again}
    for case in cases:
        for name, python in interpreters.items():
            if key_of(case.name, name, commit()) in done:
                continue
            record = run(case, name, python)
            add_lines(RECORDS, [record])
            print(
                f"{case.name:12s} {case.family:10s} {name:14s} "
                f"{'accepted' if record['accepted'] else 'refused':8s} "
                f"{record.get('metres', float('nan')):8.2f} m "
                f"{record.get('degrees', float('nan')):7.2f} deg {record.get('cpu_s', 0.0):6.1f} s "
                f"{record.get('failed', '')}",
                flush=True,
            )


def newest(records: list[Record]) -> dict[str, list[Record]]:
    """Return the records of each peer in the table's order: the last of each case.

    Of our own, only those of the revision that came last, so that no table mixes two.
    """
    ours = [r["commit"] for r in records if r["peer"] == OURS]
    kept: dict[tuple[str, str], Record] = {}
    for record in records:
        if record["peer"] != OURS or record["commit"] == ours[-1]:
            kept[record["peer"], record["case"]] = record
    rows = list(kept.values())
    peers = {name: [r for r in rows if r["peer"] == name] for name in PEERS}
    return {name: own for name, own in peers.items() if own}


def is_within(record: Record, limits: tuple[float, float]) -> bool:
    """Return whether a pair that matches was placed within (metres, degrees)."""
    return record.get("metres", np.inf) <= limits[0] and record.get("degrees", np.inf) <= limits[1]


def is_right(record: Record) -> bool:
    """Return whether an answer was accepted and is right."""
    return bool(record["accepted"]) and is_within(record, RIGHT)


def is_wrong(record: Record) -> bool:
    """Return whether an answer was accepted that is not right."""
    return bool(record["accepted"]) and not is_within(record, RIGHT)


def overall_table(peers: dict[str, list[Record]]) -> list[str]:
    """Return the lines of the table over all simulated pairs."""
    lines = [
        "| | found within " + " | ".join(WITHIN) + " | accepted and right | accepted, but wrong | "
        "other places accepted | CPU s, median (most) | CPU s a right answer | peak MB |",
        "|---" * (len(WITHIN) + 7) + "|",
    ]
    for name, rows in peers.items():
        match = [r for r in rows if r["label"] == "match" and r["family"] != "real"]
        other = [r for r in rows if r["label"] == "other"]
        timed = [r["cpu_s"] for r in match + other if "cpu_s" in r]
        found = [sum(is_within(r, limits) for r in match) for limits in WITHIN.values()]
        right = sum(map(is_right, match))
        cells = [
            PEERS[name].title, *(f"{n} of {len(match)}" for n in found), str(right),
            str(sum(is_wrong(r) for r in match)),
            f"{sum(is_wrong(r) for r in other)} of {len(other)}",
            f"{statistics.median(timed):.1f} ({max(timed):.0f})" if timed else "-",
            _per_right(timed, right),
            f"{max(r.get('peak_mb', 0.0) for r in rows):.0f}",
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def family_table(peers: dict[str, list[Record]]) -> list[str]:
    """Return the lines of the table by kind of place."""
    families = (*KINDS, "real")
    lines = ["| | " + " | ".join(families) + " |", "|---" * (len(families) + 1) + "|"]
    for name, rows in peers.items():
        cells = [_family_cell([r for r in rows if r["family"] == f]) for f in families]
        lines.append("| " + " | ".join([PEERS[name].title, *cells]) + " |")
    return lines


def _family_cell(rows: list[Record]) -> str:
    """Return "found, wrong ones accepted, median CPU seconds (CPU seconds a right answer)".

    The second and both times are over all pairs, those that do not match too.
    """
    match = [r for r in rows if r["label"] == "match"]
    if not match:
        return "-"
    timed = [r["cpu_s"] for r in rows if "cpu_s" in r]
    time = f"{statistics.median(timed):.1f} s" if timed else "-"
    found = sum(is_within(r, RIGHT) for r in match)
    right = sum(map(is_right, match))
    wrong = sum(map(is_wrong, rows))
    return f"{found}/{len(match)}, {wrong} wrong, {time} ({_per_right(timed, right)})"


def _per_right(seconds: list[float], n_right: int) -> str:
    """Return the time of all pairs over the answers that were accepted and right."""
    return f"{sum(seconds) / n_right:.2f}" if n_right else "-"


def settings_table(peers: dict[str, list[Record]]) -> list[str]:
    """Return the lines of the table of settings, as the records have them."""
    lines = ["| | version | settings | an answer is valid by |", "|---|---|---|---|"]
    for name, rows in peers.items():
        last = rows[-1]
        known = next((r["versions"] for r in reversed(rows) if "versions" in r), {})
        version = ", ".join(f"{k} {v}" for k, v in known.items())
        revision = f" ({last['commit']})" if "commonmap" in PEERS[name].needs else ""
        lines.append(
            f"| {PEERS[name].title} | {version}{revision} | {last['settings']} | "
            f"{last['accepts'] or 'nothing of its own: every answer counts'} |"
        )
    return lines


TABLES: dict[str, Callable[[dict[str, list[Record]]], list[str]]] = {
    "overall": overall_table, "families": family_table, "settings": settings_table,
}  # fmt: skip


def fill_page(text: str, peers: dict[str, list[Record]]) -> str:
    """Return a page with each `<!-- peers:NAME -->` ... `<!-- /peers:NAME -->` filled anew."""
    for name, table in TABLES.items():
        begin, end = f"<!-- peers:{name} -->", f"<!-- /peers:{name} -->"
        if begin in text:
            before, rest = text.split(begin, 1)
            after = rest.split(end, 1)[1]
            text = f"{before}{begin}\n{chr(10).join(table(peers))}\n{end}{after}"
    return text


def write_tables() -> None:
    """Fill the tables of the pages from the records, and print them."""
    peers = newest(read_records())
    for page in PAGES:
        if page.exists():
            text = page.read_text(encoding="utf-8")
            filled = fill_page(text, peers)
            if filled != text:
                with writing(page) as part:
                    part.write_text(filled, encoding="utf-8")
    for table in TABLES.values():
        print("\n".join(table(peers)), end="\n\n")


def main() -> None:
    """Run the jobs named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("job", nargs="?", default="all", choices=["all", "run", "table"])
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--python", help="a second interpreter, for the peers this one lacks")
    parser.add_argument("--again", action="store_true", help="also what has a record: new times")
    parser.add_argument("--folder", type=Path, default=Path("/tmp/peers/pairs"))
    options = parser.parse_args()
    if options.job != "table":
        run_all(options.folder, options.peers, options.python, again=options.again)
    if options.job != "run":
        write_tables()


if __name__ == "__main__":
    main()
