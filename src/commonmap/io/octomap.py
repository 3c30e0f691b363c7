"""OctoMap's files: `.ot` (log-odds of every node), `.bt` (occupied or free), scan graphs.

The format is that of OctoMap 1.x (Hornung et al. 2013, https://octomap.github.io): a text header
that ends in the line `data`, then the node stream of `octomap_nodes`. Coloured and stamped trees
are read for their occupancy.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from commonmap.errors import InputError
from commonmap.frames import from_quaternion
from commonmap.types import TREE_DEPTH, Float32s, Float64s, LeafParts, Leaves

_LOG = logging.getLogger("commonmap")

OT_MAGIC = b"# Octomap OcTree file"
BT_MAGIC = b"# Octomap OcTree binary file"
_ADVICE = b"# (feel free to add / change comments, but leave the first line as it is!)\n#\n"

EXTRA_BYTES: Mapping[str, int] = MappingProxyType(
    {"OcTree": 0, "1": 0, "OcTreeStamped": 0, "ColorOcTree": 3}
)
"""Kinds of tree we read: id of the header -> bytes of a `.ot` node beside value and children."""

LOG_ODDS_FREE = np.float32(np.log(0.1192 / (1 - 0.1192)))
"""What a free leaf of a `.bt` file is worth: OctoMap's lower clamping value."""

LOG_ODDS_OCCUPIED = np.float32(np.log(0.971 / (1 - 0.971)))
"""What an occupied leaf of a `.bt` file is worth: OctoMap's upper clamping value."""

_HEADER_LIMIT = 1 << 16


@dataclass(frozen=True)
class OctreeHeader:
    """The header of an octree file. binary: `.bt`; n_nodes: inner and leaf; data_start: bytes."""

    binary: bool
    tree: str
    n_nodes: int
    resolution: float
    data_start: int


@dataclass(frozen=True, eq=False)
class GraphScan:
    """One node of a scan graph: points (N, 3) float32 in the sensor frame, and where it stood."""

    xyz: Float32s
    T_map_sensor: Float64s


def read_octree_header(path: str | Path) -> OctreeHeader:
    """Return the header of a `.ot` or `.bt` file; costs a few kilobytes of reading."""
    path = Path(path)
    head = _read_bytes(path, _HEADER_LIMIT)
    if head.startswith(BT_MAGIC):
        binary = True
    elif head.startswith(OT_MAGIC):
        binary = False
    else:
        raise InputError(
            f"{path}: an OctoMap file starts with '{OT_MAGIC.decode()}' or '{BT_MAGIC.decode()}';"
            f" this one starts with {head[:24]!r}"
        )
    fields: dict[str, str] = {}
    start = 0
    while True:
        end = head.find(b"\n", start)
        if end < 0:
            raise InputError(
                f"{path}: the header of an octree must end in a line 'data'; none found"
            )
        line = head[start:end].decode("latin-1").strip()
        start = end + 1
        if line == "data":
            break
        if line and not line.startswith("#"):
            name, _, value = line.partition(" ")
            fields[name] = value.strip()
    for name in ("id", "size", "res"):
        if name not in fields:
            raise InputError(
                f"{path}: the header of an octree must hold a line '{name}'; it does not"
            )
    try:
        n_nodes = int(fields["size"])
    except ValueError:
        n_nodes = -1
    if n_nodes < 0:
        raise InputError(f"{path}: 'size' must be a count of nodes; it is {fields['size'][:40]!r}")
    try:
        resolution = float(fields["res"])
    except ValueError:
        resolution = np.nan
    if not (np.isfinite(resolution) and resolution > 0):
        raise InputError(
            f"{path}: 'res' must be a voxel edge in metres above 0; it is {fields['res'][:40]!r}"
        )
    tree = fields["id"]
    if tree not in EXTRA_BYTES:
        raise InputError(
            f"{path}: the tree must be one of {', '.join(t for t in EXTRA_BYTES if t != '1')};"
            f" it is a {tree[:40]!r}"
        )
    return OctreeHeader(binary, tree, n_nodes, resolution, start)


def read_octree(path: str | Path) -> Leaves:
    """Return the leaves of a `.ot` or `.bt` file, in Morton order, as they are (not pruned).

    Memory stays within a small multiple of the size of the file, whatever its header says. A leaf
    of a `.bt` file gets OctoMap's clamping value.
    """
    path = Path(path)
    header = read_octree_header(path)
    data = np.frombuffer(_read_bytes(path), np.uint8)[header.data_start :]
    if header.n_nodes > data.size * 4 + 9:
        raise InputError(
            f"{path}: the header promises {header.n_nodes} nodes, more than the"
            f" {data.size} bytes of the file can hold; it is cut off or damaged"
        )
    if header.tree not in ("OcTree", "1"):
        _LOG.info("%s: a %s; only its occupancy is read", path, header.tree)
    return _read_binary(path, header, data) if header.binary else _read_full(path, header, data)


def write_octree(path: str | Path, leaves: Leaves | LeafParts) -> None:
    """Write leaves as `.ot` (log-odds, the leaves as they are) or `.bt` (occupied or free, pruned).

    What `read_octree` read from an `.ot` file that OctoMap wrote comes out byte for byte. The file
    appears when it is complete. Memory beside the leaves is a few tens of megabytes, and for
    `LeafParts` that is all.
    """
    from commonmap.io import octomap_stream
    from commonmap.io.atomic import writing

    path = Path(path)
    if path.suffix.lower() not in (".ot", ".bt"):
        raise InputError(f"an octree is written as .ot or .bt; the file is called {path.name}")
    if not (np.isfinite(leaves.resolution) and leaves.resolution > 0):
        raise InputError(f"resolution must be metres above 0; {leaves.resolution} came")
    binary = path.suffix.lower() == ".bt"
    n_nodes = octomap_stream.count_nodes(leaves, binary=binary)
    with writing(path) as unfinished, open(unfinished, "wb") as file:
        file.write(_header_bytes(BT_MAGIC if binary else OT_MAGIC, n_nodes, leaves.resolution))
        octomap_stream.write_nodes(file, leaves, binary=binary)


def read_scan_graph(path: str | Path) -> list[GraphScan]:
    """Return the scans of an OctoMap scan graph (`.graph`), in the order of the file."""
    path = Path(path)
    data = _read_bytes(path)
    reader = _Reader(path, data)
    scans = []
    for _ in range(reader.count("scan nodes", 4 + 7 * 8 + 4)):
        n_points = reader.count("points", 4 + 3 * 8)
        record = np.dtype([("dims", "<u4"), ("xyz", "<f8", 3)])
        points = np.frombuffer(reader.take(n_points * record.itemsize), record)
        if (points["dims"] != 3).any():
            raise InputError(
                f"{path}: a point of a scan graph has 3 coordinates; one says otherwise"
            )
        with np.errstate(over="ignore"):  # what no float holds is not finite, as in OctoMap
            xyz = points["xyz"].astype(np.float32)
        scans.append((xyz, reader.pose()))
        reader.take(4)
    return [GraphScan(xyz, T) for xyz, T in scans]


class _Reader:
    """Takes pieces off the front of a scan graph and knows when there are none left."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.data, self.at = path, data, 0

    def take(self, n: int) -> bytes:
        if self.at + n > len(self.data):
            raise InputError(f"{self.path}: the scan graph is cut off after {len(self.data)} bytes")
        self.at += n
        return self.data[self.at - n : self.at]

    def count(self, what: str, least: int) -> int:
        n = int(struct.unpack("<I", self.take(4))[0])
        if n * least > len(self.data):
            raise InputError(
                f"{self.path}: {n} {what} are more than {len(self.data)} bytes can hold"
            )
        return n

    def pose(self) -> Float64s:
        dims, x, y, z = struct.unpack("<I3d", self.take(28))
        dims_q, u, qx, qy, qz = struct.unpack("<I4d", self.take(36))
        if dims != 3 or dims_q != 4:
            raise InputError(f"{self.path}: a pose of a scan graph is 3 + 4 numbers; this is not")
        length = float(np.linalg.norm([qx, qy, qz, u]))
        if not (np.isfinite([x, y, z, length]).all() and length > 0.0):
            raise InputError(
                f"{self.path}: a pose of a scan graph is a finite position and a quaternion; "
                f"{(x, y, z)} and (w, x, y, z) = {(u, qx, qy, qz)} came"
            )
        return from_quaternion((x, y, z), (qx, qy, qz, u))


def _read_full(path: Path, header: OctreeHeader, data: NDArray[np.uint8]) -> Leaves:
    from commonmap.io import octomap_nodes
    from commonmap.io.morton import decode

    node_bytes = 5 + EXTRA_BYTES[header.tree]
    n = data.size // node_bytes
    records = data[: n * node_bytes].reshape(n, node_bytes)
    children = np.ascontiguousarray(records[:, -1])
    value = np.ascontiguousarray(records[:, :4]).view("<f4").reshape(-1)
    leaf_node, codes = np.empty(n, np.int64), np.empty(n, np.int64)
    depth = np.empty(n, np.uint8)
    n_leaves, n_nodes = octomap_nodes.read_full(children, header.n_nodes, leaf_node, codes, depth)
    _check_walk(path, header, n_leaves, n_nodes, data.size, n_nodes * node_bytes)
    value = value[leaf_node[:n_leaves]].astype(np.float32)
    if not np.isfinite(value).all():
        raise InputError(f"{path}: the log-odds of every node must be finite; one is not")
    keys = decode(codes[:n_leaves])
    return Leaves(header.resolution, keys, depth[:n_leaves].copy(), value)


def _read_binary(path: Path, header: OctreeHeader, data: NDArray[np.uint8]) -> Leaves:
    from commonmap.io import octomap_nodes
    from commonmap.io.morton import decode

    if header.n_nodes == 0:
        empty = np.empty(0, np.uint8)
        return Leaves(header.resolution, np.empty((0, 3), np.uint16), empty, empty.astype("f4"))
    none = np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.bool_)
    n_leaves, n_nodes, used = octomap_nodes.read_binary(data, False, *none)
    _check_walk(path, header, n_leaves, n_nodes, data.size, used)
    codes, depth = np.empty(n_leaves, np.int64), np.empty(n_leaves, np.uint8)
    occupied = np.empty(n_leaves, np.bool_)
    octomap_nodes.read_binary(data, True, codes, depth, occupied)
    value = np.where(occupied, LOG_ODDS_OCCUPIED, LOG_ODDS_FREE)
    return Leaves(header.resolution, decode(codes), depth, value)


def _check_walk(
    path: Path, header: OctreeHeader, n_leaves: int, n_nodes: int, n_bytes: int, used: int
) -> None:
    """Raise where the node stream and the header do not agree."""
    if n_leaves == -1:
        raise InputError(
            f"{path}: the header promises {header.n_nodes} nodes; the file ends after {n_nodes}"
        )
    if n_leaves == -2:
        raise InputError(f"{path}: an octree is {TREE_DEPTH} levels deep; a node lies deeper")
    if n_nodes != header.n_nodes:
        more = "more" if n_nodes > header.n_nodes else str(n_nodes)
        raise InputError(f"{path}: the header promises {header.n_nodes} nodes; there are {more}")
    if used < n_bytes:
        _LOG.warning("%s: %d bytes after the octree are left unread", path, n_bytes - used)


def _header_bytes(magic: bytes, n_nodes: int, resolution: float) -> bytes:
    short = f"{resolution:g}"  # OctoMap writes six digits; more only where six would lose some
    res = short if float(short) == resolution else repr(float(resolution))
    return magic + b"\n" + _ADVICE + f"id OcTree\nsize {n_nodes}\nres {res}\ndata\n".encode()


def _read_bytes(path: Path, limit: int = -1) -> bytes:
    """Return the bytes of the file, the first `limit` where given."""
    try:
        with open(path, "rb") as file:
            return file.read(limit)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
