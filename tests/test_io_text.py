"""Point lists as text, and NumPy's files: layouts found out, and what is refused."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from commonmap.errors import EmptyMapError, InputError, UnitsError
from commonmap.io import read_cloud, write_cloud
from commonmap.io.text import text_version
from commonmap.types import Cloud

XYZ = [[1.5, 2.5, -3.5], [4.0, 5.0, 6.0]]


@pytest.mark.parametrize(
    "text",
    [
        "1.5 2.5 -3.5\n4 5 6\n",
        "1.5 2.5 -3.5\n4 5 6",  # no last newline
        "1.5,2.5,-3.5\r\n4,5,6\r\n",
        "1.5;2.5;-3.5\n4;5;6\n",
        "1.5\t2.5\t-3.5\n4\t5\t6\n",
        "  1.5   2.5  -3.5  \n\n 4 5 6\n\n",
        "1.5, 2.5, -3.5,\n4, 5, 6,\n",
        "1.5 2.5 -3.5 99 0\n4 5 6 98 1\n",
        "# a comment\n1.5 2.5 -3.5\n# another\n4 5 6 # and one more\n",
        "% octave\n! fortran\n// c\n1.5 2.5 -3.5\n4 5 6\n",
        "x y z\n1.5 2.5 -3.5\n4 5 6\n",
        "X,Y,Z,Red\n1.5,2.5,-3.5,7\n4,5,6,8\n",
        'id,"Z","X","Y"\n7,-3.5,1.5,2.5\n8,6,4,5\n',
        "name;elevation;easting;northing\nP1;-3.5;1.5;2.5\nP2;6;4;5\n",
        "//Z X Y\n-3.5 1.5 2.5\n6 4 5\n",  # CloudCompare
        "2\n1.5 2.5 -3.5 -1200 10 20 30\n4 5 6 -1100 1 2 3\n",  # PTS
        "//X Y Z\n2\n1.5 2.5 -3.5\n4 5 6\n",  # CloudCompare with a count
        "\ufeffx,y,z\n1.5,2.5,-3.5\n4,5,6\n",
        "1.5e0 25E-1 -3.5\n4. 5.0 +6\n",
    ],
)
def test_layouts(tmp_path: Path, text: str) -> None:
    path = tmp_path / "map.txt"
    path.write_bytes(text.encode("utf-8"))
    np.testing.assert_array_equal(read_cloud(path).xyz, XYZ)


def test_named_columns_fill_the_fields(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    path.write_text("x,y,z,R,G,B,Intensity,GPS_Time\n1,2,3,255,0,7,0.5,10.25\n4,5,6,0,1,2,3,11\n")
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.colour, [[255, 0, 7], [0, 1, 2]])
    np.testing.assert_array_equal(cloud.intensity, [0.5, 3.0])
    np.testing.assert_array_equal(cloud.time, [10.25, 11.0])
    assert text_version(path) == "text, comma, 8 columns"


def test_every_digit_of_a_coordinate_is_kept(tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).uniform(0, 1, (100, 3)) + np.array([470_600, 3_810_200, 2_278])
    for suffix in (".xyz", ".csv"):
        write_cloud(tmp_path / f"map{suffix}", Cloud(xyz=xyz))
        np.testing.assert_array_equal(read_cloud(tmp_path / f"map{suffix}").xyz, xyz)


def test_what_is_written_literally(tmp_path: Path) -> None:
    colour = np.array([[1, 2, 3], [4, 5, 6]], dtype=np.uint8)
    write_cloud(tmp_path / "map.csv", Cloud(xyz=np.array(XYZ), colour=colour))
    assert (tmp_path / "map.csv").read_text() == (
        "x,y,z,red,green,blue\n1.5,2.5,-3.5,1,2,3\n4.0,5.0,6.0,4,5,6\n"
    )
    write_cloud(tmp_path / "map.xyz", Cloud(xyz=np.array(XYZ)))
    assert (tmp_path / "map.xyz").read_text() == "x y z\n1.5 2.5 -3.5\n4.0 5.0 6.0\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2\n3 4\n", "rows hold x, y and z or more; 2 came"),
        ("1 2 3\n4 5\n", "a row does not hold the numbers expected"),
        ("1,2,3\n4,,6\n", "a row does not hold the numbers expected"),
        ("1,2,3\n4,five,6\n", "a row does not hold the numbers expected"),
        ("time,px,py,pz\n1,2,3,4\n", r"has no x y z among its columns \(time, px, py, pz\)"),
        ("x,y\n1,2\n", "has no z among"),
        ("x,y,z\n1,2\n", "its header names 3 columns, rows have 2"),
        ("x,y,z\na,b,c\n", "a row does not hold the numbers expected"),
        ("3\n1 2 3\n4 5 6\n", "its first line says 3 points, 2 came"),
        ("1,5;2,5;-3,5\n4,0;5,0;6,0\n", r"decimal commas \(1,5\)"),
        ("1,5 2,5 3,5\n4 5 6\n", r"decimal commas \(1,5\)"),
        ("ncols 3\nnrows 2\nxllcorner 0\n1 2 3\n4 5 6\n", "is an ESRI grid"),
        ("hello\n", "holds no points"),
    ],
)
def test_texts_that_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "map.asc"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_cloud(path)


def test_longitude_and_latitude_by_name(tmp_path: Path) -> None:
    path = tmp_path / "map.csv"
    path.write_text("lon,lat,z\n29.02,41.1,80\n29.03,41.1,81\n")
    with pytest.raises(UnitsError, match="degrees"):
        read_cloud(path)


def test_utf_16_and_bytes_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "map.txt"
    path.write_bytes("1 2 3\n".encode("utf-16"))
    with pytest.raises(InputError, match="UTF-16"):
        read_cloud(path)
    path.write_bytes(bytes(range(256)) * 4)
    with pytest.raises(InputError, match="its first bytes are 00 01 02"):
        read_cloud(path)


@pytest.mark.parametrize("text", ["\n\n\n", "# only\n# comments\n", "x y z\n"])
def test_texts_without_points(tmp_path: Path, text: str) -> None:
    path = tmp_path / "map.xyz"
    path.write_text(text)
    with pytest.raises(EmptyMapError, match="holds no points"):
        read_cloud(path)


# --- NPY and NPZ ------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", "<i4", ">i2", "<u8", "<f2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_every_type(tmp_path: Path, dtype: str, order: str) -> None:
    array = np.array([[1, 2, 3, 9], [4, 5, 6, 9]], dtype=dtype)
    np.save(tmp_path / "map.npy", np.asarray(array, order="F" if order == "F" else "C"))
    np.testing.assert_array_equal(read_cloud(tmp_path / "map.npy").xyz, [[1, 2, 3], [4, 5, 6]])


def test_structured_arrays(tmp_path: Path) -> None:
    array = np.array(
        [(3.0, 7, 1.0, 2.0)], dtype=[("z", "f8"), ("intensity", "u2"), ("x", "f4"), ("y", "f4")]
    )
    np.save(tmp_path / "map.npy", array)
    cloud = read_cloud(tmp_path / "map.npy")
    np.testing.assert_array_equal(cloud.xyz, [[1, 2, 3]])
    np.testing.assert_array_equal(cloud.intensity, [7])


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((2, 2)), r"must be of shape \(N, 3\) or wider; \(2, 2\) came"),
        (np.zeros(3), r"must be of shape \(N, 3\)"),
        (np.zeros((2, 3), dtype=complex), "must hold real numbers; an array of complex128"),
        (np.zeros((2, 3), dtype=bool), "must hold real numbers"),
        (np.array([["a", "b", "c"]]), "must hold real numbers"),
        (np.zeros((0, 3)), "holds no points"),
        (np.zeros(2, dtype=[("x", "f8"), ("y", "f8")]), "has no z"),
    ],
)
def test_arrays_that_are_refused(tmp_path: Path, array: np.ndarray, words: str) -> None:
    np.save(tmp_path / "map.npy", array)
    with pytest.raises(InputError, match=words):
        read_cloud(tmp_path / "map.npy")


def test_a_pickle_is_not_opened(tmp_path: Path) -> None:
    np.save(tmp_path / "map.npy", np.array([[1, "x", None]], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="Python objects"):
        read_cloud(tmp_path / "map.npy")
    np.savez(tmp_path / "map.npz", xyz=np.array([[1, "x", None]], dtype=object))
    with pytest.raises(InputError, match="Python objects"):
        read_cloud(tmp_path / "map.npz")


def test_an_array_that_claims_more_than_the_file_holds(tmp_path: Path) -> None:
    path = tmp_path / "map.npy"
    np.save(path, np.zeros((100, 3)))
    path.write_bytes(path.read_bytes().replace(b"(100, 3)", b"(10**9,3)"))
    with pytest.raises(InputError):
        read_cloud(path)
    np.save(path, np.zeros((100, 3)))
    path.write_bytes(path.read_bytes().replace(b"(100, 3), ", b"(999999,3)"))
    with pytest.raises(InputError, match="says 2999997 values, its bytes hold 300"):
        read_cloud(path)


def test_npz_by_key(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    np.savez(path, points=np.array(XYZ), time=np.array([1.0, 2.0]), other=np.zeros(7))
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.xyz, XYZ)
    np.testing.assert_array_equal(cloud.time, [1, 2])
    columns = np.array(XYZ).T
    np.savez_compressed(path, x=columns[0], y=columns[1], z=columns[2])
    np.testing.assert_array_equal(read_cloud(path).xyz, XYZ)
    np.savez(path, xyz=np.array(XYZ), intensity=np.zeros(3))
    with pytest.raises(InputError, match=r"intensity has shape \(3,\) beside x of \(2,\)"):
        read_cloud(path)
    np.savez(path, cloud=np.array(XYZ))
    with pytest.raises(InputError, match=r"has no x y z among its columns \(cloud\)"):
        read_cloud(path)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    inner = io.BytesIO()
    np.save(inner, np.zeros((4, 3)))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xyz.npy", inner.getvalue())
    data = bytearray(path.read_bytes())
    claimed = (4_000_000_000).to_bytes(4, "little")
    at = data.index(b"PK\x01\x02")  # the central directory
    data[at + 24 : at + 28] = claimed
    path.write_bytes(data)
    with pytest.raises(InputError, match="cannot unpack to 4000000000 bytes"):
        read_cloud(path)
