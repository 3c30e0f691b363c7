"""GeoTIFF: layers of a grid as bands, north up, cell `[0, ny - 1]` in the upper left corner."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap.errors import InputError
from commonmap.io.atomic import PathLike, writing
from commonmap.io.source import log, look, parsing
from commonmap.types import GridMap

MOST_CELLS_A_BYTE = 1100
"""What compression can pack into a byte at most, of cells of a byte each (deflate: 1032)."""


def write_geotiff(
    path: PathLike,
    layers: Mapping[str, NDArray[Any]],
    *,
    origin: ArrayLike,
    cell: float,
    crs: str | None = None,
) -> None:
    """Write a float32 GeoTIFF with one band for each layer, named by its band description.

    layers: name -> (nx, ny) numbers or bools in the convention of `GridMap` (i along x, j along
        y); NaN is unknown, and the file's nodata value.
    origin: (2,) metres, the lower corner of cell [0, 0]. cell: metres. crs: WKT.
    """
    corner = np.asarray(origin, dtype=np.float64)
    shapes = {name: np.shape(layer) for name, layer in layers.items()}
    if not layers or len(set(shapes.values())) != 1:
        raise InputError(f"{path}: layers must be arrays of one shape (nx, ny); {shapes} came")
    shape = next(iter(shapes.values()))
    if len(shape) != 2 or 0 in shape:
        raise InputError(f"{path}: a layer must be of shape (nx, ny); {shape} came")
    if corner.shape != (2,) or not np.isfinite(corner).all():
        raise InputError(f"{path}: origin is a finite x, y; {corner.tolist()} came")
    if not (math.isfinite(cell) and cell > 0):
        raise InputError(f"{path}: cell is a positive number of metres; {cell} came")
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.io import MemoryFile
    from rasterio.transform import Affine

    nx, ny = shape
    with writing(path) as part:
        try:
            # in memory first: GDAL does not tell when a disk is full
            with rasterio.Env(), MemoryFile() as memory:
                with memory.open(
                    driver="GTiff",
                    width=nx,
                    height=ny,
                    count=len(layers),
                    dtype="float32",
                    nodata=math.nan,
                    crs=_raster_crs(crs, path),
                    transform=Affine(cell, 0.0, corner[0], 0.0, -cell, corner[1] + ny * cell),
                    compress="deflate",
                    predictor=3,
                    interleave="band",
                    BIGTIFF="IF_SAFER",
                ) as raster:
                    for band, (name, layer) in enumerate(layers.items(), start=1):
                        raster.write(_north_up(layer, name, path), band)
                        raster.set_band_description(band, name)
                part.write_bytes(memory.getbuffer())
        except RasterioError as error:
            raise InputError(f"{path} is not written: {error}") from error


def read_geotiff(path: PathLike) -> tuple[GridMap, str | None]:
    """Return the bands of a GeoTIFF as layers, and its CRS as WKT.

    Layers are float32 (nx, ny) in the convention of `GridMap`, named by the band descriptions
    (`band1`, ... where a band has none); nodata becomes NaN. A raster that is turned, or whose
    cells are not square, raises `InputError`.
    """
    path, size, _ = look(path)
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with parsing(path, "GeoTIFF"), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as raster:
            T = raster.transform
            square = T.a > 0 and abs(T.a + T.e) <= 1e-9 * T.a
            if not square or T.b != 0 or T.d != 0:
                raise InputError(
                    f"{path} must be north up with square cells; its transform is {tuple(T)[:6]}"
                )
            cells = raster.width * raster.height * raster.count
            if cells > MOST_CELLS_A_BYTE * size:
                raise InputError(
                    f"{path} is damaged: it promises {raster.count} layers of {raster.width} x "
                    f"{raster.height} cells, more than its {size} bytes can hold"
                )
            layers: dict[str, NDArray[np.float32]] = {}
            for band in range(1, raster.count + 1):
                values = raster.read(band, masked=True).astype(np.float32).filled(np.nan)
                name = raster.descriptions[band - 1] or f"band{band}"
                layers[name] = np.ascontiguousarray(values[::-1].T)
            crs = raster.crs.to_wkt() if raster.crs else None
            corner = np.array([T.c, T.f + raster.height * T.e])
    return GridMap(origin=corner, cell=float(T.a), layers=layers), crs


def _north_up(layer: NDArray[Any], name: str, path: PathLike) -> NDArray[np.float32]:
    """Return (nx, ny) as rows of a picture: (ny, nx), greatest y first."""
    values = np.asarray(layer)
    if values.dtype.kind not in "biuf":
        raise InputError(f"{path}: layer {name} must hold numbers; {values.dtype} came")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values.T[::-1], dtype=np.float32)


def _raster_crs(crs: str | None, path: PathLike) -> Any:
    """Return the CRS for the raster; one that GDAL cannot take is told to the log and left out."""
    if crs is None:
        return None
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        return CRS.from_user_input(crs)
    except CRSError as error:
        log.warning("%s: written without its CRS, which GDAL does not know (%s)", path, error)
        return None
