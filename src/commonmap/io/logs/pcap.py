"""Captures of network packets: pcap and pcapng to UDP payloads, one at a time.

Classic pcap (libpcap, `man pcap-savefile`): both byte orders, micro- and nanoseconds. pcapng
(draft-ietf-opsawg-pcapng): sections of either byte order, several interfaces, `if_tsresol` and
`if_tsoffset`. Ethernet with any number of VLAN tags, Linux cooked captures, loopback and bare IP;
IPv4 and IPv6. Fragments, TCP and everything else is passed over.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from commonmap.errors import InputError
from commonmap.io.source import PathLike, log, look, looks_like, parsing

MAX_RECORD = 1 << 20
"""Bytes of one captured packet above which the capture is damaged (libpcap: 256 kB)."""

CLASSIC: dict[bytes, tuple[str, float]] = {
    b"\xd4\xc3\xb2\xa1": ("<", 1e-6),
    b"\xa1\xb2\xc3\xd4": (">", 1e-6),
    b"\x4d\x3c\xb2\xa1": ("<", 1e-9),
    b"\xa1\xb2\x3c\x4d": (">", 1e-9),
}
"""Magic number of a classic pcap -> byte order, seconds per unit of the second time word."""

PCAPNG = b"\x0a\x0d\x0d\x0a"
SECTION, INTERFACE, OLD_PACKET, SIMPLE_PACKET, PACKET = 0x0A0D0D0A, 1, 2, 3, 6
IPV4, IPV6, VLAN_TAGS = 0x0800, 0x86DD, (0x8100, 0x88A8, 0x9100)
UDP = 17


class Datagram(NamedTuple):
    """A UDP packet. time: seconds, clock of the capturing host. end: bytes of the file read.
    source: address of the sender as bytes. port: the one it was sent to."""

    time: float
    payload: bytes
    source: bytes
    port: int
    end: int

    @property
    def stream(self) -> str:
        """Sender and port in words: "192.168.1.201:2368"."""
        return stream_name(self.source, self.port)


def stream_name(source: bytes, port: int) -> str:
    """Return "192.168.1.201:2368" of an address in bytes and a port."""
    if len(source) == 4:
        return f"{'.'.join(map(str, source))}:{port}"
    words = ":".join(f"{word:x}" for word in struct.unpack(">8H", source))
    return f"[{words}]:{port}"


def is_capture(head: bytes) -> bool:
    """Return whether a file that begins so is a pcap or a pcapng."""
    return head[:4] in CLASSIC or head[:4] == PCAPNG


def iter_datagrams(path: PathLike, *, keep_partial: bool = False) -> Iterator[Datagram]:
    """Yield the UDP packets of a capture in the order of the file.

    A capture that ends within a packet, or in which a length makes no sense, raises `InputError`
    there; with `keep_partial` it ends there, with a warning.
    """
    path, size, head = look(path)
    if not is_capture(head):
        raise InputError(f"{path} should be a capture of packets, but {looks_like(head)}")
    with parsing(path, "a capture of packets"), open(path, "rb") as file:
        records = _classic(file, size) if head[:4] in CLASSIC else _pcapng(file, size)
        try:
            for link, time, data in records:
                found = _udp(link, data)
                if found is not None:
                    source, port, payload = found
                    yield Datagram(time, payload, source, port, file.tell())
        except _Damaged as fault:
            if not keep_partial:
                raise InputError(
                    f"{path} {fault}; what comes before can be read with keep_partial "
                    "(--keep-partial)"
                ) from None
            log.warning("%s %s; what comes before is kept", path, fault)


class _Damaged(Exception):
    """The capture cannot be read on from here; the text says why."""


def _take(file: BinaryIO, n: int, size: int) -> bytes:
    """Return the next n bytes; raise where the file has no such many."""
    at = file.tell()
    if n > MAX_RECORD:
        raise _Damaged(f"is damaged at byte {at}: a packet of {n} bytes cannot be")
    data = file.read(min(n, size - at))
    if len(data) < n:
        raise _Damaged(f"is truncated: it ends at byte {size}, within a packet")
    return data


def _classic(file: BinaryIO, size: int) -> Iterator[tuple[int, float, bytes]]:
    """Yield (link type, time, bytes) of the packets of a classic pcap."""
    header = _take(file, 24, size)
    order, unit = CLASSIC[header[:4]]
    link = struct.unpack(order + "I", header[20:])[0] & 0xFFFF
    record = struct.Struct(order + "IIII")
    while file.tell() < size:
        seconds, fraction, n, _ = record.unpack(_take(file, 16, size))
        yield link, seconds + fraction * unit, _take(file, n, size)


def _pcapng(file: BinaryIO, size: int) -> Iterator[tuple[int, float, bytes]]:
    """Yield (link type, time, bytes) of the packets of a pcapng."""
    order = "<"
    interfaces: list[tuple[int, float, int]] = []
    while file.tell() < size:
        at = file.tell()
        start = _take(file, 8, size)
        if start[:4] == PCAPNG:
            magic = _take(file, 4, size)
            if magic not in (b"\x4d\x3c\x2b\x1a", b"\x1a\x2b\x3c\x4d"):
                raise _Damaged(f"is damaged at byte {at}: it has no byte order")
            order = "<" if magic[0] == 0x4D else ">"
            interfaces = []
            file.seek(at + 8)
        kind, length = struct.unpack(order + "II", start)
        if length < 12 or length % 4:
            raise _Damaged(f"is damaged at byte {at}: a block of {length} bytes cannot be")
        if kind not in (INTERFACE, PACKET, OLD_PACKET, SIMPLE_PACKET):
            if at + length > size:
                raise _Damaged(f"is truncated: it ends at byte {size}, within a block")
            file.seek(at + length)
            continue
        body = _take(file, length - 8, size)[:-4]
        if kind == INTERFACE:
            interfaces.append(_interface(order, body))
            continue
        if kind == SIMPLE_PACKET:
            n, number, ticks, data = *struct.unpack(order + "I", body[:4]), 0, 0, body[4:]
            n = min(n, len(data))
        elif kind == PACKET:
            number, high, low, n = struct.unpack(order + "IIII", body[:16])
            ticks, data = (high << 32) | low, body[20:]
        else:
            number, _, high, low, n = struct.unpack(order + "HHIII", body[:16])
            ticks, data = (high << 32) | low, body[20:]
        if number >= len(interfaces) or n > len(data):
            raise _Damaged(f"is damaged at byte {at}: a packet of no interface, or of no length")
        link, unit, offset = interfaces[number]
        # whole seconds apart: 1.7e18 ns are more digits than a float has
        whole, rest = divmod(ticks, round(1.0 / unit))
        yield link, offset + whole + rest * unit, data[:n]


def _interface(order: str, body: bytes) -> tuple[int, float, int]:
    """Return (link type, seconds per tick, seconds to add) of an interface block."""
    link: int = struct.unpack(order + "H", body[:2])[0]
    unit, offset, at = 1e-6, 0, 8
    while at + 4 <= len(body):
        code, n = struct.unpack(order + "HH", body[at : at + 4])
        value = body[at + 4 : at + 4 + n]
        if code == 0:
            break
        if code == 9 and n == 1:
            power = value[0] & 0x7F
            unit = 2.0**-power if value[0] & 0x80 else 10.0**-power
        if code == 14 and n == 8:
            offset = struct.unpack(order + "q", value)[0]
        at += 4 + n + (-n % 4)
    if not 1e-12 <= unit <= 1.0:
        raise _Damaged(f"is damaged: its clock ticks every {unit:g} s")
    return link, unit, offset


def _udp(link: int, data: bytes) -> tuple[bytes, int, bytes] | None:
    """Return (sender, port, payload) of a captured UDP packet, None of any other."""
    if link == 1:
        at, protocol = 14, int.from_bytes(data[12:14], "big")
        while protocol in VLAN_TAGS and at + 4 <= len(data):
            protocol = int.from_bytes(data[at + 2 : at + 4], "big")
            at += 4
    elif link == 113:
        at, protocol = 16, int.from_bytes(data[14:16], "big")
    elif link == 276:
        at, protocol = 20, int.from_bytes(data[0:2], "big")
    elif link in (0, 108):
        at, protocol = 4, 0
    elif link in (12, 14, 101, 228, 229):
        at, protocol = 0, 0
    else:
        return None
    if protocol == 0 and at < len(data):
        protocol = {4: IPV4, 6: IPV6}.get(data[at] >> 4, 0)
    if protocol == IPV4 and at + 20 <= len(data):
        fragment = int.from_bytes(data[at + 6 : at + 8], "big") & 0x3FFF
        if fragment or data[at + 9] != UDP:
            return None
        source, start = data[at + 12 : at + 16], at + 4 * (data[at] & 0x0F)
    elif protocol == IPV6 and at + 40 <= len(data):
        if data[at + 6] != UDP:
            return None
        source, start = data[at + 8 : at + 24], at + 40
    else:
        return None
    if start + 8 > len(data):
        return None
    port, n = struct.unpack(">HH", data[start + 2 : start + 6])
    return source, port, data[start + 8 : start + max(n, 8)]


def capture_file(path: Path) -> bool:
    """Return whether a path is a file that begins like a capture."""
    return path.is_file() and is_capture(look(path)[2])
