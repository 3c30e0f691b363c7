"""Rolling, rough ground: heights on a regular grid, drawn as triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from commonmap.sim.mesh import Mesh, make_mesh
from commonmap.types import Float32s, Float64s


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground heights at the nodes of a grid; between the nodes the ground is two triangles a cell.

    origin: (2,) metres, x and y of node [0, 0]. cell: metres between nodes.
    z: (nx, ny) float32 metres, i along x and j along y.
    """

    origin: Float64s
    cell: float
    z: Float32s

    def height(self, xy: Float64s) -> Float64s:
        """Return the height of the ground under each of (N, 2) points, exactly on the triangles.

        Points beyond the border take the height of the border.
        """
        points = np.ascontiguousarray(xy, dtype=np.float64)
        return _height_kernel(points, self.origin, self.cell, self.z)

    def mesh(self, material: str) -> Mesh:
        """Return the ground as triangles, split along the diagonal of rising x and y."""
        nx, ny = self.z.shape
        i, j = np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij")
        x, y = self.origin[0] + i * self.cell, self.origin[1] + j * self.cell
        node = (i * ny + j)[:-1, :-1]
        lower = np.stack([node, node + ny, node + ny + 1], axis=-1)
        upper = np.stack([node, node + ny + 1, node + 1], axis=-1)
        faces = np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)])
        return make_mesh(np.stack([x, y, self.z], axis=-1), faces, material)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _height_kernel(xy: Float64s, origin: Float64s, cell: float, z: Float32s) -> Float64s:
    nx, ny = z.shape
    height = np.empty(len(xy))
    for k in range(len(xy)):
        u = min(max((xy[k, 0] - origin[0]) / cell, 0.0), nx - 1.000001)
        v = min(max((xy[k, 1] - origin[1]) / cell, 0.0), ny - 1.000001)
        i, j = int(u), int(v)
        u, v = u - i, v - j
        z00, z11 = float(z[i, j]), float(z[i + 1, j + 1])
        if u >= v:
            z10 = float(z[i + 1, j])
            height[k] = z00 + u * (z10 - z00) + v * (z11 - z10)
        else:
            z01 = float(z[i, j + 1])
            height[k] = z00 + v * (z01 - z00) + u * (z11 - z01)
    return height


def roll_terrain(
    rng: np.random.Generator,
    *,
    size: float,
    relief: float,
    wavelength: tuple[float, float] = (18.0, 90.0),
    slope: float = 0.0,
    roughness: float = 0.015,
    cell: float = 0.5,
    margin: float = 5.0,
) -> Terrain:
    """Return ground that rolls by about `relief` metres (standard deviation) over a square.

    size: metres; the ground covers `[-size/2, size/2]` in x and y and `margin` more on each side.
    wavelength: metres, shortest and longest roll; longer rolls are higher.
    slope: radians, of a plane added in a random direction.
    roughness: metres, standard deviation of each node by itself.
    """
    n = int(np.ceil((size + 2 * margin) / cell)) + 1
    axis = -size / 2 - margin + cell * np.arange(n)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    n_waves = 24
    length = np.exp(rng.uniform(np.log(wavelength[0]), np.log(wavelength[1]), n_waves))
    heading, phase = rng.uniform(0.0, 2 * np.pi, (2, n_waves))
    z = np.zeros_like(x)
    for a, direction, shift in zip(length, heading, phase, strict=True):
        wave = (x * np.cos(direction) + y * np.sin(direction)) * (2 * np.pi / a) + shift
        z += a * np.sin(wave)
    z *= relief / np.sqrt(0.5 * np.sum(length**2))
    tilt = rng.uniform(0.0, 2 * np.pi)
    z += np.tan(slope) * (x * np.cos(tilt) + y * np.sin(tilt))
    z += roughness * rng.standard_normal(z.shape)
    return Terrain(np.array([axis[0], axis[0]]), cell, z.astype(np.float32))


def winding_line(rng: np.random.Generator, size: float) -> Float64s:
    """Return a winding line across a place, one point about every metre, (N, 2)."""
    yaw = rng.uniform(0.0, 2 * np.pi)
    along = np.arange(-0.75 * size, 0.75 * size, 1.0)
    bend = rng.uniform(4.0, 10.0) * np.sin(
        along * 2 * np.pi / rng.uniform(60, 140) + rng.uniform(0, 6.28)
    )
    across = bend + rng.uniform(-0.12, 0.12) * size
    c, s = np.cos(yaw), np.sin(yaw)
    line = np.column_stack([c * along - s * across, s * along + c * across])
    kept: Float64s = line[np.abs(line).max(axis=1) < size / 2]
    return kept
