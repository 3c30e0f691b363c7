"""LZF decompression (Marc Lehmann's liblzf format), as in `binary_compressed` PCD files.

A control byte c < 32 is followed by c + 1 literal bytes. Otherwise c >> 5 (7: plus the next byte)
plus 2 bytes are copied from ((c & 31) << 8 | next byte) + 1 back; source and result may overlap.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

MAX_RATIO = 88
"""A copy makes at most 264 bytes of three: nothing unpacks to more than this times its size."""


def decompress(packed: Bytes, n_bytes: int) -> Bytes:
    """Return the `n_bytes` that `packed` holds; raise `ValueError` where it holds anything else."""
    if n_bytes > MAX_RATIO * len(packed):
        raise ValueError(f"{len(packed)} compressed bytes cannot hold {n_bytes}")
    unpacked = np.zeros(n_bytes, dtype=np.uint8)
    written = _decompress(np.ascontiguousarray(packed), unpacked)
    if written != n_bytes:
        raise ValueError(f"the compressed bytes are damaged after {abs(written)} of {n_bytes}")
    return unpacked


@numba.njit(cache=True)
def _decompress(packed: Bytes, unpacked: Bytes) -> int:
    """Fill `unpacked`; return the bytes written, negative where the stream is damaged."""
    n_in, n_out = len(packed), len(unpacked)
    i = o = 0
    while i < n_in:
        control = int(packed[i])
        i += 1
        if control < 32:
            run = control + 1
            if i + run > n_in or o + run > n_out:
                return -o
            for k in range(run):
                unpacked[o + k] = packed[i + k]
            i += run
            o += run
            continue
        length = control >> 5
        if length == 7:
            if i >= n_in:
                return -o
            length += int(packed[i])
            i += 1
        if i >= n_in:
            return -o
        start = o - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        length += 2
        if start < 0 or o + length > n_out:
            return -o
        for k in range(length):
            unpacked[o + k] = unpacked[start + k]
        o += length
    return o
