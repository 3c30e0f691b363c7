"""Metres or nothing: feet are converted where a CRS names them, degrees and millimetres refused."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from commonmap.errors import InputError, UnitsError
from commonmap.io.source import log
from commonmap.types import Float64s

MAX_EXTENT = 50_000.0
"""A map without a CRS that is wider than this, metres, is not in metres."""

MAX_COORDINATE = 1e8
"""Beyond this, metres, no projected CRS has a place: the point is a blunder."""


def to_metres(
    xyz: Float64s,
    crs: str | None,
    path: Path,
    *,
    units: tuple[float | None, float | None] = (None, None),
) -> tuple[Float64s, str | None]:
    """Return the points in metres, and their CRS as WKT with metric axes.

    xyz: (N, 3) in the units of the CRS. crs: WKT, or None for unknown.
    units: metres per unit of x and y, and of z, where the file states them beside the CRS; the
        CRS goes first where it says the same thing.

    Raises `UnitsError` for a geographic or geocentric CRS. A CRS that cannot be parsed is told to
    the log and left out. Where nothing names the unit of z, it is the horizontal one.
    """
    if crs is None:
        return _without_crs(xyz, path, units), None
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            parsed = CRS.from_user_input(crs)
    except (CRSError, UnicodeError, ValueError):
        log.warning("%s: its CRS cannot be read and is left out", path)
        return _without_crs(xyz, path, units), None
    if parsed.is_geographic:
        raise UnitsError(
            f"{path} is in degrees ({parsed.name}); reproject it to a metric CRS (UTM, say) first"
        )
    if parsed.is_geocentric:
        raise UnitsError(
            f"{path} is in geocentric coordinates ({parsed.name}), whose z is not up; "
            "reproject it to a metric CRS (UTM, say) first"
        )
    horizontal, vertical = _factors(parsed, path)
    if vertical is None:
        vertical = units[1] if units[1] is not None else horizontal
    if horizontal == 1.0 and vertical == 1.0:
        return xyz, parsed.to_wkt()
    _tell(path, parsed.name, horizontal, vertical)
    metric = CRS.from_json_dict(_with_metric_axes(parsed.to_json_dict()))
    return _scaled(xyz, horizontal, vertical), metric.to_wkt()


def check_plausible(xyz: Float64s, crs: str | None, path: Path) -> None:
    """Raise `UnitsError` where coordinates without a CRS prove that they are not metres.

    Degrees: x and y within the ranges of longitude and latitude, spread over less than 0.2, under
    heights that spread over fifty times more. Millimetres: 98 of 100 points spread over more than
    50 km.
    """
    if crs is not None or len(xyz) < 2:
        return
    low, high = np.percentile(xyz, (1.0, 99.0), axis=0)
    x, y, z = high - low
    if max(x, y) > MAX_EXTENT:
        raise UnitsError(
            f"{path} spreads over {max(x, y) / 1000.0:.0f} km if it is in metres; "
            "it seems to be in millimetres, or its points lie in places far apart"
        )
    within = (np.abs(low[:2]) <= (180, 90)).all() and (np.abs(high[:2]) <= (180, 90)).all()
    if within and 0.0 < max(x, y) < 0.2 and z > 50.0 * max(x, y):
        raise UnitsError(
            f"{path} spreads over {x:.4g} by {y:.4g} in x and y but {z:.4g} in z; it seems to be "
            "in degrees of longitude and latitude (reproject it to a metric CRS first)"
        )


def _factors(crs: Any, path: Path) -> tuple[float, float | None]:
    """Return metres per unit of the horizontal axes, and of the vertical axis if there is one."""
    horizontal: set[float] = set()
    vertical: float | None = None
    for axis in crs.axis_info:
        factor = float(axis.unit_conversion_factor)
        if axis.direction in ("up", "down"):
            vertical = factor
        else:
            horizontal.add(factor)
    if len(horizontal) > 1 or not all(np.isfinite(f) and f > 0 for f in horizontal):
        raise InputError(f"{path}: its CRS ({crs.name}) has axes in different units")
    if not horizontal:
        log.warning("%s: its CRS (%s) has no horizontal axes", path, crs.name)
        return 1.0, vertical
    return horizontal.pop(), vertical


def _without_crs(xyz: Float64s, path: Path, units: tuple[float | None, float | None]) -> Float64s:
    horizontal = units[0] if units[0] is not None else 1.0
    vertical = units[1] if units[1] is not None else horizontal
    if (horizontal, vertical) != (1.0, 1.0):
        _tell(path, "its header", horizontal, vertical)
    return _scaled(xyz, horizontal, vertical)


def _tell(path: Path, whose: str, horizontal: float, vertical: float) -> None:
    log.warning(
        "%s: converted to metres from the units of %s (1 unit = %.10g m in x and y, %.10g m in z)",
        path,
        whose,
        horizontal,
        vertical,
    )


def _scaled(xyz: Float64s, horizontal: float, vertical: float) -> Float64s:
    if horizontal == 1.0 and vertical == 1.0:
        return xyz
    scaled: Float64s = xyz * np.array([horizontal, horizontal, vertical])
    return scaled


def _unbound(crs: dict[str, Any]) -> dict[str, Any]:
    """Return the CRS inside one that is bound to another by a datum shift (TOWGS84)."""
    inner: dict[str, Any] = crs["source_crs"] if crs.get("type") == "BoundCRS" else crs
    return inner


def _with_metric_axes(crs: dict[str, Any]) -> dict[str, Any]:
    """Return a CRS (PROJJSON) with its axes in metres; it loses the code of the original."""
    metric = copy.deepcopy(crs)
    parts = [_unbound(part) for part in metric.get("components", [_unbound(metric)])]
    for part in parts:
        for axis in part.get("coordinate_system", {}).get("axis", []):
            axis["unit"] = "metre"
        part.pop("id", None)
        part["name"] = f"{part['name']} in metres"
    metric.pop("id", None)
    if "components" in metric:
        metric["name"] = " + ".join(part["name"] for part in parts)
    return metric
