"""Triangle meshes from files: Wavefront OBJ, binary glTF 2.0 (GLB), PLY with faces.

Only the shape is read: materials, colours, normals and textures are stepped over. Polygons are
split into triangles as a fan. glTF is y up and comes out z up, as its specification says; the axes
of OBJ and PLY are taken as they are, z up.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import EmptyMapError, InputError
from commonmap.io.ply import ORDERS, Element, _read_header, read_ply
from commonmap.io.source import PathLike, look, parsing
from commonmap.types import Float64s

MAX_BYTES = 1 << 30
"""Bytes of a mesh file that is read at most."""

MAX_TRIANGLES = 20_000_000


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """vertices: (V, 3) float64, in the file's unit, z up. faces: (F, 3) int64, into them."""

    vertices: Float64s
    faces: NDArray[np.int64]


def read_mesh(path: PathLike) -> TriangleMesh:
    """Return the triangles of an .obj, .glb or .ply file.

    Raises InputError for another kind of file, one that is damaged, or one too large to hold, and
    EmptyMapError for one without triangles.
    """
    path = Path(path)
    reader = MESH_READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"a mesh is one of {', '.join(MESH_READERS)}; {path.name} came")
    path, size, _ = look(path)
    if size > MAX_BYTES:
        raise InputError(f"{path} has {size / 1e9:.1f} GB; a mesh of at most 1 GB is read")
    with parsing(path, "mesh"):
        vertices, faces = reader(path)
    if len(faces) == 0 or len(vertices) == 0:
        raise EmptyMapError(f"{path} holds no triangles")
    if len(faces) > MAX_TRIANGLES:
        raise InputError(
            f"{path} holds {len(faces) / 1e6:.0f} M triangles; at most "
            f"{MAX_TRIANGLES / 1e6:.0f} M are read"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path} is damaged: a face names a vertex that is not there")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path} holds a vertex that is not finite")
    return TriangleMesh(vertices, faces)


def has_faces(path: PathLike) -> bool:
    """Return whether a PLY file holds faces, which a cloud does not."""
    path, _, _ = look(path)
    with parsing(path, "PLY"), open(path, "rb") as file:
        header = _read_header(file, path)
    return any(e.name == "face" and e.count > 0 for e in header.elements)


def _fan(polygon: list[int], faces: list[tuple[int, int, int]]) -> None:
    """Add the triangles of a polygon."""
    faces += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]


# OBJ


def _read_obj(path: Path) -> tuple[Float64s, NDArray[np.int64]]:
    """Read `v` and `f` lines; an index counts from 1, or back from the latest vertex."""
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    with open(path, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            words = line.split()
            if not words or words[0] not in ("v", "f"):
                continue
            try:
                if words[0] == "v":
                    x, y, z = (float(word) for word in words[1:4])
                    vertices.append((x, y, z))
                    continue
                polygon = [int(word.split("/")[0]) for word in words[1:]]
            except ValueError:
                raise InputError(
                    f"{path}, line {number}: three numbers of a vertex or the numbers of a face's "
                    f"vertices were expected; {line.strip()[:60]!r} came"
                ) from None
            if len(polygon) < 3 or 0 in polygon:
                raise InputError(
                    f"{path}, line {number}: a face has three vertices or more, counted from 1; "
                    f"{line.strip()[:60]!r} came"
                )
            _fan([k - 1 if k > 0 else len(vertices) + k for k in polygon], faces)
    return (
        np.array(vertices, np.float64).reshape(-1, 3),
        np.array(faces, np.int64).reshape(-1, 3),
    )


# GLB

_COMPONENTS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""x, y up, z of glTF as x, y, z up."""


def _read_glb(path: Path) -> tuple[Float64s, NDArray[np.int64]]:
    """Read the triangles of every mesh that the scene's nodes place."""
    scene, binary = _glb_chunks(path)
    used = scene.get("extensionsRequired") or []
    if used:
        raise InputError(f"{path} needs {', '.join(map(str, used))[:80]}, which is not read")
    parts: list[tuple[Float64s, NDArray[np.int64]]] = []
    nodes = scene.get("nodes", [])
    roots = _roots(scene)
    waiting = [(int(node), np.eye(4), 0) for node in reversed(roots)]
    while waiting:
        number, T_above, depth = waiting.pop()
        if depth > 64 or len(parts) > 1_000_000:
            raise InputError(f"{path}: its nodes are nested too deeply, or in a circle")
        node = nodes[number]
        T = T_above @ _node_motion(node)
        if "mesh" in node:
            for primitive in scene["meshes"][node["mesh"]]["primitives"]:
                found = _primitive(scene, binary, primitive, path)
                if found is not None:
                    vertices = found[0] @ T[:3, :3].T + T[:3, 3]
                    parts.append((vertices, found[1]))
        waiting += [(int(child), T, depth + 1) for child in reversed(node.get("children", []))]
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    starts = np.cumsum([0, *(len(v) for v, _ in parts)])
    vertices = np.concatenate([v for v, _ in parts])
    faces = np.concatenate([f + s for (_, f), s in zip(parts, starts, strict=False)])
    return np.asarray(vertices @ _Y_UP.T, np.float64), faces


def _glb_chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk of a GLB file."""
    data = path.read_bytes()
    if len(data) < 20 or data[:4] != b"glTF":
        raise InputError(f"{path} is no GLB file: it does not begin with glTF")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"{path} is glTF {version}; version 2 is read")
    if length > len(data):
        raise InputError(f"{path} is truncated: it says {length} bytes and has {len(data)}")
    chunks: dict[bytes, bytes] = {}
    position = 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, position)
        if position + 8 + size > length:
            raise InputError(f"{path} is truncated within a chunk of {size} bytes")
        chunks.setdefault(kind, data[position + 8 : position + 8 + size])
        position += 8 + size
    if b"JSON" not in chunks:
        raise InputError(f"{path} has no JSON chunk")
    scene = json.loads(chunks[b"JSON"])
    if not isinstance(scene, dict):
        raise InputError(f"{path}: its JSON chunk is no glTF scene")
    return scene, chunks.get(b"BIN\0", b"")


def _roots(scene: dict[str, Any]) -> list[int]:
    """Return the nodes at the top of the default scene; without scenes, all that are no child."""
    if scene.get("scenes"):
        return list(scene["scenes"][scene.get("scene", 0)].get("nodes", []))
    nodes = scene.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    return [n for n in range(len(nodes)) if n not in children]


def _node_motion(node: dict[str, Any]) -> Float64s:
    """Return the (4, 4) matrix of a node: given column by column, or as parts."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    T = np.eye(4)
    x, y, z, w = (float(v) for v in node.get("rotation", (0.0, 0.0, 0.0, 1.0)))
    T[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ) * np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    T[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return T


def _primitive(
    scene: dict[str, Any], binary: bytes, primitive: dict[str, Any], path: Path
) -> tuple[Float64s, NDArray[np.int64]] | None:
    """Return vertices and faces of a primitive; None where it is made of points or lines."""
    mode = primitive.get("mode", 4)
    if mode < 4:
        return None
    vertices = _accessor(scene, binary, primitive["attributes"]["POSITION"], 3, path)
    if "indices" in primitive:
        index = _accessor(scene, binary, primitive["indices"], 1, path).astype(np.int64).ravel()
    else:
        index = np.arange(len(vertices))
    if mode == 4:
        if len(index) % 3:
            raise InputError(f"{path} is damaged: {len(index)} corners make no triangles")
        faces = index.reshape(-1, 3)
    elif mode == 5:  # a strip
        faces = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    else:  # a fan
        faces = np.stack([np.full(len(index) - 2, index[0]), index[1:-1], index[2:]], axis=1)
    return np.asarray(vertices, np.float64), faces


def _accessor(
    scene: dict[str, Any], binary: bytes, number: int, columns: int, path: Path
) -> NDArray[Any]:
    """Return the (count, columns) numbers of an accessor."""
    accessor = scene["accessors"][number]
    kind = np.dtype(_COMPONENTS.get(accessor["componentType"], "V1"))
    expected = "VEC3" if columns == 3 else "SCALAR"
    if kind.kind == "V" or accessor["type"] != expected or "sparse" in accessor:
        raise InputError(f"{path}: its accessor {number} is of a kind that is not read")
    view = scene["bufferViews"][accessor["bufferView"]]
    if view.get("buffer", 0) != 0 or "uri" in scene["buffers"][0]:
        raise InputError(f"{path} keeps its numbers in another file; hand in one whole .glb")
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    step = view.get("byteStride", kind.itemsize * columns)
    count = accessor["count"]
    if start < 0 or count < 1 or step < kind.itemsize * columns:
        raise InputError(f"{path} is damaged: its accessor {number} makes no sense")
    if start + step * (count - 1) + kind.itemsize * columns > len(binary):
        raise InputError(f"{path} is truncated: its accessor {number} ends behind its bytes")
    return np.ndarray((count, columns), kind, binary, start, (step, kind.itemsize))


# PLY


def _read_ply(path: Path) -> tuple[Float64s, NDArray[np.int64]]:
    """Read the vertices as of a cloud, and the one list of the element `face`."""
    with open(path, "rb") as file:
        header = _read_header(file, path)
    names = [e.name for e in header.elements]
    if "face" not in names:
        raise EmptyMapError(f"{path} holds no faces: it is a cloud, no mesh")
    if names[:2] != ["vertex", "face"] or header.elements[0].has_lists:
        raise InputError(f"{path}: a mesh has its vertices first and then its faces")
    vertex, face = header.elements[:2]
    lists = [p for p in face.properties if p.count_type is not None]
    if len(lists) != 1 or lists[0] is not face.properties[0]:
        raise InputError(f"{path}: a face begins with the one list of its vertices")
    vertices = read_ply(path).xyz
    data = path.read_bytes()[header.data_start :]
    if header.encoding == "ascii":
        faces = _ascii_faces(data, vertex, face, path)
    else:
        start = vertex.count * vertex.row_type(ORDERS[header.encoding]).itemsize
        faces = _binary_faces(data[start:], face, ORDERS[header.encoding], path)
    return vertices, faces


def _ascii_faces(data: bytes, vertex: Element, face: Element, path: Path) -> NDArray[np.int64]:
    lines = data.split(b"\n")[vertex.count : vertex.count + face.count]
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(lines):
        try:
            words = [int(word) for word in line.split()]
            polygon = words[1 : 1 + words[0]]
            if len(polygon) < 3 or len(polygon) != words[0]:
                raise ValueError
        except (ValueError, IndexError):
            raise InputError(f"{path}: its face {number} is cut short or no numbers") from None
        _fan(polygon, faces)
    if len(lines) < face.count:
        raise InputError(f"{path} is truncated: {face.count} faces are told, {len(lines)} came")
    return np.array(faces, np.int64).reshape(-1, 3)


def _binary_faces(data: bytes, face: Element, order: str, path: Path) -> NDArray[np.int64]:
    head = face.properties[0]
    count = np.dtype(order + (head.count_type or "u1"))
    index = np.dtype(order + head.type)
    rest = sum(np.dtype(p.type).itemsize for p in face.properties[1:])
    row = np.dtype([("n", count), ("v", index, (3,)), ("rest", f"V{rest}")] if rest else
                   [("n", count), ("v", index, (3,))])  # fmt: skip
    if len(data) >= face.count * row.itemsize:  # the usual case: triangles alone
        rows = np.frombuffer(data, row, face.count)
        if (rows["n"] == 3).all():
            return rows["v"].astype(np.int64)
    faces: list[tuple[int, int, int]] = []
    position = 0
    for number in range(face.count):
        if position + count.itemsize > len(data):
            raise InputError(f"{path} is truncated: {face.count} faces are told, {number} came")
        n = int(np.frombuffer(data, count, 1, position)[0])
        position += count.itemsize
        if n < 3 or position + n * index.itemsize + rest > len(data):
            raise InputError(f"{path} is damaged: its face {number} has {n} vertices")
        _fan(np.frombuffer(data, index, n, position).astype(int).tolist(), faces)
        position += n * index.itemsize + rest
    return np.array(faces, np.int64).reshape(-1, 3)


MESH_READERS: dict[str, Callable[[Path], tuple[Float64s, NDArray[np.int64]]]] = {
    ".obj": _read_obj,
    ".glb": _read_glb,
    ".ply": _read_ply,
}
"""Suffix -> reader of vertices and faces."""
