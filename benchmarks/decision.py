"""How far the verdict can be trusted: collect simulated cases, fit the model, show what it does.

    python benchmarks/decision.py collect --first 4000 --pairs 96   # adds to the records
    python benchmarks/decision.py fit                               # the weights for decide.py
    python benchmarks/decision.py draw                              # docs/images/decision.png
    python benchmarks/decision.py show                              # right, refused, false accepts
    python benchmarks/decision.py collect --rays ...                # `match --rays`, own records
    python benchmarks/decision.py collect --closely ...             # all figures, for the fit

A case is a pair of robots in one simulated place (overlap 0.12 to 1, drift 0 to 1 %, tilt to 1
degree, up to 30 % of the objects changed), or a draft of another place of the same or another kind,
or the base's own draft in a mirror: the same walls, stems and slopes, but no motion leads there.
Every second case uses only heights under 1 m. Fit and show never use the same seeds: the fit takes
those below 7100 and from 9000 on, what is shown lies between.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from record_lines import add_lines, read_lines
from scipy.optimize import minimize
from scipy.stats import beta

import commonmap.matching.verify as verify
from commonmap.config import Config
from commonmap.frames import difference
from commonmap.matching.decide import (
    ACCEPT_AT,
    QUICK_WEIGHTS,
    WEIGHTS,
    Figures,
    at_first_look,
    decide,
    features,
    is_open,
)
from commonmap.matching.match import match
from commonmap.sim.pairs import simulate_pair
from commonmap.types import Cloud
from commonmap.version import __version__

KINDS = ("paper", "city", "forest", "village", "industrial", "field")
RECORDS = Path(__file__).parent / "records" / "decision.jsonl.xz"
WITH_RAYS = RECORDS.with_name("decision_rays.jsonl.xz")
HELD_OUT = (7100, 9000)
"""Seeds that nothing is fitted to."""
RIDGE = 0.1
"""Pull of the weights towards zero; of 0.1 to 0.4 the best, a place left out at a time."""
SHARE_RIGHT = 1.0 / 3.0
"""Of the cases of the fit, by weight: what a probability is told before anything is seen."""
RIGHT = (1.0, np.radians(2.0))
MIRRORED = "mirrored"


def simulate(seed: int, cache: Path | None = None, *, rays: bool = False) -> dict[str, Any]:
    """Return both maps, the truth and the conditions of a seed; kept in the cache, if any.

    rays: keep the rays of both maps, which the cache does not.
    """
    cache = None if rays else cache
    path = cache / f"{seed}.npz" if cache else None
    if path is not None and path.exists():
        with np.load(path) as kept:
            return {
                "target": kept["t"].astype(float), "source": kept["s"].astype(float),
                "T": kept["T"], "conditions": json.loads(str(kept["cond"])),
            }  # fmt: skip
    rng = np.random.default_rng(seed)
    conditions: dict[str, Any] = {
        "overlap": float(rng.choice([1, 0.7, 0.45, 0.3, 0.2, 0.15])),
        "drift": float(rng.choice([0, 0.003, 0.01])),
        "tilt": float(np.radians(rng.choice([0, 0.5, 1.0]))),
        "change": float(rng.choice([0, 0.3])),
    }
    kind = KINDS[seed % len(KINDS)]
    pair = simulate_pair(kind, rng=rng, max_points=500_000, **conditions)
    conditions = {"kind": kind, **conditions, "overlap": pair.overlap}
    if rays:
        return {
            "target": pair.target, "source": pair.source, "T": pair.T_target_source,
            "conditions": conditions,
        }  # fmt: skip
    # single precision in the cache and out of it: the answer must not depend on where it came from
    target, source = pair.target.xyz.astype(np.float32), pair.source.xyz.astype(np.float32)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(".part.npz")
        np.savez(beside, t=target, s=source, T=pair.T_target_source, cond=json.dumps(conditions))
        beside.replace(path)
    return {
        "target": target.astype(float), "source": source.astype(float),
        "T": pair.T_target_source, "conditions": conditions,
    }  # fmt: skip


def collect(
    first: int, n_pairs: int, n_others: int, cache: Path | None, share: str, *, rays: bool
) -> None:
    """Append the cases of `n_pairs` seeds to the records: each base with its own draft, with
    `n_others` drafts of other places of its kind, with one of another kind, and with its own in
    a mirror.

    share: "k/n", take only every n-th base from the k-th; several runs can share the work.
    """
    logging.getLogger("commonmap").setLevel(logging.ERROR)
    records = WITH_RAYS if rays else RECORDS
    kept = load(first, first + n_pairs, records)
    done = {(r["seed"], r["draft"], r["label"] == MIRRORED) for r in kept}
    start_at, of = (int(part) for part in share.split("/"))
    for seed in range(first + start_at, first + n_pairs, of):
        drafts = [seed, *(seed + len(KINDS) * (n + 1) for n in range(n_others)), seed + 1, seed]
        place = None
        for n, draft in enumerate(drafts):
            draft = first + (draft - first) % n_pairs
            mirrored = n == len(drafts) - 1
            if (seed, draft, mirrored) in done or (n and draft == seed and not mirrored):
                continue
            place = place or simulate(seed, cache, rays=rays)
            other = place if draft == seed else simulate(draft, cache, rays=rays)
            if mirrored:
                other = {**place, "source": mirror(place["source"]), "mirrored": True}
            record = judge(place, other, seed, draft, 1.0 if (seed + n) % 2 else None, rays=rays)
            add_lines(records, [record])
            print(
                seed,
                draft,
                record["kind"],
                record["label"],
                record["max_height"],
                "accepted" if record["accepted"] else "refused",
                "right" if record["right"] else "-",
                f"{record['confidence']:.3f}",
                flush=True,
            )


def mirror(source: Any) -> Any:
    """Return a map in a mirror."""
    flip = np.array([1.0, -1.0, 1.0])
    if isinstance(source, Cloud):
        assert source.origin is not None
        origin = (source.origin * flip).astype(np.float32)
        return replace(source, xyz=source.xyz * flip, origin=origin)
    return source * flip


def judge(
    place: dict[str, Any], other: dict[str, Any], seed: int, draft: int, max_height: float | None,
    *, rays: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Return the record of one case."""
    config = Config().with_values(grid={"max_height": max_height, "rays": rays})
    start = time.process_time()
    found = match(place["target"], other["source"], config=config)
    kind = place["conditions"]["kind"]
    label = "same place"
    if other.get("mirrored"):
        label = MIRRORED
    elif draft != seed:
        label = "same kind" if other["conditions"]["kind"] == kind else "other kind"
    record = {
        "version": __version__, "seed": seed, "draft": draft, "label": label,
        **place["conditions"], "max_height": max_height, "accepted": found.accepted,
        "confidence": found.confidence, "cpu_seconds": time.process_time() - start,
        "figures": dict(found.evidence), "right": False,
    }  # fmt: skip
    if label == "same place":
        best = found.T_target_source
        if best is None:
            best = found.rivals[0].T_target_source
        source = other["source"]
        xyz = source.xyz if isinstance(source, Cloud) else source
        metres, radians = difference(best, place["T"], xyz.mean(axis=0))
        record |= {"metres": metres, "radians": radians}
        record["right"] = bool(metres < RIGHT[0] and radians < RIGHT[1])
    return record


def load(first: int, last: int, path: Path = RECORDS) -> list[dict[str, Any]]:
    """Return the records of the seeds from `first` up to, not including, `last`."""
    return [r for r in read_lines(path) if first <= r["seed"] < last]


def figures_of(record: dict[str, Any]) -> Figures:
    """Return the figures of a record."""
    return Figures(**{k: v for k, v in record["figures"].items() if k in Figures.__annotations__})


def as_seen(figures: Figures) -> Figures:
    """Return the figures that `match` looks at: all of them only where the verdict is open."""
    return figures if is_open(figures) else at_first_look(figures)


def fit() -> None:
    """Print the weights of both models: ridge-regularised logistic regression.

    How many cases are right is the choice of who made them: they are weighed to be a third of all.
    """
    # Found the place but off by a little more than allowed: neither right nor wrong
    records = load(0, HELD_OUT[0]) + load(HELD_OUT[1], 1 << 40)
    records = [r for r in records if r["right"] or r.get("metres", 99.0) > 1.5]
    rows = [features(figures_of(r)) for r in records]
    y = np.array([r["right"] for r in records], dtype=float)
    share = np.where(y == 1, SHARE_RIGHT / y.mean(), (1.0 - SHARE_RIGHT) / (1.0 - y.mean()))
    for weights in (QUICK_WEIGHTS, WEIGHTS):
        names = list(weights)
        X = np.array([[row.get(name, 0.0) for name in names] for row in rows])

        def loss(w: np.ndarray, X: np.ndarray = X) -> float:
            z = X @ w
            misfit = float(np.sum(share * (np.logaddexp(0, z) - y * z)))
            return misfit + RIDGE * float(np.sum(w[1:] ** 2))

        w = minimize(loss, np.zeros(X.shape[1]), method="BFGS").x
        p = 1.0 / (1.0 + np.exp(-X @ w))
        print(dict(zip(names, w.round(2).tolist(), strict=True)), f"from {len(y)} cases")
        print("  highest p of the wrong:", np.sort(p[y == 0])[-5:].round(3))
        print("  lowest p of the right:", np.sort(p[y == 1])[:8].round(3))


def judged(path: Path = RECORDS) -> dict[str, np.ndarray]:
    """Return what today's model says of the held-out records, by name, an array each."""
    records = load(*HELD_OUT, path)
    verdicts = [decide(as_seen(figures_of(r))) for r in records]
    return {
        "p": np.array([v.confidence for v in verdicts]),
        "accepted": np.array([v.accepted for v in verdicts]),
        "right": np.array([r["right"] for r in records]),
        "same": np.array([r["label"] == "same place" for r in records]),
        "kind": np.array([r["kind"] for r in records]),
    }


BINS = ((0, 0.02), (0.02, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.01))


def show(path: Path = RECORDS) -> None:
    """Print what today's model does on the held-out seeds."""
    j = judged(path)
    p, accepted, right, same = j["p"], j["accepted"], j["right"], j["same"]
    print(f"{len(p)} cases, {same.sum()} of the same place, {(~same).sum()} of others")
    both = (accepted & right).sum()
    print(f"same place: best pose right {right.sum()}, accepted and right {both}")
    print(f"accepted and wrong: {(accepted & ~right).sum()}")
    for kind in KINDS:
        k = j["kind"] == kind
        print(
            f"  {kind:11s} same {(k & same).sum():3d}  right {(k & right).sum():3d}  "
            f"accepted {(k & accepted & right).sum():3d}   other {(k & ~same).sum():3d}  "
            f"accepted {(k & accepted & ~right).sum()}"
        )
    print("reliability: probability told (mean), cases, share right")
    for low, high in BINS:
        inside = (p >= low) & (p < high)
        if inside.any():
            print(
                f"  {low:.2f} to {min(high, 1):.2f} ({p[inside].mean():.3f})  {inside.sum():4d}  "
                f"{right[inside].mean():.3f}"
            )


def draw(path: Path) -> None:
    """Draw the reliability diagram and the risk-coverage curve of the held-out cases."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    j = judged()
    p, right, same = j["p"], j["right"], j["same"]
    figure, (left, other) = plt.subplots(1, 2, figsize=(9, 4.2), dpi=110)
    left.plot([0, 1], [0, 1], "--", color="#8a8a8a", lw=1)
    for low, high in BINS:
        inside = (p >= low) & (p < high)
        if inside.any():
            n, k = int(inside.sum()), int(right[inside].sum())
            # Clopper and Pearson's interval
            bounds = np.array([
                beta.ppf(0.025, k, n - k + 1) if k else 0.0,
                beta.ppf(0.975, k + 1, n - k) if k < n else 1.0,
            ])  # fmt: skip
            left.errorbar(
                p[inside].mean(),
                k / n,
                yerr=np.abs(bounds - k / n)[:, None],
                fmt="o",
                color="#2a78d6",
                capsize=3,
            )
            left.annotate(
                f"{n}",
                (p[inside].mean(), k / n),
                xytext=(6, -12),
                textcoords="offset points",
                fontsize=8,
            )
    left.set_xlabel("probability told")
    left.set_ylabel("share that is right (95 %)")
    order = np.argsort(-p, kind="stable")
    wrong = np.cumsum(~right[order])
    coverage = np.cumsum(right[order]) / max(same.sum(), 1)
    other.step(coverage, wrong / np.arange(1, len(p) + 1), where="post", color="#2a78d6")
    at = int((p[order] >= ACCEPT_AT).sum())
    other.plot(coverage[at - 1], wrong[at - 1] / at, "o", color="#d9541e")
    other.annotate(
        f"accepted from {ACCEPT_AT:g} on",
        (coverage[at - 1], wrong[at - 1] / at),
        xytext=(-110, 14),
        textcoords="offset points",
        fontsize=9,
    )
    other.set_xlabel("share of the pairs of one place that are told and right")
    other.set_ylabel("share of the told that are wrong")
    for axis in (left, other):
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)


def main() -> None:
    """Run the command named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    jobs = ["collect", "fit", "show", "draw"]
    parser.add_argument("job", nargs="?", default="show", choices=jobs)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--others", type=int, default=5)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--rays", action="store_true")
    parser.add_argument("--closely", action="store_true", help="look closer at clear cases too")
    parser.add_argument("--share", default="0/1")
    options = parser.parse_args()
    if options.job == "collect":
        if options.closely:
            verify.is_open = lambda figures: True
        collect(
            options.first, options.pairs, options.others, options.cache, options.share,
            rays=options.rays,
        )  # fmt: skip
    elif options.job == "fit":
        fit()
    elif options.job == "draw":
        draw(Path(__file__).parents[1] / "docs" / "images" / "decision.png")
    else:
        show(WITH_RAYS if options.rays else RECORDS)


if __name__ == "__main__":
    main()
