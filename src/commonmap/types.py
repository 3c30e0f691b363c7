"""Records that travel between layers. Plain arrays inside, frozen outside, SI units throughout."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Bools = NDArray[np.bool_]

TREE_DEPTH = 16
"""Levels of an occupancy octree below its root, as in OctoMap."""

KEY_ORIGIN = 1 << (TREE_DEPTH - 1)
"""The key of the voxel whose lower corner is the origin of the frame."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one map in one frame, as a reader returns them.

    xyz: (N, 3) float64, metres, z up, in the frame of the file.
    crs: the coordinate reference system as WKT where the file names one; such a map is level.
    colour: (N, 3) uint8 red, green, blue where the file has it.
    intensity: (N,) float32, in the file's own unit, where the file has it.
    time: (N,) float64, seconds, where the file has it.
    origin: (N, 3) float32, where the sensor was when it saw the point (ray starts), where known.
    seen_by: (N,) uint8, in a common map: 1 the target's robot saw it, 2 the source's, 3 both.
    """

    xyz: Float64s
    crs: str | None = None
    colour: NDArray[np.uint8] | None = None
    intensity: Float32s | None = None
    time: Float64s | None = None
    origin: Float32s | None = None
    seen_by: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Leaves:
    """The leaves of an occupancy octree as arrays; a node that is not there is unknown space.

    resolution: edge of the smallest voxel, metres.
    keys: (N, 3) uint16, key of the leaf's lower corner at the finest level:
        `key = floor(coordinate / resolution) + 32768`.
    depth: (N,) uint8, 16 for a smallest voxel; a leaf at depth d is `2**(16 - d)` voxels wide.
    log_odds: (N,) float32; 0 or above is occupied, below is free.
    """

    resolution: float
    keys: NDArray[np.uint16]
    depth: NDArray[np.uint8]
    log_odds: Float32s

    @property
    def occupied(self) -> Bools:
        """(N,) bool: the leaf is at least as likely occupied as not, as OctoMap decides."""
        return self.log_odds >= 0.0

    def sizes(self) -> Float64s:
        """Return the edge of each leaf in metres, (N,)."""
        return self.resolution * np.exp2(TREE_DEPTH - self.depth.astype(np.float64))

    def centres(self) -> Float64s:
        """Return the centre of each leaf in metres, (N, 3), in the frame of the tree."""
        corner = (self.keys.astype(np.float64) - KEY_ORIGIN) * self.resolution
        return corner + 0.5 * self.sizes()[:, None]


@dataclass(frozen=True, eq=False)
class LeafParts:
    """The leaves of an octree in parts, one after the other in Morton order.

    For trees whose leaves would fill the memory if they were made all at once.

    resolution: edge of the smallest voxel, metres.
    make: returns the parts, anew at each call.
    """

    resolution: float
    make: Callable[[], Iterator[Leaves]]

    def __iter__(self) -> Iterator[Leaves]:
        return self.make()


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of a lidar, as measured: not deskewed, each point in the frame of its moment.

    xyz: (N, 3) float32 metres, sensor frame (x forward, y left, z up).
    time: (N,) float64 seconds, on the clock of the log.
    ring: (N,) uint16, the channel, lowest first.
    intensity: (N,) float32.
    stamp: seconds, the time of the first firing of the turn.
    timed: whether the log told the times; else they were derived from the azimuth, and the points
        may have been moved to one moment by whoever made the log.
    """

    xyz: Float32s
    time: Float64s
    ring: NDArray[np.uint16]
    intensity: Float32s
    stamp: float
    timed: bool = True


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a sensor over time. time: (M,) seconds, rising; T_map_sensor: (M, 4, 4)."""

    time: Float64s
    T_map_sensor: Float64s


@dataclass(frozen=True, eq=False)
class GridMap:
    """Layers over one grid. Cell `[i, j]` spans `origin + [i, j] * cell` to `origin + [i+1, j+1]
    * cell`, half-open: i runs along x, j along y. Unknown is a mask, never a magic number.

    origin: (2,) float64 metres, the lower corner of cell [0, 0], in the frame of the map.
    cell: edge of a cell, metres.
    layers: name -> (nx, ny) array, or (n_slabs, nx, ny) for layers cut into height slabs.
    """

    origin: Float64s
    cell: float
    layers: Mapping[str, NDArray[Any]]
    slab_edges: Float64s | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Cells along x and along y."""
        first = next(iter(self.layers.values()))
        return int(first.shape[-2]), int(first.shape[-1])

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return the layer of that name."""
        return self.layers[name]


class Progress(Protocol):
    """What a long job calls to say where it is: the step in plain words, and the share done of
    the step, 0 to 1. A step is told at least once, at its start."""

    def __call__(self, step: str, share: float = 0.0) -> None:
        """Say that `step` is under way."""


def no_progress(step: str, share: float = 0.0) -> None:
    """Say nothing."""


@dataclass(frozen=True, eq=False)
class SearchPicture:
    """What the search saw, for a picture of it: every value the metric's score at a pose.

    score: (nx, ny), higher is better, over the translations at the best yaw; NaN where the
        overlap is too small to count.
    x: (nx,), y: (ny,) metres, where the point `centre` of the source comes to lie in the target
        frame, rising.
    centre: (3,) metres, a point of the source frame near the middle of the source map. (The
        translation of a motion turns about a frame origin that may be kilometres away; the
        place of the map's centre is what a reader of the picture can compare between yaws.)
    yaw: (m,) radians, rising. best_per_yaw: (m,) the best score of each yaw.
    decoy_best: the best score of the mirrored source over all poses.
    """

    score: Floats
    x: Float64s
    y: Float64s
    centre: Float64s
    yaw: Float64s
    best_per_yaw: Floats
    decoy_best: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that the search proposes, best first. score: of the metric; overlap: 0 to 1."""

    T_target_source: Float64s
    score: float
    overlap: float


@dataclass(frozen=True, eq=False)
class DriftField:
    """A smooth correction of a draft that is bent by drift, in the draft's own frame.

    T_grid_source: (4, 4) takes points of the source into the level frame of the grid. corner: (2,)
    metres, middle of node [0, 0]. spacing: metres between nodes. motion: (nx, ny, 4) x, y, z in
    metres and yaw in radians about each node, nx and ny at least 2.
    """

    T_grid_source: Float64s
    corner: Float64s
    spacing: float
    motion: Float64s

    def apply(self, xyz: NDArray[np.floating[Any]]) -> Float64s:
        """Return (N, 3) corrected points of the source's frame: `T_target_source` holds for them.

        The motions of the four nodes around a point are blended by its place between them (Sumner
        et al. 2007); beyond the outermost nodes the nearest ones hold.
        """
        R, t = self.T_grid_source[:3, :3], self.T_grid_source[:3, 3]
        points = np.asarray(xyz, dtype=np.float64)
        local = (points @ R.T + t)[:, :2]
        last = np.array(self.motion.shape[:2]) - 1
        place = np.clip((local - self.corner) / self.spacing, 0.0, last)
        node = np.minimum(place.astype(np.int64), last - 1)
        share = place - node
        moved = np.zeros((len(points), 3))
        for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = np.prod(np.where(step, share, 1.0 - share), axis=1)[:, None]
            at = node + step
            motion = self.motion[at[:, 0], at[:, 1]]
            offset = (place - at) * self.spacing
            turned = motion[:, 3:] * np.column_stack([-offset[:, 1], offset[:, 0]])
            moved += weight * motion[:, :3]
            moved[:, :2] += weight * turned
        return np.asarray(points + moved @ R)


@dataclass(frozen=True, eq=False)
class Area:
    """One area of the draft, matched by itself.

    centre: (3,) of its points, target frame, at the pose of the whole. T_target_source: (4, 4) its
    own best pose; None where too little stands in it to search. accepted, confidence, reason: the
    verdict on that pose, as for a whole map. score: evidence, nats. agrees: its own pose is that of
    the whole, within the distance at which the search tells two poses apart.
    drift: (3,) metres, target frame, by which its points would be moved to lie on the base, near
    the pose of the whole; None where too few points met the base. weight: 0 to 1, how far that
    goes with its neighbours.
    """

    centre: Float64s
    T_target_source: Float64s | None
    accepted: bool
    confidence: float
    reason: str
    score: float
    agrees: bool
    drift: Float64s | None
    weight: float


@dataclass(frozen=True, eq=False)
class Areas:
    """The draft by areas. size: metres, their edge. items: one per area that holds points.

    agreeing: share of the areas searched whose own pose is that of the whole; nan where none was.
    drift: the correction, where the areas support one; reason: one sentence that says why.
    before: metres, mean distance of held-out areas off the base. gain: by how much less it is with
    the drift of their neighbours taken off. gain_z: the same in standard deviations of chance
    (signed ranks over the areas). nan where there was nothing to hold out.
    """

    size: float
    items: tuple[Area, ...]
    agreeing: float
    drift: DriftField | None
    reason: str
    before: float
    gain: float
    gain_z: float


@dataclass(frozen=True, eq=False)
class Match:
    """The answer: where the source map lies in the target's frame, and whether to believe it.

    accepted: the honest yes or no.
    reason: one sentence that says why.
    T_target_source: (4, 4), `p_target = T_target_source @ p_source`; None when refused.
    confidence: 0 to 1, how probable it is that the best pose is right.
    covariance: (6, 6) of [x, y, z, rotation about x, y, z] in metres and radians, for a small
        motion applied on the target's side at the source's centre; None when refused.
    covariance_centre: (3,) the point of the target frame about which the small rotation turns.
    overlap: share of the source's known cells that fall on known cells of the target.
    score, decoy_score: of the best pose, and of the best pose of the mirrored source.
    rivals: other poses worth a look, best first (when refused, the best pose is the first).
    metric: name of the similarity metric.
    evidence: named figures behind the verdict.
    timings: seconds per step.
    areas: the draft by areas, where asked for.
    """

    accepted: bool
    reason: str
    T_target_source: Float64s | None
    confidence: float
    covariance: Float64s | None
    covariance_centre: Float64s | None
    overlap: float
    score: float
    decoy_score: float
    rivals: tuple[Candidate, ...]
    metric: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    timings: Mapping[str, float] = field(default_factory=dict)
    T_level_target: Float64s | None = None
    T_level_source: Float64s | None = None
    picture: SearchPicture | None = None
    areas: Areas | None = None
