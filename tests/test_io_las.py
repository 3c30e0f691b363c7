"""LAS and LAZ: versions, point formats, coordinate systems, units, and headers that lie."""

from __future__ import annotations

import logging
import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr
from pyproj import CRS, Transformer

from commonmap.errors import EmptyMapError, InputError, UnitsError
from commonmap.io import las, read_cloud, write_cloud
from commonmap.types import Cloud

US_FOOT = 1200.0 / 3937.0
LONG_ISLAND_FEET = "EPSG:6539+6360"  # New York Long Island, US survey feet, heights in US feet


def write_with_laspy(
    path: Path,
    *,
    version: str = "1.4",
    point_format: int = 6,
    xyz: Any = ((470600.01, 3810200.02, 2280.03), (470610.5, 3810220.25, 2290.75)),
    crs: str | None = None,
    **dimensions: Any,
) -> Path:
    header = laspy.LasHeader(version=version, point_format=point_format)
    points = np.asarray(xyz, dtype=np.float64)
    header.scales, header.offsets = np.full(3, 0.01), np.floor(points.min(axis=0))
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    for name, values in dimensions.items():
        data[name] = np.asarray(values)
    data.write(path)
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize(
    ("version", "point_format"),
    [("1.1", 0), ("1.2", 1), ("1.2", 2), ("1.2", 3), ("1.3", 4), ("1.3", 5)]
    + [("1.4", k) for k in range(11)],
)
def test_every_version_and_point_format(
    tmp_path: Path, suffix: str, version: str, point_format: int
) -> None:
    path = tmp_path / f"map{suffix}"
    write_with_laspy(path, version=version, point_format=point_format, intensity=[7, 65535])
    cloud = read_cloud(path)
    np.testing.assert_allclose(
        cloud.xyz,
        [[470600.01, 3810200.02, 2280.03], [470610.5, 3810220.25, 2290.75]],
        rtol=0,
        atol=1e-9,
    )
    np.testing.assert_array_equal(cloud.intensity, [7.0, 65535.0])
    assert las.las_version(path) == f"{suffix[1:].upper()} {version}, point format {point_format}"


def test_version_1_0_is_read(tmp_path: Path) -> None:
    path = write_with_laspy(tmp_path / "map.las", version="1.1", point_format=0)
    data = bytearray(path.read_bytes())
    data[25] = 0
    path.write_bytes(data)
    assert len(read_cloud(path).xyz) == 2
    data[25] = 5
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"says it is LAS 1\.5; 1\.0 to 1\.4 are known"):
        read_cloud(path)


@pytest.mark.parametrize(("values", "expected"), [([0, 255], [0, 255]), ([0, 0xFF80], [0, 0xFF])])
def test_colours_of_8_and_16_bits(tmp_path: Path, values: list[int], expected: list[int]) -> None:
    path = write_with_laspy(
        tmp_path / "map.las", point_format=7, red=values, green=[0, 0], blue=[0, 0]
    )
    colour = read_cloud(path).colour
    assert colour is not None and colour[:, 0].tolist() == expected


def test_withheld_and_noise_points_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    xyz = np.arange(15.0).reshape(5, 3)
    path = write_with_laspy(
        tmp_path / "map.laz",
        xyz=xyz,
        classification=[2, 7, 18, 1, 5],
        withheld=[0, 0, 0, 1, 0],
        gps_time=[1, 2, 3, 4, 5],
    )
    with caplog.at_level(logging.INFO, logger="commonmap"):
        cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz, xyz[[0, 4]])
    np.testing.assert_array_equal(cloud.time, [1.0, 5.0])
    assert "left out 1 withheld points and 2 noise points" in caplog.text
    write_with_laspy(path, xyz=xyz, classification=[7] * 5)
    with pytest.raises(EmptyMapError, match="neither withheld nor noise"):
        read_cloud(path)


# --- coordinate systems and units -------------------------------------------------------------


@pytest.mark.parametrize(("version", "point_format"), [("1.2", 1), ("1.4", 6)])
def test_the_crs_is_read_from_geotiff_keys_and_from_wkt(
    tmp_path: Path, version: str, point_format: int
) -> None:
    path = write_with_laspy(
        tmp_path / "map.laz", version=version, point_format=point_format, crs="EPSG:32612"
    )
    crs = read_cloud(path).crs
    assert crs is not None and CRS.from_wkt(crs).to_epsg() == 32612


def test_the_crs_is_read_from_an_extended_record(tmp_path: Path) -> None:
    path = write_with_laspy(tmp_path / "plain.las")
    with laspy.open(path) as reader:
        data = reader.read()
    data.evlrs = laspy.vlrs.vlrlist.VLRList([WktCoordinateSystemVlr(CRS("EPSG:25833").to_wkt())])
    data.header.global_encoding.wkt = True
    data.write(tmp_path / "map.las")
    crs = read_cloud(tmp_path / "map.las").crs
    assert crs is not None and "UTM zone 33N" in crs


def test_feet_become_metres_with_a_metric_crs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    feet = np.array([[985_000.0, 210_000.0, 100.0], [985_100.0, 210_200.0, 150.0]])
    path = write_with_laspy(tmp_path / "map.laz", xyz=feet, crs=LONG_ISLAND_FEET)
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.xyz, feet * US_FOOT, rtol=1e-9)
    # literal: 985000 US survey feet
    assert cloud.xyz[0, 0] == pytest.approx(300_228.600457, abs=1e-6)
    assert "converted to metres" in caplog.text and "0.3048006096" in caplog.text
    assert cloud.crs is not None
    metric = CRS.from_wkt(cloud.crs)
    assert {axis.unit_name for axis in metric.axis_info} == {"metre"}
    # and the metric CRS puts the point at the same place on Earth
    to_degrees = [
        Transformer.from_crs(CRS(crs).sub_crs_list[0], 6318, always_xy=True).transform(*xy)
        for crs, xy in ((LONG_ISLAND_FEET, feet[0, :2]), (cloud.crs, cloud.xyz[0, :2]))
    ]
    np.testing.assert_allclose(to_degrees[0], to_degrees[1], rtol=0, atol=1e-11)


def test_heights_in_feet_over_a_metric_grid(tmp_path: Path) -> None:
    path = write_with_laspy(tmp_path / "map.laz", crs="EPSG:32612+6360")
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.xyz[0], [470600.01, 3810200.02, 2280.03 * US_FOOT], rtol=1e-9)


def test_a_horizontal_crs_in_feet_alone_speaks_for_z_too(tmp_path: Path) -> None:
    path = write_with_laspy(tmp_path / "map.laz", crs="EPSG:2263")
    np.testing.assert_allclose(read_cloud(path).xyz[0, 2], 2280.03 * US_FOOT, rtol=1e-9)


@pytest.mark.parametrize(("code", "factor"), [(9001, 1.0), (9002, 0.3048), (9003, US_FOOT)])
def test_the_vertical_unit_of_geotiff_keys(tmp_path: Path, code: int, factor: float) -> None:
    path = write_with_laspy(tmp_path / "map.las", version="1.2", point_format=1, crs="EPSG:32612")
    with_geo_keys(path, (4099, code))
    np.testing.assert_allclose(read_cloud(path).xyz[0, 2], 2280.03 * factor, rtol=1e-9)
    np.testing.assert_allclose(read_cloud(path).xyz[0, 0], 470600.01, rtol=1e-12)


def with_geo_keys(path: Path, *entries: tuple[int, int]) -> None:
    """Add keys (id, value) to the GeoTIFF directory of a LAS file."""
    from laspy.vlrs.known import GeoKeyEntryStruct

    with laspy.open(path) as reader:
        data = reader.read()
    keys = data.header.vlrs.get("GeoKeyDirectoryVlr")[0]
    new = {key.id: key.value_offset for key in keys.geo_keys} | dict(entries)
    keys.geo_keys = []
    for name, value in sorted(new.items()):
        entry = GeoKeyEntryStruct()
        entry.id, entry.tiff_tag_location, entry.count, entry.value_offset = name, 0, 1, value
        keys.geo_keys.append(entry)
    keys.geo_keys_header.number_of_keys = len(keys.geo_keys)
    data.write(path)


def test_a_projection_without_a_code_is_not_taken_for_degrees(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_with_laspy(tmp_path / "map.las", version="1.2", point_format=1, crs="EPSG:32612")
    with_geo_keys(path, (1024, 1), (2048, 4269), (3072, 32767), (3076, 9002))
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        cloud = read_cloud(path)
    assert cloud.crs is None
    assert "its projection has no code" in caplog.text
    feet = np.array([470600.01, 3810200.02, 2280.03])
    np.testing.assert_allclose(cloud.xyz[0], feet * 0.3048, rtol=1e-12)


def test_a_foot_crs_bound_to_another_datum_becomes_metric(tmp_path: Path) -> None:
    from commonmap.io.units import to_metres

    wkt = CRS.from_proj4(
        "+proj=lcc +lat_0=40 +lon_0=-74 +lat_1=41 +lat_2=40.6 +x_0=300000 +y_0=0 +datum=NAD27 "
        "+towgs84=-8,160,176 +units=us-ft +no_defs"
    )
    assert wkt.is_bound
    xyz, crs = to_metres(np.array([[1000.0, 2000.0, 30.0]]), wkt.to_wkt(), tmp_path)
    np.testing.assert_allclose(xyz, np.array([[1000.0, 2000.0, 30.0]]) * US_FOOT, rtol=1e-12)
    assert crs is not None
    assert {axis.unit_name for axis in CRS.from_wkt(crs).axis_info} == {"metre"}


@pytest.mark.parametrize(
    ("crs", "word"),
    [("EPSG:4326", "degrees"), ("EPSG:4979", "degrees"), ("EPSG:4978", "geocentric")],
)
def test_coordinates_that_are_no_metres_on_a_plane(tmp_path: Path, crs: str, word: str) -> None:
    path = write_with_laspy(tmp_path / "map.laz", crs=crs, xyz=[[29.0, 41.0, 8.0], [29.1, 41.0, 9]])
    with pytest.raises(UnitsError, match=word):
        read_cloud(path)


def test_a_crs_that_cannot_be_parsed_is_left_out_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_with_laspy(tmp_path / "map.las", crs="EPSG:32612")
    path.write_bytes(
        path.read_bytes().replace(b"PROJCRS[", b"PROJXXX[").replace(b"PROJCS[", b"PX[")
    )
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        assert read_cloud(path).crs is None
    assert "its CRS cannot be read and is left out" in caplog.text


# --- writing ----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_what_is_written_is_las_1_4_to_others(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    xyz = np.array([[470600.1234, 3810200.0, 2280.0], [470650.0, 3810260.0, 2300.0]])
    colour = np.array([[255, 128, 0], [1, 2, 3]], dtype=np.uint8)
    write_cloud(path, Cloud(xyz=xyz, crs="EPSG:32612", colour=colour))
    with laspy.open(path) as reader:
        assert (str(reader.header.version), reader.header.point_format.id) == ("1.4", 7)
        assert reader.header.scales.tolist() == [0.001, 0.001, 0.001]
        assert reader.header.global_encoding.wkt
        crs = reader.header.parse_crs()
        assert crs.to_epsg() == 32612
        data = reader.read()
    assert data.x[0] == pytest.approx(470600.123, abs=1e-9)
    assert data.red[0] == 255 * 257
    np.testing.assert_allclose(data.header.maxs, [470650.0, 3810260.0, 2300.0], atol=1e-9)
    write_cloud(path, Cloud(xyz=xyz))
    with laspy.open(path) as reader:
        assert reader.header.point_format.id == 6


def test_blocks_join_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    xyz = rng.integers(-10_000_000, 10_000_000, (120_001, 3)) / 1000.0
    whole, parts = tmp_path / "whole.laz", tmp_path / "parts.laz"
    write_cloud(whole, Cloud(xyz=xyz))
    monkeypatch.setattr(las, "BLOCK", 7_777)
    write_cloud(parts, Cloud(xyz=xyz))
    assert whole.read_bytes() == parts.read_bytes()
    np.testing.assert_allclose(read_cloud(parts).xyz, xyz, rtol=0, atol=1e-9)


@pytest.mark.parametrize("values", [[0.25, 0.5], [-3.0, 9.0], [1e9, 0.0]])
def test_intensities_of_any_range_come_back_exactly(tmp_path: Path, values: list[float]) -> None:
    path = tmp_path / "map.laz"
    intensity = np.array(values, dtype=np.float32)
    write_cloud(path, Cloud(xyz=np.zeros((2, 3)), intensity=intensity))
    np.testing.assert_array_equal(read_cloud(path).intensity, intensity)
    assert laspy.read(path).intensity.max() == 65535


def test_a_cloud_too_wide_for_las_is_refused(tmp_path: Path) -> None:
    wide = np.array([[0.0, 0.0, 0.0], [5e6, 0.0, 0.0]])
    with pytest.raises(InputError, match="extents up to 4294 km"):
        write_cloud(tmp_path / "map.laz", Cloud(xyz=wide))
    with pytest.raises(InputError, match="not finite"):
        write_cloud(tmp_path / "map.laz", Cloud(xyz=np.full((2, 3), np.nan)))
    assert list(tmp_path.iterdir()) == []


# --- headers that lie -------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("claimed", [3, 60_000, 10**7, 4 * 10**9, 2**60])
def test_a_header_that_claims_more_points(tmp_path: Path, suffix: str, claimed: int) -> None:
    path = write_with_laspy(tmp_path / f"map{suffix}")
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 247, claimed)
    path.write_bytes(data)
    with pytest.raises(InputError, match=str(claimed) if suffix == ".las" else "damaged"):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_no_points(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"map{suffix}"
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=6)).write(path)
    with pytest.raises(EmptyMapError, match="holds no points"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("offset", "code", "value", "words"),
    [
        (96, "<I", 4_000_000_000, "its points should begin at byte 4000000000"),
        (100, "<I", 4_000_000_000, "variable length records"),
        (243, "<I", 4_000_000_000, "extended records"),
        (104, "<B", 63, "point format 63"),
        (105, "<H", 3, "have 30 bytes or more; its header says 3"),
        (131, "<d", 0.0, "scale and offset"),
        (131, "<d", float("nan"), "scale and offset"),
        (94, "<H", 100, "truncated"),
    ],
)
def test_fields_of_the_header_that_cannot_be(
    tmp_path: Path, offset: int, code: str, value: float, words: str
) -> None:
    path = write_with_laspy(tmp_path / "map.las")
    data = bytearray(path.read_bytes())
    struct.pack_into(code, data, offset, value)
    path.write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_cloud(path)


def test_a_laszip_record_of_another_point_format(tmp_path: Path) -> None:
    path = write_with_laspy(tmp_path / "map.laz", point_format=10)
    data = bytearray(path.read_bytes())
    items = struct.pack("<9H", 10, 30, 3, 12, 8, 3, 13, 29, 3)
    at = data.index(items)
    data[at : at + 18] = struct.pack("<9H", 10, 30, 3, 12, 8, 3, 12, 29, 3)
    path.write_bytes(data)  # a decoder would look for layers where there are none
    with pytest.raises(InputError, match="does not describe points of format 10 with 67 bytes"):
        read_cloud(path)


def test_layers_of_a_chunk_that_outgrow_it(tmp_path: Path) -> None:
    path = write_with_laspy(tmp_path / "map.laz")
    data = bytearray(path.read_bytes())
    start = struct.unpack_from("<I", data, 96)[0] + 8 + 30
    count, first_layer = struct.unpack_from("<II", data, start)
    assert count == 2
    struct.pack_into("<I", data, start + 4, 4_000_000_000)  # a decoder would allocate it
    path.write_bytes(data)
    with pytest.raises(InputError, match="LAZ chunk 0 is longer than its bytes"):
        read_cloud(path)
    struct.pack_into("<II", data, start, 1_000_000, first_layer)
    path.write_bytes(data)
    with pytest.raises(InputError, match="chunk 0 says 1000000 points, 2 were expected"):
        read_cloud(path)
