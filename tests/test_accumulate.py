"""The cloud of a whole log: one point a voxel, bounded, whatever the order of calls."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap.errors import EmptyMapError, InputError
from commonmap.odometry import Accumulator
from commonmap.types import Cloud, Float64s


def cloud_of(xyz: Float64s, origin: Float64s | None = None) -> Cloud:
    """Return a cloud whose time and intensity number the points."""
    n = len(xyz)
    origin = np.zeros((n, 3)) if origin is None else origin
    number = np.arange(n, dtype=np.float64)
    return Cloud(
        xyz, origin=origin.astype(np.float32), time=number, intensity=number.astype(np.float32)
    )


def walk(n: int, seed: int) -> Cloud:
    """Return points on a floor, seen from places along a way."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(-4, 4, (n, 2)), rng.normal(0, 0.02, n)])
    origin = np.column_stack([np.linspace(-4, 4, n), np.zeros(n), np.ones(n)])
    return cloud_of(xyz, origin)


def gather_slowly(cloud: Cloud, voxel: float) -> list[int]:
    """Return which points are kept, in the order of voxels: the rule as a dictionary."""
    assert cloud.origin is not None
    kept: dict[tuple[int, ...], int] = {}
    square = np.square(cloud.xyz - cloud.origin.astype(np.float64)).sum(axis=1)
    for p, row in enumerate(cloud.xyz):
        key = tuple(np.floor(row / voxel).astype(int).tolist())
        if key not in kept or square[p] < 0.25 * square[kept[key]]:
            kept[key] = p
    return list(kept.values())


def test_a_voxel_keeps_its_first_point_until_one_is_seen_from_half_as_far() -> None:
    xyz = np.array([[1.01, 0.01, 0.01], [1.02, 0.02, 0.01], [1.03, 0.01, 0.02], [-0.01, 0, 0]])
    far, nearer, near = [11.0, 0, 0], [7.0, 0, 0], [5.0, 0, 0]
    gathered = Accumulator(voxel=0.05)
    gathered.add(cloud_of(xyz, np.array([far, nearer, near, near])))
    cloud = gathered.cloud()
    assert cloud.time is not None and cloud.intensity is not None and cloud.origin is not None
    assert cloud.time.tolist() == cloud.intensity.tolist() == [2.0, 3.0]
    assert cloud.xyz.tolist() == [[1.03, 0.01, 0.02], [-0.01, 0.0, 0.0]]
    assert cloud.origin.tolist() == [near, near]


@pytest.mark.parametrize("seed", range(3))
def test_it_agrees_with_a_dictionary(seed: int) -> None:
    cloud = walk(40_000, seed)
    gathered = Accumulator(voxel=0.11)
    for part in np.array_split(np.arange(len(cloud.xyz)), 7):
        assert cloud.origin is not None and cloud.time is not None and cloud.intensity is not None
        gathered.add(
            Cloud(
                cloud.xyz[part], origin=cloud.origin[part], time=cloud.time[part],
                intensity=cloud.intensity[part],
            )
        )  # fmt: skip
    kept = gathered.cloud()
    assert kept.time is not None
    assert kept.time.astype(int).tolist() == gather_slowly(cloud, 0.11)


def test_voxels_widen_and_the_number_of_points_is_bounded() -> None:
    gathered = Accumulator(voxel=0.05, max_points=2000)
    for seed in range(4):
        gathered.add(walk(5000, seed))
        assert gathered.n <= 2000
    assert gathered.voxel == pytest.approx(
        0.05 * 2 ** (round(2 * np.log2(gathered.voxel / 0.05)) / 2)
    )
    assert 0.1 < gathered.voxel < 0.4
    # all of the floor is still there
    cell = np.floor(gathered.cloud().xyz[:, :2]).astype(int) + 4
    assert np.bincount(8 * cell[:, 0] + cell[:, 1], minlength=64).min() >= 5


def test_nothing_and_too_little_are_told() -> None:
    with pytest.raises(EmptyMapError, match="no point"):
        Accumulator().cloud()
    with pytest.raises(InputError, match="time"):
        Accumulator().add(Cloud(np.zeros((1, 3))))
    with pytest.raises(InputError, match="wide"):
        Accumulator(voxel=0.0)
