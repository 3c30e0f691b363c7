"""What can still be read of a bag that was cut short: ROS 1 (.bag) and MCAP, from the start on.

Both formats are a row of records, and put their index at the end; rosbags needs the index. Here
the records are read one by one until one is not whole.

Sources: http://wiki.ros.org/Bags/Format/2.0 and https://mcap.dev/spec.
"""

from __future__ import annotations

import bz2
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from commonmap.errors import InputError
from commonmap.io.source import log, look, looks_like, reason

MAX_CHUNK = 1 << 30
"""Bytes of an unpacked chunk above which it is damaged (rosbag2 writes 768 kB to some MB)."""

Found = tuple[str, str, int, bytes, bool]
"""Topic, type of the message, time in nanoseconds, bytes, whether it is ROS 1."""


def salvage(path: Path) -> Iterator[Found]:
    """Yield the messages of a .bag or .mcap that are whole, in the order of the file."""
    path, size, head = look(path)
    if head.startswith(b"#ROSBAG V2.0\n"):
        source = _ros1(path, size)
    elif head.startswith(b"\x89MCAP0\r\n"):
        source = _mcap(path, size)
    else:
        raise InputError(f"{path} cannot be salvaged: {looks_like(head)}")
    n = 0
    try:
        for found in source:
            n += 1
            yield found
    except Exception as error:  # a parser's error on damaged bytes, as in `source.parsing`
        log.warning("%s is damaged after %d messages, which are kept (%s)", path, n,
                    reason(error))  # fmt: skip
        return
    log.warning("%s has no usable index: its messages are read in the order of the file", path)


def _unpack(kind: str, data: bytes) -> bytes:
    """Return a chunk's bytes; never more than `MAX_CHUNK`."""
    if kind in ("", "none"):
        return data
    if kind == "bz2":
        return bz2.BZ2Decompressor().decompress(data, MAX_CHUNK)
    if kind == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return bytes(LZ4FrameDecompressor().decompress(data, MAX_CHUNK))
    if kind == "zstd":
        if sys.version_info >= (3, 14):
            from compression.zstd import ZstdDecompressor
        else:
            from backports.zstd import ZstdDecompressor

        return ZstdDecompressor().decompress(data, MAX_CHUNK)
    raise ValueError(f"compression {kind!r} is not known")


def _ros1(path: Path, size: int) -> Iterator[Found]:
    connections: dict[int, tuple[str, str]] = {}
    with open(path, "rb") as file:
        file.seek(13)
        while file.tell() < size:
            header = _ros1_header(_exact(file.read, file.read(4), size - file.tell()))
            length = file.read(4)
            op = header["op"][0]
            data = _exact(file.read, length, size - file.tell())
            if op == 7:
                _ros1_connection(header, data, connections)
            elif op == 5:
                yield from _ros1_chunk(_unpack(header["compression"].decode(), data), connections)


def _ros1_chunk(data: bytes, connections: dict[int, tuple[str, str]]) -> Iterator[Found]:
    at = 0
    while at < len(data):
        n = int.from_bytes(data[at : at + 4], "little")
        header = _ros1_header(data[at + 4 : at + 4 + n])
        at += 4 + n
        n = int.from_bytes(data[at : at + 4], "little")
        body = data[at + 4 : at + 4 + n]
        if len(body) < n or at + 4 > len(data):
            raise ValueError("a message is cut short")
        at += 4 + n
        op = header["op"][0]
        if op == 7:
            _ros1_connection(header, body, connections)
        elif op == 2:
            topic, type_ = connections[int.from_bytes(header["conn"], "little")]
            seconds, nanoseconds = struct.unpack("<II", header["time"])
            yield topic, type_, seconds * 10**9 + nanoseconds, body, True


def _ros1_connection(
    header: dict[str, bytes], data: bytes, connections: dict[int, tuple[str, str]]
) -> None:
    from rosbags.typesys.msg import normalize_msgtype

    inner = _ros1_header(data)
    number = int.from_bytes(header["conn"], "little")
    type_ = str(normalize_msgtype(inner["type"].decode()))
    connections[number] = header["topic"].decode(), type_


def _ros1_header(data: bytes) -> dict[str, bytes]:
    fields = {}
    at = 0
    while at < len(data):
        n = int.from_bytes(data[at : at + 4], "little")
        name, _, value = data[at + 4 : at + 4 + n].partition(b"=")
        fields[name.decode("ascii")] = value
        at += 4 + n
    return fields


def _exact(read: Callable[[int], bytes], length: bytes, left: int) -> bytes:
    """Return the bytes that a length of 4 bytes announces."""
    n = struct.unpack("<I", length)[0]
    if n > left:
        raise EOFError("the file ends within a record")
    return read(n)


def _mcap(path: Path, size: int) -> Iterator[Found]:
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with open(path, "rb") as file:
        file.seek(8)
        while file.tell() + 9 <= size:
            op, n = struct.unpack("<BQ", file.read(9))
            if n > size - file.tell():
                raise EOFError("the file ends within a record")
            if op == 0x02 or op == 0x0F:
                return
            if op not in (3, 4, 5, 6):
                file.seek(n, 1)
                continue
            data = file.read(n)
            if op == 6:
                compression, at = _text(data, 28)
                packed = data[at + 8 : at + 8 + struct.unpack_from("<Q", data, at)[0]]
                yield from _mcap_records(_unpack(compression, packed), schemas, channels)
            else:
                yield from _mcap_record(op, data, schemas, channels)


def _mcap_records(
    data: bytes, schemas: dict[int, str], channels: dict[int, tuple[str, str]]
) -> Iterator[Found]:
    at = 0
    while at + 9 <= len(data):
        op, n = struct.unpack_from("<BQ", data, at)
        if n > len(data) - at - 9:
            raise EOFError("a chunk ends within a record")
        yield from _mcap_record(op, data[at + 9 : at + 9 + n], schemas, channels)
        at += 9 + n


def _mcap_record(
    op: int, data: bytes, schemas: dict[int, str], channels: dict[int, tuple[str, str]]
) -> Iterator[Found]:
    if op == 3:
        schemas[struct.unpack_from("<H", data)[0]] = _text(data, 2)[0]
    elif op == 4:
        number, schema = struct.unpack_from("<HH", data)
        channels[number] = _text(data, 4)[0], schemas.get(schema, "")
    elif op == 5:
        number, _, time, _ = struct.unpack_from("<HIQQ", data)
        if number in channels:
            topic, type_ = channels[number]
            yield topic, type_, time, data[22:], False


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return a text that its length precedes, and where it ends."""
    n = struct.unpack_from("<I", data, at)[0]
    return data[at + 4 : at + 4 + n].decode(), at + 4 + n
