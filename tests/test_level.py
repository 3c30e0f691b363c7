"""Levelling: walls and posts say which way is up; bare slopes and hillsides stay as they are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from commonmap.mapping.level import apply_level, find_level, no_levelling
from commonmap.types import Float64s
from matching_scenes import look, make_place


def tilt_about(degrees: float, heading: float) -> Float64s:
    """Return the rotation (3, 3) by an angle about a horizontal axis."""
    axis = np.array([math.cos(heading), math.sin(heading), 0.0])
    return np.asarray(Rotation.from_rotvec(math.radians(degrees) * axis).as_matrix())


def error_of_up(xyz_level: Float64s, R: Float64s) -> float:
    """Return degrees between true up and what is found for the map turned by R."""
    levelling = find_level(xyz_level @ R.T)
    up = levelling.T_level_map[:3, :3] @ R @ np.array([0.0, 0.0, 1.0])
    return math.degrees(math.acos(min(1.0, float(up[2]))))


def posts_on_slope(rng: np.random.Generator, degrees: float, n_posts: int) -> Float64s:
    """Return a plane that rises along x, with posts of 6 m that stand upright on it."""
    rise = math.tan(math.radians(degrees))
    xy = rng.uniform(-15.0, 15.0, (30_000, 2))
    parts = [np.column_stack([xy, rise * xy[:, 0]])]
    for x, y in rng.uniform(-13.0, 13.0, (n_posts, 2)):
        turn = rng.uniform(0.0, 2.0 * math.pi, 900)
        z = rise * x + rng.uniform(0.0, 6.0, 900)
        parts.append(np.column_stack([x + 0.15 * np.cos(turn), y + 0.15 * np.sin(turn), z]))
    xyz = np.concatenate(parts)
    return np.asarray(xyz + rng.normal(0.0, 0.02, xyz.shape))


@pytest.fixture(scope="module")
def town() -> Float64s:
    """Return a level place of walls and posts, without roofs."""
    return look(make_place(3, n_boxes=10), np.random.default_rng(3), roofs=False)


@pytest.mark.parametrize(("degrees", "heading"), [(2.0, 0.4), (5.0, 2.0), (8.0, -1.0)])
def test_a_known_tilt_of_walls_is_found_within_a_fifth_of_a_degree(
    town: Float64s, degrees: float, heading: float
) -> None:
    assert error_of_up(town, tilt_about(degrees, heading)) < 0.2


def test_a_level_town_stays_level(town: Float64s) -> None:
    assert error_of_up(town, np.eye(3)) < 0.2
    levelling = find_level(town)
    assert levelling.sigma < math.radians(1.0)
    assert levelling.tilt < math.radians(0.2)


def test_a_hillside_with_upright_posts_is_not_flattened() -> None:
    hill = posts_on_slope(np.random.default_rng(4), 13.0, 40)
    assert error_of_up(hill, np.eye(3)) < 0.3
    assert error_of_up(hill, tilt_about(3.0, 1.0)) < 0.3


@pytest.mark.parametrize("degrees", [0.0, 10.0, 20.0])
def test_a_bare_slope_is_left_alone(degrees: float) -> None:
    bare = posts_on_slope(np.random.default_rng(5), degrees, 0)
    levelling = find_level(bare)
    assert np.array_equal(levelling.T_level_map, np.eye(4))
    assert levelling.tilt == 0.0
    assert levelling.sigma == math.inf
    assert "own z" in levelling.reason


def test_walls_of_one_direction_do_not_invent_a_tilt() -> None:
    # five walls along x say much about the tilt across them, little about the one along them
    rng = np.random.default_rng(6)
    xy = rng.uniform(-15.0, 15.0, (20_000, 2))
    parts = [np.column_stack([xy, np.zeros(len(xy))])]
    for y in (-12.0, -6.0, 0.0, 6.0, 12.0):
        x, z = rng.uniform(-14.0, 14.0, 6000), rng.uniform(0.0, 4.0, 6000)
        parts.append(np.column_stack([x, np.full(6000, y), z]))
    walls = np.concatenate(parts)
    walls += rng.normal(0.0, 0.02, walls.shape)
    for degrees in (0.0, 4.0):
        R = tilt_about(degrees, 0.0)
        up = find_level(walls @ R.T).T_level_map[:3, :3] @ R[:, 2]
        assert abs(math.degrees(math.atan2(up[1], up[2]))) < 0.3
        assert abs(math.degrees(math.atan2(up[0], up[2]))) < 2.5


@pytest.mark.parametrize("heading", [0.3, 2.5])
def test_a_town_on_its_side_is_put_upright(town: Float64s, heading: float) -> None:
    assert error_of_up(town, tilt_about(60.0, heading)) < 0.5


def test_levelling_is_a_rotation_about_the_origin(town: Float64s) -> None:
    levelling = find_level(town @ tilt_about(6.0, 1.2).T)
    T = levelling.T_level_map
    assert T[:3, 3].tolist() == [0.0, 0.0, 0.0]
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    angle = math.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())
    assert angle == pytest.approx(math.degrees(levelling.tilt), abs=1e-6)
    assert angle == pytest.approx(6.0, abs=0.2)
    assert abs(Rotation.from_matrix(T[:3, :3]).as_rotvec()[2]) < 1e-9  # no turn about z


def test_levelling_is_deterministic(town: Float64s) -> None:
    tilted = town @ tilt_about(5.0, 0.9).T
    first, second = find_level(tilted), find_level(tilted.copy())
    assert first.T_level_map.tobytes() == second.T_level_map.tobytes()
    assert (first.tilt, first.sigma, first.reason) == (second.tilt, second.sigma, second.reason)


def test_where_the_map_lies_does_not_matter(town: Float64s) -> None:
    tilted = town @ tilt_about(5.0, 0.9).T
    near, far = find_level(tilted), find_level(np.add(tilted, (1000.0, -2000.0, 500.0)))
    assert far.T_level_map == pytest.approx(near.T_level_map, abs=1e-3)


def test_too_few_points_change_nothing() -> None:
    levelling = find_level(np.random.default_rng(7).normal(size=(199, 3)))
    assert np.array_equal(levelling.T_level_map, np.eye(4))
    assert "too few points" in levelling.reason


def test_apply_level_turns_points() -> None:
    quarter = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    levelling = type(no_levelling(""))(quarter, math.pi / 2, 0.1, "by hand")
    assert apply_level(levelling, np.array([[1.0, 2.0, 3.0]])).tolist() == [[3.0, 2.0, -1.0]]
