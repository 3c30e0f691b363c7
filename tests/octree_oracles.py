"""Slow twins of the octree, written from OctoMap's description in plain Python, and test scans."""

from __future__ import annotations

import itertools
import math

import numpy as np

from commonmap.types import Float32s, Float64s, Leaves

Key = tuple[int, int, int]
f32 = np.float32


def turned_points(start: tuple[float, float, float], n: int, step: float) -> Float32s:
    """Return the n * n points of OctoMap's tests: turned by yaw in each step, by pitch each row."""
    x, y, z = (float(f32(v)) for v in start)
    c, s = math.cos(step), math.sin(step)
    out = np.empty((n * n, 3))
    for i in range(n):
        for j in range(n):
            out[i * n + j] = x, y, z
            x, y = float(f32(x * c - y * s)), float(f32(x * s + y * c))
        x, z = float(f32(z * s + x * c)), float(f32(z * c - x * s))
    return out.astype(np.float32)


def ray_keys(origin: Float32s, end: Float32s, resolution: float) -> list[Key]:
    """Return the keys of the voxels before the end of a ray: OctoMap's `computeRayKeys`."""
    factor = 1.0 / resolution
    key = [math.floor(factor * float(v)) + 32768 for v in origin]
    last = [math.floor(factor * float(v)) + 32768 for v in end]
    if key == last:
        return []
    keys = [(key[0], key[1], key[2])]
    d = end - origin
    length = f32(math.sqrt(float(f32(f32(d[0] * d[0] + d[1] * d[1]) + d[2] * d[2]))))
    if length == 0:
        length = f32(1)
    t, dt, step = [math.inf] * 3, [math.inf] * 3, [0] * 3
    for a in range(3):
        direction = f32(d[a] / length)
        if direction != 0:
            step[a] = 1 if direction > 0 else -1
            border = (key[a] - 32768 + 0.5) * resolution + float(f32(step[a] * resolution * 0.5))
            t[a] = (border - float(origin[a])) / float(direction)
            dt[a] = resolution / abs(float(direction))
    while True:
        a = (0 if t[0] < t[2] else 2) if t[0] < t[1] else (1 if t[1] < t[2] else 2)
        key[a] += step[a]
        t[a] += dt[a]
        if key == last or min(t) > float(length):
            return keys
        keys.append((key[0], key[1], key[2]))


class DictOctree:
    """Voxels in a dictionary, scans inserted as `insertPointCloud` says. Slow."""

    def __init__(self, resolution: float) -> None:
        self.resolution = resolution
        self.hit, self.miss, self.low, self.high = (
            f32(math.log(p / (1 - p))) for p in (0.7, 0.4, 0.1192, 0.971)
        )
        self.voxels: dict[Key, np.float32] = {}

    def insert(self, origin: Float32s, points: Float32s, max_range: float = -1.0) -> None:
        free: set[Key] = set()
        occupied: set[Key] = set()
        for p in points:
            d = p - origin
            norm = math.sqrt(float(f32(f32(d[0] * d[0] + d[1] * d[1]) + d[2] * d[2])))
            end = p
            if max_range >= 0 and norm > max_range:
                end = (origin + (d / f32(norm)) * f32(max_range)).astype(np.float32)
            else:
                k = [math.floor(1.0 / self.resolution * float(v)) + 32768 for v in end]
                occupied.add((k[0], k[1], k[2]))
            free.update(ray_keys(origin, end, self.resolution))
        for key in free - occupied:
            self._add(key, self.miss)
        for key in occupied:
            self._add(key, self.hit)

    def _add(self, key: Key, change: np.float32) -> None:
        value = f32(self.voxels.get(key, f32(0)) + change)
        self.voxels[key] = min(max(value, self.low), self.high)


def voxels_of(leaves: Leaves) -> dict[Key, np.float32]:
    """Return every finest voxel of (small) leaves with its log-odds."""
    voxels: dict[Key, np.float32] = {}
    for key, depth, value in zip(leaves.keys, leaves.depth, leaves.log_odds, strict=True):
        edge = 1 << (16 - int(depth))
        for dx, dy, dz in itertools.product(range(edge), repeat=3):
            voxels[(int(key[0]) + dx, int(key[1]) + dy, int(key[2]) + dz)] = value
    return voxels


def leaves_at(keys: list[Key], values: list[float], resolution: float = 0.1) -> Leaves:
    """Return finest leaves at the given keys."""
    return Leaves(
        resolution,
        np.array(keys, np.uint16).reshape(-1, 3),
        np.full(len(keys), 16, np.uint8),
        np.array(values, np.float32),
    )


def room_scan(origin: Float64s, rng: np.random.Generator, n_per_ring: int = 300) -> Float32s:
    """Return a 16-ring scan of flat ground and four walls 6 to 12 m away; some returns far off."""
    azimuth = np.tile(np.arange(n_per_ring) * (2 * np.pi / n_per_ring), 16)
    elevation = np.repeat(np.deg2rad(np.linspace(-15, 15, 16)), n_per_ring)
    d = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    reach = np.full(len(d), 40.0)
    with np.errstate(divide="ignore"):
        for axis, wall in ((0, 9.0), (0, -7.0), (1, 6.0), (1, -12.0), (2, 0.0)):
            t = (wall - origin[axis]) / d[:, axis]
            reach = np.where((t > 0) & (t < reach), t, reach)
    reach = reach + rng.normal(0, 0.02, len(d))
    reach[rng.random(len(d)) < 0.02] = 60.0
    points: Float64s = origin + d * reach[:, None]
    return points.astype(np.float32)
