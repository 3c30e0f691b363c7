"""GeoTIFF and navigation maps: where a cell of the grid comes to lie, by literal numbers."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import rasterio

from commonmap.errors import InputError, OutputError
from commonmap.io import read_geotiff, write_geotiff, write_nav2_map
from commonmap.io.nav2 import FREE_THRESH, OCCUPIED_THRESH, PIXELS

NAN = np.nan


def test_a_cell_comes_to_lie_where_the_grid_says(tmp_path: Path) -> None:
    path = tmp_path / "heights.tif"
    height = np.full((3, 2), NAN)  # 3 cells along x, 2 along y
    height[2, 0] = 7.5  # spans x 470601 to 470601.5, y 3810200 to 3810200.5
    seen = np.array([[True, False], [False, False], [True, True]])
    write_geotiff(
        path,
        {"height": height, "seen": seen},
        origin=(470_600.0, 3_810_200.0),
        cell=0.5,
        crs="EPSG:32612",
    )
    with rasterio.open(path) as raster:
        assert (raster.width, raster.height, raster.count) == (3, 2, 2)
        assert raster.descriptions == ("height", "seen")
        assert raster.dtypes == ("float32", "float32")
        assert np.isnan(raster.nodata)
        assert raster.crs.to_epsg() == 32612
        assert tuple(raster.bounds) == (470_600.0, 3_810_200.0, 470_601.5, 3_810_201.0)
        # row 0 is the upper edge of the map
        np.testing.assert_array_equal(raster.read(1), [[NAN, NAN, NAN], [NAN, NAN, 7.5]])
        np.testing.assert_array_equal(raster.read(2), [[0, 0, 1], [1, 0, 1]])
        assert raster.xy(1, 2) == (470_601.25, 3_810_200.25)
        assert next(raster.sample([(470_601.25, 3_810_200.25)]))[0] == 7.5


def test_a_raster_comes_back_as_a_grid(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    layers = {"a": rng.normal(size=(17, 9)).astype(np.float32), "b c": np.full((17, 9), NAN)}
    layers["a"][3, 4] = NAN
    path = tmp_path / "map.tif"
    write_geotiff(path, layers, origin=(-12.5, 3.25), cell=0.25)
    grid, crs = read_geotiff(path)
    assert crs is None
    assert (grid.cell, grid.origin.tolist(), grid.shape) == (0.25, [-12.5, 3.25], (17, 9))
    assert list(grid.layers) == ["a", "b c"]
    np.testing.assert_array_equal(grid["a"], layers["a"])
    assert np.isnan(grid["b c"]).all()


def test_nodata_of_others_becomes_nan(tmp_path: Path) -> None:
    path = tmp_path / "dem.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=2, height=1, count=1, dtype="int16", nodata=-9999,
        transform=rasterio.transform.Affine(2, 0, 10, 0, -2, 20), crs="EPSG:25833",
    ) as raster:  # fmt: skip
        raster.write(np.array([[[5, -9999]]], dtype=np.int16))
    grid, crs = read_geotiff(path)
    np.testing.assert_array_equal(grid["band1"], [[5], [NAN]])
    assert grid.origin.tolist() == [10.0, 18.0] and crs is not None and "33N" in crs


def test_the_same_layers_give_the_same_bytes(tmp_path: Path) -> None:
    layers = {"a": np.arange(6.0).reshape(2, 3)}
    for name in ("1.tif", "2.tif"):
        write_geotiff(tmp_path / name, layers, origin=(0, 0), cell=1.0, crs="EPSG:32612")
    assert (tmp_path / "1.tif").read_bytes() == (tmp_path / "2.tif").read_bytes()


def test_compound_and_metric_copies_of_foot_systems_are_taken(tmp_path: Path) -> None:
    from commonmap.io.units import to_metres

    _, crs = to_metres(np.zeros((1, 3)), "EPSG:6539+6360", Path("x"))
    write_geotiff(tmp_path / "a.tif", {"a": np.zeros((2, 2))}, origin=(0, 0), cell=1, crs=crs)
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs.linear_units.lower() in ("metre", "meter")


def test_a_crs_that_gdal_does_not_know_is_left_out_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        write_geotiff(tmp_path / "a.tif", {"a": np.zeros((2, 2))}, origin=(0, 0), cell=1, crs="hm")
    assert "written without its CRS" in caplog.text
    assert read_geotiff(tmp_path / "a.tif")[1] is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(layers={}), "arrays of one shape"),
        (dict(layers={"a": np.zeros((2, 2)), "b": np.zeros((2, 3))}), "arrays of one shape"),
        (dict(layers={"a": np.zeros((2, 2, 2))}), r"must be of shape \(nx, ny\); \(2, 2, 2\) came"),
        (dict(layers={"a": np.zeros((2, 0))}), r"must be of shape \(nx, ny\)"),
        (dict(layers={"a": np.full((2, 2), "x")}), "must hold numbers"),
        (dict(cell=0.0), "cell is a positive number"),
        (dict(origin=(np.nan, 0.0)), "origin is a finite x, y"),
    ],
)
def test_rasters_that_are_refused(tmp_path: Path, change: dict[str, object], words: str) -> None:
    given = {"layers": {"a": np.zeros((2, 2))}, "origin": (0.0, 0.0), "cell": 1.0} | change
    with pytest.raises(InputError, match=words):
        write_geotiff(tmp_path / "a.tif", **given)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_a_raster_takes_no_more_than_its_file_can_hold(tmp_path: Path) -> None:
    path = tmp_path / "heights.tif"
    write_geotiff(path, {"height": np.zeros((3, 2))}, origin=(0, 0), cell=0.5)
    data = bytearray(path.read_bytes())
    at = data.rindex(struct.pack("<HHI", 257, 3, 1))  # tag ImageLength
    data[at + 8 : at + 12] = struct.pack("<HH", 60_000, 0)
    at = data.rindex(struct.pack("<HHI", 256, 3, 1))  # tag ImageWidth
    data[at + 8 : at + 12] = struct.pack("<HH", 60_000, 0)
    path.write_bytes(data)
    with pytest.raises(InputError, match="1 layers of 60000 x 60000 cells, more than its"):
        read_geotiff(path)


def test_what_is_no_raster(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\x00 nothing else")
    with pytest.raises(InputError, match="cannot be read as GeoTIFF"):
        read_geotiff(path)
    with pytest.raises(OutputError, match="there is no folder"):
        write_geotiff(tmp_path / "b" / "a.tif", {"a": np.zeros((2, 2))}, origin=(0, 0), cell=1.0)


# --- navigation maps --------------------------------------------------------------------------


def test_a_navigation_map_literally(tmp_path: Path) -> None:
    occupancy = np.array([[0, 100], [-1, 0], [100, -1]], dtype=np.int8)  # 3 along x, 2 along y
    pgm, yaml = write_nav2_map(tmp_path / "map", occupancy, origin=(-10.0, 2.5), cell=0.05)
    assert (pgm, yaml) == (tmp_path / "map.pgm", tmp_path / "map.yaml")
    # upper row: y = 1 of x = 0, 1, 2: occupied, free, unknown
    assert pgm.read_bytes() == b"P5\n3 2\n255\n" + bytes([0, 254, 205, 254, 205, 0])
    assert yaml.read_text() == (
        "image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [-10.0, 2.5, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def test_the_loader_of_nav2_reads_each_cell_as_it_was_meant() -> None:
    """nav2 map_io.cpp, trinary: p = (255 - grey) / 255; occupied above, free below its limit."""
    for meaning, grey in PIXELS.items():
        p = (255 - grey) / 255.0
        loaded = 100 if p >= OCCUPIED_THRESH else 0 if p <= FREE_THRESH else -1
        assert loaded == meaning


def test_numbers_and_names_that_yaml_could_misread(tmp_path: Path) -> None:
    _, yaml = write_nav2_map(
        tmp_path / "it's 1e3", np.zeros((1, 1), dtype=np.int8), origin=(1e-7, 5e6), cell=1e-5
    )
    assert yaml.read_text().splitlines()[:4] == [
        "image: 'it''s 1e3.pgm'",
        "mode: trinary",
        "resolution: 0.000010000000",
        "origin: [0.000000100000, 5000000.0, 0.0]",
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(occupancy=np.full((2, 2), 50, dtype=np.int8)), "50 came"),
        (dict(occupancy=np.zeros((2, 2))), "float64"),
        (dict(occupancy=np.zeros(2, dtype=np.int8)), r"shape \(2,\)"),
        (dict(cell=-1.0), "cell is a positive number"),
        (dict(origin=(0.0, np.inf)), "origin is a finite x, y"),
    ],
)
def test_navigation_maps_that_are_refused(
    tmp_path: Path, change: dict[str, object], words: str
) -> None:
    given = {
        "occupancy": np.zeros((2, 2), dtype=np.int8), "origin": (0.0, 0.0), "cell": 1.0
    } | change  # fmt: skip
    with pytest.raises(InputError, match=words):
        write_nav2_map(tmp_path / "map", **given)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
