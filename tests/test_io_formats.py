"""The choice of a reader or a writer, round trips through every format, and what is refused."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from commonmap.errors import CommonmapError, EmptyMapError, InputError, OutputError, UnitsError
from commonmap.io import READERS, WRITERS, find_writer, read_cloud, read_map, write_cloud, write_map
from commonmap.types import Cloud, Leaves

CLOUD_SUFFIXES = [s for row in WRITERS if row.holds == "cloud" for s in row.suffixes]
UTM_WKT = "EPSG:32612"


def full_cloud(n: int = 200, *, utm: bool = True) -> Cloud:
    """Return a cloud with every field, on whole millimetres so that LAS can hold it exactly."""
    rng = np.random.default_rng(7)
    xyz = rng.integers(0, 50_000, (n, 3)) / 1000.0
    if utm:
        xyz = np.round(xyz + np.array([470_600.0, 3_810_200.0, 2_278.0]), 3)
    return Cloud(
        xyz=xyz,
        crs=UTM_WKT if utm else None,
        colour=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        intensity=rng.integers(1, 4000, n).astype(np.float32),
        time=np.sort(rng.uniform(1.0, 100.0, n)),
        origin=rng.uniform(0.0, 50.0, (n, 3)).astype(np.float32),
        seen_by=rng.integers(1, 4, n).astype(np.uint8),
    )


def one_line(error: BaseException) -> str:
    text = str(error)
    assert text and "\n" not in text and len(text) < 500
    return text


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_round_trip_keeps_every_field_of_a_cloud_in_utm(tmp_path: Path, suffix: str) -> None:
    cloud = full_cloud()
    path = tmp_path / f"map{suffix}"
    write_map(path, cloud)
    back = read_cloud(path)
    assert back.xyz.dtype == np.float64
    np.testing.assert_allclose(back.xyz, cloud.xyz, rtol=0, atol=1e-8)
    if suffix == ".npy":
        return
    for name in ("colour", "intensity", "time", "origin", "seen_by"):
        want, got = getattr(cloud, name), getattr(back, name)
        assert got is not None and got.dtype == want.dtype, name
        np.testing.assert_array_equal(got, want, err_msg=name)
    assert back.crs is not None and "UTM zone 12N" in back.crs


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_round_trip_of_bare_points(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    write_cloud(path, Cloud(xyz=np.array([[1.5, -2.25, 3.0], [0.0, 0.5, -7.125]])))
    back = read_cloud(path)
    np.testing.assert_array_equal(back.xyz, [[1.5, -2.25, 3.0], [0.0, 0.5, -7.125]])
    assert (back.crs, back.colour, back.intensity, back.time, back.origin) == (None,) * 5


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_the_same_cloud_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    first, second = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    write_cloud(first, full_cloud())
    write_cloud(second, full_cloud())
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("suffix", [s for s in CLOUD_SUFFIXES if s != ".npy"])
def test_extra_columns_are_written(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    layer = np.arange(200, dtype=np.int16)
    write_cloud(path, full_cloud(), extra={"height": layer.astype(np.float32), "tile": layer})
    assert b"tile" in path.read_bytes()
    np.testing.assert_allclose(read_cloud(path).xyz, full_cloud().xyz, rtol=0, atol=1e-8)


def test_extra_columns_have_the_values_given(tmp_path: Path) -> None:
    import laspy

    write_cloud(tmp_path / "map.laz", full_cloud(), extra={"tile": np.arange(200, dtype=np.int16)})
    las = laspy.read(tmp_path / "map.laz")
    np.testing.assert_array_equal(las["tile"], np.arange(200))
    write_cloud(tmp_path / "map.csv", full_cloud(3), extra={"tile": np.array([7, 8, 9])})
    lines = (tmp_path / "map.csv").read_text().splitlines()
    assert lines[1].endswith(",tile")
    assert [line.rsplit(",", 1)[1] for line in lines[2:]] == ["7", "8", "9"]


def test_octrees_go_through_the_same_door(tmp_path: Path) -> None:
    pytest.importorskip("commonmap.io.octomap")
    leaves = Leaves(
        resolution=0.25,
        keys=np.array([[32768, 32768, 32768], [32769, 32768, 32770]], dtype=np.uint16),
        depth=np.array([16, 16], dtype=np.uint8),
        log_odds=np.array([0.85, -0.4], dtype=np.float32),
    )
    write_map(tmp_path / "map.ot", leaves)
    back = read_map(tmp_path / "map.ot")
    assert isinstance(back, Leaves)
    assert back.resolution == 0.25 and len(back.keys) == 2
    with pytest.raises(InputError, match="holds an octree; a cloud was expected"):
        read_cloud(tmp_path / "map.ot")
    with pytest.raises(InputError, match=r"an octree is written to .*\.bt \.ot"):
        write_map(tmp_path / "map.ply", leaves)


def test_every_suffix_belongs_to_one_row() -> None:
    for table in (READERS, WRITERS):
        suffixes = [suffix for row in table for suffix in row.suffixes]
        assert len(suffixes) == len(set(suffixes))
        assert all(row.available() is None for row in table)


# --- what is refused, in one sentence ---------------------------------------------------------


@pytest.mark.parametrize("suffix", [s for row in READERS for s in row.suffixes])
def test_missing_folder_empty(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    with pytest.raises(InputError, match="there is no file"):
        read_map(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="is empty"):
        read_map(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match="is a folder"):
        read_map(path)


ROW = {suffix: row.name for row in READERS for suffix in row.suffixes}
LIES = [
    (really, named)
    for really in (".las", ".laz", ".ply", ".pcd", ".npy", ".npz", ".xyz")
    for named in ROW
    if ROW[really] != ROW[named]
]


@pytest.mark.parametrize(("really", "named"), LIES)
def test_a_suffix_that_lies_is_told(tmp_path: Path, really: str, named: str) -> None:
    write_cloud(tmp_path / f"true{really}", full_cloud())
    path = tmp_path / f"false{named}"
    path.write_bytes((tmp_path / f"true{really}").read_bytes())
    with pytest.raises(InputError) as caught:
        read_map(path)
    text = one_line(caught.value)
    assert str(path) in text
    assert (ROW[really] if really != ".xyz" else "begins with the text") in text


def test_a_las_file_named_ply(tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.las", full_cloud())
    (tmp_path / "a.las").rename(tmp_path / "a.ply")
    with pytest.raises(InputError) as caught:
        read_map(tmp_path / "a.ply")
    assert str(caught.value) == (
        f"{tmp_path}/a.ply should be PLY by its suffix, but its first bytes look like LAS/LAZ"
    )


def test_unknown_suffixes_list_what_there_is(tmp_path: Path) -> None:
    path = tmp_path / "map.docx"
    path.write_bytes(b"PK\x03\x04 something")
    with pytest.raises(InputError, match=r"\.las \.laz \.ply .*its first bytes look like NPZ"):
        read_map(path)
    with pytest.raises(InputError, match=r"a cloud is written to a file ending in \.las \.laz"):
        write_cloud(path, full_cloud())
    with pytest.raises(InputError, match=r"\.las .*\.bt \.ot"):
        find_writer(path)


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_clouds_that_cannot_be_written(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    with pytest.raises(EmptyMapError):
        write_cloud(path, Cloud(xyz=np.empty((0, 3))))
    with pytest.raises(InputError, match="colour must be of shape"):
        write_cloud(path, Cloud(xyz=np.zeros((2, 3)), colour=np.zeros((3, 3), dtype=np.uint8)))
    with pytest.raises(OutputError, match="there is no folder"):
        write_cloud(tmp_path / "nowhere" / f"map{suffix}", full_cloud())
    with pytest.raises(InputError):
        write_cloud(path, full_cloud(), extra={"x": np.zeros(200)})
    with pytest.raises(InputError):
        write_cloud(path, full_cloud(), extra={"good_name": np.zeros(199)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz", ".xyz"])
def test_points_that_are_not_finite(
    tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / f"map{suffix}"
    xyz = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [4.0, np.inf, 0.0], [5.0, 6.0, 7.0]])
    write_cloud(path, Cloud(xyz=xyz, intensity=np.arange(4, dtype=np.float32)))
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz, [[1.0, 2.0, 3.0], [5.0, 6.0, 7.0]])
    assert f"{path}: dropped 2 of 4 points without finite coordinates" in caplog.text
    if suffix != ".npy":
        np.testing.assert_array_equal(cloud.intensity, [0.0, 3.0])
    write_cloud(path, Cloud(xyz=np.full((3, 3), np.nan)))
    with pytest.raises(EmptyMapError, match="no points with finite coordinates"):
        read_cloud(path)


def test_degrees_and_millimetres_are_refused_where_the_numbers_prove_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    path = tmp_path / "map.csv"
    degrees = rng.uniform(0, 1, (500, 3)) * [0.003, 0.002, 25.0] + [29.02, 41.1, 80.0]
    write_cloud(path, Cloud(xyz=degrees))
    with pytest.raises(UnitsError, match="degrees"):
        read_cloud(path)
    write_cloud(path, Cloud(xyz=rng.uniform(0, 1, (500, 3)) * [90_000, 60_000, 9_000]))
    with pytest.raises(UnitsError, match="millimetres"):
        read_cloud(path)


def test_small_and_tall_maps_in_metres_are_not_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    rng = np.random.default_rng(1)
    for size in ([0.3, 0.3, 10.0], [4.0, 3.0, 80.0], [49_000.0, 20_000.0, 900.0]):
        write_cloud(path, Cloud(xyz=rng.uniform(0, 1, (500, 3)) * size))
        assert len(read_cloud(path).xyz) == 500
    far = rng.uniform(0, 30, (500, 3))
    far[0] = [9e6, 0, 0]  # one blunder makes no millimetres
    write_cloud(path, Cloud(xyz=far))
    assert len(read_cloud(path).xyz) == 500


@pytest.mark.parametrize("suffix", CLOUD_SUFFIXES)
def test_every_truncation_is_told(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    write_cloud(path, full_cloud())
    data = path.read_bytes()
    for share in (0.01, 0.1, 0.5, 0.9, 0.999):
        path.write_bytes(data[: int(share * len(data))])
        if suffix in (".xyz", ".txt", ".csv") and share > 0.1:
            continue  # a text cut short between two rows cannot be told from a whole one
        with pytest.raises(InputError) as caught:
            read_map(path)
        assert str(path) in one_line(caught.value)


def test_unreadable_text_in_errors_stays_on_one_line(tmp_path: Path) -> None:
    path = tmp_path / "map.xyz"
    path.write_text("hello\x0cworld, this is\nno map\n")
    with pytest.raises(CommonmapError) as caught:
        read_map(path)
    one_line(caught.value)
