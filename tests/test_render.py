"""Pictures of three dimensions: where things come to lie, and what hides what."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap.study.render import Camera, draw_faces, draw_points, draw_voxels, look_at
from commonmap.types import Float64s

RED, BLUE = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])


@pytest.fixture
def above() -> Camera:
    """Return a camera that looks straight down, north up, 10 pixels a metre, about (5, 5)."""
    return Camera(np.eye(3), np.array([5.0, 5.0, 0.0]), 10.0, 100, 80)


def centre_of(mask: np.ndarray) -> Float64s:
    return np.asarray(np.argwhere(mask).mean(axis=0))


def test_projection_is_the_literal_one(above: Camera) -> None:
    assert above.project(np.array([[5.0, 5.0, 2.0], [7.0, 6.0, -1.0]])).tolist() == [
        [50.0, 40.0, 2.0], [70.0, 30.0, -1.0],
    ]  # fmt: skip


def test_look_at_shows_all_of_it_upright() -> None:
    points = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 30.0, 0.0], [10.0, 10.0, 9.0]])
    camera = look_at(points, yaw=0.7, pitch=0.6, width=300, height=200)
    u, v, _ = camera.project(points).T
    assert u.min() >= 0 and u.max() <= 300 and v.min() >= 0 and v.max() <= 200
    high, low = camera.project(np.array([[10.0, 10.0, 9.0], [10.0, 10.0, 0.0]]))
    assert high[1] < low[1] and high[0] == pytest.approx(low[0])  # up is up
    near, far = camera.project(np.array([[0.0, 0.0, 0.0], [7.6, 6.4, 0.0]]))
    assert near[2] > far[2] and near[1] > far[1]  # what lies ahead is farther and higher


def test_a_voxel_covers_its_square_and_hides_what_is_below(above: Camera) -> None:
    centres = np.array([[6.0, 7.0, 0.0], [6.0, 7.0, 5.0], [2.0, 3.0, 0.0]])
    colour = np.concatenate([RED, BLUE, RED])
    picture = draw_voxels(centres, np.ones(3), colour, above)
    blue = (picture.rgb[..., 2] > 0.3) & (picture.rgb[..., 0] < 0.1)
    red = (picture.rgb[..., 0] > 0.3) & (picture.rgb[..., 2] < 0.1)
    np.testing.assert_allclose(centre_of(blue), [40 - 20 - 0.5, 50 + 10 - 0.5], atol=0.6)
    np.testing.assert_allclose(centre_of(red), [40 + 20 - 0.5, 50 - 30 - 0.5], atol=0.6)
    assert blue.sum() == pytest.approx(100, abs=22)
    assert picture.depth[20, 60] == pytest.approx(5.5, abs=0.05)
    assert np.isneginf(picture.depth[0, 0]) and picture.rgb[0, 0].tolist() == [1.0, 1.0, 1.0]


def test_what_stands_in_the_sun_throws_a_shadow(above: Camera) -> None:
    ground = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], float)
    roof = np.array([[4, 4, 3], [6, 4, 3], [6, 6, 3], [4, 6, 3]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    grey = np.full((4, 3), 0.6)
    picture = draw_faces(np.concatenate([ground, roof]), faces, grey, above)
    lit, shaded = picture.rgb[10, 10, 0], picture.rgb[30, 68, 0]  # the sun is in the south-west
    assert lit > shaded + 0.15


def test_the_nearest_point_is_on_top(above: Camera) -> None:
    xyz = np.array([[5.0, 5.0, 3.0], [5.0, 5.0, 1.0]])
    for order in ([0, 1], [1, 0]):
        picture = draw_points(xyz[order], np.concatenate([BLUE, RED])[order], above)
        pixel = picture.rgb[40, 50]
        assert pixel[2] > pixel[0]
