"""The exact score of every translation at once, by FFT, for one yaw and any metric of the table.

Source and target are height grids with masks; a cell not known in either contributes nothing.
`prepare_target` computes the target's spectra once; `score_surface` scores one turned source.

    surface[u, v]: source cell [i, j] lies on target cell [i + u - (sx - 1), j + v - (sy - 1)]

over the full range of shifts, (tx + sx - 1, ty + sy - 1). Derivations: docs/metrics-math.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import EmptyMapError, InputError
from commonmap.matching.arrays import Array, choose_shape, count_rim, find_arrays
from commonmap.matching.classes import Classes, Steps, class_products
from commonmap.matching.kernels import Kernel
from commonmap.matching.roads import Frame, Products, moment_products
from commonmap.matching.special import Poses, Special, find_specials
from commonmap.metrics.plans import (
    A_SUM,
    B_SUM,
    DifferenceSum,
    JointHistogram,
    MinSum,
    Moments,
    Smooth,
    Sums,
    Term,
)
from commonmap.metrics.table import Metric, Normalise, check_normalise, find_metric, raise_to_floor
from commonmap.types import Bools, Float64s, Floats

COUNT: dict[str, tuple[Term, ...]] = {"n": ((1.0, "1", "1"),)}


@dataclass(frozen=True, eq=False)
class Surface:
    """Scores of all translations of one yaw, on the host.

    score: (Sx, Sy) float64; NaN where fewer than the smallest number of cells overlap, and where
        the metric has no value. `[u, v]` is the shift by (u - (sx - 1), v - (sy - 1)) cells.
    n_overlap: (Sx, Sy) int32, cells known in both; 0 at shifts of the rim that are not told apart
        because too few cells could overlap there.
    bound: (Sx, Sy) float64, what the score may differ from the literal formula, where asked for.
    """

    score: Float64s
    n_overlap: NDArray[np.int32]
    source_shape: tuple[int, int]
    bound: Float64s | None = None

    def shift(self, u: int, v: int) -> tuple[int, int]:
        """Return the target cell on which source cell [0, 0] lies at `[u, v]`."""
        return u - (self.source_shape[0] - 1), v - (self.source_shape[1] - 1)


@dataclass(frozen=True, eq=False)
class PreparedTarget:
    """A target map with its spectra, ready to score any turned source of `source_shape`."""

    metric: Metric
    normalise: Normalise
    floor: float
    height_range: tuple[float, float]
    min_cells: int
    tolerance: float
    frame: Frame
    height: Float64s
    known: Bools
    offset: float
    total: float
    names: tuple[str, ...]
    moments: Products
    classes: Classes | None
    kernels: dict[tuple[float, float], Kernel] = field(default_factory=dict)
    lock: Any = field(default_factory=Lock)

    @property
    def step(self) -> float:
        """Width of a height class, metres or ln metres; 0 where the metric quantises nothing."""
        return self.classes.steps.step if self.classes is not None else 0.0

    def combine(self, sums: Sums) -> Array:
        """Return the metric from its sums."""
        plan = self.metric.fft
        if isinstance(plan, DifferenceSum | JointHistogram):
            return sums["score"]
        assert plan is not None
        return plan.combine(sums)

    def moved(self, name: str, value: Array, n: Array) -> Array | float:
        """Return by how much the classes of heights may have moved a moment."""
        if self.classes is None:
            return 0.0
        steps = self.classes.steps
        return value * np.expm1(steps.step) if steps.logarithmic else 0.5 * steps.step * n

    def snap(self, height: Floats) -> Float64s:
        """Return heights as the score sees them: floored, and moved to the middle of a class."""
        lifted = raise_to_floor(self.metric, np.asarray(height, np.float64), self.floor)
        return self.classes.steps.snap(lifted) if self.classes is not None else lifted


def _check_grid(height: Floats, known: Bools, name: str) -> tuple[Float64s, Bools]:
    values, mask = np.asarray(height, np.float64), np.asarray(known)
    if values.ndim != 2 or mask.shape != values.shape or mask.dtype != np.bool_:
        raise InputError(
            f"the {name} must be a (nx, ny) grid of heights and a bool mask of that shape; shapes "
            f"{values.shape} and {mask.shape}, mask of {mask.dtype} came"
        )
    if not np.isfinite(values[mask]).all():
        raise InputError(f"the {name} must have finite heights where it is known")
    return np.where(mask, values, 0.0), mask


def prepare_target(
    metric: Metric | str,
    height_t: Floats,
    known_t: Bools,
    source_shape: tuple[int, int],
    *,
    normalise: str = "overlap",
    floor: float = 0.05,
    height_range: tuple[float, float] | None = None,
    min_cells: int = 1,
    rim: tuple[int, int] = (0, 0),
    tolerance: float = 1e-6,
    classes: int | None = None,
    dtype: type[np.floating[Any]] = np.float32,
    xp: str = "numpy",
    workers: int = 1,
) -> PreparedTarget:
    """Return the target with everything that does not depend on the source computed.

    height_t, known_t: (tx, ty) metres above ground, bool. source_shape: cells of the sources.
    normalise: "overlap", "map" or "off" (metrics.table). floor: see there, metres.
    height_range: metres, holds the heights of both maps; by default those of the target. Metrics
        whose plan expands or quantises heights refuse a source that leaves it.
    min_cells: poses with fewer cells known in both have no score.
    rim: what `find_rim` says of the sources to come; it saves transforms of poses without a score.
    tolerance: of the expansion of a smooth metric, on shares that sum to one.
    classes: steps into which heights are cut, for the metrics that need it.
    dtype: float32 or float64, of the transforms. xp: "numpy" or "cupy".
    """
    row = find_metric(metric) if isinstance(metric, str) else metric
    if row.fft is None:
        raise InputError(f"{row.name} cannot be scored at all poses at once: {row.note}")
    plan = row.fft
    reading = check_normalise(row, normalise)
    raw, known = _check_grid(height_t, known_t, "target")
    if not known.any():
        raise EmptyMapError("the target map has no known cell")
    if min_cells < 1 or min(source_shape) < 1:
        raise InputError(
            f"min_cells and the source's shape must be 1 or more; {min_cells}, {source_shape} came"
        )
    height = raise_to_floor(row, raw, floor)
    low, high = height_range or (float(height[known].min()), float(height[known].max()))
    if row.needs_positive:
        low, high = floor, max(high, floor)
    if not (np.isfinite(low) and np.isfinite(high) and low <= high):
        raise InputError(f"height_range must be two finite heights that rise; {low}, {high} came")

    tx, ty = height.shape
    sx, sy = source_shape
    frame = Frame(
        find_arrays(xp),
        choose_shape((tx, ty), (sx, sy), min_cells, rim),
        (sx, sy),
        (tx + sx - 1, ty + sy - 1),
        dtype,
    )
    terms: dict[str, tuple[Term, ...]] = dict(COUNT)
    unit, offset = float(np.sqrt(floor * max(high, floor))), 0.0
    cut: Classes | None = None
    if isinstance(plan, Moments | Smooth):
        terms.update(plan.terms if isinstance(plan, Moments) else {**A_SUM, **B_SUM})
        if reading == "overlap":
            terms.update({**A_SUM, **B_SUM})
        if isinstance(plan, Moments) and plan.shift_free:
            offset = float(height[known].mean())
    else:
        terms.update({**A_SUM, **B_SUM} if not isinstance(plan, JointHistogram) else {})
        logarithmic = row.needs_positive and not (isinstance(plan, MinSum) and reading == "off")
        edges = (np.log(low), np.log(high)) if logarithmic else (low, high)
        wide = max(float(edges[1] - edges[0]), 1e-6)
        count = classes or (8 if isinstance(plan, JointHistogram) else 32)
        steps = Steps(float(edges[0]), float(edges[0]) + wide, count, logarithmic)
        cut = class_products(frame, steps, height, known, workers)
        if not isinstance(plan, JointHistogram):
            height = steps.snap(height)
    height = np.where(known, height - offset, 0.0)
    moments = moment_products(frame, terms, height, known, unit=unit, workers=workers)
    return PreparedTarget(
        row, reading, floor, (low, high), min_cells, tolerance, frame, height, known, offset,
        float(height[known].sum()), tuple(terms), moments, cut,
    )  # fmt: skip


def _source_heights(
    prepared: PreparedTarget, height_s: Floats, known_s: Bools
) -> tuple[Float64s, Bools]:
    """Return the source floored, quantised, centred and padded, and its mask, padded."""
    raw, known = _check_grid(height_s, known_s, "source")
    sx, sy = prepared.frame.source_shape
    if raw.shape[0] > sx or raw.shape[1] > sy:
        raise InputError(f"the source must fit into {(sx, sy)} cells; {raw.shape} came")
    if not known.any():
        raise EmptyMapError("the source map has no known cell")
    height = raise_to_floor(prepared.metric, raw, prepared.floor)
    plan = prepared.metric.fft
    if not isinstance(plan, Moments | JointHistogram):
        low, high = prepared.height_range
        least, most = float(height[known].min()), float(height[known].max())
        slack = 1e-6 * max(abs(low), abs(high))
        if least < low - slack or most > high + slack:
            raise InputError(
                f"{prepared.metric.name} was prepared for heights of {low:.4g} to {high:.4g} m and "
                f"the source has {least:.4g} to {most:.4g} m; give height_range of both maps"
            )
        height = np.clip(height, low, high)
        if prepared.classes is not None:
            height = prepared.classes.steps.snap(height)
    height = np.where(known, height - prepared.offset, 0.0)
    pad = ((0, sx - raw.shape[0]), (0, sy - raw.shape[1]))
    known = np.pad(known, pad)
    frame = prepared.frame
    for axis in (0, 1):
        told_apart = frame.out_shape[axis] - frame.shape[axis]
        if count_rim(known, axis, prepared.min_cells) < told_apart:
            raise InputError(
                f"the target was prepared for sources with fewer than {prepared.min_cells} known "
                f"cells in the {told_apart} outermost rows; this one has more"
            )
    return np.pad(height, pad), known


def _count(
    prepared: PreparedTarget, seen: Array, rounding: float, known: Bools, turn: bool, workers: int
) -> tuple[Array, Array]:
    """Return the whole number of cells known in both, and which poses count; (Nx, Ny) each."""
    frame = prepared.frame
    if rounding > 0.25:  # large maps: single precision no longer tells whole numbers apart
        exact = replace(frame, dtype=np.float64)
        U = exact.source_spectra(known[None].astype(np.float64), workers)
        V = exact.target_spectra(prepared.known[None].astype(np.float64), workers)
        seen = exact.correlate((U.conj() if turn else U) * V, workers)[0]
    n = frame.arrays.xp.rint(seen)
    for axis in (0, 1):  # shifts of the rim that wrap onto each other
        wrapped = np.arange(max(0, frame.out_shape[axis] - frame.shape[axis]))
        n[(slice(None),) * axis + (frame.rows_of(wrapped, axis, turned=turn),)] = 0.0
    return n, n >= prepared.min_cells


def score_surface(
    prepared: PreparedTarget,
    height_s: Floats,
    known_s: Bools,
    *,
    bound: bool = False,
    workers: int = 1,
) -> Surface:
    """Return the score of every translation of the source, (Sx, Sy), as the module's head says.

    height_s, known_s: (sx, sy) or smaller, metres above ground and bool, already turned.
    bound: also return how far each score may be from the literal formula. workers: threads of
    the transforms; the result is the same to the bit for any number.
    """
    return _score(prepared, height_s, known_s, (False,), bound, workers)[0]


def score_half_turns(
    prepared: PreparedTarget,
    height_s: Floats,
    known_s: Bools,
    *,
    bound: bool = False,
    workers: int = 1,
) -> tuple[Surface, Surface]:
    """Return the surfaces of the source and of the source after half a turn, for less than two.

    The second is that of `height_s[::-1, ::-1]`, after padding to the prepared source shape: half a
    turn only conjugates spectra, so source transforms and products serve both. Scores agree
    with those of `score_surface` within the bound, not to the bit.
    """
    if isinstance(prepared.metric.fft, Moments | Smooth):
        first, second = _score(prepared, height_s, known_s, (False, True), bound, workers)
        return first, second
    (first,) = _score(prepared, height_s, known_s, (False,), bound, workers)
    sx, sy = prepared.frame.source_shape
    pad = ((0, sx - height_s.shape[0]), (0, sy - height_s.shape[1]))
    h, known = np.pad(height_s, pad)[::-1, ::-1], np.pad(known_s, pad)[::-1, ::-1]
    (second,) = _score(prepared, h, known, (False,), bound, workers)
    return first, second


def _score(
    prepared: PreparedTarget,
    height_s: Floats,
    known_s: Bools,
    turns: tuple[bool, ...],
    bound: bool,
    workers: int,
) -> list[Surface]:
    h, known = _source_heights(prepared, height_s, known_s)
    # the moments over the overlap of every pose, (m, Sx, Sy); the first is the number of cells
    moments, rounding = prepared.moments.correlate(h, known, turns=turns, workers=workers)
    poses = []
    for outputs, turn in zip(moments, turns, strict=True):
        n, counted = _count(prepared, outputs[0], float(rounding[0]), known, turn, workers)
        total = float(h[known].sum())
        poses.append(_gather(prepared, outputs, rounding, n, counted, turn, total))
    # the one sum that is not a moment
    specials = find_specials(prepared, h, known, poses, turns, workers)
    return [
        _combine(prepared, some, special, bound)
        for some, special in zip(poses, specials, strict=True)
    ]


def _gather(
    prepared: PreparedTarget,
    outputs: Array,
    rounding: Float64s,
    n: Array,
    counted: Array,
    turn: bool,
    total_s: float,
) -> Poses:
    """Return what the moments say of all poses, in double precision."""
    xp, names = prepared.frame.arrays.xp, prepared.names
    safe = xp.where(counted, n, 1.0).astype(np.float64)
    values = {name: outputs[k].astype(np.float64) for k, name in enumerate(names) if name != "n"}
    errors = {name: float(rounding[k]) for k, name in enumerate(names) if name != "n"}
    if prepared.metric.needs_positive:  # what rounding cannot know where hardly a cell overlaps
        for name in ("a", "b"):
            if name in values:
                values[name] = xp.maximum(values[name], safe * prepared.floor)
    return Poses(safe, n, counted, turn, values, errors, total_s, prepared.total)


def _combine(
    prepared: PreparedTarget, poses: Poses, special: Special | None, bound: bool
) -> Surface:
    """Return the surface of the metric from its sums; NaN where a pose does not count."""
    frame, xp = prepared.frame, prepared.frame.arrays.xp
    n_overlap = frame.place(poses.n_seen.astype(np.int32), 0, turned=poses.turned)

    def score(values: dict[str, Array], push: float = 0.0) -> Array:
        A, B = poses.scales(prepared.normalise, values)
        sums = dict(values)
        if special is not None:
            extra = special.error(A, B, values) if push else 0.0
            sums[special.name] = special.evaluate(A, B) + push * extra
        return prepared.combine(Sums(poses.n, A, B, sums, poses.errors))

    with np.errstate(all="ignore"):
        result = score(poses.values)
        spread = None
        if bound:  # first-order propagation, by trying each sum at both ends of its own error
            trials = []
            for name, error in poses.errors.items():
                value = poses.values[name]
                off = error + prepared.moved(name, value, poses.n)
                trials.append(score({**poses.values, name: value + off}))
                trials.append(score({**poses.values, name: value - off}))
            if special is not None:
                trials += [score(poses.values, 1.0), score(poses.values, -1.0)]
            spread = 1e-12 * (1.0 + np.abs(result))
            for up, down in zip(trials[::2], trials[1::2], strict=True):
                spread = spread + xp.fmax(np.abs(up - result), np.abs(down - result))
            spread = frame.place(
                xp.where(poses.counted, spread, np.nan), np.nan, turned=poses.turned
            )
    whole = frame.place(xp.where(poses.counted, result, np.nan), np.nan, turned=poses.turned)
    return Surface(whole, n_overlap, frame.source_shape, spread)


def score_surfaces(
    prepared: PreparedTarget,
    sources: Iterable[tuple[Floats, Bools]],
    *,
    workers: int = 1,
) -> Iterator[Surface]:
    """Yield the surface of each (height, known) of `sources`, in their order, `workers` at a time.

    One thread a source is the best use of few cores: nothing waits inside a transform.
    """
    if workers == 1:
        for height, known in sources:
            yield score_surface(prepared, height, known)
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[Surface]] = deque()
        for height, known in sources:
            waiting.append(pool.submit(score_surface, prepared, height, known))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
