"""PCD of the Point Cloud Library: versions 0.5 to 0.7, ascii, binary and binary_compressed.

Fields may come in any order, type, size and count; `_` is padding. The points are taken as they
stand. A VIEWPOINT other than the identity (0 0 0 1 0 0 0) tells where the sensor was: its position
becomes `origin` of every point, its rotation is not applied (as in PCL). A comment `# crs ...`
holds the CRS as WKT in files written here.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from commonmap.errors import EmptyMapError, InputError
from commonmap.io.atomic import writing
from commonmap.io.columns import Column, cloud_of, columns_of, require_xyz
from commonmap.io.source import PathLike, look, parsing
from commonmap.io.text import read_rows
from commonmap.types import Cloud

TYPES = {
    ("F", 4): "<f4", ("F", 8): "<f8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
    ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
}  # fmt: skip
"""TYPE and SIZE of a field -> NumPy."""

IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
MAX_HEADER = 1 << 18
MAX_COUNT = 1 << 16


@dataclass(frozen=True)
class Field:
    """A field of a point. type: NumPy's name of it; count: how many values it has."""

    name: str
    type: str
    count: int

    @property
    def n_bytes(self) -> int:
        """Bytes of the field in one point."""
        return np.dtype(self.type).itemsize * self.count


@dataclass(frozen=True)
class Header:
    """A PCD header. viewpoint: x y z qw qx qy qz. data: ascii, binary or binary_compressed."""

    version: str
    fields: tuple[Field, ...]
    n_points: int
    viewpoint: tuple[float, ...]
    data: str
    crs: str | None
    data_start: int

    @property
    def point_bytes(self) -> int:
        """Bytes of one point (binary)."""
        return sum(field.n_bytes for field in self.fields)


def read_pcd(path: PathLike) -> Cloud:
    """Return the points of a PCD file."""
    path, size, _ = look(path)
    with parsing(path, "PCD"), open(path, "rb") as file:
        header = _read_header(file, path)
        names = [field.name for field in header.fields]
        found = require_xyz(names, path)
        if header.n_points == 0:
            raise EmptyMapError(f"{path} holds no points")
        file.seek(header.data_start)
        if header.data == "ascii":
            values = _ascii_values(file, path, size, header)
        elif header.data == "binary":
            values = _binary_values(file, path, size, header)
        else:
            values = _compressed_values(file, path, size, header)
        columns = {name: values[i] for name, i in found.items() if header.fields[i].count == 1}
        for name in ("rgb", "rgba"):
            if name in names and "red" not in columns:
                columns |= _unpacked_colour(values[names.index(name)])
        require_xyz(list(columns), path)
    cloud = cloud_of(columns, path, crs=header.crs)
    if header.viewpoint == IDENTITY or cloud.origin is not None:
        return cloud
    origin = np.tile(np.array(header.viewpoint[:3], dtype=np.float32), (len(cloud.xyz), 1))
    return replace(cloud, origin=origin)


def pcd_version(path: Path) -> str:
    """Return version and encoding: "PCD 0.7, binary_compressed"."""
    path, _, _ = look(path)
    with parsing(path, "PCD"), open(path, "rb") as file:
        header = _read_header(file, path)
    return f"PCD {header.version}, {header.data}"


def write_pcd(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    """Write a binary PCD 0.7 file; colour goes into the packed float `rgb`, as PCL has it.

    x, y, z are 4-byte floats where that moves no point by more than a millimetre, else 8-byte.
    extra: name -> (N,) numbers, written as fields of that name.
    """
    path = Path(path)
    columns = columns_of(cloud, extra, path)
    if cloud.colour is not None:
        for name in ("red", "green", "blue"):
            del columns[name]
        packed = (cloud.colour.astype(np.uint32) << np.array([16, 8, 0], dtype=np.uint32)).sum(
            axis=1, dtype=np.uint32
        )
        columns["rgb"] = packed.view(np.float32)
    n = len(cloud.xyz)
    dtypes = {name: column.dtype.newbyteorder("<") for name, column in columns.items()}
    lines = ["# .PCD v0.7 - Point Cloud Data file format"]
    if cloud.crs is not None:
        lines.append("# crs " + " ".join(cloud.crs.split()))
    lines += [
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(dtype.itemsize) for dtype in dtypes.values()),
        "TYPE " + " ".join(dtype.kind.upper() for dtype in dtypes.values()),
        "COUNT " + " ".join("1" for _ in columns),
        f"WIDTH {n}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {n}",
        "DATA binary",
    ]
    rows = np.empty(n, dtype=list(dtypes.items()))
    for name, column in columns.items():
        rows[name] = column
    with writing(path) as part, open(part, "wb") as file:
        file.write(("\n".join(lines) + "\n").encode("utf-8"))
        file.write(rows.data)


def _read_header(file: BinaryIO, path: Path) -> Header:
    entries: dict[str, list[str]] = {}
    crs: str | None = None
    while "DATA" not in entries:
        line = file.readline(MAX_HEADER)
        if not line or file.tell() > MAX_HEADER:
            raise InputError(f"{path} is truncated: its PCD header has no DATA line")
        words = line.decode("utf-8", "replace").split()
        if words[:2] == ["#", "crs"]:
            crs = " ".join(words[2:])
        if words and not words[0].startswith("#"):
            entries["FIELDS" if words[0] == "COLUMNS" else words[0]] = words[1:]
    names = entries.get("FIELDS", [])
    if not names:
        raise InputError(f"{path}: its PCD header has no FIELDS")
    counts = _numbers(entries.get("COUNT", ["1"] * len(names)), "COUNT", len(names), path)
    sizes = _numbers(entries.get("SIZE", ["4"] * len(names)), "SIZE", len(names), path)
    kinds = entries.get("TYPE", ["F"] * len(names))
    if len(kinds) != len(names):
        raise InputError(f"{path}: its PCD header has {len(names)} fields and {len(kinds)} TYPEs")
    fields = []
    for name, kind, n_bytes, count in zip(names, kinds, sizes, counts, strict=True):
        if (kind, n_bytes) not in TYPES:
            raise InputError(f"{path}: field {name} is of type {kind} {n_bytes}, unknown in PCD")
        if count > MAX_COUNT or (count == 0 and name != "_"):
            raise InputError(f"{path}: field {name} has a COUNT of {count}")
        fields.append(Field(name, TYPES[kind, n_bytes], count))
    width = _numbers(entries.get("WIDTH", ["0"]), "WIDTH", 1, path)[0]
    height = _numbers(entries.get("HEIGHT", ["1"]), "HEIGHT", 1, path)[0]
    n_points = width * height
    if "POINTS" in entries:
        n_points = _numbers(entries["POINTS"], "POINTS", 1, path)[0]
        if "WIDTH" in entries and n_points != width * height:
            raise InputError(f"{path}: its header says {n_points} points and {width} x {height}")
    try:
        viewpoint = tuple(float(word) for word in entries.get("VIEWPOINT", map(str, IDENTITY)))
    except ValueError:
        viewpoint = ()
    if len(viewpoint) != 7 or not np.isfinite(viewpoint).all():
        raise InputError(f"{path}: VIEWPOINT holds seven numbers; {entries['VIEWPOINT']} came")
    data = (entries["DATA"] or [""])[0]
    if data not in ("ascii", "binary", "binary_compressed"):
        raise InputError(f"{path}: DATA is ascii, binary or binary_compressed; {data!r} came")
    version = (entries.get("VERSION") or ["0.7"])[0]
    version = f"0{version}" if version.startswith(".") else version
    return Header(version, tuple(fields), n_points, viewpoint, data, crs, file.tell())


def _numbers(words: list[str], name: str, n: int, path: Path) -> list[int]:
    if len(words) != n or not all(w.isascii() and w.isdigit() and len(w) < 19 for w in words):
        raise InputError(
            f"{path}: {name} of its PCD header holds {n} whole number{'s' * (n > 1)}; "
            f"{' '.join(words)[:60]!r} came"
        )
    return [int(word) for word in words]


def _check_room(path: Path, header: Header, room: int) -> None:
    if header.n_points > room:
        raise InputError(
            f"{path} is truncated: its header says {header.n_points} points, its bytes hold {room}"
        )


def _binary_values(file: BinaryIO, path: Path, size: int, header: Header) -> list[Column]:
    """Return each field, (N,), or (N, count) where it has several values."""
    _check_room(path, header, (size - header.data_start) // header.point_bytes)
    row = np.dtype([(f"f{i}", f.type, (f.count,)) for i, f in enumerate(header.fields)])
    file.seek(header.data_start)
    rows = np.fromfile(file, row, header.n_points)
    _check_room(path, header, len(rows))
    return [_flat(rows[f"f{i}"]) for i in range(len(header.fields))]


def _compressed_values(file: BinaryIO, path: Path, size: int, header: Header) -> list[Column]:
    """The same, field after field, of an LZF stream behind its packed and unpacked size."""
    from commonmap.io.lzf import decompress

    sizes = file.read(8)
    room = size - header.data_start - 8
    n_packed, n_bytes = struct.unpack("<II", sizes) if len(sizes) == 8 else (0, 0)
    if room < 0 or n_packed > room:
        raise InputError(
            f"{path} is truncated: {n_packed} compressed bytes should follow, {max(room, 0)} came"
        )
    if n_bytes != header.n_points * header.point_bytes:
        raise InputError(
            f"{path} is damaged: {header.n_points} points of {header.point_bytes} bytes are not "
            f"the {n_bytes} bytes that it holds unpacked"
        )
    data = decompress(np.frombuffer(file.read(n_packed), dtype=np.uint8), n_bytes)
    values: list[Column] = []
    position = 0
    for field in header.fields:
        end = position + field.n_bytes * header.n_points
        values.append(_flat(data[position:end].view(field.type).reshape(-1, max(field.count, 1))))
        position = end
    return values


def _ascii_values(file: BinaryIO, path: Path, size: int, header: Header) -> list[Column]:
    n_columns = sum(field.count for field in header.fields)
    _check_room(path, header, (size - header.data_start + 1) // (2 * n_columns))
    rows = read_rows(file, path, n_columns=n_columns, max_rows=header.n_points)
    _check_room(path, header, len(rows))
    values: list[Column] = []
    position = 0
    for field in header.fields:
        column = _flat(rows[:, position : position + field.count])
        if field.name in ("rgb", "rgba") and field.count == 1 and not field.type.startswith("<f"):
            column = column.astype(np.uint32)
        elif field.name == "rgb" and field.count == 1:
            column = _ascii_rgb(column)
        elif np.dtype(field.type).kind != "f":
            with np.errstate(invalid="ignore"):
                column = column.astype(field.type)
        values.append(column)
        position += field.count
    return values


def _ascii_rgb(column: Column) -> Column:
    """Return the packed colours of a text: a float's bits (below 1), or the number itself."""
    with np.errstate(invalid="ignore", over="ignore"):
        if np.abs(column).max(initial=0.0) >= 1.0:
            return column.astype(np.uint32)
        return column.astype(np.float32).view(np.uint32)


def _flat(column: Column) -> Column:
    return column[:, 0] if column.shape[1] == 1 else column


def _unpacked_colour(packed: Column) -> dict[str, Column]:
    """Return red, green and blue of PCL's packed colour (0x00RRGGBB in four bytes)."""
    if packed.ndim != 1 or packed.dtype.itemsize != 4:
        return {}
    bits = np.ascontiguousarray(packed).view(np.uint32)
    return {
        name: (bits >> np.uint32(shift) & np.uint32(255)).astype(np.uint8)
        for name, shift in (("red", 16), ("green", 8), ("blue", 0))
    }
