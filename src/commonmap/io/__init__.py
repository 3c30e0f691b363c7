"""Readers and writers of maps, scans, trajectories and rasters; each file whole or not at all."""

from commonmap.io.atomic import writing, writing_all, writing_folder
from commonmap.io.describe import describe
from commonmap.io.formats import (
    READERS,
    WRITERS,
    Reader,
    Writer,
    find_reader,
    find_writer,
    read_cloud,
    read_map,
    write_cloud,
    write_map,
)
from commonmap.io.nav2 import write_nav2_map
from commonmap.io.raster import read_geotiff, write_geotiff
from commonmap.io.scans import iter_scans, write_scans
from commonmap.io.trajectory import read_trajectory, write_trajectory

__all__ = [
    "READERS",
    "WRITERS",
    "Reader",
    "Writer",
    "describe",
    "find_reader",
    "find_writer",
    "iter_scans",
    "read_cloud",
    "read_geotiff",
    "read_map",
    "read_trajectory",
    "write_cloud",
    "write_geotiff",
    "write_map",
    "write_nav2_map",
    "write_scans",
    "write_trajectory",
    "writing",
    "writing_all",
    "writing_folder",
]
