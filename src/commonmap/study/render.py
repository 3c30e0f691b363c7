"""Three-dimensional pictures of triangles, voxels and points, with depth that a reader can see.

Triangles and voxels are ray cast (Embree) with a sun, its shadows and dark edges; points are drawn
as small squares and shaded by the depth of their neighbours (eye-dome lighting, Boucheny 2009).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from commonmap.types import Float64s

Rgb = NDArray[np.float64]
"""Colours from 0 to 1, last axis red, green, blue."""

BACKGROUND = np.array([1.0, 1.0, 1.0])
SUN = np.array([-0.45, -0.35, 0.82]) / np.linalg.norm([-0.45, -0.35, 0.82])
FINER = 2
"""Each pixel of a picture is the mean of so many squared."""

NO_FAR = 1e30


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera without perspective that looks down on a place: lengths compare anywhere.

    R: (3, 3), rows right, up and towards the eye, in the world. centre: (3,) metres, in the middle
    of the picture. per_metre: pixels. width, height: pixels.
    """

    R: Float64s
    centre: Float64s
    per_metre: float
    width: int
    height: int

    def project(self, xyz: Float64s) -> Float64s:
        """Return (N, 3): pixels from the left, pixels from the top, metres towards the eye."""
        local = (np.asarray(xyz, np.float64) - self.centre) @ self.R.T
        u = 0.5 * self.width + local[:, 0] * self.per_metre
        v = 0.5 * self.height - local[:, 1] * self.per_metre
        return np.column_stack([u, v, local[:, 2]])

    def finer(self, factor: int) -> Camera:
        """Return the same view with so many times the pixels along each side."""
        return Camera(
            self.R, self.centre, self.per_metre * factor, self.width * factor, self.height * factor
        )


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture (height, width, 3) with the camera that made it.

    depth: (height, width) metres towards the eye, as `Camera.project` gives; -inf where nothing is.
    """

    rgb: Rgb
    depth: Float64s
    camera: Camera


def look_at(
    points: Float64s, *, yaw: float, pitch: float, width: int, height: int, margin: float = 0.06
) -> Camera:
    """Return a camera that sees all of (N, 3) points, metres.

    yaw: radians, of the direction in which it looks; pitch: radians below the horizon. margin:
    share of the picture that stays free on each side.
    """
    ahead = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    R = np.stack([right, np.cross(right, ahead), -ahead])
    local = points @ R.T
    least, most = local.min(axis=0), local.max(axis=0)
    span = most - least
    room = 1.0 - 2.0 * margin
    per_metre = min(room * width / span[0], room * height / span[1])
    return Camera(R, np.asarray(0.5 * (least + most) @ R), per_metre, width, height)


def draw_faces(vertices: NDArray[Any], faces: NDArray[Any], colour: Rgb, camera: Camera) -> Picture:
    """Return a picture of triangles. vertices: (V, 3); faces: (F, 3); colour: (F, 3)."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    fine = camera.finer(FINER)
    middle = vertices.mean(axis=0)  # single precision near the origin
    scene: Any = EmbreeScene()
    TriangleMesh(scene, (vertices - middle).astype(np.float32), faces.astype(np.int32))
    reach = float(np.linalg.norm(np.ptp(vertices, axis=0))) + 10.0
    u, v = np.meshgrid(np.arange(fine.width) + 0.5, np.arange(fine.height) + 0.5)
    start = (
        fine.centre - middle
        + ((u.ravel() - 0.5 * fine.width) / fine.per_metre)[:, None] * fine.R[0]
        - ((v.ravel() - 0.5 * fine.height) / fine.per_metre)[:, None] * fine.R[1]
        + reach * fine.R[2]
    )  # fmt: skip
    towards = np.broadcast_to(-fine.R[2], start.shape)
    hit = scene.run(start.astype(np.float32), towards.astype(np.float32), output=True)
    met = hit["geomID"] >= 0
    distance = np.where(met, hit["tfar"], NO_FAR).astype(np.float64)
    normal = np.where(met[:, None], hit["Ng"], [0.0, 0.0, 1.0]).astype(np.float64)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal *= np.sign(np.sum(normal * fine.R[2], axis=1, keepdims=True) + 1e-9)

    # the sun, where nothing stands in its way; the sky from above
    lit = np.maximum(normal @ SUN, 0.0)
    sunny = np.flatnonzero(met & (lit > 0.0))
    at = start[sunny] - distance[sunny, None] * fine.R[2] + 0.02 * normal[sunny]
    rays = np.broadcast_to(SUN, at.shape)
    shadow = scene.run(at.astype(np.float32), rays.astype(np.float32), output=True)
    lit[sunny[shadow["geomID"] >= 0]] = 0.0
    light = 0.46 + 0.14 * normal[:, 2] + 0.48 * lit
    rgb = colour[np.where(met, hit["primID"], 0)] * light[:, None]
    rgb[~met] = BACKGROUND
    shape = (fine.height, fine.width)
    rgb = rgb.reshape(*shape, 3) * _edges(distance.reshape(shape), 0.6)[..., None]
    towards_eye = np.where(met, reach - distance, -np.inf)  # of the plane through the centre
    return _picture(np.clip(rgb, 0.0, 1.0), towards_eye.reshape(shape), camera)


def draw_voxels(centres: Float64s, size: Float64s, colour: Rgb, camera: Camera) -> Picture:
    """Return a picture of cubes. centres: (N, 3); size: (N,) metres; colour: (N, 3)."""
    corner = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)]) - 0.5
    sides = np.array(
        [
            [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7],
            [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
        ]
    )  # fmt: skip
    vertices = centres[:, None] + 0.96 * size[:, None, None] * corner
    faces = (8 * np.arange(len(centres)))[:, None, None] + sides
    return draw_faces(
        vertices.reshape(-1, 3), faces.reshape(-1, 3), np.repeat(colour, len(sides), axis=0), camera
    )


def draw_points(xyz: Float64s, colour: Rgb, camera: Camera, *, pixels: int = 3) -> Picture:
    """Return a picture of points as squares, the nearest on top. colour: (N, 3).

    pixels: edge of a square in fine pixels.
    """
    fine = camera.finer(FINER)
    uvz = fine.project(xyz)
    order = np.argsort(uvz[:, 2], kind="stable")  # far ones first
    u, v = (np.floor(uvz[order, k]).astype(np.int64) for k in (0, 1))
    depth = np.full((fine.height, fine.width), NO_FAR)
    rgb = np.broadcast_to(BACKGROUND, (*depth.shape, 3)).copy()
    rank = np.full(depth.shape, -1, np.int64)
    number = np.arange(len(order))
    half = pixels // 2
    for du in range(-half, pixels - half):
        for dv in range(-half, pixels - half):
            x, y = u + du, v + dv
            inside = (x >= 0) & (x < fine.width) & (y >= 0) & (y < fine.height)
            np.maximum.at(rank, (y[inside], x[inside]), number[inside])
    seen = rank >= 0
    chosen = order[rank[seen]]
    rgb[seen], depth[seen] = colour[chosen], -uvz[chosen, 2]
    shade = _domed(depth, seen)
    return _picture(rgb * shade[..., None], np.where(seen, -depth, -np.inf), camera)


def _domed(depth: Float64s, seen: NDArray[np.bool_]) -> Float64s:
    """Return 0 to 1: how far each pixel stands back behind those round it."""
    darkness = np.zeros(depth.shape)
    for reach in (2, 5):
        for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
            beside = np.roll(depth, (reach * dv, reach * du), axis=(0, 1))
            behind = np.where(beside < NO_FAR, np.clip(depth - beside, 0.0, 3.0), 0.0)
            darkness += behind / reach
    return np.where(seen, np.exp(-0.075 * darkness), 1.0)


def _edges(distance: Float64s, step: float) -> Float64s:
    """Return 0 to 1, dark where the depth bends by more than `step` metres within two pixels."""
    known = np.where(distance < NO_FAR, distance, distance[distance < NO_FAR].max(initial=0.0))
    bend = np.abs(ndimage.laplace(known))
    return np.asarray(1.0 - 0.45 * np.clip(bend / step - 1.0, 0.0, 1.0))


def _picture(rgb: Rgb, depth: Float64s, camera: Camera) -> Picture:
    """Return the picture with its fine pixels merged; the nearest of them tells the depth."""
    shape = (camera.height, FINER, camera.width, FINER)
    nearest = np.where(depth < -0.5 * NO_FAR, -np.inf, depth).reshape(shape).max(axis=(1, 3))
    return Picture(rgb.reshape(*shape, 3).mean(axis=(1, 3)), nearest, camera)
