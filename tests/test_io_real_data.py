"""Real files: a drone's and a ground robot's LAZ, airborne PCD, a registration pair in PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from commonmap.errors import InputError
from commonmap.io import describe, read_cloud, write_cloud

DATA = Path(__file__).resolve().parents[1].parent / "shared" / "data"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is absent")


def test_the_drone_file() -> None:
    cloud = read_cloud(DATA / "air-ground" / "uas.laz")
    assert cloud.xyz.shape == (390_875, 3)  # 390877 less two that are classified as noise
    assert cloud.crs is not None and "NAD83(2011) / UTM zone 12N" in cloud.crs
    np.testing.assert_allclose(cloud.xyz.min(axis=0), [470627.46, 3810222.30, 2278.88], atol=1e-6)
    np.testing.assert_allclose(cloud.xyz.max(axis=0), [470654.56, 3810248.12, 2313.19], atol=1e-6)
    assert cloud.intensity is not None and cloud.time is not None and cloud.colour is None


def test_the_ground_file_says_what_it_holds() -> None:
    what = describe(DATA / "air-ground" / "mls.laz")
    assert what["kind"] == "cloud" and what["format"] == "LAZ 1.4, point format 7"
    assert (what["points"], what["crs"], what["time_span"]) == (301_477, None, None)
    assert (what["colour"], what["intensity"]) == (False, False)  # there, but zero throughout
    assert what["spacing"] == pytest.approx(0.08, abs=0.01)
    assert what["density"] == pytest.approx(301_477 / (27.1 * 25.8), rel=0.25)


def test_airborne_files_compressed_with_lzf() -> None:
    cloud = read_cloud(DATA / "airborne" / "CSite1_red1-utm.pcd")
    assert cloud.xyz.shape == (522_674, 3)
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    np.testing.assert_allclose(low, [512049.5, 5403059.5, 247.19], atol=1e-3)
    np.testing.assert_allclose(high, [513150.19, 5404100.0, 426.82], atol=5e-3)
    assert np.unique(cloud.xyz[:, 1] * 2 % 1).tolist() == [0.0]  # y in steps of half a metre


def test_the_registration_pair_is_a_pair() -> None:
    """The transform that comes with the files lays one on the other: fields are in place."""
    from scipy.spatial import cKDTree

    T = np.loadtxt(DATA / "registration" / "T_target_source.txt")
    source = read_cloud(DATA / "registration" / "source.ply")
    target = read_cloud(DATA / "registration" / "target.ply")
    assert source.intensity is not None and source.xyz.shape == (69_792, 3)
    # what stands up: the rings on flat ground lie on one another wherever the sensor is
    upright = source.xyz[source.xyz[:, 2] > 0.5]
    moved = upright @ T[:3, :3].T + T[:3, 3]
    tree = cKDTree(target.xyz)
    assert np.median(tree.query(moved)[0]) < 0.1
    assert np.median(tree.query(upright)[0]) > 0.3


@pytest.mark.parametrize("suffix", [".laz", ".ply", ".pcd", ".npz"])
def test_real_points_go_round(tmp_path: Path, suffix: str) -> None:
    cloud = read_cloud(DATA / "air-ground" / "uas.laz")
    write_cloud(tmp_path / f"map{suffix}", cloud)
    back = read_cloud(tmp_path / f"map{suffix}")
    np.testing.assert_allclose(back.xyz, cloud.xyz, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(back.intensity, cloud.intensity)
    np.testing.assert_array_equal(back.time, cloud.time)
    assert back.crs is not None and "NAD83(2011) / UTM zone 12N" in back.crs


@pytest.mark.parametrize("name", ["air-ground/uas.laz", "airborne/CSite2_orig-utm.pcd"])
@pytest.mark.parametrize("share", [0.0001, 0.05, 0.5, 0.9, 0.99])
def test_real_files_cut_short(tmp_path: Path, name: str, share: float) -> None:
    data = (DATA / name).read_bytes()
    path = tmp_path / Path(name).name
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError):
        read_cloud(path)
