"""Damaged files: cut short, or with bytes changed. Readers return a map or raise a known error."""

from __future__ import annotations

import contextlib
import io
import struct
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from commonmap.errors import CommonmapError, InputError
from commonmap.io import (
    read_geotiff,
    read_map,
    read_trajectory,
    write_cloud,
    write_geotiff,
    write_trajectory,
)
from commonmap.io.meshes import read_mesh
from commonmap.io.octomap import BT_MAGIC, OT_MAGIC, read_scan_graph, write_octree
from commonmap.io.scans import iter_scans, write_scans
from commonmap.mapping.octree import Octree
from commonmap.types import Cloud, Scan, Trajectory
from test_world_files import triangle_glb

N = 60
RNG = np.random.default_rng(0)
XYZ = RNG.uniform(0, 20, (N, 3)) + np.array([470_600.0, 3_810_200.0, 2_278.0])
CLOUD = Cloud(
    xyz=XYZ,
    crs="EPSG:32612",
    colour=RNG.integers(0, 256, (N, 3), dtype=np.uint8),
    intensity=RNG.uniform(0, 1, N).astype(np.float32),
    time=np.sort(RNG.uniform(1, 9, N)),
    seen_by=RNG.integers(1, 4, N).astype(np.uint8),
)


def written(suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{suffix}"
        write_cloud(path, CLOUD)
        return path.read_bytes()


def old_laz() -> bytes:
    """Return a LAZ 1.2 file of point format 3: compressed point by point, not in layers."""
    header = laspy.LasHeader(version="1.2", point_format=3)
    header.offsets, header.scales = XYZ.min(axis=0), np.full(3, 0.01)
    data = laspy.LasData(header)
    data.x, data.y, data.z = XYZ.T
    buffer = io.BytesIO()
    data.write(buffer, do_compress=True)
    return buffer.getvalue()


def ascii_ply() -> bytes:
    rows = "".join(f"{x} {y} {z} 3 1 2 3\n" for x, y, z in XYZ.tolist())
    return (
        f"ply\nformat ascii 1.0\nelement vertex {N}\nproperty double x\nproperty double y\n"
        f"property double z\nproperty list uchar int n\nend_header\n{rows}"
    ).encode()


def ply_with_lists() -> bytes:
    rows = b"".join(struct.pack(">B2idddH", 2, 5, 6, *xyz, 7) for xyz in XYZ.tolist())
    return (
        f"ply\nformat binary_big_endian 1.0\nelement vertex {N}\nproperty list uchar int n\n"
        "property double x\nproperty double y\nproperty double z\nproperty ushort id\nend_header\n"
    ).encode() + rows


def ascii_pcd() -> bytes:
    rows = "".join(f"{x} {y} {z} 4.2e-39\n" for x, y, z in XYZ.tolist())
    return (
        "VERSION 0.7\nFIELDS x y z rgb\nSIZE 8 8 8 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {N}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {N}\nDATA ascii\n{rows}"
    ).encode()


def compressed_pcd() -> bytes:
    plain = np.ascontiguousarray((XYZ - XYZ.min(axis=0)).T.astype("<f4")).tobytes()
    packed = b"".join(
        bytes([len(plain[i : i + 32]) - 1]) + plain[i : i + 32] for i in range(0, len(plain), 32)
    )
    return (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {N}\nHEIGHT 1\nPOINTS {N}\n"
        "DATA binary_compressed\n"
    ).encode() + struct.pack("<II", len(packed), len(plain)) + packed  # fmt: skip


def raster() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.tif"
        layers = {"a": RNG.normal(size=(9, 7)), "b": RNG.normal(size=(9, 7))}
        write_geotiff(path, layers, origin=(470_600, 3_810_200), cell=0.5, crs="EPSG:32612")
        return path.read_bytes()


def trajectory() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.tum"
        T = np.tile(np.eye(4), (9, 1, 1))
        write_trajectory(path, Trajectory(time=np.arange(9.0), T_map_sensor=T))
        return path.read_bytes()


def octree(suffix: str) -> bytes:
    tree = Octree(0.5)
    tree.insert(np.zeros(3), RNG.uniform(-6, 6, (N, 3)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{suffix}"
        write_octree(path, tree.leaves())
        return path.read_bytes()


def scan_graph() -> bytes:
    points = b"".join(struct.pack("<I3d", 3, *xyz) for xyz in XYZ.tolist())
    pose = struct.pack("<I3dI4d", 3, 1, 2, 3, 4, 1, 0, 0, 0)
    return struct.pack("<I", 2) + 2 * (struct.pack("<I", N) + points + pose + bytes(4))


def wavefront() -> bytes:
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in XYZ.tolist())
    return (corners + "".join(f"f {k} {k + 1}/3/4 -1\n" for k in range(1, N - 1))).encode()


FILES: dict[str, tuple[str, Callable[[], bytes], Callable[[Path], object]]] = {
    **{suffix: (suffix, lambda s=suffix: written(s), read_map)  # type: ignore[misc]
       for suffix in (".las", ".laz", ".ply", ".pcd", ".csv", ".npy", ".npz")},
    "laz 1.2": (".laz", old_laz, read_map),
    "ascii ply": (".ply", ascii_ply, read_map),
    "ply with lists": (".ply", ply_with_lists, read_map),
    "ascii pcd": (".pcd", ascii_pcd, read_map),
    "compressed pcd": (".pcd", compressed_pcd, read_map),
    "geotiff": (".tif", raster, read_geotiff),
    "tum": (".tum", trajectory, read_trajectory),
    "ot": (".ot", lambda: octree(".ot"), read_map),
    "bt": (".bt", lambda: octree(".bt"), read_map),
    "scan graph": (".graph", scan_graph, read_scan_graph),
    "obj": (".obj", wavefront, read_mesh),
    "glb": (".glb", triangle_glb, read_mesh),
}  # fmt: skip


@st.composite
def damages(draw: st.DrawFn) -> tuple[float | None, list[tuple[float, bool, int]]]:
    """Draw where a file is cut (a share of it), and which bytes of what is left are changed.

    A change is (place, whether in the first 600 bytes, what to xor with).
    """
    cut = draw(st.none() | st.floats(0, 1))
    changes = st.tuples(st.floats(0, 1, exclude_max=True), st.booleans(), st.integers(1, 255))
    return cut, draw(st.lists(changes, min_size=0 if cut is not None else 1, max_size=6))


# rasterio's own logger stumbles over damaged bytes in a message of GDAL
RASTERIO_LOGS = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
KINDS = [pytest.param(k, marks=RASTERIO_LOGS) if k == "geotiff" else k for k in FILES]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_give_a_map_or_a_known_error(kind: str, tmp_path: Path) -> None:
    suffix, make, read = FILES[kind]
    whole = make()
    path = tmp_path / f"map{suffix}"
    path.write_bytes(whole)
    read(path)

    @settings(
        max_examples=150, deadline=5000, database=None, derandomize=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(damages())
    def damage_and_read(damage: tuple[float | None, list[tuple[float, bool, int]]]) -> None:
        cut, changes = damage
        data = bytearray(whole if cut is None else whole[: int(cut * len(whole))])
        for place, early, mask in changes if data else []:
            data[int(place * (min(len(data), 600) if early else len(data)))] ^= mask
        path.write_bytes(data)
        try:
            read(path)
        except CommonmapError as error:
            assert "\n" not in str(error) and str(path) in str(error)

    damage_and_read()


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=60, deadline=5000, database=None, derandomize=True)
@given(data=st.binary(max_size=400))
def test_any_bytes_behind_a_true_beginning(kind: str, data: bytes) -> None:
    suffix, _, read = FILES[kind]
    start = {".las": b"LASF", ".laz": b"LASF", ".ply": b"ply\nformat ", ".pcd": b"VERSION 0.7\n",
             ".npy": b"\x93NUMPY\x01\x00", ".npz": b"PK\x03\x04", ".tif": b"II*\0",
             ".ot": OT_MAGIC, ".bt": BT_MAGIC, ".glb": b"glTF\2\0\0\0"}  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{suffix}"
        path.write_bytes(start.get(suffix, b"") + data)
        with pytest.raises(CommonmapError):
            read(path)
            raise CommonmapError("read as a map: fine too")


def test_a_pose_of_a_scan_graph_has_a_rotation(tmp_path: Path) -> None:
    none = struct.pack("<I3dI4d", 3, 1, 2, 3, 4, 0, 0, 0, 0)
    point = struct.pack("<II3d", 1, 3, 1, 2, 3)
    (tmp_path / "a.graph").write_bytes(struct.pack("<I", 1) + point + none + bytes(4))
    with pytest.raises(InputError, match="a finite position and a quaternion"):
        read_scan_graph(tmp_path / "a.graph")


def test_a_member_of_an_archive_takes_no_more_than_its_file_holds(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    write_cloud(path, CLOUD)
    data = bytearray(path.read_bytes())
    at = data.rindex(b"PK\x01\x02")  # what the directory says of the last member
    data[at + 20 : at + 28] = struct.pack("<II", 800_000_000, 800_000_000)
    path.write_bytes(data)
    tracemalloc.start()
    with contextlib.suppress(CommonmapError):
        read_map(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10_000_000


def test_a_header_of_an_array_is_no_longer_than_its_file(tmp_path: Path) -> None:
    # versions 2 and 3 of NPY tell the length of the header in four bytes
    (tmp_path / "map.npy").write_bytes(b"\x93NUMPY\x02\x00" + struct.pack("<I", 700_000_000))
    none = np.zeros(N, np.float32)
    scan = Scan(XYZ.astype(np.float32), np.arange(float(N)), none.astype(np.uint16), none, 0.0)
    write_scans(tmp_path / "k", [scan])
    ring = tmp_path / "k" / "ring" / "000000.npy"
    ring.write_bytes(b"\x93NUMPY\x03\x00" + struct.pack("<I", 700_000_000) + ring.read_bytes()[12:])
    tracemalloc.start()
    with pytest.raises(CommonmapError):
        read_map(tmp_path / "map.npy")
    with pytest.raises(CommonmapError):
        list(iter_scans(tmp_path / "k"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10_000_000
