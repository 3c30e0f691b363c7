"""How far accepted poses are off where nothing drifts, and whether their covariance says so.

    python benchmarks/pose_errors.py [--first 6500] [--pairs 220]
    python benchmarks/pose_errors.py --share 0/2        # every second seed; another run takes 1/2

Every seed is a pair without drift of one of the six kinds of place; overlap, tilt and change are
drawn as in `decision.py`, at half its points. Of every accepted pose the error (metres, radians, at
the point that the covariance is about) and the normalised squared error `e^T C^-1 e` (6 is right on
average) are kept, one line a pair. Seeds that are in the records are not run again.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

import numpy as np
from record_lines import add_lines, read_lines
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from commonmap.frames import invert
from commonmap.matching.match import match
from commonmap.sim.pairs import simulate_pair

RECORDS = Path(__file__).parent / "records" / "pose_errors.jsonl"


KINDS = ("paper", "city", "forest", "village", "industrial", "field")


def run(seed: int) -> dict[str, Any]:
    """Return the record of a pair."""
    rng = np.random.default_rng(seed)
    conditions: dict[str, Any] = {
        "overlap": float(rng.choice([1, 0.7, 0.45, 0.3, 0.2, 0.15])),
        "tilt": float(np.radians(rng.choice([0, 0.5, 1.0]))),
        "change": float(rng.choice([0, 0.3])),
    }
    kind = KINDS[seed % len(KINDS)]
    pair = simulate_pair(
        kind, rng=rng, drift=0.0, max_points=250_000, azimuth_decimation=8, **conditions
    )
    found = match(pair.target.xyz, pair.source.xyz)
    record = {"seed": seed, "kind": kind, **conditions, "overlap": pair.overlap,
              "accepted": found.accepted}  # fmt: skip
    if found.T_target_source is None:
        return record
    off = found.T_target_source @ invert(pair.T_target_source)
    middle = np.append(found.covariance_centre, 1.0)
    error = np.concatenate(
        [(off @ middle - middle)[:3], Rotation.from_matrix(off[:3, :3]).as_rotvec()]
    )
    return record | {
        "error": error.tolist(),
        "sd": np.sqrt(np.diag(found.covariance)).tolist(),
        "metres": float(np.linalg.norm(error[:3])),
        "degrees": float(np.degrees(np.linalg.norm(error[3:]))),
        "nees": float(error @ np.linalg.solve(found.covariance, error)),
    }


def main() -> None:
    """Run the pairs, keep a line of each, and print the quantiles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=6500)
    parser.add_argument("--pairs", type=int, default=220)
    parser.add_argument("--share", default="0/1")
    options = parser.parse_args()
    logging.getLogger("commonmap").setLevel(logging.ERROR)
    records = read_lines(RECORDS)
    done = {r["seed"] for r in records}
    start, step = (int(part) for part in options.share.split("/"))
    for seed in range(options.first + start, options.first + options.pairs, step):
        if seed in done:
            continue
        records.append(run(seed))
        add_lines(RECORDS, records[-1:])
        print(
            seed,
            records[-1]["kind"],
            f"{records[-1].get('metres', np.nan):.4f} m",
            f"{records[-1].get('nees', np.nan):.1f}",
            flush=True,
        )
    show([r for r in records if r["accepted"]])


def show(done: list[dict[str, Any]]) -> None:
    """Print the median errors and what the normalised squared errors are, by kind."""
    for kind in (*KINDS, "all"):
        some = [r for r in done if kind in (r["kind"], "all")]
        if not some:
            continue
        nees = np.array([r["nees"] for r in some])
        low, high = chi2.ppf([0.025, 0.975], 6 * len(nees)) / len(nees)
        print(
            f"| {kind} | {len(nees)} | {1e3 * np.median([r['metres'] for r in some]):.1f} mm | "
            f"{np.median([r['degrees'] for r in some]):.4f} deg | {nees.mean():.2f} "
            f"({low:.1f} to {high:.1f}) | {np.median(nees):.2f} | "
            f"{100 * np.mean(nees > chi2.ppf(0.99, 6)):.0f} % |"
        )


if __name__ == "__main__":
    main()
