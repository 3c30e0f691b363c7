"""PCD: versions, encodings, field layouts, packed colours, LZF, and headers that lie."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commonmap.errors import EmptyMapError, InputError
from commonmap.io import read_cloud, write_cloud
from commonmap.io.lzf import decompress
from commonmap.io.pcd import pcd_version
from commonmap.types import Cloud


def lzf_compress(data: bytes) -> bytes:
    """Return an LZF stream of `data`: slow and greedy, with literals, short and long copies."""
    out, literals, i = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend([len(run) - 1, *run])
        literals.clear()

    while i < len(data):
        best, length = -1, 0
        for j in range(max(0, i - 8192), i):
            k = 0
            while k < 264 and i + k < len(data) and data[j + k] == data[i + k]:
                k += 1
            if k > length:
                best, length = j, k
        if length < 3:
            literals.append(data[i])
            i += 1
            continue
        flush()
        back = i - best - 1
        if length - 2 < 7:
            out.extend([(length - 2) << 5 | back >> 8, back & 255])
        else:
            out.extend([7 << 5 | back >> 8, length - 2 - 7, back & 255])
        i += length
    flush()
    return bytes(out)


HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS {fields}
SIZE {size}
TYPE {type}
COUNT {count}
WIDTH {n}
HEIGHT 1
VIEWPOINT {viewpoint}
POINTS {n}
DATA {data}
"""


def header(
    data: str,
    *,
    n: int = 2,
    fields: str = "x y z",
    size: str = "4 4 4",
    type: str = "F F F",
    count: str = "1 1 1",
    viewpoint: str = "0 0 0 1 0 0 0",
) -> bytes:
    return HEADER.format(
        fields=fields, size=size, type=type, count=count, n=n, viewpoint=viewpoint, data=data
    ).encode()


# --- LZF --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("packed", "unpacked"),
    [
        (b"\x00A", b"A"),
        (b"\x02ABC", b"ABC"),
        (b"\x02ABC\x20\x02", b"ABCABC"),  # copy 3 from 3 back
        (b"\x00A\x20\x00", b"AAAA"),  # overlapping copy of 3 from 1 back
        (b"\x00A\xe0\x01\x00", b"A" * 11),  # long copy: 7 + 1 + 2
        (b"", b""),
    ],
)
def test_lzf_literally(packed: bytes, unpacked: bytes) -> None:
    array = np.frombuffer(packed, dtype=np.uint8)
    assert decompress(array, len(unpacked)).tobytes() == unpacked


@pytest.mark.parametrize(
    ("packed", "n"),
    [
        (b"\x05AB", 6),  # literals run over the end
        (b"\x20\x00", 3),  # copy before the beginning
        (b"\x00A\x21\x00", 4),  # 257 back
        (b"\x00A\xe0", 10),  # cut within a copy
        (b"\x00A\xe0\x01", 10),
        (b"\x00A", 2),  # too short
        (b"\x02ABC", 2),  # too long
        (b"\x00A", 10**12),  # cannot be
    ],
)
def test_lzf_streams_that_are_damaged(packed: bytes, n: int) -> None:
    with pytest.raises(ValueError, match="compressed"):
        decompress(np.frombuffer(packed, dtype=np.uint8), n)


@settings(deadline=None)
@given(st.lists(st.sampled_from([b"a", b"bb", b"abcabcabc", bytes(300), b"\x01\xff"]), max_size=20))
def test_lzf_brings_back_what_was_packed(pieces: list[bytes]) -> None:
    data = b"".join(pieces)
    packed = np.frombuffer(lzf_compress(data), dtype=np.uint8)
    assert decompress(packed, len(data)).tobytes() == data


# --- files ------------------------------------------------------------------------------------


def test_ascii_literally(tmp_path: Path) -> None:
    path = tmp_path / "map.pcd"
    path.write_bytes(header("ascii") + b"1.5 2.5 -3.5\nnan nan nan\n")
    np.testing.assert_array_equal(read_cloud(path).xyz, [[1.5, 2.5, -3.5]])
    assert pcd_version(path) == "PCD 0.7, ascii"


MIXED: dict[str, Any] = dict(
    fields="normal _ z intensity y x rgb",
    size="4 2 8 2 4 4 4",
    type="F U F U F I F",
    count="3 3 1 1 1 1 1",
)
ROWS = [
    ((0.0, 0.0, 1.0), (9, 9, 9), 2278.25, 65535, -7.5, 470600, 0x00FF8001),
    ((1.0, 0.0, 0.0), (9, 9, 9), -1.0, 3, 0.25, 470595, 0x00010203),
]


def check_mixed(cloud: Cloud) -> None:
    np.testing.assert_array_equal(cloud.xyz, [[470600.0, -7.5, 2278.25], [470595.0, 0.25, -1.0]])
    np.testing.assert_array_equal(cloud.intensity, [65535.0, 3.0])
    np.testing.assert_array_equal(cloud.colour, [[255, 128, 1], [1, 2, 3]])


def test_binary_with_any_fields(tmp_path: Path) -> None:
    path = tmp_path / "map.pcd"
    body = b"".join(struct.pack("<3f3HdHfiI", *a, *b, *rest) for a, b, *rest in ROWS)
    path.write_bytes(header("binary", **MIXED) + body)
    check_mixed(read_cloud(path))
    path.write_bytes(header("binary", **MIXED) + body[:-1])
    with pytest.raises(InputError, match="says 2 points, its bytes hold 1"):
        read_cloud(path)


def test_binary_compressed_is_stored_field_by_field(tmp_path: Path) -> None:
    path = tmp_path / "map.pcd"
    columns = list(zip(*ROWS, strict=True))
    codes = ["3f", "3H", "d", "H", "f", "i", "I"]
    plain = b""
    for code, column in zip(codes, columns, strict=True):
        for value in column:
            plain += struct.pack("<" + code, *(value if isinstance(value, tuple) else (value,)))
    packed = lzf_compress(plain)
    sizes = struct.pack("<II", len(packed), len(plain))
    path.write_bytes(header("binary_compressed", **MIXED) + sizes + packed)
    check_mixed(read_cloud(path))
    path.write_bytes(header("binary_compressed", **MIXED) + sizes + packed[:-1])
    with pytest.raises(InputError, match="compressed bytes should follow"):
        read_cloud(path)
    wrong = struct.pack("<II", len(packed), 4_000_000_000)
    path.write_bytes(header("binary_compressed", **MIXED) + wrong + packed)
    with pytest.raises(InputError, match="are not the 4000000000 bytes"):
        read_cloud(path)
    path.write_bytes(
        header("binary_compressed", n=60_000_000) + struct.pack("<II", 9, 720_000_000) + bytes(9)
    )
    with pytest.raises(InputError, match="9 compressed bytes cannot hold 720000000"):
        read_cloud(path)


def test_version_0_5_with_columns_and_without_count_and_points(tmp_path: Path) -> None:
    path = tmp_path / "map.pcd"
    path.write_text(
        "VERSION .5\nCOLUMNS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA ascii\n"
        "1 2 3\n4 5 6\n"
    )
    np.testing.assert_array_equal(read_cloud(path).xyz, [[1, 2, 3], [4, 5, 6]])
    assert pcd_version(path) == "PCD 0.5, ascii"


@pytest.mark.parametrize(
    ("kind", "word"),
    [("F", repr(float(np.array(0x00FF8001, np.uint32).view(np.float32)))), ("U", "16744449")],
)
def test_packed_colours_in_ascii(tmp_path: Path, kind: str, word: str) -> None:
    path = tmp_path / "map.pcd"
    layout: dict[str, Any] = dict(
        fields="x y z rgb", size="4 4 4 4", type=f"F F F {kind}", count="1 1 1 1"
    )
    path.write_bytes(header("ascii", n=1, **layout) + f"1 2 3 {word}\n".encode())
    np.testing.assert_array_equal(read_cloud(path).colour, [[255, 128, 1]])


def test_the_viewpoint_tells_where_the_sensor_was(tmp_path: Path) -> None:
    path = tmp_path / "map.pcd"
    path.write_bytes(header("ascii", viewpoint="10 20 30 0.7071 0 0 0.7071") + b"1 2 3\n4 5 6\n")
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.origin, [[10, 20, 30], [10, 20, 30]])
    path.write_bytes(header("ascii") + b"1 2 3\n4 5 6\n")
    assert read_cloud(path).origin is None


def test_what_is_written_literally(tmp_path: Path) -> None:
    path = tmp_path / "map.pcd"
    colour = np.array([[255, 128, 1]], dtype=np.uint8)
    write_cloud(path, Cloud(xyz=np.array([[470600.123, 2.5, 3.0]]), colour=colour))
    assert path.read_bytes() == header(
        "binary", n=1, fields="x y z rgb", size="8 8 8 4", type="F F F F", count="1 1 1 1"
    ) + struct.pack("<dddI", 470600.123, 2.5, 3.0, 0x00FF8001)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (header("binary", n=10**15), "says 1000000000000000 points, its bytes hold 0"),
        (header("ascii", n=10**15), "its bytes hold 0"),
        (header("zipped"), "DATA is ascii, binary or binary_compressed; 'zipped' came"),
        (header("binary", size="4 4 3"), "field z is of type F 3"),
        (header("binary", count="1 1 99999999"), "has a COUNT of 99999999"),
        (header("binary", count="1 1"), "COUNT of its PCD header holds 3 whole numbers"),
        (header("binary", count="1 1 3"), "has no z among"),
        (header("binary", type="F F"), "has 3 fields and 2 TYPEs"),
        (header("binary", fields="x y w"), "has no z among its columns"),
        (header("binary", viewpoint="0 0 0"), "VIEWPOINT holds seven numbers"),
        (header("ascii").replace(b"POINTS 2", b"POINTS 5"), "says 5 points and 2 x 1"),
        (header("ascii").replace(b"DATA ascii\n", b""), "no DATA line"),
        (header("ascii") + b"1 2 3\n4 500000\n", "a row does not hold the numbers expected"),
        (header("ascii") + b"1 2 3           ", "says 2 points, its bytes hold 1"),
    ],
)
def test_headers_that_lie(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "map.pcd"
    path.write_bytes(data + bytes(40) if "has no z among" in words else data)
    with pytest.raises(InputError, match=words):
        read_cloud(path)


def test_no_points(tmp_path: Path) -> None:
    path = tmp_path / "map.pcd"
    path.write_bytes(header("binary", n=0))
    with pytest.raises(EmptyMapError, match="holds no points"):
        read_cloud(path)
