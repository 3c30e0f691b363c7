"""The counts of `evidence_fft.py` on a device, in whole arrays over slabs' layers and yaws."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from commonmap.matching.arrays import Array, Arrays
from commonmap.matching.slabs import Bits, unpack
from commonmap.metrics.formulas import DOUBT
from commonmap.types import Float32s, Float64s

if TYPE_CHECKING:
    from commonmap.matching.evidence_fft import Spectra


def transform_layers(
    arrays: Arrays, bits: list[tuple[Bits, int]], shape: tuple[int, int], dtype: Any
) -> Array:
    """Return the spectra (n, Nx, Ny // 2 + 1) of slabs (bits, number), padded to `shape`."""
    layers = arrays.xp.stack(
        [unpack(arrays, arrays.xp.asarray(some), slab, dtype) for some, slab in bits]
    )
    return arrays.fft.rfft2(layers, s=shape, axes=(-2, -1))


def score(
    target: Spectra, occupied: Bits, known: Bits, shared: bool, standing: tuple[bool, ...],
    least: int, table: Float64s,
) -> tuple[Float32s, Float32s]:  # fmt: skip
    """Return (score, overlap) of the yaws as `evidence_fft.evidence_surfaces`, on the host."""
    arrays, xp = target.arrays, target.arrays.xp
    region = (slice(None), slice(*target.rows), slice(*target.columns))
    on_device = [
        xp.asarray(np.ascontiguousarray(np.moveaxis(bits, 2, 0)[:, ::-1, ::-1]))
        for bits in (occupied, known)
    ]

    def forward(bits: Array, k: int) -> Array:
        layer = unpack(arrays, bits, k, target.dtype)
        return arrays.fft.rfft2(layer, s=target.fft_shape, axes=(-2, -1))

    def count(spectra: Array, layer: int) -> Array:
        product = spectra * target.layers[layer][None]
        seen = arrays.fft.irfft2(product, s=target.fft_shape, axes=(-2, -1))[region]
        return (seen + 0.5).astype(np.int32)

    shape = (occupied.shape[2], *target.shape)
    total, doubt = xp.zeros(shape, np.float64), xp.zeros(shape, np.float64)
    overlap = xp.zeros(shape, np.int32)
    xlogx = xp.asarray(table)
    for k in range(target.n_slabs):
        if k == 0 or not shared:
            seen = forward(on_device[1], k)
            n = count(seen, target.known_layer(k))
            overlap = xp.maximum(overlap, n)
        if not standing[k]:
            continue  # a source that never varies says nothing
        stands = forward(on_device[0], k)
        r = count(stands, target.known_layer(k))
        doubt += (xlogx[n] - xlogx[r] - xlogx[n - r]) * ((r > 0) & (r < n))
        if target.standing[k]:
            total += _signed_evidence(xp, n, r, count(seen, k), count(stands, k), xlogx)
    total = total * xp.abs(total) / (doubt + DOUBT)
    told = xp.where(overlap >= least, total, -np.inf).astype(np.float32)
    return arrays.to_host(told), arrays.to_host(overlap.astype(np.float32))


def _signed_evidence(xp: Any, n: Array, r: Array, c: Array, n11: Array, xlogx: Array) -> Array:
    """`evidence.signed_evidence` in whole arrays, each sum in the same order: the same bits."""
    n11 = xp.minimum(xp.maximum(xp.maximum(n11, r + c - n), 0), xp.minimum(r, c))
    g = xlogx[n] - xlogx[r] - xlogx[n - r] - xlogx[c] - xlogx[n - c]
    g += xlogx[n11] + xlogx[r - n11] + xlogx[c - n11] + xlogx[n - r - c + n11]
    varies = (r > 0) & (c > 0) & (r < n) & (c < n)
    agrees = n11.astype(np.int64) * n > r.astype(np.int64) * c
    return (2.0 * agrees - 1.0) * g * varies
