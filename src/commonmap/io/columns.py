"""Named columns to clouds and back: what PLY, PCD, text and NPZ files have in common."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import EmptyMapError, InputError, UnitsError
from commonmap.io.source import log
from commonmap.io.units import MAX_COORDINATE, check_plausible, to_metres
from commonmap.types import Cloud, Float64s

Column = NDArray[Any]

ALIASES: dict[str, tuple[str, ...]] = {
    "x": ("x", "easting", "east", "coord_x", "x_m"),
    "y": ("y", "northing", "north", "coord_y", "y_m"),
    "z": ("z", "elevation", "height", "altitude", "alt", "coord_z", "z_m"),
    "red": ("red", "r", "diffuse_red"),
    "green": ("green", "g", "diffuse_green"),
    "blue": ("blue", "b", "diffuse_blue"),
    "intensity": ("intensity", "i", "reflectance", "reflectivity"),
    "time": ("time", "gps_time", "gpstime", "timestamp", "t"),
    "origin_x": ("origin_x",),
    "origin_y": ("origin_y",),
    "origin_z": ("origin_z",),
    "seen_by": ("seen_by",),
}
"""Name here -> names in files, in any case; CloudCompare's `scalar_` in front is read over."""

DEGREES = ("lon", "long", "longitude", "lat", "latitude", "lon_deg", "lat_deg", "lng")

FLOAT32_LOSS = 1e-3
"""Where float32 would move a coordinate by more than this, metres, files are written in float64."""


def find(names: list[str]) -> dict[str, int]:
    """Return what the columns of these names mean: name here -> index of the column."""
    clean = [name.strip().strip("\"'").lower().removeprefix("scalar_") for name in names]
    found: dict[str, int] = {}
    for meaning, aliases in ALIASES.items():
        for alias in aliases:
            if alias in clean:
                found[meaning] = clean.index(alias)
                break
    return found


def require_xyz(names: list[str], path: Path) -> dict[str, int]:
    """Return `find(names)`, or raise `InputError` where x, y or z is missing."""
    found = find(names)
    missing = [axis for axis in "xyz" if axis not in found]
    if not missing:
        return found
    if any(name.strip().strip("\"'").lower() in DEGREES for name in names):
        raise UnitsError(
            f"{path} is in degrees (its columns are {_listed(names)}); "
            "reproject it to a metric CRS (UTM, say) first"
        )
    raise InputError(f"{path} has no {' '.join(missing)} among its columns ({_listed(names)})")


def cloud_of(
    columns: Mapping[str, Column],
    path: Path,
    *,
    crs: str | None = None,
    units: tuple[float | None, float | None] = (None, None),
) -> Cloud:
    """Return the cloud of columns named as in `ALIASES`, each (N,).

    units: metres per unit of x and y, and of z, where the file states them beside its CRS.

    Points without finite coordinates are dropped and counted in the log. Raises `EmptyMapError`
    where none is left, `UnitsError` where the coordinates cannot be metres.
    """
    with np.errstate(invalid="ignore"):  # signalling NaN
        xyz = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
        finite = np.isfinite(xyz).all(axis=1)
        finite &= (np.abs(xyz) <= MAX_COORDINATE).all(axis=1)
    dropped = len(xyz) - int(finite.sum())
    if len(xyz) == 0:
        raise EmptyMapError(f"{path} holds no points")
    if dropped == len(xyz):
        raise EmptyMapError(f"{path} holds no points with finite coordinates ({dropped} without)")
    if dropped:
        log.warning(
            "%s: dropped %d of %d points without finite coordinates", path, dropped, len(xyz)
        )
        xyz = xyz[finite]
        columns = {name: column[finite] for name, column in columns.items()}
    metric, crs = to_metres(xyz, crs, path, units=units)
    check_plausible(metric, crs, path)
    return Cloud(
        xyz=metric,
        crs=crs,
        colour=_colour(columns),
        intensity=_as(columns, "intensity", np.float32),
        time=_time(columns),
        origin=_origin(columns) if metric is xyz else None,
        seen_by=_as(columns, "seen_by", np.uint8),
    )


def columns_of(cloud: Cloud, extra: Mapping[str, Column] | None, path: Path) -> dict[str, Column]:
    """Return the columns to write, in a fixed order: x y z, what the cloud has, then `extra`.

    x, y, z come in float32 where that moves no point by more than a millimetre, else in float64.
    extra: name -> (N,) numbers. Raises `InputError` for a wrong length or name.
    """
    check_writable(cloud, path)
    xyz: Column = cloud.xyz
    if float32_suffices(cloud.xyz):
        xyz = cloud.xyz.astype(np.float32)
    columns: dict[str, Column] = {axis: xyz[:, i] for i, axis in enumerate("xyz")}
    if cloud.colour is not None:
        for i, name in enumerate(("red", "green", "blue")):
            columns[name] = cloud.colour[:, i]
    if cloud.intensity is not None:
        columns["intensity"] = cloud.intensity
    if cloud.time is not None:
        columns["time"] = cloud.time
    if cloud.origin is not None:
        for i, axis in enumerate("xyz"):
            columns[f"origin_{axis}"] = cloud.origin[:, i]
    if cloud.seen_by is not None:
        columns["seen_by"] = cloud.seen_by
    columns.update(checked_extra(extra, len(cloud.xyz), set(find(list(columns))), path))
    return columns


def float32_suffices(xyz: Float64s) -> bool:
    """Return whether float32 moves no coordinate by more than a millimetre."""
    finite = xyz[np.isfinite(xyz)]
    if np.abs(finite).max(initial=0.0) > 3e38:
        return False
    return float(np.abs(finite - finite.astype(np.float32)).max(initial=0.0)) <= FLOAT32_LOSS


def check_writable(cloud: Cloud, path: Path) -> None:
    """Raise `InputError` where a cloud has no points, or arrays of unequal length."""
    if cloud.xyz.ndim != 2 or cloud.xyz.shape[1] != 3:
        raise InputError(f"{path}: points must be an (N, 3) array; {cloud.xyz.shape} came")
    n = len(cloud.xyz)
    if n == 0:
        raise EmptyMapError(f"{path} is not written: the cloud holds no points")
    shapes = {"colour": (n, 3), "intensity": (n,), "time": (n,), "origin": (n, 3), "seen_by": (n,)}
    for name, shape in shapes.items():
        array = getattr(cloud, name)
        if array is not None and array.shape != shape:
            raise InputError(f"{path}: {name} must be of shape {shape}; {array.shape} came")


def checked_extra(
    extra: Mapping[str, Column] | None, n: int, taken: set[str], path: Path
) -> dict[str, Column]:
    """Return extra columns as contiguous numbers of up to 8 bytes, or raise `InputError`."""
    columns: dict[str, Column] = {}
    for name, array in (extra or {}).items():
        column = np.asarray(array)
        if not (name.isidentifier() and name.isascii() and len(name) <= 31) or name in taken:
            raise InputError(f"{path}: {name!r} cannot be the name of an extra column")
        if column.shape != (n,):
            raise InputError(f"{path}: {name} must be of shape ({n},); {column.shape} came")
        if column.dtype == np.bool_:
            column = column.astype(np.uint8)
        if column.dtype.kind not in "iuf" or column.dtype.itemsize > 8:
            raise InputError(f"{path}: {name} must hold numbers; {column.dtype} came")
        if column.dtype == np.float16:
            column = column.astype(np.float32)
        columns[name] = column
    return columns


def _as(columns: Mapping[str, Column], name: str, dtype: type[Any]) -> Any:
    """Return a column as `dtype`; None where it is absent or does not fit."""
    column = columns.get(name)
    if column is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        converted = column.astype(dtype)
    if np.issubdtype(dtype, np.integer) and not np.array_equal(converted, column):
        return None
    return converted


def _time(columns: Mapping[str, Column]) -> Float64s | None:
    """Return time where it is in seconds: a column of floats (counts of ticks are left out)."""
    column = columns.get("time")
    if column is None or column.dtype.kind != "f" or not np.isfinite(column).all():
        return None
    return column.astype(np.float64)


def _origin(columns: Mapping[str, Column]) -> Any:
    names = ("origin_x", "origin_y", "origin_z")
    if not all(name in columns for name in names):
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        origin = np.stack([columns[name] for name in names], axis=1).astype(np.float32)
    return origin if np.isfinite(origin).all() else None


def _colour(columns: Mapping[str, Column]) -> NDArray[np.uint8] | None:
    """Return colours as bytes: 16-bit values lose their low byte, floats run from 0 to 1."""
    names = ("red", "green", "blue")
    if not all(name in columns for name in names):
        return None
    colour = np.stack([columns[name] for name in names], axis=1)
    if colour.dtype == np.uint8:
        return colour
    if not np.isfinite(colour).all() or colour.min() < 0 or colour.max() > 65535:
        return None
    if colour.dtype.kind == "f" and colour.max() <= 1.0:
        return np.rint(colour * 255.0).astype(np.uint8)
    if colour.max() > 255:
        return (colour.astype(np.uint32) >> 8).astype(np.uint8)
    return colour.astype(np.uint8)


def _listed(names: list[str]) -> str:
    shown = ", ".join(name.strip()[:30] for name in names[:12])
    return shown + (", ..." if len(names) > 12 else "")
