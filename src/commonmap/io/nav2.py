"""Navigation maps for ROS: a PGM picture and its YAML, as map_saver of ROS 2 (nav2) writes them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from commonmap.errors import InputError
from commonmap.io.atomic import PathLike, writing_all

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Values of nav_msgs/OccupancyGrid."""

PIXELS = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
"""Grey value of each in a trinary picture."""

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
"""What map_saver writes. A pixel is free below 0.196: unknown is (255 - 205) / 255 = 0.19608, so
with the often seen 0.25 every unknown cell would be loaded as free."""


def write_nav2_map(
    stem: PathLike, occupancy: NDArray[Any], *, origin: ArrayLike, cell: float, yaw: float = 0.0
) -> tuple[Path, Path]:
    """Write `stem.pgm` and `stem.yaml`, both or neither, and return their paths.

    occupancy: (nx, ny) integers, cell `[i, j]` as in `GridMap`: -1 unknown, 0 free, 100 occupied;
        other values raise `InputError`.
    origin: (2,) metres, lower corner of cell [0, 0]. cell: metres. yaw: of the grid, radians.
    The first row of the picture is the one of greatest y.
    """
    stem = Path(stem)
    grid = np.asarray(occupancy)
    corner = np.asarray(origin, dtype=np.float64)
    if grid.ndim != 2 or grid.size == 0 or grid.dtype.kind not in "iu":
        raise InputError(
            f"{stem}: occupancy is an (nx, ny) array of -1, 0 and 100; {grid.dtype} "
            f"of shape {grid.shape} came"
        )
    if corner.shape != (2,) or not np.isfinite(corner).all():
        raise InputError(f"{stem}: origin is a finite x, y; {corner.tolist()} came")
    if not (math.isfinite(cell) and cell > 0 and math.isfinite(yaw)):
        raise InputError(f"{stem}: cell is a positive number of metres; {cell} came")
    known = np.isin(grid, list(PIXELS))
    if not known.all():
        raise InputError(
            f"{stem}: occupancy is -1 (unknown), 0 (free) or 100 (occupied); "
            f"{int(grid[~known][0])} came"
        )
    pixels = np.full(grid.shape, PIXELS[UNKNOWN], dtype=np.uint8)
    pixels[grid == FREE] = PIXELS[FREE]
    pixels[grid == OCCUPIED] = PIXELS[OCCUPIED]
    picture = np.ascontiguousarray(pixels.T[::-1])
    pgm, yaml = stem.with_name(stem.name + ".pgm"), stem.with_name(stem.name + ".yaml")
    text = (
        f"image: {_quoted(pgm.name)}\n"
        "mode: trinary\n"
        f"resolution: {_number(cell)}\n"
        f"origin: [{_number(corner[0])}, {_number(corner[1])}, {_number(yaw)}]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESH}\n"
        f"free_thresh: {FREE_THRESH}\n"
    )
    with writing_all(pgm, yaml) as (part_pgm, part_yaml):
        height, width = picture.shape
        part_pgm.write_bytes(f"P5\n{width} {height}\n255\n".encode("ascii") + picture.tobytes())
        part_yaml.write_bytes(text.encode("utf-8"))
    return pgm, yaml


def _number(value: float) -> str:
    """Return a number that YAML 1.1 reads as a float, with all its digits."""
    text = repr(float(value) + 0.0)
    return text if "e" not in text else f"{value:.12f}"


def _quoted(name: str) -> str:
    """Return a file name as YAML: bare where it is plain, else in single quotes."""
    plain = name.isascii() and name.replace("_", "a").replace("-", "a").replace(".", "a").isalnum()
    return name if plain and name[0].isalpha() else "'" + name.replace("'", "''") + "'"
