"""How far accepted poses are off where nothing drifts, and whether their covariance says so.

    python benchmarks/pose_errors.py [--first 4000] [--pairs 96] [--cache DIR]

The pairs are those of `decision.py` of the seeds without drift, in all six kinds of scene. Of every
accepted pose the error (metres, radians, at the point that the covariance is about) and the
normalised squared error `e^T C^-1 e` (6 is right on average) are kept, one line a pair.
"""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from commonmap.frames import invert
from commonmap.matching.match import match
from decision import simulate

RECORDS = Path(__file__).parent / "records" / "pose_errors.jsonl"


def main() -> None:
    """Run the pairs, keep a line of each, and print the quantiles."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=4000)
    parser.add_argument("--pairs", type=int, default=96)
    parser.add_argument("--cache", type=Path)
    options = parser.parse_args()
    logging.getLogger("commonmap").setLevel(logging.ERROR)
    done = []
    if RECORDS.exists():
        done = [json.loads(line) for line in RECORDS.read_text().splitlines()]
    for seed in range(options.first, options.first + options.pairs):
        # the seed's second draw is its drift: most seeds are skipped without a simulation
        rng = np.random.default_rng(seed)
        rng.choice([1, 0.7, 0.45, 0.3, 0.2, 0.15])
        if rng.choice([0, 0.003, 0.01]) > 0 or any(r["seed"] == seed for r in done):
            continue
        place = simulate(seed, options.cache)
        found = match(place["target"], place["source"])
        if found.T_target_source is None:
            continue
        off = found.T_target_source @ invert(place["T"])
        middle = np.append(found.covariance_centre, 1.0)
        error = np.concatenate(
            [(off @ middle - middle)[:3], Rotation.from_matrix(off[:3, :3]).as_rotvec()]
        )
        record = {
            "seed": seed, **place["conditions"], "error": error.tolist(),
            "metres": float(np.linalg.norm(error[:3])),
            "degrees": float(np.degrees(np.linalg.norm(error[3:]))),
            "nees": float(error @ np.linalg.solve(found.covariance, error)),
        }  # fmt: skip
        done.append(record)
        with RECORDS.open("a") as out:
            out.write(json.dumps(record) + "\n")
        print(seed, record["kind"], f"{record['metres']:.4f} m", f"{record['degrees']:.4f} deg",
              f"{record['nees']:.1f}", flush=True)
    nees = np.array([r["nees"] for r in done])
    low, high = chi2.ppf([0.025, 0.975], 6 * len(nees)) / len(nees)
    print(f"{len(nees)} pairs: median error {np.median([r['metres'] for r in done]):.4f} m, "
          f"{np.median([r['degrees'] for r in done]):.4f} deg; normalised squared error: mean "
          f"{nees.mean():.2f} (95 % band {low:.2f} to {high:.2f}), median {np.median(nees):.2f} "
          f"(5.35), above 16.8: {100 * np.mean(nees > 16.81):.0f} % (1 %)")


if __name__ == "__main__":
    main()
