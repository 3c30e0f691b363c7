"""PLY: encodings, byte orders, types, lists and elements in any order, and headers that lie."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from commonmap.errors import EmptyMapError, InputError
from commonmap.io import read_cloud, write_cloud
from commonmap.io.ply import ply_version
from commonmap.types import Cloud

XYZ = [[1.5, 2.5, -3.5], [4.0, 5.0, 6.0]]


def test_an_ascii_file_literally(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    path.write_text(
        "ply\nformat ascii 1.0\ncomment made by hand\nobj_info nothing\nelement vertex 2\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        "property double z\nproperty float x\nproperty float y\nproperty float scalar_Intensity\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "255 0 1 -3.5 1.5 2.5 0.25\n2 3 4 6 4 5 1e2\n3 0 1 1\n"
    )
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz, XYZ)
    np.testing.assert_array_equal(cloud.colour, [[255, 0, 1], [2, 3, 4]])
    np.testing.assert_array_equal(cloud.intensity, [0.25, 100.0])
    assert ply_version(path) == "PLY 1.0, ascii"


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(("order", "name"), [("<", "little"), (">", "big")])
def test_binary_files_literally(tmp_path: Path, order: str, name: str, newline: str) -> None:
    path = tmp_path / "map.ply"
    header = newline.join(
        [
            "ply",
            f"format binary_{name}_endian 1.0",
            "element camera 1",
            "property list uint8 float32 matrix",
            "property int16 id",
            "element marker 2",
            "property float64 value",
            "element vertex 2",
            "property short flag",
            "property double x",
            "property float y",
            "property int z",
            "property list uchar float weights",
            "property double gps_time",
            "end_header",
            "",
        ]
    )
    body = struct.pack(order + "Bffh", 2, 9.0, 9.0, 7) + struct.pack(order + "2d", 8.0, 8.0)
    body += struct.pack(order + "hdfiBffd", 1, 470601.5, 2.5, -3, 2, 0.5, 0.5, 10.0)
    body += struct.pack(order + "hdfiBd", 1, 470600.123, 5.0, 6, 0, 11.5)
    path.write_bytes(header.encode() + body)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz, [[470601.5, 2.5, -3.0], [470600.123, 5.0, 6.0]])
    np.testing.assert_array_equal(cloud.time, [10.0, 11.5])
    path.write_bytes(header.encode() + body[:-1])
    with pytest.raises(InputError, match="truncated"):
        read_cloud(path)


@pytest.mark.parametrize("type_name", ["char", "uchar", "short", "ushort", "int", "uint"])
@pytest.mark.parametrize("order", ["little", "big"])
def test_coordinates_of_every_integer_type(tmp_path: Path, type_name: str, order: str) -> None:
    code = dict(char="b", uchar="B", short="h", ushort="H", int="i", uint="I")[type_name]
    path = tmp_path / "map.ply"
    lines = [f"property {type_name} {axis}" for axis in "xyz"]
    header = f"ply\nformat binary_{order}_endian 1.0\nelement vertex 1\n" + "\n".join(lines)
    packed = struct.pack(("<" if order == "little" else ">") + 3 * code, 1, 2, 100)
    path.write_bytes(header.encode() + b"\nend_header\n" + packed)
    np.testing.assert_array_equal(read_cloud(path).xyz, [[1, 2, 100]])


def test_ascii_vertices_with_lists(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement mark 1\nproperty int a\nelement vertex 2\n"
        "property list uchar int n\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n7\n2 9 9 1.5 2.5 -3.5\n0 4 5 6\n"
    )
    np.testing.assert_array_equal(read_cloud(path).xyz, XYZ)
    path.write_text(path.read_text().replace("0 4 5 6", "3 4 5 6"))
    with pytest.raises(InputError, match="vertex 1 is cut short"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("offset", "width", "type_name"), [(0.0, 50.0, "float"), (470_600.0, 50.0, "double")]
)
def test_coordinates_are_double_where_float_would_lose_a_millimetre(
    tmp_path: Path, offset: float, width: float, type_name: str
) -> None:
    path = tmp_path / "map.ply"
    xyz = np.random.default_rng(0).uniform(0, width, (50, 3)) + np.array([offset, 0, 0])
    write_cloud(path, Cloud(xyz=xyz))
    assert f"property {type_name} x\nproperty {type_name} y\n".encode() in path.read_bytes()
    back = read_cloud(path).xyz
    np.testing.assert_allclose(back, xyz, rtol=0, atol=0 if type_name == "double" else 4e-6)


def test_what_is_written_literally(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    colour = np.array([[1, 2, 3], [4, 5, 6]], dtype=np.uint8)
    write_cloud(path, Cloud(xyz=np.array(XYZ), colour=colour), extra={"tile": np.array([7, 8])})
    assert path.read_bytes() == (
        b"ply\nformat binary_little_endian 1.0\ncomment written by commonmap\n"
        b"element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        b"property uchar red\nproperty uchar green\nproperty uchar blue\nproperty double tile\n"
        b"end_header\n"
        + struct.pack("<fffBBBd", 1.5, 2.5, -3.5, 1, 2, 3, 7.0)
        + struct.pack("<fffBBBd", 4.0, 5.0, 6.0, 4, 5, 6, 8.0)
    )


def test_trimesh_reads_what_is_written(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "map.ply"
    write_cloud(path, Cloud(xyz=np.array(XYZ), crs="EPSG:32612"))
    np.testing.assert_array_equal(np.asarray(trimesh.load(path).vertices), XYZ)


HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{body}end_header\n"
FLOATS = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEADER.format(n=10**15, body=FLOATS), "says 1000000000000000 of vertex, its bytes hold 0"),
        (HEADER.format(n=-1, body=FLOATS), "an element has a name and a count"),
        (HEADER.format(n=1, body="property float x\nproperty float y\n"), "has no z among"),
        (HEADER.format(n=1, body="property quad x\n"), "not a property of a PLY header"),
        (HEADER.format(n=1, body="property list float int x\n"), "counts in whole numbers"),
        (HEADER.format(n=1, body=FLOATS + "property int x\n"), "the property x is named twice"),
        (HEADER.format(n=1, body="nonsense\n"), "has no line 'nonsense'"),
        (HEADER.format(n=1, body=FLOATS).replace("little", "middle"), "the format is one of"),
        (HEADER.format(n=1, body=FLOATS).replace("vertex", "face"), "has no element 'vertex'"),
        (HEADER.format(n=1, body=FLOATS).replace("end_header\n", ""), "no end_header"),
        ("ply\nelement vertex 1\n" + FLOATS + "end_header\n", "no format line"),
        (
            "ply\nformat ascii 1.0\nelement vertex 2\n" + FLOATS + "end_header\n1 2 3\n4 5 \n",
            "a row does not hold the numbers expected",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 3\n"
            + FLOATS
            + "end_header\n1 2 3\n4 5 6       \n",
            "says 3 of vertex, 2 came",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 99999999999\n" + FLOATS + "end_header\n1 2 3\n",
            "more than its 6 bytes hold",
        ),
    ],
)
def test_headers_that_lie(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "map.ply"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_cloud(path)


def test_no_vertices(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    path.write_text(HEADER.format(n=0, body=FLOATS))
    with pytest.raises(EmptyMapError, match="holds no points"):
        read_cloud(path)


def test_an_element_of_empty_rows_does_not_hang(tmp_path: Path) -> None:
    path = tmp_path / "map.ply"
    text = HEADER.format(n=1, body=FLOATS).replace(
        "element vertex", "element nothing 99999999999\nelement vertex"
    )
    path.write_bytes(text.encode() + struct.pack("<3f", 1, 2, 3))
    np.testing.assert_array_equal(read_cloud(path).xyz, [[1, 2, 3]])
    path.write_text(text.replace("binary_little_endian", "ascii") + "1 2 3\n")
    np.testing.assert_array_equal(read_cloud(path).xyz, [[1, 2, 3]])
