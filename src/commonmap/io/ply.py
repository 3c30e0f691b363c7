"""PLY: ascii, binary little and big endian, properties in any order and of any type.

Only the element `vertex` is read; other elements (faces, cameras) are stepped over, wherever they
stand. A comment line `crs ...` holds the CRS as WKT in files written here.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from commonmap.errors import EmptyMapError, InputError
from commonmap.io.atomic import writing
from commonmap.io.columns import Column, cloud_of, columns_of, require_xyz
from commonmap.io.source import PathLike, look, parsing
from commonmap.io.text import read_rows
from commonmap.types import Cloud

SCALARS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
"""Names of types in PLY headers -> NumPy."""

NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
         "f4": "float", "f8": "double"}  # fmt: skip

ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

MAX_HEADER = 1 << 20


@dataclass(frozen=True)
class Property:
    """A property of an element. count_type: of the length of a list, None for a single number."""

    name: str
    type: str
    count_type: str | None = None


@dataclass(frozen=True)
class Element:
    """An element: its name, how many rows it has, what a row holds."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(p.count_type is not None for p in self.properties)

    def row_type(self, order: str) -> np.dtype[np.void]:
        """Return the structured type of a row without lists."""
        return np.dtype([(f"p{i}", order + p.type) for i, p in enumerate(self.properties)])

    @property
    def min_bytes(self) -> int:
        """Bytes of the shortest row there can be (binary)."""
        return sum(np.dtype(p.count_type or p.type).itemsize for p in self.properties)


@dataclass(frozen=True)
class Header:
    """A PLY header. encoding: a key of `ORDERS`. data_start: byte at which the elements begin."""

    encoding: str
    version: str
    elements: tuple[Element, ...]
    crs: str | None
    data_start: int


def read_ply(path: PathLike) -> Cloud:
    """Return the vertices of a PLY file."""
    path, size, _ = look(path)
    with parsing(path, "PLY"), open(path, "rb") as file:
        header = _read_header(file, path)
        vertex = next((e for e in header.elements if e.name == "vertex"), None)
        if vertex is None:
            names = ", ".join(e.name for e in header.elements) or "none"
            raise InputError(f"{path} has no element 'vertex' (its elements: {names})")
        scalars = [p for p in vertex.properties if p.count_type is None]
        found = require_xyz([p.name for p in scalars], path)
        if vertex.count == 0:
            raise EmptyMapError(f"{path} holds no points")
        if header.encoding == "ascii":
            values = _ascii_values(file, path, size, header, vertex)
        else:
            values = _binary_values(file, path, size, header, vertex)
        columns = {name: values[scalars[i].name] for name, i in found.items()}
    return cloud_of(columns, path, crs=header.crs)


def ply_version(path: Path) -> str:
    """Return version and encoding: "PLY 1.0, binary_little_endian"."""
    path, _, _ = look(path)
    with parsing(path, "PLY"), open(path, "rb") as file:
        header = _read_header(file, path)
    return f"PLY {header.version}, {header.encoding}"


def write_ply(path: PathLike, cloud: Cloud, *, extra: Mapping[str, Column] | None = None) -> None:
    """Write a binary little endian PLY file.

    x, y, z are `float` where that moves no point by more than a millimetre, else `double`.
    extra: name -> (N,) numbers, written as properties of that name.
    """
    path = Path(path)
    columns = {name: _storable(c) for name, c in columns_of(cloud, extra, path).items()}
    lines = ["ply", "format binary_little_endian 1.0", "comment written by commonmap"]
    if cloud.crs is not None:
        lines.append("comment crs " + " ".join(cloud.crs.split()))
    lines.append(f"element vertex {len(cloud.xyz)}")
    for name, column in columns.items():
        lines.append(f"property {NAMES[column.dtype.str[1:]]} {name}")
    rows = np.empty(
        len(cloud.xyz), dtype=[(name, "<" + c.dtype.str[1:]) for name, c in columns.items()]
    )
    for name, column in columns.items():
        rows[name] = column
    with writing(path) as part, open(part, "wb") as file:
        file.write(("\n".join([*lines, "end_header"]) + "\n").encode("utf-8"))
        file.write(rows.data)


def _storable(column: Column) -> Column:
    """Return 8-byte integers, for which PLY has no type, as double."""
    return column.astype(np.float64) if column.dtype.str[1:] in ("i8", "u8") else column


def _read_header(file: BinaryIO, path: Path) -> Header:
    data = file.read(MAX_HEADER)
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise InputError(f"{path} is truncated: its PLY header has no end_header")
    after = data[end + 10 : end + 12]
    skip = 2 if after == b"\r\n" else 1
    if after[:1] not in (b"\n", b"\r", b""):
        raise InputError(f"{path}: its PLY header does not end in a line end_header")
    text = data[:end].decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
    encoding = version = ""
    crs: str | None = None
    elements: list[Element] = []
    for number, line in enumerate(text.split("\n")[1:], start=2):
        words = line.split()
        where = f"{path}, line {number} of the header"
        if not words or words[0] == "obj_info":
            continue
        if words[0] == "comment":
            if len(words) > 2 and words[1] == "crs":
                crs = line.split(None, 2)[2]
        elif words[0] == "format":
            if len(words) != 3 or words[1] not in ORDERS:
                raise InputError(
                    f"{where}: the format is one of {', '.join(ORDERS)}; {line!r} came"
                )
            encoding, version = words[1], words[2]
        elif words[0] == "element":
            if len(words) != 3 or not (words[2].isascii() and words[2].isdigit()):
                raise InputError(f"{where}: an element has a name and a count; {line!r} came")
            elements.append(Element(words[1], int(words[2]), ()))
        elif words[0] == "property" and elements:
            last = elements[-1]
            item = _property(words, where)
            if any(p.name == item.name for p in last.properties):
                raise InputError(f"{where}: the property {item.name} is named twice")
            elements[-1] = Element(last.name, last.count, (*last.properties, item))
        else:
            raise InputError(f"{where}: a PLY header has no line {line[:60]!r}")
    if not encoding:
        raise InputError(f"{path}: its PLY header has no format line")
    return Header(encoding, version, tuple(elements), crs, end + 10 + skip)


def _property(words: list[str], where: str) -> Property:
    if len(words) == 3 and words[1] in SCALARS:
        return Property(words[2], SCALARS[words[1]])
    if len(words) == 5 and words[1] == "list" and words[2] in SCALARS and words[3] in SCALARS:
        count = SCALARS[words[2]]
        if count[0] == "f":
            raise InputError(f"{where}: a list counts in whole numbers; {words[2]} came")
        return Property(words[4], SCALARS[words[3]], count)
    raise InputError(f"{where}: not a property of a PLY header: {' '.join(words)[:60]!r}")


def _binary_values(
    file: BinaryIO, path: Path, size: int, header: Header, vertex: Element
) -> Mapping[str, Column]:
    """Return name -> (N,) of the scalar properties of the vertices."""
    order = ORDERS[header.encoding]
    position = header.data_start
    for element in header.elements:
        if element.count * element.min_bytes > size - position:
            room = (size - position) // element.min_bytes
            raise InputError(
                f"{path} is truncated: its header says {element.count} of {element.name}, "
                f"its bytes hold {'at most ' if element.has_lists else ''}{max(room, 0)}"
            )
        if element is vertex and not element.has_lists:
            rows = np.fromfile(
                file, element.row_type(order), element.count, offset=position - file.tell()
            )
            return {p.name: rows[f"p{i}"] for i, p in enumerate(element.properties)}
        if not element.has_lists:
            position += element.count * element.min_bytes
            continue
        file.seek(position)
        values, used = _walk_rows(file.read(), element, order, path, keep=element is vertex)
        if element is vertex:
            return values
        position += used
    raise AssertionError("the vertex element is one of the elements")


def _walk_rows(
    data: bytes, element: Element, order: str, path: Path, *, keep: bool
) -> tuple[dict[str, Column], int]:
    """Step through rows that hold lists; return the scalars (if `keep`) and the bytes used."""
    readers = [
        (p, struct.Struct((order or "<") + np.dtype(p.count_type or p.type).char))
        for p in element.properties
    ]
    kept: dict[str, list[float]] = {p.name: [] for p in element.properties if not p.count_type}
    position = 0
    try:
        for _ in range(element.count):
            for item, reader in readers:
                (value,) = reader.unpack_from(data, position)
                position += reader.size
                if item.count_type is not None:
                    if value < 0:
                        raise InputError(f"{path} is damaged: a list of {value} values")
                    position += value * np.dtype(item.type).itemsize
                elif keep:
                    kept[item.name].append(value)
        if position > len(data):
            raise struct.error
    except struct.error:
        raise InputError(
            f"{path} is truncated: its header says {element.count} of {element.name}, "
            "its bytes end before the last"
        ) from None
    types = {p.name: p.type for p in element.properties}
    return {name: np.array(v, dtype=types[name]) for name, v in kept.items()}, position


def _ascii_values(
    file: BinaryIO, path: Path, size: int, header: Header, vertex: Element
) -> Mapping[str, Column]:
    """Return name -> (N,) of the scalar properties of the vertices, one row a line."""
    file.seek(header.data_start)
    for element in header.elements:
        if element.count * 2 * len(element.properties) > size - header.data_start + 1:
            raise InputError(
                f"{path} is truncated: its header says {element.count} of {element.name}, "
                f"more than its {size - header.data_start} bytes hold"
            )
        if element is vertex:
            break
        for _ in range(element.count if element.properties else 0):
            if not file.readline():
                raise InputError(f"{path} is truncated: it ends within the {element.name} rows")
    if vertex.has_lists:
        return _ascii_rows_with_lists(file, path, vertex)
    rows = read_rows(file, path, n_columns=len(vertex.properties), max_rows=vertex.count)
    if len(rows) != vertex.count:
        raise InputError(
            f"{path} is truncated: its header says {vertex.count} of vertex, {len(rows)} came"
        )
    values: dict[str, Column] = {}
    for i, item in enumerate(vertex.properties):
        values[item.name] = _retyped(rows[:, i], item.type)
    return values


def _retyped(column: Column, code: str) -> Column:
    """Return a column read as float64 in the type that its header states, where it fits.

    Single precision floats stay as read: the text may hold more digits than the type.
    """
    if code[0] == "f":
        return column
    with np.errstate(invalid="ignore", over="ignore"):
        typed = column.astype(code)
    return typed if np.array_equal(typed, column) else column


def _ascii_rows_with_lists(file: BinaryIO, path: Path, vertex: Element) -> dict[str, Column]:
    kept: dict[str, list[float]] = {p.name: [] for p in vertex.properties if not p.count_type}
    for row in range(vertex.count):
        words = file.readline().split()
        at = 0
        try:
            for item in vertex.properties:
                if item.count_type is None:
                    kept[item.name].append(float(words[at]))
                    at += 1
                else:
                    at += 1 + max(int(words[at]), 0)
            if at > len(words):
                raise IndexError
        except (IndexError, ValueError):
            raise InputError(f"{path}: vertex {row} is cut short or holds no numbers") from None
    return {name: np.array(values) for name, values in kept.items()}
