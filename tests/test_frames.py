"""The conventions of docs/conventions.md, each by literal numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from commonmap import frames
from commonmap.errors import InputError
from commonmap.types import GridMap, Leaves

QUARTER = math.pi / 2


def test_yaw_turns_x_towards_y() -> None:
    T_a_b = frames.from_xyz_yaw(10.0, 20.0, 30.0, QUARTER)
    np.testing.assert_allclose(
        frames.apply(T_a_b, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])),
        [[10.0, 21.0, 30.0], [9.0, 20.0, 30.0], [10.0, 20.0, 31.0]],
        atol=1e-12,
    )
    assert frames.yaw_of(T_a_b) == pytest.approx(QUARTER)


def test_inner_letters_cancel() -> None:
    T_a_b = frames.from_xyz_yaw(1.0, 0.0, 0.0, QUARTER)
    T_b_c = frames.from_xyz_yaw(5.0, 0.0, 0.0, 0.0)
    # c's origin is 5 m along b's x, which is a's y
    np.testing.assert_allclose((T_a_b @ T_b_c)[:3, 3], [1.0, 5.0, 0.0], atol=1e-12)


def test_invert_by_hand() -> None:
    T_a_b = frames.from_xyz_yaw(10.0, 20.0, 30.0, QUARTER)
    expected = [[0, 1, 0, -20], [-1, 0, 0, 10], [0, 0, 1, -30], [0, 0, 0, 1]]
    np.testing.assert_allclose(frames.invert(T_a_b), expected, atol=1e-12)
    np.testing.assert_allclose(frames.invert(np.stack([np.eye(4), T_a_b]))[1], expected, atol=1e-12)


def test_quaternion_is_xyzw_with_w_not_negative() -> None:
    half = math.sqrt(0.5)
    T = frames.from_xyz_yaw(0.0, 0.0, 0.0, QUARTER)
    np.testing.assert_allclose(frames.quaternion(T), [0, 0, half, half], atol=1e-12)
    T = frames.from_xyz_yaw(0.0, 0.0, 0.0, math.radians(270.0))
    np.testing.assert_allclose(frames.quaternion(T), [0, 0, -half, half], atol=1e-12)


def test_from_quaternion_roll() -> None:
    half = math.sqrt(0.5)
    T = frames.from_quaternion([1, 2, 3], [half, 0, 0, half])  # a quarter about x: y goes to z
    np.testing.assert_allclose(
        frames.apply(T, np.array([[0.0, 1.0, 0.0]])), [[1, 2, 4]], atol=1e-12
    )


def test_rotation_between_quarter_and_half_turn() -> None:
    R = frames.rotation_between([1, 0, 0], [0, 2, 0])
    np.testing.assert_allclose(R, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    R = frames.rotation_between([0, 0, 1], [0, 0, -1])
    np.testing.assert_allclose(R @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_array_equal(frames.rotation_between([0, 0, 3], [0, 0, 5]), np.eye(3))


def test_difference_is_taken_where_the_map_is() -> None:
    T_a_b = np.eye(4)
    turned = frames.from_xyz_yaw(0.0, 0.0, 0.0, 0.001)
    metres, radians = frames.difference(T_a_b, turned, [1000.0, 0.0, 0.0])
    assert metres == pytest.approx(1.0, rel=1e-6)
    assert radians == pytest.approx(0.001, rel=1e-6)


@given(
    yaw=st.floats(-3.1, 3.1), x=st.floats(-1e6, 1e6), y=st.floats(-1e6, 1e6), z=st.floats(-1e4, 1e4)
)
def test_there_and_back_again(yaw: float, x: float, y: float, z: float) -> None:
    T_a_b = frames.from_xyz_yaw(x, y, z, yaw)
    points = np.array([[3.0, -4.0, 5.0]])
    back = frames.apply(frames.invert(T_a_b), frames.apply(T_a_b, points))
    np.testing.assert_allclose(back, points, atol=1e-8)
    assert frames.yaw_of(T_a_b) == pytest.approx(yaw)


@pytest.mark.parametrize(
    ("T", "words"),
    [
        (np.eye(3), "shape (3, 3)"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.ones((4, 4)), "0 0 0 1"),
        (np.diag([2.0, 1.0, 1.0, 1.0]), "rotation"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "rotation"),
    ],
)
def test_check_T_names_what_came(T: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match="T_target_source must") as caught:
        frames.check_T(T, "T_target_source")
    assert words in str(caught.value)


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((4, 2)), np.array([["a", "b", "c"]])])
def test_check_points_refuses(points: np.ndarray) -> None:
    with pytest.raises(InputError, match="points must"):
        frames.check_points(points)


def test_grid_shape_is_x_then_y() -> None:
    grid = GridMap(np.zeros(2), 0.5, {"slabs": np.zeros((7, 3, 2)), "flat": np.zeros((3, 2))})
    assert grid.shape == (3, 2)


def test_octree_keys_as_octomap() -> None:
    # key = floor(coordinate / resolution) + 32768: 0.25 m lies in voxel 2 of 0.1 m, -0.05 in -1
    keys = np.array([[32770, 32767, 32768]], np.uint16)
    leaves = Leaves(0.1, keys, np.array([16], np.uint8), np.array([0.5], np.float32))
    np.testing.assert_allclose(leaves.centres(), [[0.25, -0.05, 0.05]], atol=1e-9)
    coarse = Leaves(
        0.1, np.array([[32768] * 3], np.uint16), np.array([14], np.uint8), -leaves.log_odds
    )
    np.testing.assert_allclose(coarse.centres(), [[0.2, 0.2, 0.2]], atol=1e-9)
    np.testing.assert_allclose(coarse.sizes(), [0.4])
    assert leaves.occupied.tolist() == [True]
    assert coarse.occupied.tolist() == [False]
