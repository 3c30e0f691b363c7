"""The drift of a draft, from areas that are each laid on the base by themselves.

Every area of the draft's plan has four degrees of freedom (x, y, z, yaw). Its own points say where
it wants to lie (robust point-to-plane), with the information they have: along a straight wall none.
A Gaussian process over the areas' centres (Rasmussen and Williams 2006, Matern 3/2) ties them
together; how far, how strongly, and how much an area's own word is worth is taken from the data by
maximum marginal likelihood. The correction blends the areas' motions (embedded deformation, Sumner
et al. 2007).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from commonmap.types import Bools, Float64s

MOST_PER_AREA = 1_500
"""Points of an area that are laid on the base."""

LEAST_PER_AREA = 60
"""Points on the base under which an area has no say."""

MOST_FITTED = 150
"""Areas from which the prior's parameters are taken."""

DIGITS = 5
"""Decimals of a motion. A hundredth of a millimetre is far below what is known, and far above the
rounding of large linear systems, which differs with the threads that solve them."""

N_FOLDS = 5
"""Areas are held out by fifths; no two that touch are held out together."""

CONTRADICTION = 16.0
"""Squared error of an area against its neighbours, in its own variance, at which it counts half;
chance alone gives four."""

LEAST_AREAS = 8
"""Areas with a say under which no drift can be told from chance."""

SURE = 3.0
"""Standard deviations of chance by which held-out areas must lie better (signed ranks)."""

LEAST_GAIN = 1e-3
"""Metres by which held-out areas must lie better on average; less is known of no pose."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Points with unit normals, each (N, 3), metres."""

    xyz: Float64s
    normal: Float64s


@dataclass(frozen=True, eq=False)
class Pieces:
    """The draft's points by areas. surface: (N, 3) in the grid's frame. area: (N,) index of each
    point's area, 0 to A - 1. centre: (A, 3) metres, middle of an area at the height of its points.
    """

    surface: Surface
    area: NDArray[np.int64]
    centre: Float64s


@dataclass(frozen=True, eq=False)
class Readings:
    """What the areas say of themselves. motion: (A, 4) x, y, z in metres, yaw in radians about the
    area's centre. information: (A, 4, 4), inverse covariance as independent points would have it.
    heard: (A,) bool, the area has points enough on the base.
    """

    motion: Float64s
    information: Float64s
    heard: Bools


@dataclass(frozen=True)
class Prior:
    """What the areas show of the drift. reach: metres over which it is alike. level, climb: metres,
    its standard deviation in the plane and in z. own: metres, by which an area errs as a whole.
    noise: factor on the variance that independent points would have.
    """

    reach: float
    level: float
    climb: float
    own: float
    noise: float

    def scales(self) -> Float64s:
        """Return the standard deviation of x, y, z (metres) and yaw (radians); yaw is half the
        curl of the displacement, whose slope has sqrt(3) / reach of its deviation."""
        yaw = math.sqrt(1.5) * self.level / self.reach
        return np.array([self.level, self.level, self.climb, yaw])


@dataclass(frozen=True, eq=False)
class Drift:
    """The drift told by the areas. motion: (A, 4) smoothed, to be added to the draft.

    readings: the areas' own. weight: (A,) 0 to 1, how far an area goes with its neighbours.
    prior: as fitted. before: metres, how far held-out areas lie off the base as they are. gain: by
    how much less with the drift of the other areas taken off. gain_z: Wilcoxon's signed ranks of
    the areas' gains, in standard deviations of chance.
    """

    motion: Float64s
    readings: Readings
    weight: Float64s
    prior: Prior
    before: float
    gain: float
    gain_z: float

    @property
    def supported(self) -> bool:
        """Whether held-out areas lie measurably better with the correction than without."""
        return self.gain > LEAST_GAIN and self.gain_z > SURE


def find_surface(xyz: Float64s, *, n_neighbours: int = 12) -> Surface:
    """Return the points with their normals, of their nearest neighbours."""
    import small_gicp

    cloud, _ = small_gicp.preprocess_points(
        xyz, downsampling_resolution=1e-3, num_neighbors=n_neighbours, num_threads=1
    )
    return Surface(np.asarray(cloud.points())[:, :3], np.asarray(cloud.normals())[:, :3])


def find_drift(base: Surface, pieces: Pieces, *, size: float, reach: float) -> Drift | None:
    """Return the drift of the draft's areas on the base, or None where too few have a say.

    Both in one frame, at the rigid pose. size: metres, edge of an area. reach: metres, the largest
    drift that the areas are asked about.
    """
    tree = cKDTree(base.xyz, balanced_tree=False)
    motion = np.zeros((len(pieces.centre), 4))
    # Each area by itself from where its neighbours put it; then all together; ever closer
    for near in (reach, 0.7 * reach, 0.5 * reach, 0.35 * reach, 0.25 * reach):
        readings = read_areas(base, tree, pieces, motion, reach=near)
        if np.count_nonzero(readings.heard) < LEAST_AREAS:
            return None
        prior = fit_prior(readings, pieces.centre, size)
        motion, weight = smooth(readings, pieces.centre, pieces.centre, prior)
    guessed = _guess_held_out(readings, pieces.centre, prior, size)
    before, after = _compare(base, tree, pieces, guessed, reach=0.5 * reach)
    used = readings.heard & np.isfinite(before)
    gain = before[used] - after[used]
    return Drift(
        motion, readings, weight, prior,
        before=float(before[used].mean()), gain=float(gain.mean()), gain_z=_signed_ranks(gain),
    )  # fmt: skip


def displace(motion: Float64s, offset: Float64s) -> Float64s:
    """Return the displacement (N, 3) at `offset` (N, 3) from the centres of motions (N, 4)."""
    moved = motion[:, :3].copy()
    moved[:, 0] -= motion[:, 3] * offset[:, 1]
    moved[:, 1] += motion[:, 3] * offset[:, 0]
    return moved


def read_areas(
    base: Surface, tree: cKDTree, pieces: Pieces, motion: Float64s, *, reach: float
) -> Readings:
    """Return where each area wants to lie by its own points, starting from `motion` (A, 4)."""
    motion = motion.copy()
    n_areas = len(motion)
    for _ in range(5):
        offset, normal, r, hit = _residuals(base, tree, pieces, motion, reach)
        area = pieces.area[hit]
        count = np.bincount(area, minlength=n_areas)
        scale = _spread(r, area, n_areas)[area]
        w = 1.0 / (1.0 + (r / (2.0 * scale)) ** 2)
        turn = normal[:, 1] * offset[:, 0] - normal[:, 0] * offset[:, 1]
        J = np.column_stack([normal, turn])
        information = np.zeros((n_areas, 4, 4))
        gradient = np.zeros((n_areas, 4))
        for a in range(4):
            gradient[:, a] = np.bincount(area, J[:, a] * w * r / scale**2, minlength=n_areas)
            for b in range(4):
                information[:, a, b] = np.bincount(
                    area, J[:, a] * J[:, b] * w / scale**2, minlength=n_areas
                )
        heard = count >= LEAST_PER_AREA
        # What the points leave open stays as it is
        held = information + np.eye(4) / reach**2
        step = -np.linalg.solve(held, gradient[:, :, None])[:, :, 0]
        step[~heard] = 0.0
        motion += np.clip(step, -0.5 * reach, 0.5 * reach)
    return Readings(motion, information, heard)


def _compare(
    base: Surface, tree: cKDTree, pieces: Pieces, motion: Float64s, *, reach: float
) -> tuple[Float64s, Float64s]:
    """Return each area's mean distance off the base, without and with `motion`, (A,) metres each.

    Points that meet the base either way count; a point that misses it counts as `reach` off.
    """
    off = np.full((2, len(pieces.area)), np.inf)
    for row, tried in zip(off, (np.zeros_like(motion), motion), strict=True):
        _, _, r, hit = _residuals(base, tree, pieces, tried, reach)
        row[hit] = np.abs(r)
    met = np.isfinite(off).any(axis=0)
    off, area = np.minimum(off[:, met], reach), pieces.area[met]
    count = np.bincount(area, minlength=len(motion))
    with np.errstate(invalid="ignore"):
        before, after = (np.bincount(area, row, minlength=len(motion)) / count for row in off)
    return before, after


def _signed_ranks(gain: Float64s) -> float:
    """Return Wilcoxon's signed-rank statistic in its standard deviations under chance."""
    n = len(gain)
    ranks = rankdata(np.abs(gain))
    return float((np.sign(gain) * ranks).sum() / math.sqrt(n * (n + 1) * (2 * n + 1) / 6.0))


def _residuals(
    base: Surface, tree: cKDTree, pieces: Pieces, motion: Float64s, reach: float
) -> tuple[Float64s, Float64s, Float64s, NDArray[np.int64]]:
    """Return (offset, normal, residual, index) of the points that have a like surface in reach."""
    offset = pieces.surface.xyz - pieces.centre[pieces.area]
    moved = pieces.surface.xyz + displace(motion[pieces.area], offset)
    distance, index = tree.query(moved, distance_upper_bound=reach, workers=1)
    index = np.minimum(index, len(base.xyz) - 1)
    alike = np.abs(np.einsum("ij,ij->i", pieces.surface.normal, base.normal[index])) > 0.8
    hit = np.flatnonzero(np.isfinite(distance) & alike)
    normal = base.normal[index[hit]]
    r = np.einsum("ij,ij->i", normal, moved[hit] - base.xyz[index[hit]])
    return offset[hit], normal, r, hit


def _spread(r: Float64s, area: NDArray[np.int64], n_areas: int) -> Float64s:
    """Return each area's robust standard deviation of its residuals, at least 1 cm, (A,)."""
    order = np.lexsort((np.abs(r), area))
    starts = np.searchsorted(area[order], np.arange(n_areas + 1))
    middle = (starts[:-1] + starts[1:]) // 2
    spread = np.full(n_areas, 0.01)
    some = starts[1:] > starts[:-1]
    spread[some] = np.maximum(1.4826 * np.abs(r[order[middle[some]]]), 0.01)
    return spread


def fit_prior(readings: Readings, centre: Float64s, size: float) -> Prior:
    """Return the prior under which the areas' own readings are most probable.

    Coordinate by coordinate over factors of two, then of the square root of two.
    """
    used = np.flatnonzero(readings.heard)
    used = used[:: max(1, math.ceil(len(used) / MOST_FITTED))]
    motion, information, at = readings.motion[used], readings.information[used], centre[used]
    extent = float(np.ptp(at, axis=0)[:2].max())
    spread = max(float(np.median(np.abs(motion[:, :2]))), 0.005)
    low = {"reach": 1.5 * size, "level": 1e-3, "climb": 1e-3, "own": 2e-3, "noise": 1.0}
    high = {"reach": max(extent, 3.0 * size), "level": 5.0, "climb": 5.0, "own": 1.0, "noise": 1e4}
    best = Prior(max(0.3 * extent, 2.0 * size), spread, spread, 0.3 * spread, 10.0)
    value = _surprise(best, motion, information, at)
    for factor in (4.0, 2.0, 2.0, math.sqrt(2.0)):
        for name in ("own", "noise", "level", "climb", "reach"):
            for sign in (factor, 1.0 / factor):
                while True:
                    trial = min(max(getattr(best, name) * sign, low[name]), high[name])
                    other = replace(best, **{name: trial})
                    if trial == getattr(best, name):
                        break
                    new = _surprise(other, motion, information, at)
                    if not new < value - 1e-6:
                        break
                    best, value = other, new
    return best


def smooth(
    readings: Readings,
    centre: Float64s,
    at: Float64s,
    prior: Prior,
    *,
    without: Bools | None = None,
) -> tuple[Float64s, Float64s]:
    """Return the motions (B, 4) at places `at` (B, 3), and the areas' weights (A,).

    A reading that its neighbours contradict counts less (Cauchy). without: (A,) areas left out.
    """
    used = readings.heard if without is None else readings.heard & ~without
    index = np.flatnonzero(used)
    m = readings.motion[index].reshape(-1)
    K = _kernel(prior, centre[index], centre[index])
    cross = _kernel(prior, at, centre[index])
    own = _noise(prior, readings.information[index])
    weight = np.ones(len(index))
    for _ in range(4):
        factor = cho_factor(K + _block_diagonal(own / weight[:, None, None]), lower=True)
        solved = cho_solve(factor, m)
        # Leave-one-out errors of the areas in closed form (Rasmussen and Williams, eq. 5.12), each
        # judged by what it would be with full weight
        inverse = _blocks(cho_solve(factor, np.eye(len(m))))
        variance = np.linalg.inv(inverse)
        error = np.einsum("nab,nb->na", variance, solved.reshape(-1, 4))
        variance -= own * (1.0 / weight - 1.0)[:, None, None]
        square = np.einsum("na,na->n", error, np.linalg.solve(variance, error[:, :, None])[:, :, 0])
        weight = 1.0 / (1.0 + square / CONTRADICTION)
    weights = np.zeros(len(centre))
    weights[index] = weight
    motion = (cross @ solved).reshape(-1, 4)
    return np.round(motion, DIGITS), np.round(weights, DIGITS)


def _guess_held_out(readings: Readings, centre: Float64s, prior: Prior, size: float) -> Float64s:
    """Return each area's motion (A, 4) as the areas of the other folds have it."""
    ij = np.floor(centre[:, :2] / size).astype(np.int64)
    folds = (ij[:, 0] + 2 * ij[:, 1]) % N_FOLDS
    guessed = np.zeros((len(centre), 4))
    for fold in range(N_FOLDS):
        held = folds == fold
        guessed[held] = smooth(readings, centre, centre[held], prior, without=held)[0]
    return guessed


def _kernel(prior: Prior, a: Float64s, b: Float64s) -> Float64s:
    """Return the covariance (4A, 4B) of the motions at two sets of places, (A, 3) and (B, 3)."""
    distance = np.hypot(*(a[:, None, :2] - b[None, :, :2]).transpose(2, 0, 1)) / prior.reach
    alike = (1.0 + math.sqrt(3.0) * distance) * np.exp(-math.sqrt(3.0) * distance)
    return np.asarray(np.kron(alike, np.diag(prior.scales() ** 2)))


def _noise(prior: Prior, information: Float64s) -> Float64s:
    """Return the covariances (A, 4, 4) of the areas' own readings."""
    # What its points leave open is known to a metre and to a fortieth of a radian
    floor = np.diag([1.0, 1.0, 1.0, 1600.0])
    own = np.diag([prior.own**2] * 3 + [(prior.own / 4.0) ** 2])
    return np.asarray(prior.noise * np.linalg.inv(information + floor) + own)


def _block_diagonal(blocks: Float64s) -> Float64s:
    """Return the matrix (4A, 4A) with these blocks (A, 4, 4) on its diagonal."""
    n = len(blocks)
    out = np.zeros((n, 4, n, 4))
    out[np.arange(n), :, np.arange(n), :] = blocks
    return out.reshape(4 * n, 4 * n)


def _blocks(matrix: Float64s) -> Float64s:
    """Return the blocks (A, 4, 4) on the diagonal of a matrix (4A, 4A)."""
    n = len(matrix) // 4
    return np.asarray(matrix.reshape(n, 4, n, 4)[np.arange(n), :, np.arange(n), :])


def _surprise(prior: Prior, motion: Float64s, information: Float64s, centre: Float64s) -> float:
    """Return minus the logarithm of the readings' marginal likelihood, but for a constant."""
    C = _kernel(prior, centre, centre) + _block_diagonal(_noise(prior, information))
    m = motion.reshape(-1)
    factor = cho_factor(C, lower=True)
    return float(0.5 * m @ cho_solve(factor, m) + np.log(np.diag(factor[0])).sum())
