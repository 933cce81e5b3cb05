"""Point files, one by one, and what messages of bags hold."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from fuzz.cases import Files, Parser
from point_writers import packed, revolution, write_pcd

from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats.point_files import read_cloud, read_points, write_cloud, write_ply
from lslam.io.formats.sensor_messages import decode_livox, decode_pointcloud2
from lslam.io.formats.state_files import read_npz, write_npz

_N = 30


def _points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.uniform(-20, 20, (_N, 3)).astype(np.float32), rng.random(_N).astype(np.float32)


def _point_parser(name: str, file: str, make: Callable[[Path], list[bytes]]) -> Parser:
    return Parser(
        name, lambda folder: read_cloud(folder / file), lambda folder: [{file: d} for d in make(folder)], tables=(file,)
    )


def _pcd(folder: Path) -> list[bytes]:
    made = []
    for binary in ("binary", "binary_compressed"):
        write_pcd(folder / "a.pcd", *_points(), encoding=binary)
        made.append((folder / "a.pcd").read_bytes())
    head = b"VERSION .7\nFIELDS x y z intensity time ring\nSIZE 4 4 4 4 8 2\nTYPE F F F F F U\nCOUNT 1 1 1 1 1 1\n"
    rows = b"".join(b"%d %d 1 0.5 0.0%d %d\n" % (k, k, k, k) for k in range(4))
    ascii_ = head + b"WIDTH 4\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA ascii\n" + rows
    huge = ascii_.replace(b"WIDTH 4", b"WIDTH 4000000000").replace(b"POINTS 4", b"POINTS 4000000000")
    bare = (
        head.split(b"COUNT")[0] + b"COUNT 1 1 1 1000000000 1 1\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA binary\n" + bytes(104)
    )
    raw = ascii_.replace(b"SIZE 4 4 4 4", b"SIZE 4 4 4 1").replace(b"TYPE F F F F", b"TYPE F F F U")
    raw = raw.replace(b" 0.5 ", b" \n ").replace(b"WIDTH 4", b"WIDTH 0")
    double = raw.replace(b"SIZE 4 4 4 1", b"SIZE 8 8 8 4").replace(b"ascii", b"binary") + bytes(400)
    return [*made, ascii_, raw, double, huge, huge.replace(b"ascii", b"binary_compressed"), bare, b"", head]


def _ply(folder: Path) -> list[bytes]:
    write_ply(folder / "a.ply", *_points(), "")
    binary = (folder / "a.ply").read_bytes()
    head = b"ply\nformat %s 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty double z\nend_header\n"
    big = head % (b"binary_big_endian", 2) + struct.pack(">ffdffd", *range(6))
    ascii_ = head % (b"ascii", 2) + b"1 2 3\n4 5 6\n"
    huge = head % (b"ascii", 10**30) + b"1 2 3\n"
    return [binary, big, ascii_, huge, huge.replace(b"ascii", b"binary_little_endian"), b"ply\n", b""]


def _npy(folder: Path) -> list[bytes]:
    made = []
    table = np.column_stack(_points())
    fields = np.zeros(4, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<f8")])
    xyz = np.zeros(4, [("xyz", "<f8", 3), ("ring", "u1"), ("t", "<f8", 2), ("name", "S4")])
    columns = revolution(turns=20, rings=4)
    wide = np.column_stack([columns[name] for name in ("x", "y", "z", "intensity", "time", "ring", "noise")])
    for array in (
        xyz,
        wide,
        wide.T,
        table,
        table.reshape(2, -1, 4),
        fields,
        np.zeros((0, 4)),
        np.zeros((3, 4), "<c8"),
        np.array("text"),
    ):
        stream = io.BytesIO()
        np.save(stream, array)
        made.append(stream.getvalue())
    head = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118)
    for text in (
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (9000000000000, 4), }",
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 4), }",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (1, 4), }",
        b"{'descr': [('x', '<f4')], 'fortran_order': 1, 'shape': [1], }",
        b"(" * 100,
    ):
        made.append(head + text.ljust(117) + b"\n" + bytes(64))
    return made


def _text(folder: Path) -> list[bytes]:
    return [b"1 2 3 0.5\n4 5 6 0.25\n", b"", b"1 2 3\n", b"nan nan nan nan\n"]


_RECORDS = (
    "x y z intensity ring", "x y z intensity ring time", "x:f8 y:f8 z:f8 intensity:f8", "x y z intensity ring:u2 stamp:f8",
    "x y z intensity time_ns:u4 pad:u2 ring:u2 pad:u2", "x y z noise noise noise", "x y z",
)  # fmt: skip


def _bin(folder: Path) -> list[bytes]:
    data = np.column_stack(_points()).astype("<f4").tobytes()
    columns = revolution(turns=20, rings=4)
    others = [packed(columns, words) for words in _RECORDS]
    return [data, *others, data[:-3], b"", np.full((4, 4), np.nan, "<f4").tobytes(), b"\xff" * 64]


def _las(suffix: str) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        path = folder / f"a{suffix}"
        points, intensity = _points()
        write_cloud(path, ArrayCloud.of(points, intensity), wkt='GEOGCS["WGS 84"]')
        data = path.read_bytes()
        start = int.from_bytes(data[96:100], "little")
        edits = [
            (100, 2**32 - 1),
            (94, 0),
            (96, 2**32 - 1),
            (105, 0),
            (107, 2**32 - 1),
            (247, 2**32 - 1),
            (start, 2**31),
        ]
        made = [data, data[: start + 20], data[:200], b"LASF", b""]
        for at, value in edits:
            size = {94: 2, 105: 2}.get(at, 4)
            made.append(data[:at] + (value % (1 << 8 * size)).to_bytes(size, "little") + data[at + size :])
        if suffix == ".laz":
            # How many chunks there are is said where the table begins, which the first eight bytes of the points say.
            table = int.from_bytes(data[start : start + 8], "little")
            for value in (2**32 - 1, 2**20, 0):
                made.append(data[: table + 4] + value.to_bytes(4, "little") + data[table + 8 :])
        return made

    return make


def _npz(folder: Path) -> list[Files]:
    write_npz(folder / "a.npz", {"a": np.arange(20.0), "b": np.zeros((2, 3), np.uint8)})
    return [{"a.npz": (folder / "a.npz").read_bytes()}, {"a.npz": b""}, {"a.npz": b"PK\x05\x06" + bytes(18)}]


_CLOUD = {
    "height": 1, "width": 4, "point_step": 16, "row_step": 64, "is_bigendian": False, "size": 64,
    "fields": [{"name": n, "offset": 4 * k, "datatype": 7, "count": 1} for k, n in enumerate(("x", "y", "z", "time"))],
}  # fmt: skip


def _read_message(folder: Path) -> None:
    """A PointCloud2 of JSON; what no message can hold, since its fields have types, is nothing."""
    where = folder / "a.json"
    try:
        tree = json.loads(where.read_bytes())
        u32 = {name: int(tree[name]) % 2**32 for name in ("height", "width", "point_step", "row_step")}
        fields = [
            SimpleNamespace(
                name=str(f["name"]),
                offset=int(f["offset"]) % 2**32,
                datatype=int(f["datatype"]) % 256,
                count=int(f["count"]) % 2**32,
            )
            for f in tree["fields"]
        ]
        data = np.zeros(int(tree["size"]) % 4096, np.uint8)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return
    message = SimpleNamespace(**u32, fields=fields, data=data, is_bigendian=bool(tree.get("is_bigendian")))
    decode_pointcloud2(message, where)


def _livox(folder: Path) -> list[Files]:
    points = b"".join(struct.pack("<IfffBBBB", k * 1000, 1.0 * k, 2.0, 3.0, 9, 0, k % 4, 0)[:19] for k in range(5))
    return [{"a.bin": bytes(8) + struct.pack("<QIB3x", 10**18, 5, 0) + points}, {"a.bin": b""}]


def _read_livox(folder: Path) -> None:
    data = (folder / "a.bin").read_bytes()
    for is_ros1 in (True, False):
        decode_livox(data, 8, is_ros1, "<", folder / "a.bin")


PARSERS = [
    _point_parser("PCD", "a.pcd", _pcd),
    _point_parser("PLY", "a.ply", _ply),
    _point_parser("NumPy", "a.npy", _npy),
    _point_parser("KITTI .bin", "a.bin", _bin),
    _point_parser("LAS", "a.las", _las(".las")),
    _point_parser("LAZ", "a.laz", _las(".laz")),
    Parser("points as text", lambda f: read_points(f / "a.txt"), lambda f: [{"a.txt": d} for d in _text(f)], tables=("a.txt",)),
    Parser("npz", lambda f: read_npz(f / "a.npz"), _npz),
    Parser("PointCloud2", _read_message, lambda f: [{"a.json": json.dumps(_CLOUD).encode()}], trees=("a.json",)),
    Parser("Livox", _read_livox, _livox),
]  # fmt: skip
