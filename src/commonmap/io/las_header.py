"""The header of a LAS or LAZ file, checked against the file's size before anything is allocated.

Offsets are those of the LAS specification 1.0 to 1.4 (ASPRS).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from commonmap.errors import EmptyMapError, InputError

RECORD_BYTES = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
"""Smallest record of each point format, bytes."""

_CORE, _TIME, _RGB, _WAVE = (6, 20), (7, 8), (8, 6), (9, 29)
_CORE14, _RGB14, _NIR14, _WAVE14 = (10, 30), (11, 6), (12, 8), (13, 29)
ITEMS: dict[int, tuple[tuple[int, int], ...]] = {
    0: (_CORE,), 1: (_CORE, _TIME), 2: (_CORE, _RGB), 3: (_CORE, _TIME, _RGB),
    4: (_CORE, _TIME, _WAVE), 5: (_CORE, _TIME, _RGB, _WAVE),
    6: (_CORE14,), 7: (_CORE14, _RGB14), 8: (_CORE14, _NIR14), 9: (_CORE14, _WAVE14),
    10: (_CORE14, _NIR14, _WAVE14),
}  # fmt: skip
"""Type and bytes of the items of each point format in a LASzip record."""

LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}
"""Compressed layers of a LAZ chunk of each layered point format, without extra bytes."""

LAZ_POINTS_PER_BYTE = 16
"""More points than this in a byte of LAZ, over a whole file, are not believed (seen: 0.1 to 1)."""

LAZ_FREE_POINTS = 1_000_000
"""Up to this many points are believed whatever the size of the file."""

MAX_VLRS = 100_000

METRES_PER_UNIT = {9001: 1.0, 9002: 0.3048, 9003: 1200.0 / 3937.0}
"""EPSG codes of linear units in GeoTIFF keys."""


@dataclass(frozen=True)
class GeoKeys:
    """GeoTIFF keys that laspy does not read. projected: the model is a projection (key 1024), even
    where its code is user-defined. horizontal, vertical: metres per unit (keys 3076 and 4099)."""

    projected: bool = False
    horizontal: float | None = None
    vertical: float | None = None


@dataclass(frozen=True)
class LasInfo:
    """What the header says, once it agrees with the file.

    version: "1.4", say. point_format: 0 to 10. n_points: in the header, checked.
    compressed: LAZ. chunk_size: points per LAZ chunk, None where chunks vary.
    keys: what GeoTIFF keys say beside the code of a CRS.
    """

    version: str
    point_format: int
    record_bytes: int
    n_points: int
    data_start: int
    compressed: bool
    chunk_size: int | None
    keys: GeoKeys


def read_info(path: Path, size: int) -> LasInfo:
    """Return what the header of a LAS/LAZ file says, or raise the `InputError` that it deserves."""
    with open(path, "rb") as file:
        return _read_info(file, path, size)


def _read_info(file: BinaryIO, path: Path, size: int) -> LasInfo:
    head = file.read(375)
    if len(head) < 227:
        raise InputError(f"{path} is truncated: a LAS header has 227 bytes or more, {size} came")
    version = (head[24], head[25])
    if not (1, 0) <= version <= (1, 4):
        raise InputError(f"{path} says it is LAS {version[0]}.{version[1]}; 1.0 to 1.4 are known")
    header_bytes, data_start, n_vlrs = struct.unpack_from("<HII", head, 94)
    format_byte, record_bytes, n_points = struct.unpack_from("<BHI", head, 104)
    evlr_start, n_evlrs = 0, 0
    if version == (1, 4):
        if len(head) < 375 or header_bytes < 375:
            raise InputError(f"{path} is truncated: a LAS 1.4 header has 375 bytes")
        evlr_start, n_evlrs, long_count = struct.unpack_from("<QIQ", head, 235)
        n_points = long_count or n_points
    compressed, point_format = bool(format_byte & 0xC0), format_byte & 0x3F
    if point_format not in RECORD_BYTES:
        raise InputError(f"{path} holds LAS point format {point_format}; 0 to 10 are known")
    if record_bytes < RECORD_BYTES[point_format]:
        raise InputError(
            f"{path}: records of point format {point_format} have "
            f"{RECORD_BYTES[point_format]} bytes or more; its header says {record_bytes}"
        )
    if not 227 <= header_bytes <= data_start <= size:
        raise InputError(
            f"{path} is truncated or damaged: its points should begin at byte {data_start} "
            f"and the file has {size} bytes"
        )
    scales = struct.unpack_from("<6d", head, 131)
    if not all(0.0 < abs(scale) <= 1e6 for scale in scales[:3]) or not all(
        abs(offset) < 1e12 for offset in scales[3:]
    ):
        raise InputError(f"{path}: its header has scale and offset {scales}, which cannot be")
    laszip, keys = _walk_vlrs(file, path, header_bytes, data_start, n_vlrs)
    if n_evlrs:
        _check_evlrs(file, path, evlr_start, n_evlrs, size)
    if n_points == 0:
        raise EmptyMapError(f"{path} holds no points")
    info = LasInfo(
        version=f"{version[0]}.{version[1]}",
        point_format=point_format,
        record_bytes=record_bytes,
        n_points=n_points,
        data_start=data_start,
        compressed=compressed,
        chunk_size=None,
        keys=keys,
    )
    if not compressed:
        room = (size - data_start) // record_bytes
        if n_points > room:
            raise InputError(
                f"{path} is truncated: its header says {n_points} points, its bytes hold {room}"
            )
        return info
    if laszip is None:
        raise InputError(f"{path} is compressed but has no LASzip record; it cannot be unpacked")
    return _check_laz(file, path, size, info, laszip)


def _walk_vlrs(
    file: BinaryIO, path: Path, start: int, end: int, n_vlrs: int
) -> tuple[bytes | None, GeoKeys]:
    """Return the LASzip record and the GeoTIFF keys; raise where records overrun."""
    laszip, keys = None, GeoKeys()
    position = start
    for i in range(n_vlrs):
        file.seek(position)
        head = file.read(54)
        length = int.from_bytes(head[20:22], "little")
        if position + 54 + length > end or i >= MAX_VLRS:
            raise InputError(
                f"{path} is damaged: its header says {n_vlrs} variable length records, "
                f"{i} of them fit before the points"
            )
        user, record = head[2:18].rstrip(b"\0"), int.from_bytes(head[18:20], "little")
        if user == b"laszip encoded" and record == 22204:
            laszip = file.read(length)
        elif user == b"LASF_Projection" and record == 34735:
            keys = _geo_keys(file.read(length))
        position += 54 + length
    return laszip, keys


def _geo_keys(directory: bytes) -> GeoKeys:
    """Return what a GeoTIFF key directory says: entries of key, place (0: here), count, value."""
    shorts = struct.unpack(f"<{len(directory) // 2}H", directory[: len(directory) // 2 * 2])
    here = {shorts[i]: shorts[i + 3] for i in range(4, len(shorts) - 3, 4) if shorts[i + 1] == 0}
    return GeoKeys(
        projected=here.get(1024) == 1,
        horizontal=METRES_PER_UNIT.get(here.get(3076, 0)),
        vertical=METRES_PER_UNIT.get(here.get(4099, 0)),
    )


def _check_evlrs(file: BinaryIO, path: Path, start: int, n_evlrs: int, size: int) -> None:
    position = start
    for i in range(n_evlrs):
        if position + 60 > size:
            length = size
        else:
            file.seek(position + 20)
            length = int.from_bytes(file.read(8), "little")
        if position + 60 + length > size or i >= MAX_VLRS:
            raise InputError(
                f"{path} is truncated: its header says {n_evlrs} extended records, "
                f"{i} of them fit in the file"
            )
        position += 60 + length


def _check_laz(file: BinaryIO, path: Path, size: int, info: LasInfo, laszip: bytes) -> LasInfo:
    """Return `info` with the chunk size, once the chunks agree with the count and with the file."""
    believed = LAZ_FREE_POINTS + LAZ_POINTS_PER_BYTE * (size - info.data_start)
    if info.n_points > believed:
        raise InputError(
            f"{path} is truncated or damaged: its header says {info.n_points} points, "
            f"more than {size - info.data_start} compressed bytes hold"
        )
    if len(laszip) < 34:
        raise InputError(f"{path} is damaged: its LASzip record has {len(laszip)} bytes")
    compressor, coder = struct.unpack_from("<HH", laszip, 0)
    (chunk_size,) = struct.unpack_from("<I", laszip, 12)
    (n_items,) = struct.unpack_from("<H", laszip, 32)
    items = [
        struct.unpack_from("<HH", laszip, 34 + 6 * i)
        for i in range(n_items)
        if 40 + 6 * i <= len(laszip)
    ]
    layered = info.point_format >= 6
    if coder != 0 or compressor not in ((3,) if layered else (1, 2)) or items != _items(info):
        raise InputError(
            f"{path} is damaged: its LASzip record does not describe points of format "
            f"{info.point_format} with {info.record_bytes} bytes"
        )
    if compressor == 1:  # pointwise: one stream, no chunks
        return info
    variable = chunk_size == 0xFFFFFFFF
    chunks = _chunk_table(file, path, size, info, laszip, variable)
    if variable:
        room = sum(count for count, _ in chunks)
    else:
        if not 0 < chunk_size <= believed:
            raise InputError(f"{path} is damaged: its LAZ chunks are of {chunk_size} points")
        room = len(chunks) * chunk_size
    if info.n_points > room or (not variable and info.n_points <= room - chunk_size):
        raise InputError(
            f"{path} is truncated or damaged: its header says {info.n_points} points, "
            f"its {len(chunks)} chunks hold {'' if variable else 'up to '}{room}"
        )
    if info.point_format in LAYERS:
        _check_layers(file, path, info, chunks, None if variable else chunk_size)
    return LasInfo(**{**info.__dict__, "chunk_size": None if variable else chunk_size})


def _items(info: LasInfo) -> list[tuple[int, int]]:
    """Return type and bytes of the parts into which LASzip takes a point of this format."""
    items = list(ITEMS[info.point_format])
    extra = info.record_bytes - sum(n_bytes for _, n_bytes in items)
    return [*items, (14 if info.point_format >= 6 else 0, extra)] if extra else items


def _chunk_table(
    file: BinaryIO, path: Path, size: int, info: LasInfo, laszip: bytes, variable: bool
) -> list[tuple[int, int]]:
    """Return (points, bytes) of each chunk, once the bytes fit between header and table.

    The count of points is only meaningful where chunks vary in size.
    """
    import lazrs

    file.seek(info.data_start)
    (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
    if table == -1:  # a writer that could not seek back leaves the place at the end
        file.seek(size - 8)
        (table,) = struct.unpack("<q", file.read(8))
    first = info.data_start + 8
    if not first <= table <= size - 8:
        raise InputError(
            f"{path} is truncated: its chunk table should begin at byte {table} "
            f"and the file has {size} bytes"
        )
    file.seek(table)
    _, n_chunks = struct.unpack("<II", file.read(8))
    if n_chunks * info.record_bytes > table - first:
        raise InputError(
            f"{path} is damaged: its chunk table says {n_chunks} chunks, "
            f"more than {table - first} bytes hold"
        )
    file.seek(info.data_start)
    chunks = [(int(c), int(b)) for c, b in lazrs.read_chunk_table(file, lazrs.LazVlr(laszip))]
    if len(chunks) != n_chunks or sum(b for _, b in chunks) > table - first:
        raise InputError(
            f"{path} is damaged: its chunk table does not fit its {table - first} bytes"
        )
    if variable and any(c <= 0 for c, _ in chunks):
        raise InputError(f"{path} is damaged: its chunk table has an empty chunk")
    return chunks


def _check_layers(
    file: BinaryIO,
    path: Path,
    info: LasInfo,
    chunks: list[tuple[int, int]],
    chunk_size: int | None,
) -> None:
    """Check each chunk of a layered point format: one raw point, a count, the bytes of each layer.

    A decoder allocates what these numbers say before it reads, so they must fit their chunk.
    """
    n_layers = LAYERS[info.point_format] + info.record_bytes - RECORD_BYTES[info.point_format]
    position = info.data_start + 8
    left = info.n_points
    for index, (points, n_bytes) in enumerate(chunks):
        expected = points if chunk_size is None else min(chunk_size, left)
        file.seek(position + info.record_bytes)
        head = file.read(4 + 4 * n_layers)
        fits = len(head) == 4 + 4 * n_layers and info.record_bytes + len(head) <= n_bytes
        count, *layers = struct.unpack(f"<{1 + n_layers}I", head) if fits else (0,)
        if not fits or info.record_bytes + len(head) + sum(layers) > n_bytes:
            raise InputError(f"{path} is damaged: LAZ chunk {index} is longer than its bytes")
        if count != expected:
            raise InputError(
                f"{path} is truncated or damaged: LAZ chunk {index} says {count} points, "
                f"{expected} were expected"
            )
        position += n_bytes
        left -= expected
