"""LAS and LAZ: what surveyors, drones and national programmes deliver; laspy and lazrs do it."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.errors import EmptyMapError, InputError
from commonmap.io.atomic import writing
from commonmap.io.columns import Column, check_writable, checked_extra, cloud_of
from commonmap.io.las_header import LasInfo, read_info
from commonmap.io.source import PathLike, log, look, parsing
from commonmap.types import Cloud
from commonmap.version import __version__

BLOCK = 1_000_000
"""Points that are unpacked or packed at a time."""

SCALE = 0.001
"""Resolution of written coordinates, metres."""

NOISE_CLASSES = (7, 18)
"""Low and high noise in the LAS classification: points that the provider says are not real."""

LAZ_DATE = date(2000, 1, 1)
"""Creation date of written files: a fixed one, so that the same map gives the same bytes."""

DETAILED_INTENSITY = "intensity_value"
"""Extra dimension for intensities that are no whole numbers from 0 to 65535."""


def read_las(path: PathLike) -> Cloud:
    """Return the points of a LAS or LAZ file, versions 1.0 to 1.4, point formats 0 to 10.

    Points that the file marks as withheld or as noise (classes 7 and 18) are left out and counted
    in the log. Coordinates in feet become metres. `time` is the file's GPS time. An extra
    dimension `seen_by`, or `origin_x`, `origin_y`, `origin_z`, fills the field of that name.
    """
    path, size, _ = look(path)
    with parsing(path, "LAS/LAZ"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        info = read_info(path, size)
        columns, crs = _read_columns(path, info)
    return cloud_of(columns, path, crs=crs, units=(info.keys.horizontal, info.keys.vertical))


def las_version(path: Path) -> str:
    """Return version and point format of a LAS/LAZ file: "LAZ 1.4, point format 7"."""
    path, size, _ = look(path)
    with parsing(path, "LAS/LAZ"):
        info = read_info(path, size)
    return f"{'LAZ' if info.compressed else 'LAS'} {info.version}, point format {info.point_format}"


def write_las(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    """Write a LAS 1.4 file, LAZ where the suffix is `.laz`: point format 6, or 7 with colour.

    Coordinates are rounded to a millimetre. extra: name -> (N,) numbers, written as extra
    dimensions, as are `origin` and `seen_by`. An intensity that is no whole number from 0 to 65535
    is scaled to that range and kept exactly in the extra dimension `intensity_value`.
    """
    path = Path(path)
    check_writable(cloud, path)
    _require_finite(cloud, path)
    columns = _extra_columns(cloud, extra, path)
    header = _header(cloud, columns, path)
    import laspy
    from lazrs import LazrsError

    compress = path.suffix.lower() == ".laz"
    with writing(path) as part, open(part, "wb+") as file:
        try:
            with laspy.LasWriter(
                file,
                header,
                do_compress=compress,
                laz_backend=laspy.LazBackend.Lazrs if compress else None,
                closefd=False,
            ) as writer:
                for start in range(0, len(cloud.xyz), BLOCK):
                    writer.write_points(_record(cloud, columns, header, start))
        except LazrsError as error:
            raise OSError(str(error)) from error


def _read_columns(path: Path, info: LasInfo) -> tuple[dict[str, Column], str | None]:
    """Return the columns that a cloud needs, block by block, and the CRS as WKT."""
    import laspy

    blocks: list[dict[str, Column]] = []
    withheld = noise = 0
    with open(path, "rb") as file, laspy.open(file, closefd=False) as reader:
        crs = _crs(reader, path, info)
        names = set(reader.header.point_format.dimension_names)
        wanted = [
            name
            for name in (
                "gps_time",
                "red",
                "green",
                "blue",
                "intensity",
                "seen_by",
                DETAILED_INTENSITY,
                "origin_x",
                "origin_y",
                "origin_z",
            )
            if name in names
        ]
        n_read = 0
        for points in reader.chunk_iterator(min(BLOCK, info.n_points)):
            n_read += len(points)
            hidden = np.asarray(points.withheld, dtype=bool)
            false = np.isin(np.asarray(points.classification), NOISE_CLASSES)
            keep = ~(hidden | false)
            withheld += int(hidden.sum())
            noise += int((false & ~hidden).sum())
            block = {axis: np.asarray(points[axis], dtype=np.float64)[keep] for axis in "xyz"}
            for name in wanted:
                block[name] = np.array(points[name])[keep]
            blocks.append(block)
    if n_read != info.n_points:
        raise InputError(
            f"{path} is truncated: its header says {info.n_points} points, {n_read} could be read"
        )
    if withheld or noise:
        log.info("%s: left out %d withheld points and %d noise points", path, withheld, noise)
    columns = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
    if not len(columns["x"]):
        raise EmptyMapError(f"{path} holds no points that are neither withheld nor noise")
    return _as_cloud_columns(columns), crs


def _as_cloud_columns(columns: dict[str, Column]) -> dict[str, Column]:
    """Return the columns under the names of a cloud; those that are zero throughout are absent."""
    detailed = columns.pop(DETAILED_INTENSITY, None)
    if detailed is not None:
        columns["intensity"] = detailed
    time = columns.pop("gps_time", None)
    if time is not None and time.any():
        columns["time"] = time
    if "red" in columns and not any(columns[name].any() for name in ("red", "green", "blue")):
        for name in ("red", "green", "blue"):
            del columns[name]
    if not columns["intensity"].any():
        del columns["intensity"]
    return columns


def _crs(reader: Any, path: Path, info: LasInfo) -> str | None:
    """Return the CRS of a LAS file as WKT, from its WKT record (EVLR too) or its GeoTIFF keys.

    Of a projection that the keys spell out without a code, laspy returns the geographic base: such
    a file is in metres or feet, not in degrees, and its CRS is left out.
    """
    from pyproj.exceptions import CRSError

    if reader.header.evlrs is None and reader.header.version.minor >= 4:
        reader.read_evlrs()
    quiet = logging.getLogger("laspy")
    level = quiet.level
    quiet.setLevel(logging.CRITICAL)
    try:
        crs = reader.header.parse_crs()
    except (CRSError, UnicodeError, ValueError, AttributeError):
        log.warning("%s: its CRS cannot be read and is left out", path)
        return None
    finally:
        quiet.setLevel(level)
    if crs is None:
        return None
    if crs.is_geographic and info.keys.projected:
        log.warning("%s: its projection has no code in the GeoTIFF keys and is left out", path)
        return None
    return str(crs.to_wkt())


def _require_finite(cloud: Cloud, path: Path) -> None:
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError(f"{path} is not written: the cloud has points that are not finite")
    if (high - low).max() / SCALE >= 2.0**32 - 4096:
        raise InputError(
            f"{path} is not written: LAS holds extents up to 4294 km at a millimetre; "
            f"the cloud spreads over {(high - low).max() / 1000.0:.0f} km"
        )


def _header(cloud: Cloud, columns: Mapping[str, Column], path: Path) -> Any:
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    header = laspy.LasHeader(version="1.4", point_format=7 if cloud.colour is not None else 6)
    header.scales = np.full(3, SCALE)
    middle = 0.5 * (cloud.xyz.min(axis=0) + cloud.xyz.max(axis=0))
    header.offsets = np.round(middle / 100.0) * 100.0 + 0.0
    header.creation_date = LAZ_DATE
    header.generating_software = f"commonmap {__version__}"[:32]
    header.global_encoding.wkt = True
    if cloud.crs is not None:
        record = WktCoordinateSystemVlr(_las_wkt(cloud.crs, path))
        header.vlrs.append(record)
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name=name, type=column.dtype) for name, column in columns.items()]
    )
    return header


def _las_wkt(crs: str, path: Path) -> str:
    """Return the CRS as WKT 1 where it can be said so (LAS 1.4 asks for it), else as WKT 2."""
    from pyproj import CRS
    from pyproj.enums import WktVersion
    from pyproj.exceptions import CRSError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            parsed = CRS.from_user_input(crs)
    except (CRSError, UnicodeError) as error:
        raise InputError(f"{path} is not written: its CRS cannot be parsed ({error})") from None
    try:
        return str(parsed.to_wkt(WktVersion.WKT1_GDAL))
    except CRSError:
        return str(parsed.to_wkt())


def _extra_columns(
    cloud: Cloud, extra: Mapping[str, Column] | None, path: Path
) -> dict[str, Column]:
    columns: dict[str, Column] = {}
    if cloud.intensity is not None and not _fits_16_bits(cloud.intensity):
        columns[DETAILED_INTENSITY] = cloud.intensity.astype(np.float32)
    if cloud.origin is not None:
        for i, axis in enumerate("xyz"):
            columns[f"origin_{axis}"] = np.ascontiguousarray(cloud.origin[:, i], dtype=np.float32)
    if cloud.seen_by is not None:
        columns["seen_by"] = cloud.seen_by
    import laspy

    taken = set(columns) | set(laspy.PointFormat(7).dimension_names) | {"x", "y", "z"}
    columns.update(checked_extra(extra, len(cloud.xyz), taken, path))
    return columns


def _fits_16_bits(intensity: Column) -> bool:
    with np.errstate(invalid="ignore"):
        return bool(
            ((intensity >= 0) & (intensity <= 65535) & (intensity == np.floor(intensity))).all()
        )


def _record(cloud: Cloud, columns: Mapping[str, Column], header: Any, start: int) -> Any:
    """Return the point record of one block."""
    import laspy

    part = slice(start, start + BLOCK)
    points = laspy.ScaleAwarePointRecord.zeros(len(cloud.xyz[part]), header=header)
    for i, axis in enumerate("xyz"):
        points[axis] = cloud.xyz[part, i]
    points["return_number"] = np.ones(len(points), dtype=np.uint8)
    points["number_of_returns"] = np.ones(len(points), dtype=np.uint8)
    if cloud.colour is not None:
        for i, name in enumerate(("red", "green", "blue")):
            points[name] = cloud.colour[part, i].astype(np.uint16) * 257
    if cloud.time is not None:
        points["gps_time"] = cloud.time[part]
    if cloud.intensity is not None:
        points["intensity"] = _standard_intensity(cloud.intensity, part)
    for name, column in columns.items():
        points[name] = column[part]
    return points


def _standard_intensity(intensity: Column, part: slice) -> Column:
    """Return the block's intensity as LAS has it, 16 bits; other ranges are scaled to fill them."""
    if _fits_16_bits(intensity):
        return intensity[part].astype(np.uint16)
    finite = np.nan_to_num(intensity, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float64)
    low, high = min(float(finite.min()), 0.0), float(finite.max())
    scaled = (finite[part] - low) / max(high - low, 1e-300) * 65535.0
    return np.rint(scaled).astype(np.uint16)
