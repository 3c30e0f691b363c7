"""NPY and NPZ: arrays of NumPy, without pickle, and never larger than the file warrants."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from commonmap.errors import EmptyMapError, InputError
from commonmap.io.atomic import writing
from commonmap.io.columns import Column, check_writable, checked_extra, cloud_of, require_xyz
from commonmap.io.source import PathLike, look, open_bounded, parsing
from commonmap.types import Cloud

MAX_RATIO = 1100
"""Deflate unpacks to at most about 1032 times its size."""

XYZ_KEYS = ("xyz", "points")
ATTRIBUTES = ("colour", "intensity", "time", "origin", "seen_by")


def read_npy(path: PathLike) -> Cloud:
    """Return the points of an .npy file: (N, 3) or wider, or a structured array with x, y, z."""
    path, size, _ = look(path)
    with parsing(path, "NPY"), open_bounded(path) as file:
        columns = _columns(read_array(file, size, path), path, path.name)
    return cloud_of(columns, path)


def read_npz(path: PathLike) -> Cloud:
    """Return the points of an .npz file: key `xyz` or `points` (N, 3), or keys x, y and z.

    Keys colour (N, 3), intensity, time, origin (N, 3), seen_by and crs (text) fill the fields of
    that name.
    """
    path, _, _ = look(path)
    with parsing(path, "NPZ"), open_bounded(path) as file, zipfile.ZipFile(file) as archive:
        members = {
            i.filename.removesuffix(".npy"): i
            for i in archive.infolist()
            if i.filename.endswith(".npy")
        }
        key = next((k for k in XYZ_KEYS if k in members), None)
        if key is not None:
            columns = _columns(_member(archive, members[key], path), path, key)
        else:
            found = require_xyz(list(members), path)
            names = list(members)
            columns = {}
            for axis, i in found.items():
                columns[axis] = _member(archive, members[names[i]], path)
        for name in ATTRIBUTES:
            if name in members and name not in columns:
                columns |= _attribute(name, _member(archive, members[name], path))
        crs: str | None = None
        if "crs" in members:
            text = _member(archive, members["crs"], path)
            crs = str(text) if text.dtype.kind == "U" and text.ndim == 0 else None
        for name, column in columns.items():
            if column.shape != columns["x"].shape or column.ndim != 1:
                raise InputError(
                    f"{path}: {name} has shape {column.shape} beside x of {columns['x'].shape}"
                )
    return cloud_of(columns, path, crs=crs)


def npy_version(path: Path) -> str:
    """Return "NPY 1.0", or "NPZ"."""
    path, _, head = look(path)
    if head.startswith(b"PK"):
        return "NPZ"
    return f"NPY {head[6]}.{head[7]}" if len(head) > 7 else "NPY"


def write_npy(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    """Write x, y, z as float64 (N, 3); nothing else fits (use .npz)."""
    path = Path(path)
    check_writable(cloud, path)
    if extra:
        raise InputError(
            f"{path}: an .npy file holds x, y, z alone; use .npz for {', '.join(extra)}"
        )
    with writing(path) as part, open(part, "wb") as file:
        np.save(file, np.ascontiguousarray(cloud.xyz, dtype=np.float64), allow_pickle=False)


def write_npz(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    """Write `xyz` (N, 3) float64 and one array for each field that the cloud has, compressed."""
    path = Path(path)
    check_writable(cloud, path)
    arrays: dict[str, Column] = {"xyz": np.ascontiguousarray(cloud.xyz, dtype=np.float64)}
    for name in ATTRIBUTES:
        array = getattr(cloud, name)
        if array is not None:
            arrays[name] = array
    taken = {*XYZ_KEYS, *ATTRIBUTES, "crs", "x", "y", "z"}
    arrays |= checked_extra(extra, len(cloud.xyz), taken, path)
    if cloud.crs is not None:
        arrays["crs"] = np.array(cloud.crs)
    with writing(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            # a fixed date: the same map gives the same bytes
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> Column:
    if info.file_size > MAX_RATIO * info.compress_size + 4096:
        raise InputError(
            f"{path} is damaged: {info.filename} cannot unpack to {info.file_size} bytes"
        )
    with archive.open(info) as file:
        return read_array(io.BytesIO(file.read(info.file_size)), info.file_size, path)


def read_array(file: BinaryIO, size: int, path: Path) -> Column:
    """Return one array of an NPY file, once its header fits in `size` bytes; no pickle."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, fortran, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise InputError(f"{path}: NPY versions 1 and 2 are known; {version[0]} came")
    if dtype.hasobject:
        raise InputError(f"{path} holds Python objects; an array of numbers was expected")
    count = math.prod(shape)
    room = (size - file.tell()) // max(dtype.itemsize, 1)
    if count > room:
        raise InputError(
            f"{path} is truncated: its header says {count} values, its bytes hold {max(room, 0)}"
        )
    array = np.frombuffer(file.read(count * dtype.itemsize), dtype=dtype, count=count)
    return array.reshape(shape, order="F" if fortran else "C")


def _columns(array: Column, path: Path, name: str) -> dict[str, Column]:
    """Return the columns of a structured array by name, of a plain one the first three."""
    if array.dtype.names is not None and array.ndim == 1:
        names = list(array.dtype.names)
        found = require_xyz(names, path)
        columns = {meaning: array[names[i]] for meaning, i in found.items()}
        if any(c.ndim != 1 or c.dtype.kind not in "iuf" for c in columns.values()):
            raise InputError(f"{path}: {name} has columns that are not single numbers")
        return columns
    if array.dtype.kind not in "iuf":
        raise InputError(f"{path}: {name} must hold real numbers; an array of {array.dtype} came")
    if array.ndim != 2 or array.shape[1] < 3:
        raise InputError(f"{path}: {name} must be of shape (N, 3) or wider; {array.shape} came")
    if not len(array):
        raise EmptyMapError(f"{path} holds no points")
    return {axis: array[:, i] for i, axis in enumerate("xyz")}


def _attribute(name: str, array: Column) -> dict[str, Column]:
    """Return the columns of one field; none where it holds no numbers."""
    if array.dtype.kind not in "iuf":
        return {}
    if name == "colour" and array.ndim == 2 and array.shape[1] == 3:
        return {colour: array[:, i] for i, colour in enumerate(("red", "green", "blue"))}
    if name == "origin" and array.ndim == 2 and array.shape[1] == 3:
        return {f"origin_{axis}": array[:, i] for i, axis in enumerate("xyz")}
    return {name: array} if array.ndim == 1 else {}
