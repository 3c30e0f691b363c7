"""The pairs that all peers are given: 44 simulated that match, 12 that do not, and the real one.

A pair is two files of float32 points, written once, so that all get the same bytes. Seeds start at
20000 and were used for nothing else. A draft of another place is the draft of the pair six seeds
on, which is another place of the same kind.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.frames import apply, from_xyz_yaw, invert
from commonmap.io.atomic import writing
from commonmap.sim.pairs import simulate_pair
from commonmap.types import Float64s

KINDS = ("paper", "city", "village", "forest", "industrial", "field")
FIRST_SEED, N_MATCH, N_OTHER = 20000, 44, 12
MAX_POINTS = 500_000
REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "air-ground"
ORIGIN = np.array([470_641.01, 3_810_235.21, 2_278.83])
T_UAS_MLS = np.array([
    [0.999732, -0.004279, -0.022768, 0.694892],
    [0.004077, 0.999952, -0.008942, 0.059796],
    [0.022806, 0.008847, 0.999701, -0.106446],
    [0.0, 0.0, 0.0, 1.0],
])  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One question to every peer.

    name: unique. family: kind of place. label: "match" or "other". base, draft: files of (N, 3)
    float32 metres. truth: T_target_source (4, 4), None where the places differ. centre: (3,) the
    middle of the draft, where errors are measured. conditions: what was asked of the simulator.
    """

    name: str
    family: str
    label: str
    base: str
    draft: str
    truth: list[list[float]] | None
    centre: list[float]
    conditions: dict[str, Any]


def conditions_of(seed: int) -> dict[str, Any]:
    """Return what a seed asks of the simulator."""
    rng = np.random.default_rng([seed, 1])
    return {
        "overlap": float(rng.choice([1.0, 0.7, 0.45, 0.3, 0.2, 0.15])),
        "drift": float(rng.choice([0.0, 0.003, 0.01])),
        "tilt": float(np.radians(rng.choice([0.0, 0.5, 1.0]))),
        "change": float(rng.choice([0.0, 0.3])),
    }


def make_cases(folder: Path, n_match: int = N_MATCH, n_other: int = N_OTHER) -> list[Case]:
    """Write the files that are not there yet and return all cases, in rounds of every kind.

    A run that is stopped after some rounds has asked of every kind and label alike.
    """
    folder.mkdir(parents=True, exist_ok=True)
    matching = [_simulated(seed, folder) for seed in range(FIRST_SEED, FIRST_SEED + n_match)]
    others = [_crossed(matching[n], matching[n + len(KINDS)]) for n in range(n_other)]
    parts = ((matching, len(KINDS)), (others, 2), (_real(folder), 1))
    rounds = max(-(-len(part) // n) for part, n in parts)
    return [c for k in range(rounds) for part, n in parts for c in part[k * n : (k + 1) * n]]


def checksum(case: Case) -> str:
    """Return the start of the SHA-256 of a case's two files."""
    digest = hashlib.sha256()
    for name in (case.base, case.draft):
        digest.update(Path(name).read_bytes())
    return digest.hexdigest()[:16]


def _simulated(seed: int, folder: Path) -> Case:
    kind = KINDS[seed % len(KINDS)]
    path = folder / f"{seed}.json"
    if not path.exists():
        asked = conditions_of(seed)
        pair = simulate_pair(kind, rng=np.random.default_rng(seed), max_points=MAX_POINTS, **asked)
        base, draft = folder / f"{seed}-base.npy", folder / f"{seed}-draft.npy"
        asked["overlap_reached"] = round(pair.overlap, 3)
        case = _case(
            str(seed), kind, base, draft, pair.target.xyz, pair.source.xyz, pair.T_target_source,
            asked,
        )  # fmt: skip
        with writing(path) as part:
            part.write_text(json.dumps(asdict(case)), encoding="utf-8")
    return Case(**json.loads(path.read_text(encoding="utf-8")))


def _crossed(a: Case, b: Case) -> Case:
    """Return the case of one pair's base and another's draft."""
    return Case(
        f"{a.name}x{b.name}", a.family, "other", a.base, b.draft, None, b.centre,
        {"base": a.name, "draft": b.name},
    )  # fmt: skip


def _real(folder: Path) -> list[Case]:
    """Return the real drone and ground maps of one forest plot: whole, and three 10 m crops."""
    if not REAL.is_dir():
        return []
    import laspy

    clouds = []
    for name in ("uas.laz", "mls.laz"):
        las = laspy.read(REAL / name)
        clouds.append(np.column_stack([las.x, las.y, las.z]) - ORIGIN)
    cases = []
    for seed in range(4):
        rng = np.random.default_rng([FIRST_SEED, seed])
        draft = clouds[1]
        if seed:
            low, high = np.quantile(draft[:, :2], [0.01, 0.99], axis=0)
            corner = rng.uniform(low, high - 10.0)
            inside = (draft[:, :2] >= corner) & (draft[:, :2] < corner + 10.0)
            draft = draft[inside.all(axis=1)]
        x, y, z = rng.uniform(-100.0, 100.0, 3)
        moved = from_xyz_yaw(x, y, z, rng.uniform(-np.pi, np.pi))
        name = f"real-{seed}"
        cases.append(
            _case(
                name, "real", folder / "real-base.npy", folder / f"{name}-draft.npy", clouds[0],
                apply(moved, draft), T_UAS_MLS @ invert(moved), {"crop_m": 10.0 if seed else None},
            )
        )  # fmt: skip
    return cases


def _case(
    name: str, family: str, base: Path, draft: Path, target: Float64s, source: Float64s,
    truth: Float64s, conditions: dict[str, Any],
) -> Case:  # fmt: skip
    """Write the two files where they are missing, and return the case."""
    for path, xyz in ((base, target), (draft, source)):
        if not path.exists():
            with writing(path) as part:
                np.save(part, xyz.astype(np.float32))
    return Case(
        name, family, "match", str(base), str(draft), truth.tolist(), source.mean(axis=0).tolist(),
        conditions,
    )  # fmt: skip
