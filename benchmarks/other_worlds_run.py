"""Match pairs of worlds from another generator: a check on scenes that nothing was made for.

    python benchmarks/other_worlds_run.py [--first 0] [--pairs 56] [--cache DIR]
    python benchmarks/other_worlds_run.py --show

Each seed gives a drone's and a ground robot's map of one place (overlap 0.14 to 1, drift 0 to 1 %
of the way, tilt to 1 degree, up to 30 % of the movable things changed), and the draft of the
seed before of the same kind is matched on the same base too, which must be refused. One line each
is kept in `records/other_worlds.jsonl`.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
from other_worlds import KINDS, World, build
from record_lines import add_lines, read_lines
from scipy.spatial.transform import Rotation

from commonmap.frames import apply, difference, fit_motion, from_rotation, invert
from commonmap.matching.match import match

RECORDS = Path(__file__).parent / "records" / "other_worlds.jsonl"


def scene_of(world: World, objects: list[Any]) -> Any:
    """Return an Embree scene of the ground and the objects."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    n = int(1.3 * world.size / 0.8)
    line = np.linspace(-0.65 * world.size, 0.65 * world.size, n)
    x, y = (a.ravel() for a in np.meshgrid(line, line, indexing="ij"))
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    vertices = [np.column_stack([x, y, world.height(x, y)])]
    faces = [np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])]
    first = n * n
    for parts, _ in objects:
        for v, f in parts:
            vertices.append(v)
            faces.append(f + first)
            first += len(v)
    scene = EmbreeScene()
    TriangleMesh(
        scene, np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32)
    )
    return scene


def fire(
    scene: Any, origins: np.ndarray, directions: np.ndarray, rng: np.random.Generator,
    noise: float, reach: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return which rays came back, and how far they went (metres, with noise)."""
    hit = scene.run(origins.astype(np.float32), directions.astype(np.float32), output=True)
    far = hit["tfar"].astype(float)
    back = (hit["geomID"] >= 0) & (far < reach) & (far > 0.6) & (rng.random(len(far)) > 0.05)
    return back, far + rng.normal(0, noise, len(far))


def fly(world: World, rng: np.random.Generator) -> np.ndarray:
    """Return what a drone sees on parallel lines at 22 to 45 m: (N, 3), world frame."""
    half, altitude, way = 0.45 * world.size, rng.uniform(22, 45), []
    for k, y in enumerate(np.arange(-half, half, rng.uniform(14, 25))):
        x = np.arange(-half, half, 1.0)
        way.append(np.column_stack([x if k % 2 == 0 else x[::-1], np.full(len(x), y)]))
    at = np.concatenate(way)
    top = max(world.z(x, y) for x, y in at[::40]) + altitude
    each = int(rng.uniform(1.2e6, 2.5e6) / len(at))
    origins = np.repeat(np.column_stack([at, np.full(len(at), top)]), each, axis=0)
    n = len(origins)
    azimuth, off = rng.uniform(0, 2 * np.pi, n), np.radians(38) * np.sqrt(rng.random(n))
    directions = np.column_stack(
        [np.sin(off) * np.cos(azimuth), np.sin(off) * np.sin(azimuth), -np.cos(off)]
    )
    directions[:, :2] += np.repeat(rng.normal(0, 0.05, (len(at), 2)), each, axis=0)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    back, far = fire(scene_of(world, world.objects), origins, directions, rng, 0.03, 120.0)
    return np.asarray(origins[back] + directions[back] * far[back, None])


def drive(
    world: World, rng: np.random.Generator, drift: float, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a ground robot sees on a bent loop: where it is, and where it believes it is."""
    scene = scene_of(world, changed(world, rng, share))
    radius, half = rng.uniform(12, 24), 0.45 * world.size
    x0, y0 = 0.75 * rng.uniform(radius - half, half - radius, 2)
    turn = np.arange(0, 2 * np.pi, 0.9 / radius)
    bent = radius * (1 + 0.25 * np.sin(3 * turn + rng.uniform(0, 6)))
    way = np.column_stack([x0 + bent * np.cos(turn), y0 + bent * np.sin(turn)])
    heading = np.unwrap(np.arctan2(np.gradient(way[:, 1]), np.gradient(way[:, 0])))
    mast, channels = rng.uniform(0.5, 1.2), int(rng.choice([16, 32, 64]))
    elevation = np.radians(np.linspace(-15 if channels == 16 else -25, 15, channels))
    azimuth = np.arange(0, 2 * np.pi, np.radians(0.4 if channels < 64 else 0.8))
    e, a = (k.ravel() for k in np.meshgrid(elevation, azimuth, indexing="ij"))
    beams = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    step = float(np.linalg.norm(np.diff(way, axis=0), axis=1).mean())
    off, twist = np.zeros(3), 0.0
    pull, pull_yaw = rng.normal(0, 1, 3) * [1, 1, 0.5], rng.normal()
    true, believed = [], []
    for k, (x, y) in enumerate(way):
        at = np.array([x, y, world.z(x, y) + mast])
        sway = Rotation.from_euler("zyx", [heading[k], rng.normal(0, 0.03), rng.normal(0, 0.03)])
        rays = sway.apply(beams)
        back, far = fire(scene, np.repeat(at[None], len(rays), 0), rays, rng, 0.02, 60.0)
        seen = rays[back] * far[back, None]
        true.append(at + seen)
        off, twist = off + 0.8 * drift * step * pull, twist + 0.02 * drift * step * pull_yaw
        pull = 0.98 * pull + 0.2 * rng.normal(0, 1, 3) * [1, 1, 0.4]
        pull /= max(float(np.linalg.norm(pull)), 1e-9)
        pull_yaw = 0.98 * pull_yaw + 0.2 * rng.normal()
        believed.append(at + off + Rotation.from_rotvec([0, 0, twist]).apply(seen))
    kept = rng.choice(sum(map(len, true)), int(rng.uniform(2e5, 6e5)))
    return np.concatenate(true)[kept], np.concatenate(believed)[kept]


def changed(world: World, rng: np.random.Generator, share: float) -> list[Any]:
    """Return the objects, a share of the movable ones gone or some metres away."""
    kept = []
    for parts, movable in world.objects:
        if movable and rng.random() < share:
            if rng.random() < 0.5:
                continue
            shift = [*rng.normal(0, 6, 2), 0.0]
            parts = [(v + shift, f) for v, f in parts]
        kept.append((parts, movable))
    return kept


def cut(base: np.ndarray, draft: np.ndarray, overlap: float) -> tuple[np.ndarray, float]:
    """Return the base ended by a straight line so that it shares `overlap` of the draft's cells."""
    cells = np.unique(np.floor(draft[:, :2]).astype(int), axis=0)
    known = set(map(tuple, np.unique(np.floor(base[:, :2]).astype(int), axis=0).tolist()))
    shared = cells[[tuple(c) in known for c in cells.tolist()]]
    if len(shared) <= overlap * len(cells):
        return base, len(shared) / len(cells)
    away = draft[:, :2].mean(axis=0)
    away = away / (np.linalg.norm(away) + 1e-9)
    end = np.sort(shared @ away)[round(overlap * len(cells)) - 1]
    return base[base[:, :2] @ away < end], overlap


def frame(rng: np.random.Generator, tilt: float) -> np.ndarray:
    """Return T_world_map of a map that begins anywhere, off level by `tilt` radians."""
    about, yaw = rng.uniform(0, 2 * np.pi), rng.uniform(-np.pi, np.pi)
    lean = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
    R = (Rotation.from_euler("z", yaw) * lean).as_matrix()
    return np.asarray(from_rotation(R, rng.uniform(-80, 80, 3) * [1, 1, 0.3]))


def make_pair(seed: int, cache: Path | None) -> dict[str, Any]:
    """Return both maps (own frames), the truth and the conditions of a seed."""
    path = cache / f"{seed}.npz" if cache else None
    if path is not None and path.exists():
        with np.load(path) as kept:
            return {**{k: kept[k] for k in ("target", "source", "T")},
                    "conditions": json.loads(str(kept["conditions"]))}  # fmt: skip
    rng = np.random.default_rng([seed, 777])
    overlap = float(rng.choice([0.14, 0.2, 0.3, 0.45, 0.7, 1.0]))
    drift, share = float(rng.choice([0, 0.003, 0.01])), float(rng.choice([0, 0.3]))
    tilt = float(np.radians(rng.choice([0, 0.5, 1.0])))
    world = build(KINDS[seed % len(KINDS)], rng)
    base = fly(world, rng)
    true, believed = drive(world, rng, drift, share)
    base, overlap = cut(base, true, overlap)
    T_world_target, T_world_source = frame(rng, 0.0), frame(rng, tilt)
    # with drift, the truth is the best rigid motion of the whole draft
    T_true_believed = fit_motion(true, believed)
    pair = {
        "target": apply(invert(T_world_target), base).astype(np.float32),
        "source": apply(invert(T_world_source), believed).astype(np.float32),
        "T": invert(T_world_target) @ T_true_believed @ T_world_source,
        "conditions": {"kind": world.kind, "overlap": overlap, "drift": drift, "tilt": tilt,
                       "change": share},
    }  # fmt: skip
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **{**pair, "conditions": json.dumps(pair["conditions"])})
    return pair


def judge(pair: dict[str, Any], draft: dict[str, Any], label: str) -> dict[str, Any]:
    """Return the record of one match."""
    target, source = (p.astype(np.float64) for p in (pair["target"], draft["source"]))
    start = time.process_time()
    found = match(target, source)
    record = {
        "label": label, **pair["conditions"], "n_target": len(target), "n_source": len(source),
        "accepted": found.accepted, "confidence": found.confidence,
        "cpu_seconds": round(time.process_time() - start, 2), "reason": found.reason,
    }  # fmt: skip
    best = found.T_target_source
    if best is None and found.rivals:
        best = found.rivals[0].T_target_source
    if label == "same place" and best is not None:
        metres, radians = difference(best, pair["T"], source.mean(axis=0))
        record |= {"metres": round(metres, 4), "degrees": round(float(np.degrees(radians)), 4)}
    return record


def show() -> None:
    """Print what the records hold."""
    records = read_lines(RECORDS)

    def within(r: dict[str, Any], metres: float, degrees: float) -> bool:
        return r.get("metres", 99.0) < metres and r.get("degrees", 99.0) < degrees

    for kind in (*KINDS, "all"):
        own = [r for r in records if kind in (r["kind"], "all") and r["label"] == "same place"]
        other = [r for r in records if kind in (r["kind"], "all") and r["label"] != "same place"]
        right = [r for r in own if within(r, 1.0, 2.0)]
        print(
            f"{kind:8s} {len(own):3d} of one place: {len(right):3d} right (1 m, 2 deg), "
            f"{sum(r['accepted'] for r in right):3d} accepted, "
            f"{sum(within(r, 0.3, 0.5) for r in right):3d} within (0.3 m, 0.5 deg), "
            f"{sum(r['accepted'] for r in own if r not in right)} wrong accepted; "
            f"{len(other)} of others: {sum(r['accepted'] for r in other)} accepted"
        )


def main() -> None:
    """Run the seeds that have no record yet, or show the records."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--pairs", type=int, default=56)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--show", action="store_true")
    options = parser.parse_args()
    logging.getLogger("commonmap").setLevel(logging.ERROR)
    done = {record["seed"] for record in read_lines(RECORDS)}
    for seed in () if options.show else range(options.first, options.first + options.pairs):
        if seed in done:
            continue
        pair = make_pair(seed, options.cache)
        lines = [judge(pair, pair, "same place")]
        before = seed - len(KINDS)
        if before >= options.first:
            lines.append(judge(pair, make_pair(before, options.cache), "another place"))
        add_lines(RECORDS, ({"seed": seed, **line} for line in lines))
        for line in lines:
            print(
                seed,
                line["kind"],
                line["label"],
                line["accepted"],
                line.get("metres", "-"),
                line.get("degrees", "-"),
                flush=True,
            )
    show()


if __name__ == "__main__":
    main()
