"""The real pair: drone lidar and ground lidar of one pine plot, displaced at random.

Data and truth: ../shared/data/air-ground beside the repository, README.md there.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from commonmap.config import Config
from commonmap.matching.match import match
from commonmap.types import Float64s, Match
from matching_scenes import apart, moved, rigid

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "air-ground"
pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"the real pair is not here ({DATA} is absent)"
)

ORIGIN = np.array([470_641.01, 3_810_235.21, 2_278.83])
T_UAS_MLS = np.array(
    [
        [0.999732, -0.004279, -0.022768, 0.694892],
        [0.004077, 0.999952, -0.008942, 0.059796],
        [0.022806, 0.008847, 0.999701, -0.106446],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def read_points(name: str) -> Float64s:
    """Return a file's points about the origin that the truth refers to."""
    import laspy

    las = laspy.read(DATA / name)
    return np.asarray(np.column_stack([las.x, las.y, las.z]) - ORIGIN, dtype=np.float64)


@pytest.fixture(scope="module")
def drone() -> Float64s:
    """Return the drone's cloud."""
    return read_points("uas.laz")


@pytest.fixture(scope="module")
def robot() -> Float64s:
    """Return the ground robot's cloud."""
    return read_points("mls.laz")


def displaced(xyz: Float64s, seed: int) -> tuple[Float64s, Float64s]:
    """Return the points under a motion that the software is not told, and the truth for them."""
    rng = np.random.default_rng(seed)
    x, y, z = rng.uniform(-200.0, 200.0, 3)
    D = rigid(x, y, z, rng.uniform(-math.pi, math.pi))
    return moved(D, xyz), T_UAS_MLS @ np.linalg.inv(D)


def error_of(answer: Match, truth: Float64s, source: Float64s) -> tuple[float, float]:
    """Return (metres at the middle of the source, degrees) of an accepted answer."""
    assert answer.accepted, answer.reason
    assert answer.T_target_source is not None
    middle = 0.5 * (source.min(axis=0) + source.max(axis=0))
    return apart(answer.T_target_source, truth, middle[None])


def crop(xyz: Float64s, seed: int, edge: float) -> Float64s:
    """Return a square piece of the cloud at a random place inside it."""
    rng = np.random.default_rng(seed)
    low, high = np.quantile(xyz[:, :2], [0.01, 0.99], axis=0)
    corner = rng.uniform(low, np.maximum(high - edge, low + 0.01))
    return np.asarray(xyz[((xyz[:, :2] >= corner) & (xyz[:, :2] < corner + edge)).all(axis=1)])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_whole_draft_is_placed(drone: Float64s, robot: Float64s, seed: int) -> None:
    source, truth = displaced(robot[::4], seed)
    metres, degrees = error_of(match(drone[::4], source), truth, source)
    assert metres < 0.3
    assert degrees < 0.5


@pytest.mark.parametrize("seed", [10, 11, 12, 13])
def test_a_crop_of_ten_metres_is_placed(drone: Float64s, robot: Float64s, seed: int) -> None:
    source, truth = displaced(crop(robot[::2], seed, 10.0), seed)
    metres, degrees = error_of(match(drone[::2], source), truth, source)
    assert metres < 0.5
    assert degrees < 2.0


def test_crops_are_placed_from_what_lies_under_one_metre(drone: Float64s, robot: Float64s) -> None:
    config = Config().with_values(grid={"max_height": 1.0})
    accepted = 0
    for seed in range(20, 32):
        source, truth = displaced(crop(robot, seed, 16.0), seed)
        answer = match(drone, source, config=config)
        if answer.accepted:
            metres, degrees = error_of(answer, truth, source)
            assert metres < 0.5, seed
            assert degrees < 2.0, seed
            accepted += 1
    assert accepted >= 11


def test_a_forest_is_not_found_in_a_city(robot: Float64s) -> None:
    from commonmap.sim.pairs import simulate_pair

    city = simulate_pair(
        "city", rng=np.random.default_rng(5), seed_world=5, size=60.0, max_points=100_000,
        azimuth_decimation=32,
    )  # fmt: skip
    source, _ = displaced(robot[::4], 5)
    answer = match(city.target, source)
    assert not answer.accepted
    assert answer.T_target_source is None
    assert answer.reason.startswith("refused: ")
