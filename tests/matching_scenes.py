"""Small places for the tests of mapping and matching, made of points only (no simulator).

A place is a list of boxes and posts on ground that is given by a formula. `look` samples its
surfaces afresh, so two looks at one place share no point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from commonmap.types import Float64s, Floats


@dataclass(frozen=True, eq=False)
class Place:
    """boxes: (B, 6) x, y, length, width, height, yaw. posts: (P, 4) x, y, radius, height.

    relief: metres, amplitude of the ground's waves. size: metres, edge of the square place.
    """

    boxes: Float64s
    posts: Float64s
    relief: float
    size: float


def make_place(
    seed: int, size: float = 40.0, *, n_boxes: int = 7, n_posts: int = 14, relief: float = 0.5
) -> Place:
    """Return a random place centred on the origin."""
    rng = np.random.default_rng(seed)
    half = 0.5 * size - 2.0
    boxes = np.column_stack(
        [
            rng.uniform(-half, half, (n_boxes, 2)),
            rng.uniform(2.0, 7.0, (n_boxes, 2)),
            rng.uniform(1.5, 5.0, n_boxes),
            rng.uniform(0.0, math.pi, n_boxes),
        ]
    )
    posts = np.column_stack(
        [
            rng.uniform(-half, half, (n_posts, 2)),
            rng.uniform(0.1, 0.4, n_posts),
            rng.uniform(2.0, 6.0, n_posts),
        ]
    )
    return Place(boxes, posts, relief, size)


def ground_z(place: Place, xy: Float64s) -> Float64s:
    """Return the z of the place's ground."""
    x, y = xy[:, 0] / place.size, xy[:, 1] / place.size
    return np.asarray(place.relief * (np.sin(5.0 * x + 0.3) + np.cos(4.0 * y)))


def look(
    place: Place,
    rng: np.random.Generator,
    *,
    roofs: bool = True,
    density: float = 25.0,
    noise: float = 0.02,
    centre: tuple[float, float] = (0.0, 0.0),
    edge: float | None = None,
) -> Float64s:
    """Return points (N, 3) of the surfaces inside a square of that edge about `centre`."""
    parts = [_ground_points(place, rng, density)]
    parts += [_box_points(place, box, rng, density, roofs) for box in place.boxes]
    parts += [_post_points(place, post, rng, density) for post in place.posts]
    xyz = np.concatenate(parts) + rng.normal(0.0, noise, (sum(map(len, parts)), 3))
    if edge is not None:
        xyz = xyz[(np.abs(xyz[:, :2] - np.array(centre)) < 0.5 * edge).all(axis=1)]
    return np.asarray(xyz)


def _ground_points(place: Place, rng: np.random.Generator, density: float) -> Float64s:
    half = 0.5 * place.size
    xy = rng.uniform(-half, half, (int(place.size**2 * density * 0.5), 2))
    free = np.ones(len(xy), dtype=bool)
    for x, y, length, width, _, yaw in place.boxes:
        c, s = math.cos(yaw), math.sin(yaw)
        u = c * (xy[:, 0] - x) + s * (xy[:, 1] - y)
        v = -s * (xy[:, 0] - x) + c * (xy[:, 1] - y)
        free &= (np.abs(u) > 0.5 * length) | (np.abs(v) > 0.5 * width)
    xy = xy[free]
    return np.column_stack([xy, ground_z(place, xy)])


def _box_points(
    place: Place, box: Float64s, rng: np.random.Generator, density: float, roof: bool
) -> Float64s:
    x, y, length, width, height, yaw = box
    n = int(2.0 * (length + width) * height * density)
    along = rng.uniform(0.0, 2.0 * (length + width), n)
    z = rng.uniform(0.0, height, n)
    u = np.select(
        [along < length, along < length + width, along < 2 * length + width],
        [along - 0.5 * length, 0.5 * length, 1.5 * length + width - along],
        -0.5 * length,
    )
    v = np.select(
        [along < length, along < length + width, along < 2 * length + width],
        [-0.5 * width, along - length - 0.5 * width, 0.5 * width],
        2.0 * length + 1.5 * width - along,
    )
    if roof:
        m = int(length * width * density)
        u = np.append(u, rng.uniform(-0.5 * length, 0.5 * length, m))
        v = np.append(v, rng.uniform(-0.5 * width, 0.5 * width, m))
        z = np.append(z, np.full(m, height))
    c, s = math.cos(yaw), math.sin(yaw)
    base = ground_z(place, np.array([[x, y]]))[0]
    return np.column_stack([x + c * u - s * v, y + s * u + c * v, base + z])


def _post_points(
    place: Place, post: Float64s, rng: np.random.Generator, density: float
) -> Float64s:
    x, y, radius, height = post
    n = int(max(6.0 * radius, 1.5) * height * density)
    turn = rng.uniform(0.0, 2.0 * math.pi, n)
    base = ground_z(place, np.array([[x, y]]))[0]
    return np.column_stack(
        [
            x + radius * np.cos(turn),
            y + radius * np.sin(turn),
            base + rng.uniform(0.0, height, n),
        ]
    )


def rigid(x: float, y: float, z: float, yaw: float) -> Float64s:
    """Return the motion that turns by yaw about z and then shifts, written out by hand."""
    T = np.eye(4)
    T[0, 0], T[0, 1] = math.cos(yaw), -math.sin(yaw)
    T[1, 0], T[1, 1] = math.sin(yaw), math.cos(yaw)
    T[:3, 3] = x, y, z
    return T


def moved(T: Floats, xyz: Floats) -> Float64s:
    """Return T applied to every point, one coordinate after the other."""
    h = np.column_stack([xyz, np.ones(len(xyz))])
    return np.column_stack([h @ T[0], h @ T[1], h @ T[2]])


def apart(T_a: Floats, T_b: Floats, xyz: Floats) -> tuple[float, float]:
    """Return (metres, degrees): the largest distance over the points, and the turn between."""
    distance = np.linalg.norm(moved(T_a, xyz) - moved(T_b, xyz), axis=1).max()
    trace = float(np.trace(T_a[:3, :3].T @ T_b[:3, :3]))
    return float(distance), math.degrees(math.acos(min(1.0, max(-1.0, 0.5 * (trace - 1.0)))))
