"""Scans of a simulated world: every laser fired from where the moving sensor is at that moment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from commonmap.errors import InputError
from commonmap.sim.mesh import MATERIALS, REFLECTIVITY
from commonmap.sim.vlp16 import LidarModel
from commonmap.sim.world import World
from commonmap.types import Float32s, Float64s, Scan, Trajectory

BATCH_RAYS = 1_500_000
"""Rays cast in one call; bounds the memory to about 150 MB."""


class RayCaster:
    """A world made ready for ray casting (an Embree scene and what its faces are made of)."""

    def __init__(self, world: World):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene: Any = EmbreeScene()
        self._mesh: Any = TriangleMesh(self._scene, world.vertices, world.faces)
        table = np.array([REFLECTIVITY[name] for name in MATERIALS], dtype=np.float32)
        self.reflectivity: Float32s = table[world.face_material]

    def cast(
        self, origins: Float32s, directions: Float32s
    ) -> tuple[Float32s, NDArray[np.int32], Float32s]:
        """Return distance (inf where nothing is met), face (-1) and |cosine of incidence|, (N,).

        origins, directions: (N, 3) float32, world frame, directions of unit length.
        """
        hit = self._scene.run(origins, directions, output=True)
        face = np.where(hit["geomID"] >= 0, hit["primID"], np.int32(-1)).astype(np.int32)
        distance = np.where(face >= 0, hit["tfar"], np.float32(np.inf)).astype(np.float32)
        normal = hit["Ng"]
        length = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        cosine = np.abs(np.einsum("ij,ij->i", normal, directions))
        return distance, face, (cosine / np.maximum(length, 1e-12)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of many turns in one stretch of arrays.

    xyz: (N, 3) float32, sensor frame of each firing. time: (N,) seconds. ring: (N,) uint16.
    intensity: (N,) float32, 0 to 255. turn: (N,) int32, rising.
    face: (N,) int32, the face of the world that was hit (truth, which no sensor tells).
    """

    xyz: Float32s
    time: Float64s
    ring: NDArray[np.uint16]
    intensity: Float32s
    turn: NDArray[np.int32]
    face: NDArray[np.int32]


def scan_world(
    caster: RayCaster,
    trajectory: Trajectory,
    lidar: LidarModel,
    stamps: Float64s,
    *,
    rng: np.random.Generator,
    azimuth_decimation: int = 1,
) -> Returns:
    """Return what a lidar on a trajectory measures in the turns that begin at `stamps`.

    trajectory: true poses of the sensor in the world; the turns must lie within its time.
    azimuth_decimation: only every so many firing sequences are fired (for speed); the phase
        changes from turn to turn, so that no direction is left out.
    """
    if azimuth_decimation < 1:
        raise InputError(f"azimuth_decimation must be 1 or more; {azimuth_decimation} came")
    per_turn = -(-lidar.sequences_per_turn // azimuth_decimation) * lidar.n_channels
    batch = max(1, BATCH_RAYS // per_turn)
    parts = []
    for start in range(0, len(stamps), batch):
        parts.append(
            _scan_batch(
                caster, trajectory, lidar, stamps[start : start + batch], start, rng,
                azimuth_decimation,
            )
        )  # fmt: skip
    if not parts:
        raise InputError("stamps must hold at least one turn; none came")
    return Returns(
        np.concatenate([part.xyz for part in parts]),
        np.concatenate([part.time for part in parts]),
        np.concatenate([part.ring for part in parts]),
        np.concatenate([part.intensity for part in parts]),
        np.concatenate([part.turn for part in parts]),
        np.concatenate([part.face for part in parts]),
    )


def split_scans(returns: Returns, stamps: Float64s) -> Iterator[Scan]:
    """Yield the turns one by one, as a driver would deliver them."""
    edges = np.searchsorted(returns.turn, np.arange(len(stamps) + 1))
    for i, stamp in enumerate(stamps):
        part = slice(edges[i], edges[i + 1])
        yield Scan(
            returns.xyz[part], returns.time[part], returns.ring[part], returns.intensity[part],
            float(stamp),
        )  # fmt: skip


def turn_stamps(trajectory: Trajectory, lidar: LidarModel) -> Float64s:
    """Return the start of every whole turn within a trajectory, seconds, (T,)."""
    first, last = trajectory.time[0], trajectory.time[-1]
    n = int(np.floor((last - first) * lidar.rate - 1e-6))
    if n < 1:
        raise InputError(f"a trajectory must last at least one turn; {last - first:g} s came")
    stamps: Float64s = first + np.arange(n) / lidar.rate
    return stamps


def firing_pattern(
    lidar: LidarModel, *, first: int = 0, every: int = 1
) -> tuple[Float64s, Float64s, NDArray[np.intp]]:
    """Return time after the start of the turn (R,), unit direction (R, 3) and laser (R,) of the
    firings of one turn, in the order of firing.

    The head turns clockwise seen from above: the azimuth from x towards y falls with time.
    """
    sequence = np.arange(first, lidar.sequences_per_turn, every)
    time = (sequence[:, None] * lidar.sequence_period + lidar.fire_time).ravel()
    laser = np.tile(np.arange(lidar.n_channels), len(sequence))
    azimuth = -2 * np.pi * lidar.rate * time + lidar.azimuth_offset[laser]
    flat = np.cos(lidar.elevation[laser])
    direction = np.column_stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(lidar.elevation[laser])]
    )
    return time, direction, laser


def _scan_batch(
    caster: RayCaster, trajectory: Trajectory, lidar: LidarModel, stamps: Float64s, turn: int,
    rng: np.random.Generator, every: int,
) -> Returns:  # fmt: skip
    """Return the returns of a few turns, the first of which has number `turn`."""
    pattern = [firing_pattern(lidar, first=(turn + i) % every, every=every) for i in range(every)]
    which = np.arange(len(stamps)) % every
    time = np.concatenate([s + pattern[k][0] for s, k in zip(stamps, which, strict=True)])
    direction = np.concatenate([pattern[k][1] for k in which])
    laser = np.concatenate([pattern[k][2] for k in which])
    number = np.repeat(
        np.arange(turn, turn + len(stamps), dtype=np.int32), [len(pattern[k][0]) for k in which]
    )
    local = np.zeros_like(direction)
    local[:, 2] = lidar.height_offset[laser]
    origin_world, direction_world = _move_rays(trajectory, time, local, direction)
    distance, face, cosine = caster.cast(origin_world, direction_world)

    hit = np.flatnonzero(face >= 0)
    distance, face, cosine = distance[hit], face[hit], np.maximum(cosine[hit], 1e-3)
    reflectivity = caster.reflectivity[face]
    strength = reflectivity * cosine / np.maximum(distance, 1.0) ** 2
    weakest = 0.1 / lidar.sensitive_range**2
    seen = 1.0 / (1.0 + (weakest / strength) ** 4)
    kept = rng.uniform(size=len(hit)) < seen * (1.0 - lidar.drop_out)
    # a beam that grazes a surface lights up a long spot: its range is less certain
    sigma = lidar.range_sigma * np.minimum(1.0 + 0.1 / cosine, 3.0) / 1.1
    measured = distance + sigma * rng.standard_normal(len(hit))
    measured = np.round(measured / lidar.range_step) * lidar.range_step
    kept &= (measured >= lidar.min_range) & (measured <= lidar.max_range)
    hit, measured = hit[kept], measured[kept]
    xyz = direction[hit] * measured[:, None] + local[hit]
    intensity = np.clip(255.0 * reflectivity[kept] * np.sqrt(cosine[kept]), 0.0, 255.0)
    return Returns(
        xyz.astype(np.float32), time[hit], lidar.ring[laser[hit]],
        np.round(intensity).astype(np.float32), number[hit], face[kept],
    )  # fmt: skip


def _stretch(trajectory: Trajectory, time: Float64s) -> tuple[NDArray[np.intp], Float64s]:
    """Return the pose before each time (N,) and the share of the way to the next (N,)."""
    first, last = trajectory.time[0], trajectory.time[-1]
    if time.min() < first - 1e-9 or time.max() > last + 1e-9:
        raise InputError(
            f"times must lie within the trajectory ({first:.3f} to {last:.3f} s); "
            f"{time.min():.3f} to {time.max():.3f} s came"
        )
    before = np.searchsorted(trajectory.time, time, side="right") - 1
    before = np.clip(before, 0, len(trajectory.time) - 2)
    step = trajectory.time[before + 1] - trajectory.time[before]
    return before, np.clip((time - trajectory.time[before]) / step, 0.0, 1.0)


def _move_rays(
    trajectory: Trajectory, time: Float64s, points: Float64s, directions: Float64s
) -> tuple[Float32s, Float32s]:
    """Return points and directions (N, 3) of the sensor, each at its own time, in the map."""
    before, share = _stretch(trajectory, time)
    t, q = trajectory.T_map_sensor[:, :3, 3], _quaternions(trajectory)
    return _move_rays_kernel(before, share, np.ascontiguousarray(t), q, points, directions)


def place_points(trajectory: Trajectory, time: Float64s, xyz: NDArray[Any]) -> Float64s:
    """Return (N, 3) points of the sensor frame, each measured at its own time, in the map.

    This is deskewing and georeferencing in one step; poses are interpolated linearly in position
    and along the shortest arc in rotation.
    """
    before, share = _stretch(trajectory, time)
    t, q = trajectory.T_map_sensor[:, :3, 3], _quaternions(trajectory)
    points = np.ascontiguousarray(xyz, dtype=np.float64)
    return _place_points_kernel(before, share, np.ascontiguousarray(t), q, points)


def sensor_positions(trajectory: Trajectory, time: Float64s) -> Float64s:
    """Return where the sensor was at each time, (N, 3), map frame."""
    columns = [np.interp(time, trajectory.time, trajectory.T_map_sensor[:, k, 3]) for k in range(3)]
    return np.stack(columns, axis=1)


def _quaternions(trajectory: Trajectory) -> Float64s:
    """Return the quaternions xyzw (M, 4), each on the side of the one before it."""
    q: Float64s = Rotation.from_matrix(trajectory.T_map_sensor[:, :3, :3]).as_quat()
    flips = np.where(np.einsum("ij,ij->i", q[1:], q[:-1]) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(flips)[:, None]
    return q


@njit(cache=True)  # type: ignore[untyped-decorator]
def _rotation(qa: Float64s, qb: Float64s, w: float, R: Float64s) -> None:
    """Fill R (3, 3) with the rotation a share `w` of the way from qa to qb (slerp)."""
    cosine = qa[0] * qb[0] + qa[1] * qb[1] + qa[2] * qb[2] + qa[3] * qb[3]
    if cosine > 0.999999:
        a, b = 1.0 - w, w
    else:
        angle = np.arccos(cosine)
        sine = np.sin(angle)
        a, b = np.sin((1.0 - w) * angle) / sine, np.sin(w * angle) / sine
    x, y = a * qa[0] + b * qb[0], a * qa[1] + b * qb[1]
    z, s = a * qa[2] + b * qb[2], a * qa[3] + b * qb[3]
    n = 1.0 / np.sqrt(x * x + y * y + z * z + s * s)
    x, y, z, s = x * n, y * n, z * n, s * n
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * s), 2 * (x * z + y * s)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + z * s), 1 - 2 * (x * x + z * z), 2 * (y * z - x * s)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - y * s), 2 * (y * z + x * s), 1 - 2 * (x * x + y * y)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _move_rays_kernel(
    before: NDArray[np.intp], share: Float64s, t: Float64s, q: Float64s, points: Float64s,
    directions: Float64s,
) -> tuple[Float32s, Float32s]:  # fmt: skip
    n = len(before)
    origin, ray = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    R = np.empty((3, 3))
    for i in range(n):
        k, w = before[i], share[i]
        _rotation(q[k], q[k + 1], w, R)
        for r in range(3):
            o = t[k, r] + w * (t[k + 1, r] - t[k, r])
            d = 0.0
            for c in range(3):
                o += R[r, c] * points[i, c]
                d += R[r, c] * directions[i, c]
            origin[i, r] = o
            ray[i, r] = d
    return origin, ray


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _place_points_kernel(
    before: NDArray[np.intp], share: Float64s, t: Float64s, q: Float64s, points: Float64s
) -> Float64s:
    n = len(before)
    placed = np.empty((n, 3))
    R = np.empty((3, 3))
    for i in range(n):
        k, w = before[i], share[i]
        _rotation(q[k], q[k + 1], w, R)
        for r in range(3):
            value = t[k, r] + w * (t[k + 1, r] - t[k, r])
            for c in range(3):
                value += R[r, c] * points[i, c]
            placed[i, r] = value
    return placed
