"""What rays saw free counts as known, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from commonmap.config import Config
from commonmap.frames import difference
from commonmap.mapping.octree import Octree
from commonmap.mapping.octree_build import insert_cloud
from commonmap.matching.maps import Layers, Prepared, build_layers, prepare
from commonmap.matching.match import match
from commonmap.matching.seen_free import know_by_rays, see_free
from commonmap.sim.pairs import simulate_pair
from commonmap.types import Cloud

CONFIG = Config().with_values(level={"mode": "off"}, grid={"resolution": 1.0})


def yard() -> Cloud:
    """Return a wall at x = 8 and the ground before it, seen from (0, 0, 1): nothing above 1 m
    before the wall lies on a ray."""
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-8, 7.9, 20_000), rng.uniform(-8, 8, 20_000)])
    ground = np.column_stack([ground, np.zeros(len(ground))])
    wall = np.column_stack(
        [np.full(4000, 8.0), rng.uniform(-8, 8, 4000), rng.uniform(0, 1.0, 4000)]
    )
    xyz = np.concatenate([ground, wall])
    return Cloud(xyz=xyz, origin=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(xyz), 1)))


def layers_of(cloud: Cloud) -> tuple[Layers, Prepared]:
    item = prepare(cloud, "target", CONFIG)
    edges = np.array([0.25, 0.75, 1.5, 3.0])
    return build_layers(item, 1.0, edges, None), item


def test_what_no_ray_crossed_is_not_known() -> None:
    cloud = yard()
    layers, item = layers_of(cloud)
    free = see_free(layers, cloud, item)
    assert free is not None
    grid = layers.grid
    i, j = np.floor((np.array([4.0, 0.0]) + item.T_prepared_map[:2, 3] - grid.origin) / grid.cell)
    column = (slice(None), int(i), int(j))
    assert grid["slab_known"][column].all()  # a column with points
    assert free[column].tolist() == [True, False, False]  # the rays there are lower than 1 m
    ours = know_by_rays(layers, cloud, item)
    known = [bool(ours.slabs.known[int(i), int(j)] >> k & 1) for k in range(3)]
    assert known == [True, False, False]
    assert np.array_equal(ours.slabs.occupied, layers.slabs.occupied)
    assert ((ours.slabs.known & ours.slabs.occupied) == ours.slabs.occupied).all()


def test_without_rays_nothing_changes() -> None:
    cloud = yard()
    layers, item = layers_of(cloud)
    bare = Cloud(xyz=cloud.xyz)
    assert know_by_rays(layers, bare, item) is layers
    assert know_by_rays(layers, cloud.xyz, item) is layers


def test_an_octree_says_what_its_cloud_says() -> None:
    cloud = yard()
    layers, item = layers_of(cloud)
    tree = Octree(0.5)
    insert_cloud(cloud, tree, discretize=True)
    by_cloud, by_tree = see_free(layers, cloud, item), see_free(layers, tree.leaves(), item)
    assert by_cloud is not None and by_tree is not None
    assert (by_cloud != by_tree).mean() < 0.02  # voxels begin elsewhere


@pytest.mark.parametrize("kind", ["paper", "forest"])
def test_a_match_with_rays_is_right(kind: str) -> None:
    pair = simulate_pair(
        kind, rng=np.random.default_rng(5), overlap=0.5, drift=0.0, max_points=120_000,
        azimuth_decimation=8,
    )  # fmt: skip
    config = Config().with_values(grid={"rays": True})
    found = match(pair.target, pair.source, config=config)
    assert found.accepted and found.T_target_source is not None
    assert "rays" in found.timings
    middle = pair.source.xyz.mean(axis=0)
    metres, radians = difference(found.T_target_source, pair.T_target_source, middle)
    assert metres < 0.2 and radians < np.radians(0.3)
