"""The peers, one small adapter each with its settings, and the process that runs one of them.

    python benchmarks/peers_methods.py                          # who can run in this interpreter
    python benchmarks/peers_methods.py PEER BASE.npy DRAFT.npy  # one run, one line of JSON

An adapter takes the (N, 3) float64 points of base and draft, in metres, and returns an `Answer`.
Only its call is timed: imports, reading and (where code is compiled on first use) a first call on
a toy scene come before. Each run has a process of its own, on one core.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CPU_LIMIT = 120
"""Seconds of CPU time after which a run counts as failed."""
GICP_VOXEL = 0.3
"""Voxel in metres of the refinement: that of KISS-Matcher's own SLAM."""
OPEN3D_ACROSS = 40
"""Voxels across the draft; the best of some tried on pairs of other seeds (docs/peers.md)."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What a peer says: its pose, the pose before refinement, whether it believes it, and why."""

    T: Floats
    T_raw: Floats
    accepted: bool
    figures: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Peer:
    """A row of the table.

    needs: distributions, as pip names them. accepts: what of its own makes an answer valid; ""
    where it has nothing of the kind, and every answer counts as accepted. warm: compiled on
    first use, so called once on a toy scene before the clock starts.
    """

    title: str
    run: Callable[[Floats, Floats], Answer]
    needs: tuple[str, ...]
    settings: str
    accepts: str = ""
    warm: bool = False


def choose_voxel(draft: Floats, across: int) -> float:
    """Return the edge in metres of which `across` span the draft, at least 0.1 m."""
    low, high = np.quantile(draft[:, :2], [0.01, 0.99], axis=0)
    return max(0.1, float((high - low).max()) / across)


def refine_with_gicp(
    target: Floats, source: Floats, T: Floats, voxel: float = GICP_VOXEL
) -> tuple[Floats, dict[str, Any]]:
    """Return the pose after small_gicp as KISS-Matcher's own SLAM calls it, and its inliers."""
    import small_gicp

    result = small_gicp.align(
        target, source, T, registration_type="VGICP", voxel_resolution=voxel,
        downsampling_resolution=voxel, max_correspondence_distance=5.0 * voxel,
        max_iterations=32, num_threads=1,
    )  # fmt: skip
    return np.asarray(result.T_target_source), {"gicp_inliers": int(result.num_inliers)}


def run_kiss_matcher(target: Floats, source: Floats, *, across: int) -> Answer:
    """KISS-Matcher, then small_gicp; valid from five final inliers on, as its example says."""
    import kiss_matcher

    voxel = choose_voxel(source, across)
    config = kiss_matcher.KISSMatcherConfig(voxel, use_quatro=True)
    matcher = kiss_matcher.KISSMatcher(config)
    found = matcher.estimate(source.astype(np.float32), target.astype(np.float32))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.asarray(found.rotation), np.asarray(found.translation).ravel()
    n_inliers = int(matcher.get_num_final_inliers())
    refined, figures = refine_with_gicp(target, source, T)
    return Answer(refined, T, n_inliers >= 5, {"voxel_m": voxel, "inliers": n_inliers} | figures)


def run_open3d(target: Floats, source: Floats, *, method: str) -> Answer:
    """Global registration as Open3D's tutorial has it: FPFH, RANSAC or FGR, point-to-plane ICP."""
    import open3d

    registration, search = open3d.pipelines.registration, open3d.geometry.KDTreeSearchParamHybrid
    open3d.utility.random.seed(0)
    voxel = choose_voxel(source, OPEN3D_ACROSS)

    def prepare(xyz: Floats) -> tuple[Any, Any]:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz))
        cloud = cloud.voxel_down_sample(voxel)
        cloud.estimate_normals(search(radius=2.0 * voxel, max_nn=30))
        return cloud, registration.compute_fpfh_feature(cloud, search(5.0 * voxel, 100))

    base, base_features = prepare(target)
    draft, draft_features = prepare(source)
    if method == "ransac":
        found = registration.registration_ransac_based_on_feature_matching(
            draft, base, draft_features, base_features, True, 1.5 * voxel,
            registration.TransformationEstimationPointToPoint(False), 3,
            [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
             registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel)],
            registration.RANSACConvergenceCriteria(100_000, 0.999),
        )  # fmt: skip
    else:
        found = registration.registration_fgr_based_on_feature_matching(
            draft,
            base,
            draft_features,
            base_features,
            registration.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * voxel),
        )
    refined = registration.registration_icp(
        draft, base, 0.4 * voxel, found.transformation,
        registration.TransformationEstimationPointToPlane(),
    )  # fmt: skip
    figures = {"voxel_m": voxel, "fitness": found.fitness, "icp_fitness": refined.fitness}
    return Answer(
        np.asarray(refined.transformation), np.asarray(found.transformation), True, figures
    )


def run_map_closures(target: Floats, source: Floats) -> Answer:
    """MapClosures with its defaults, base and draft as two local maps; then small_gicp."""
    from map_closures.config import MapClosuresConfig
    from map_closures.map_closures import MapClosures
    from map_closures.voxel_map import VoxelMap

    config = MapClosuresConfig()
    closures = MapClosures(config)
    maps = []
    for xyz in (target, source):
        voxels = VoxelMap(config.density_map_resolution, 100.0)
        voxels.integrate_frame(xyz - target.mean(axis=0), np.eye(4))
        maps.append(voxels.point_cloud())
    closures.get_best_closure(0, maps[0])
    found = closures.get_best_closure(10, maps[1])
    # Its pose takes the older map's points into the newer one
    T = np.linalg.inv(np.asarray(found.pose))
    T[:3, 3] += target.mean(axis=0) - T[:3, :3] @ target.mean(axis=0)
    n_inliers = int(found.number_of_inliers)
    figures: dict[str, Any] = {"inliers": n_inliers}
    if n_inliers == 0:
        return Answer(T, T, False, figures)
    refined, more = refine_with_gicp(target, source, T)
    return Answer(refined, T, n_inliers > config.inliers_threshold, figures | more)


def run_grid(target: Floats, source: Floats, *, measure: str) -> Answer:
    """The best pose of a coarse grid by one measure; small_gicp with half a cell, then as above."""
    import peers_grids

    T, figures = peers_grids.search(target, source, measure=measure)
    if not figures["found"]:
        return Answer(T, T, False, figures)
    near, _ = refine_with_gicp(target, source, T, voxel=max(GICP_VOXEL, 0.5 * figures["cell_m"]))
    refined, more = refine_with_gicp(target, source, near)
    return Answer(refined, T, True, figures | more)


def run_commonmap(target: Floats, source: Floats) -> Answer:
    """commonmap as it comes; a refused match still names the pose it thinks best."""
    from commonmap.matching.match import match

    found = match(target, source)
    T = found.T_target_source
    if T is None:
        T = found.rivals[0].T_target_source if found.rivals else np.eye(4)
    return Answer(T, T, found.accepted, {"confidence": found.confidence, "reason": found.reason})


_GICP = f"then small_gicp VGICP, voxel {GICP_VOXEL} m, reach {5 * GICP_VOXEL} m"
_OPEN3D = (
    f"tutorial: voxel 1/{OPEN3D_ACROSS} of the draft's extent, normals 2, FPFH 5 voxels, {{}}, "
    "then point-to-plane ICP, 0.4 voxels"
)
_GRID = (
    "cells of 1/48 of the draft's extent, every 4 deg, half of the draft overlaps; "
    f"small_gicp with voxels of half a cell, {_GICP}"
)

PEERS = {
    "commonmap": Peer(
        "commonmap", run_commonmap, ("commonmap",), "as it comes", "its verdict", warm=True
    ),
    **{
        name: Peer(
            f"KISS-Matcher, voxel 1/{across}", partial(run_kiss_matcher, across=across),
            ("kiss_matcher", "small_gicp"),
            f"voxel 1/{across} of the draft's extent, Quatro, {_GICP}",
            "5 final inliers, as in its example",
        )
        for name, across in (("kiss-matcher", 150), ("kiss-matcher-coarse", 75))
    },
    "open3d-ransac": Peer(
        "Open3D FPFH + RANSAC", partial(run_open3d, method="ransac"), ("open3d",),
        _OPEN3D.format("RANSAC 1.5 voxels, 100,000 iterations, 0.999"),
    ),
    "open3d-fgr": Peer(
        "Open3D FPFH + FGR", partial(run_open3d, method="fgr"), ("open3d",),
        _OPEN3D.format("FGR 0.5 voxels"),
    ),
    "map-closures": Peer(
        "MapClosures", run_map_closures, ("map_closures", "small_gicp"),
        f"its defaults (density map 0.5 m), {_GICP}", "more than 5 inliers, its default",
    ),
    **{
        f"kaeslin-{measure}": Peer(
            f"Kaeslin et al., {title}", partial(run_grid, measure=measure),
            ("numba", "scipy", "small_gicp"), f"elevation maps, {_GRID}", warm=True,
        )
        for measure, title in (
            ("zsad", "zero-mean SAD"), ("zssd", "zero-mean SSD"), ("ncc", "NCC"), ("mi", "MI"),
        )
    },
    "akay-k": Peer(
        "Akay et al., K divergence", partial(run_grid, measure="k"),
        ("commonmap", "numba", "scipy", "small_gicp"), f"heights under 1 m, {_GRID}", warm=True,
    ),
}  # fmt: skip


def toy_scene(rng: np.random.Generator) -> Floats:
    """Return (N, 3) points of twelve blocks on a flat square of 20 m."""
    floor = np.column_stack([rng.uniform(0.0, 20.0, (8000, 2)), np.zeros(8000)])
    corners, sides = rng.uniform(0.0, 18.0, (12, 2)), rng.uniform(0.3, 2.0, (12, 3))
    blocks = rng.uniform(size=(12, 800, 3)) * sides[:, None]
    blocks[..., :2] += corners[:, None]
    return np.concatenate([floor, blocks.reshape(-1, 3)])


def missing(peer: Peer) -> str:
    """Return why a peer cannot run in this interpreter; "" where it can."""
    for need in peer.needs:
        try:
            importlib.import_module(need)
        except ImportError as error:
            return f"{need} is not installed ({error})"
    return ""


def versions(peer: Peer) -> dict[str, str]:
    """Return the version of each distribution that a peer needs."""
    return {need: importlib.metadata.version(need) for need in peer.needs}


def peak_mb() -> float:
    """Return the most memory that this process ever held, in MB (libraries included)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1024
    return float("nan")


def run_one(name: str, base: Path, draft: Path) -> dict[str, Any]:
    """Return the record of one run."""
    peer = PEERS[name]
    for need in peer.needs:
        importlib.import_module(need)
    target, source = (np.load(path).astype(np.float64) for path in (base, draft))
    if peer.warm:
        toy = toy_scene(np.random.default_rng(0))
        peer.run(toy, toy)
    wall, cpu = time.perf_counter(), time.process_time()
    answer = peer.run(target, source)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    result = asdict(answer) | {"T": answer.T.tolist(), "T_raw": answer.T_raw.tolist()}
    return result | {
        "cpu_s": round(cpu, 3), "wall_s": round(wall, 3), "peak_mb": round(peak_mb(), 1),
        "versions": versions(peer),
    }  # fmt: skip


def main() -> int:
    """List the peers, or run one on one core within the time limit."""
    if len(sys.argv) == 1:
        print(json.dumps({name: missing(peer) for name, peer in PEERS.items()}, indent=1))
        return 0
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT, CPU_LIMIT + 5))
    real = os.dup(1)
    os.dup2(2, 1)  # what libraries print is no part of the record
    record = run_one(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
    os.write(real, (json.dumps(record) + "\n").encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
