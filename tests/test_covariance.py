"""What the covariance of a refined pose promises, against what many draws of the noise do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from commonmap.frames import from_xyz_yaw
from commonmap.matching.covariance import (
    SMALLEST,
    Pairs,
    Surface,
    measure_covariance,
    pair_points,
)
from commonmap.matching.refine import refine
from commonmap.types import Float64s
from matching_scenes import look, make_place


def sheet(normal: int, rng: np.random.Generator, n: int, noise: float) -> tuple[Float64s, Float64s]:
    """Return points on a square of 10 m across one axis, and their exact normals."""
    xyz = rng.uniform(-5.0, 5.0, (n, 3))
    xyz[:, normal] = rng.normal(0.0, noise, n)
    normals = np.zeros((n, 3))
    normals[:, normal] = 1.0
    return xyz, normals


def corner(rng: np.random.Generator, noise: float, n: int = 4_000) -> tuple[Float64s, Float64s]:
    sheets = [sheet(axis, rng, n, noise) for axis in range(3)]
    shift = 30.0 * np.eye(3)  # far apart: a point never meets another sheet
    return (
        np.concatenate([xyz + shift[axis] for axis, (xyz, _) in enumerate(sheets)]),
        np.concatenate([normals for _, normals in sheets]),
    )


def test_three_sheets_of_known_noise_by_hand() -> None:
    # exact target, source noise of 3 cm, one sheet across each axis: the variance along an axis
    # is close to noise^2 / n, by the sandwich 1.2 times that for Cauchy weights (c = 2 sigma)
    rng = np.random.default_rng(3)
    points, normals = corner(rng, 0.0, n=20_000)
    source, _ = corner(rng, 0.03)
    surface = Surface(points, normals, cKDTree(points))
    pairs = pair_points(surface, source, np.eye(4), reach=1.0)
    assert pairs is not None and len(pairs.r) > 11_900
    covariance = measure_covariance(surface, source, np.eye(4), pairs, reach=1.0, spacing=0.1)
    for axis in range(3):
        # the turning of the sheets lets each slide a little: at least the plain value
        assert 0.5 * 0.03**2 / 4_000 < covariance[axis, axis] - SMALLEST[axis, axis] < 1e-4


def test_residuals_and_weights_by_hand() -> None:
    surface = Surface(*sheet(2, np.random.default_rng(0), 400, 0.0), tree=None)
    surface = Surface(surface.points, surface.normals, cKDTree(surface.points))
    source = surface.points[:50] + np.array([0.0, 0.0, 0.25])
    pairs = pair_points(surface, source, np.eye(4), reach=1.0, scale=0.125)
    assert pairs is not None
    assert pairs.r == pytest.approx(np.full(50, 0.25))
    assert pairs.w == pytest.approx(np.full(50, 0.5))  # 1 / (1 + (0.25 / 0.25)^2)
    assert pairs.pulls()[:, 2] == pytest.approx(np.full(50, 0.125))
    assert pairs.curvature()[2, 2] == pytest.approx(0.0)  # the pull is largest at twice the scale
    assert pair_points(surface, source[:19], np.eye(4), reach=1.0) is None
    assert pair_points(surface, source, np.eye(4), reach=0.1) is None


def test_a_surface_seen_from_elsewhere_is_the_surface_moved_there() -> None:
    rng = np.random.default_rng(4)
    points, normals = corner(rng, 0.0)
    origin = np.array([7.0, -3.0, 2.0])
    source = points[::5] - origin + rng.normal(0.0, 0.1, points[::5].shape)
    here = Surface(points - origin, normals, cKDTree(points - origin))
    seen = Surface(points, normals, cKDTree(points)).about(origin)
    T = from_xyz_yaw(0.1, 0.05, -0.1, 0.01)
    one, other = (pair_points(surface, source, T, reach=1.0) for surface in (here, seen))
    assert one is not None and other is not None
    for name in ("p", "J", "w", "r"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), abs=1e-9)


def test_a_floor_of_noisy_normals_has_no_grip_sideways() -> None:
    rng = np.random.default_rng(5)
    points, _ = sheet(2, rng, 20_000, 0.0)
    tilt = Rotation.from_rotvec(rng.normal(0.0, 0.1, (20_000, 3)) * [1.0, 1.0, 0.0])
    normals = tilt.apply(np.array([0.0, 0.0, 1.0]))
    surface = Surface(points, normals, cKDTree(points))
    source, _ = sheet(2, rng, 4_000, 0.01)
    pairs = pair_points(surface, source, np.eye(4), reach=1.0)
    assert pairs is not None
    told = measure_covariance(surface, source, np.eye(4), pairs, reach=1.0, spacing=0.1)
    pulls = pairs.pulls()
    H = np.linalg.inv(pairs.hessian())
    naive = H @ (pulls.T @ pulls) @ H
    assert told[0, 0] > 20.0 * naive[0, 0]  # fixed pairs promise what is not there
    assert told[2, 2] < 0.005**2


def test_errors_of_many_looks_are_as_large_as_told() -> None:
    place = make_place(8, 24.0, n_boxes=5, n_posts=8)
    nees = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        target, source = look(place, rng, noise=0.03), look(place, rng, noise=0.03, roofs=False)
        refined = refine(target, source, np.eye(4), cell=0.5)
        T = refined.T_target_source
        error = np.concatenate(
            [
                T[:3, :3] @ refined.centre + T[:3, 3] - refined.centre,
                Rotation.from_matrix(T[:3, :3]).as_rotvec(),
            ]
        )
        nees.append(float(error @ np.linalg.solve(refined.covariance, error)))
    # 6 expected; the mean of 24 draws of chi squared lies within 4.7 and 7.5 in 95 %
    assert 2.0 < np.mean(nees) < 12.0


def test_loose_surfaces_may_all_be_shifted_alike() -> None:
    # sheets with a residual scale of 0.1 m: 0.1 * sqrt(0.1^2 - 0.02^2) = 9.8 mm, level only
    rng = np.random.default_rng(11)
    points, normals = corner(rng, 0.0, n=20_000)
    source, _ = corner(rng, 0.1, n=40_000)
    surface = Surface(points, normals, cKDTree(points))
    pairs = pair_points(surface, source, np.eye(4), reach=1.0)
    assert pairs is not None and pairs.scale == pytest.approx(0.1, rel=0.05)
    told = measure_covariance(surface, source, np.eye(4), pairs, reach=1.0, spacing=0.1)
    expected = 0.01 * (pairs.scale**2 - 0.02**2)
    assert told[0, 0] > expected and told[1, 1] > expected
    assert told[2, 2] < 0.5 * expected
    # what is as flat as a lidar's noise has no such shift
    flat, _ = corner(rng, 0.015, n=40_000)
    pairs = pair_points(surface, flat, np.eye(4), reach=1.0)
    assert pairs is not None
    told = measure_covariance(surface, flat, np.eye(4), pairs, reach=1.0, spacing=0.1)
    assert told[0, 0] < 0.1 * expected


def test_a_single_patch_is_told_as_little_known() -> None:
    rng = np.random.default_rng(7)
    J = rng.normal(size=(40, 6))
    pairs = Pairs(rng.uniform(0, 0.01, (40, 3)), J, np.ones(40), rng.normal(0, 0.01, 40), 0.01)
    assert np.isfinite(pairs.curvature()).all()
    assert pairs.hessian() == pytest.approx(J.T @ J)
