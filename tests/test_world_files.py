"""Meshes from files, and places made of them: literal triangles, a yard, and what is no place."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap.errors import CommonmapError, EmptyMapError, InputError
from commonmap.io import write_cloud
from commonmap.io.meshes import read_mesh
from commonmap.sim.mesh import Mesh, box, join, make_mesh, slab
from commonmap.sim.pairs import plan_missions, simulate_pair
from commonmap.sim.scanning import RayCaster
from commonmap.sim.world import World
from commonmap.sim.world_file import read_world, world_of_cloud, world_of_mesh
from commonmap.types import Cloud, Float64s
from test_cli import Run, run, told

__all__ = ["run"]

AIRBORNE = Path(__file__).resolve().parents[2] / "shared" / "data" / "airborne"


def glb(scene: dict[str, Any], binary: bytes) -> bytes:
    """Return a GLB file, its chunks padded to four bytes."""
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def triangle_glb(**node: Any) -> bytes:
    """Return a GLB of one triangle, (0,0,0), (1,0,0), (0,2,0) as glTF has it: y up."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], "<f4").tobytes()
    index = np.array([0, 1, 2], "<u2").tobytes()
    scene = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 6},
        ],
        "buffers": [{"byteLength": 42}],
    }
    return glb(scene, points + index)


def write_obj(path: Path, mesh: Mesh, scale: float = 1.0) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in (mesh.vertices * scale).tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def yard(size: float = 44.0) -> Mesh:
    """Return level ground with a block, a roof on posts and a wall."""
    half = size / 2
    corners = [[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]
    ground = make_mesh(corners, [[0, 1, 2], [0, 2, 3]], "soil")
    posts = [box([x, y, -1], [x + 0.2, y + 0.2, 3], "wood") for x in (6, 12) for y in (6, 11)]
    block, wall = box([-12, -9, -1], [-6, -5, 4], "brick"), box([-3, 12, -1], [9, 12.4, 2], "brick")
    return join([ground, block, box([6, 6, 3], [12.2, 11.2, 3.2], "wood"), wall, *posts])


# Files


def test_obj_polygons_and_indices_from_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(
        "# a square and a triangle\nv 0 0 0\nv 1 0 0\nvn 0 0 1\nv 1 1 0\nv 0 1 0\n"
        "f 1/1/1 2//1 3 4\nv 0 0 5\nf -1 1 2\n"
    )
    mesh = read_mesh(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 5]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 0, 1]]


def test_glb_is_turned_from_y_up_to_z_up(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(triangle_glb())
    assert read_mesh(path).vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 0, 2]]
    # moved by (10, 0, 3) in glTF, twice as large, a quarter turn about its y: x -> -z
    s = float(np.sqrt(0.5))
    path.write_bytes(
        triangle_glb(translation=[10, 0, 3], scale=[2, 2, 2], rotation=[0.0, s, 0.0, s])
    )
    mesh = read_mesh(path)
    np.testing.assert_allclose(mesh.vertices, [[10, -3, 0], [10, -1, 0], [10, -3, 4]], atol=1e-12)
    assert mesh.faces.tolist() == [[0, 1, 2]]
    path.write_bytes(triangle_glb(matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]))
    assert read_mesh(path).vertices[0].tolist() == [7, -9, 8]


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("quad", [False, True])
def test_ply_faces(tmp_path: Path, order: str, quad: bool) -> None:
    polygons = [[0, 1, 2], [0, 2, 3]] if not quad else [[0, 1, 2, 3], [0, 2, 3]]
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.5], [0.0, 1.0, 0.0]]
    head = (
        f"ply\nformat {order} 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(polygons)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    if order == "ascii":
        rows: list[list[Any]] = [*points, *([len(p), *p] for p in polygons)]
        body = "\n".join(" ".join(str(value) for value in row) for row in rows).encode() + b"\n"
    else:
        sign = "<" if "little" in order else ">"
        body = np.array(points, sign + "f4").tobytes()
        for p in polygons:
            body += struct.pack(f"{sign}B{len(p)}i", len(p), *p)
    path = tmp_path / "a.ply"
    path.write_bytes(head + body)
    mesh = read_mesh(path)
    assert mesh.vertices.tolist() == points
    expected = [[0, 1, 2], [0, 2, 3], *([[0, 2, 3]] if quad else [])]
    assert mesh.faces.tolist() == expected
    path.write_bytes((head + body)[: -6 if order == "ascii" else -5])
    with pytest.raises(InputError):
        read_mesh(path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.obj", b"# nothing\n", "no triangles"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 3\n", "a vertex that is not there"),
        ("a.obj", b"v 0 0 0\nf 1 2\n", "three vertices or more"),
        ("a.obj", b"v 0 zero 0\n", "line 1"),
        ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("a.glb", b"glTF" + bytes(40), "glTF 0"),
        ("a.glb", triangle_glb()[:-30], "truncated"),
        ("a.glb", b"PK\x03\x04" + bytes(40), "does not begin with glTF"),
        ("a.glb", triangle_glb(children=[0]), "in a circle"),
        ("a.stl", b"solid", ".obj, .glb, .ply"),
    ],
)
def test_what_is_no_mesh_is_told(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_mesh(path)


def test_a_damaged_glb_is_refused_or_read_and_nothing_else(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    whole, path = triangle_glb(), tmp_path / "a.glb"
    n_refused = 0
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(256)
        path.write_bytes(bytes(data))
        try:
            read_mesh(path)
        except CommonmapError:
            n_refused += 1
    assert n_refused > 100


# Places


@pytest.fixture(scope="module")
def place() -> World:
    mesh = yard()
    return world_of_mesh(mesh.vertices + np.array([500.0, 20.0, 7.0]), mesh.faces)


def test_a_mesh_becomes_a_place_with_ground_under_its_roofs(place: World) -> None:
    assert place.size == 44.0
    # its middle is the origin now; the lowest corner of the mesh (1 m under ground) is z = 0
    under = np.array([[0.0, 0.0], [9.0, 8.5], [-20.0, 20.0]])
    np.testing.assert_allclose(place.height(under), 1.0, atol=0.05)
    caster = RayCaster(place)
    start = np.array([[9.0, 8.5, 10.0], [0.0, 0.0, 10.0]], np.float32)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0], np.float32), start.shape).copy()
    distance, _, _ = caster.cast(start, down)
    np.testing.assert_allclose(distance, [10.0 - 4.2, 9.0], atol=1e-4)


def test_robots_go_through_a_place_of_a_mesh(place: World) -> None:
    pair = simulate_pair(
        place, rng=np.random.default_rng(5), azimuth_decimation=24, max_points=60_000
    )
    assert pair.overlap > 0.9
    assert pair.kind == "mesh"
    route = pair.source_mission.body.T_map_sensor[:, :3, 3]
    inside = (route[:, :2] > [-12.3, -9.3]).all(axis=1) & (route[:, :2] < [-5.7, -4.7]).all(axis=1)
    assert not inside.any(), "the ground robot drives through the block"
    np.testing.assert_allclose(route[:, 2], 1.0, atol=0.1)
    with pytest.raises(InputError, match="size"):
        plan_missions(place, rng=np.random.default_rng(0), size=30.0)


def test_a_cloud_from_the_air_becomes_a_place() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-40.0, 40.0, (20_000, 2))
    z = 0.05 * xy[:, 0]
    on_house = (np.abs(xy[:, 0] - 5.0) < 6.0) & (np.abs(xy[:, 1]) < 4.0)
    xyz = np.column_stack([xy, np.where(on_house, 0.25 + 8.0, z)])
    xyz = xyz + np.array([1000.0, 2000.0, 300.0])
    xyz = np.vstack([xyz, [1020.0, 2020.0, 420.0]])  # a bird
    place = world_of_cloud(xyz, size=60.0)
    assert place.size == 60.0
    slope = place.height(np.array([[20.0, -20.0]])) - place.height(np.array([[-20.0, -20.0]]))
    assert slope[0] == pytest.approx(2.0, abs=0.15)
    caster = RayCaster(place)
    start = np.array([[5.0, 0.0, 50.0], [-20.0, -20.0, 50.0], [20.0, 20.0, 50.0]], np.float32)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0], np.float32), start.shape).copy()
    top = 50.0 - caster.cast(start, down)[0]
    assert top[0] - place.height(np.array([[5.0, 0.0]]))[0] == pytest.approx(8.0, abs=0.3)
    assert top[1] == pytest.approx(place.height(np.array([[-20.0, -20.0]]))[0], abs=0.05)
    assert top[2] - place.height(np.array([[20.0, 20.0]]))[0] <= 15.0 + 1.0


def test_units_and_extent_are_checked(tmp_path: Path) -> None:
    mesh = yard()
    vertices = mesh.vertices.astype(np.float64)
    with pytest.raises(InputError, match="in metres"):  # in kilometres
        world_of_mesh(0.001 * vertices, mesh.faces)
    with pytest.raises(InputError, match="in metres"):  # in millimetres
        world_of_mesh(1000.0 * vertices, mesh.faces)
    with pytest.raises(InputError, match="20 to 1000"):
        read_world(write_obj(tmp_path / "a.obj", mesh), size=5.0)
    with pytest.raises(InputError, match="300 came"):
        read_world(write_obj(tmp_path / "a.obj", mesh), size=300.0)
    pillars = join([slab(1.0, 1.0, 0.0, 3.0, "brick"), box([40, 40, 0], [41, 41, 3], "brick")])
    with pytest.raises(InputError, match="ground"):
        world_of_mesh(pillars.vertices.astype(np.float64), pillars.faces)
    with pytest.raises(EmptyMapError, match="points"):
        far = np.array([[x, y, 0.0] for x in (-100.0, 100.0) for y in (-100.0, 100.0)])
        world_of_cloud(np.repeat(far, 60, axis=0), size=50.0)


def test_simulate_takes_a_world(tmp_path: Path, run: Run) -> None:
    path = write_obj(tmp_path / "yard.obj", yard(30.0))
    out = tmp_path / "sim"
    done = run("simulate", "-o", out, "--world", path, "--logs", "none", "--seed", "3")
    assert done.code == 0, done.err
    truth = json.loads((out / "truth.json").read_text())
    assert truth["kind"] == "yard" and truth["world_size"] == 30.0


def test_simulate_tells_what_is_wrong_with_a_world(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "sim"
    told(run("simulate", "-o", out, "--world", tmp_path / "no.obj"), "no file")
    small = write_obj(tmp_path / "small.obj", yard(), scale=0.01)
    told(run("simulate", "-o", out, "--world", small), "in metres", "20 m")
    told(run("simulate", "-o", out, "--world", small, "--scene", "city"), "--scene and --world")
    (tmp_path / "empty.glb").write_bytes(b"")
    told(run("simulate", "-o", out, "--world", tmp_path / "empty.glb"), "is empty")
    assert not out.exists()


def test_a_ply_without_faces_is_a_cloud(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    xyz: Float64s = np.column_stack([rng.uniform(-20, 20, (4000, 2)), np.zeros(4000)])
    write_cloud(tmp_path / "tile.ply", Cloud(xyz))
    place = read_world(tmp_path / "tile.ply")
    assert place.size == pytest.approx(40.0, abs=0.5) and place.name == "tile"


@pytest.mark.skipif(not AIRBORNE.is_dir(), reason=f"no airborne data ({AIRBORNE} is absent)")
def test_a_real_tile_becomes_a_place() -> None:
    place = read_world(AIRBORNE / "CSite2_orig-utm.pcd", size=80.0)
    assert place.size == 80.0
    pair = simulate_pair(
        place, rng=np.random.default_rng(2), azimuth_decimation=24, max_points=60_000
    )
    assert pair.overlap > 0.6  # few rays are cast here; with all of them it is 0.98
