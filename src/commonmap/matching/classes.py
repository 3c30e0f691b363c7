"""Heights cut into classes, and the sums over pairs of classes at every pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from commonmap.matching.arrays import Array
from commonmap.matching.roads import Frame, norm
from commonmap.types import Bools, Float64s


@dataclass(frozen=True, eq=False)
class Steps:
    """Heights cut into `count` equal steps of `low .. high`, of h or of ln h."""

    low: float
    high: float
    count: int
    logarithmic: bool

    @property
    def step(self) -> float:
        """The width of a step, in metres or of ln h."""
        return (self.high - self.low) / self.count

    def index(self, h: Float64s) -> Float64s:
        """Return the class of each height, 0 .. count - 1."""
        x = np.log(h) if self.logarithmic else h
        return np.clip(np.floor((x - self.low) / self.step), 0, self.count - 1)

    def snap(self, h: Float64s) -> Float64s:
        """Return each height moved to the middle of its class."""
        middle = self.low + (self.index(h) + 0.5) * self.step
        return np.exp(middle) if self.logarithmic else middle


@dataclass(frozen=True, eq=False)
class Classes:
    """The layers of each class: one where a cell is of that class, else zero."""

    frame: Frame
    steps: Steps
    spectra: Array
    target_norm: Float64s

    def source(
        self, h: Float64s, known: Bools, workers: int, *, weighted: bool = False
    ) -> tuple[Array, Float64s]:
        """Return the spectra and the norms of the source's classes, times the heights if asked."""
        layers = class_layers(self.steps, h, known)
        if weighted:
            layers = layers * np.where(known, self.steps.snap(np.where(known, h, 1.0)), 0.0)
        return self.frame.source_spectra(layers, workers), norm(layers)

    def difference(
        self,
        U: Array,
        weigh: Callable[[Float64s], Float64s],
        shift: int,
        workers: int,
    ) -> Array:
        """Return `sum_ij weigh((j - i + shift) step) U_i V_j` at every pose, (Sx, Sy)."""
        xp, count = self.frame.arrays.xp, self.steps.count
        j = np.arange(count, dtype=np.float64)
        total = xp.zeros(U.shape[1:], U.dtype)
        table = weigh((j[None, :] - j[:, None] + shift) * self.steps.step)
        factor = xp.asarray(table.astype(self.frame.dtype))
        flat = self.spectra.reshape(count, -1)
        block = 16384
        out, u = total.reshape(-1), U.reshape(count, -1)
        for start in range(0, flat.shape[1], block):
            part = slice(start, start + block)
            out[part] = (u[:, part] * (factor @ flat[:, part])).sum(axis=0)
        return self.frame.correlate(total[None], workers)[0]


def class_layers(steps: Steps, h: Float64s, known: Bools) -> Float64s:
    """Return the (count, nx, ny) layers, one where a known cell is of the class."""
    index = np.where(known, steps.index(np.where(known, h, 1.0)), -1.0)
    return np.asarray(
        index[None] == np.arange(steps.count, dtype=np.float64)[:, None, None], np.float64
    )


def class_products(
    frame: Frame, steps: Steps, height_t: Float64s, known_t: Bools, workers: int
) -> Classes:
    """Return the target's half of the class layers."""
    layers = class_layers(steps, height_t, known_t)
    return Classes(frame, steps, frame.target_spectra(layers, workers), norm(layers))


def mutual_information(
    classes: Classes, h: Float64s, known: Bools, known_t: Array, n: Array, workers: int
) -> Array:
    """Return the mutual information at every pose from the joint counts, which are whole numbers.

    known_t: the spectrum of the target's mask. Counts of the last row and column follow from
    those of the others and from the masks.
    """
    frame, count = classes.frame, classes.steps.count
    xp = frame.arrays.xp
    U, _ = classes.source(h, known, workers)
    known_s = frame.source_spectra(known[None].astype(np.float64), workers)[0]

    def counted(spectra: Array) -> Array:
        return xp.maximum(xp.rint(frame.correlate(spectra, workers)), 0.0).astype(np.float64)

    def entropy(counts: Array) -> Array:
        return counts * np.log(xp.maximum(counts, 1.0))

    columns = counted(known_s[None] * classes.spectra[:-1])
    last_column = n - columns.sum(axis=0)
    last_row = columns.copy()
    total = -entropy(columns).sum(axis=0) - entropy(last_column)
    rows = xp.zeros_like(total)
    for i in range(count - 1):
        joint = counted(U[i][None] * classes.spectra[:-1])
        row = counted((U[i] * known_t)[None])[0]
        total += entropy(joint).sum(axis=0) + entropy(row - joint.sum(axis=0)) - entropy(row)
        last_row -= joint
        rows += row
    last = n - rows
    total += entropy(last_row).sum(axis=0) + entropy(last - last_row.sum(axis=0)) - entropy(last)
    return xp.maximum(total / xp.maximum(n, 1.0) + np.log(xp.maximum(n, 1.0)), 0.0)
