"""Point files of all kinds, for readers to read."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from lzf_compressor import compress
from numpy.typing import NDArray

from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.pcd_files import pcd_header
from lslam.io.formats.point_cloud import float_table
from lslam.io.formats.point_files import write_bin, write_cloud

PERIOD_S = 0.1
ENCODINGS = ("binary", "ascii", "binary_compressed")


def write_points(path: Path, points: NDArray[Any], intensity: NDArray[Any] | None = None) -> None:
    """Points (N, 3), m, and intensity (N,) as float32; intensities of `.bin` and `.npy` files are 0 where there are none."""
    if path.suffix == ".bin":
        write_bin(path, points, intensity)
    elif path.suffix == ".npy":
        with atomic_write(path) as stream:
            np.save(stream, float_table(points, np.zeros(len(points)) if intensity is None else intensity))
    else:
        write_cloud(path, ArrayCloud.of(points, intensity))


def write_pcd(path: Path, points: NDArray[Any], intensity: NDArray[Any], encoding: str = "binary") -> None:
    """Points (N, 3), m, and intensity (N,) as float32 in one of `ENCODINGS`."""
    table = float_table(points, intensity)
    header = pcd_header(len(table), np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])).replace(
        b"DATA binary", f"DATA {encoding}".encode()
    )
    with path.open("wb") as stream:
        stream.write(header)
        if encoding == "binary":
            stream.write(table.data)
        elif encoding == "ascii":
            np.savetxt(stream, table, fmt="%.9g")
        else:
            plain = np.ascontiguousarray(table.T).view(np.uint8).ravel()
            target = np.empty(len(plain) + len(plain) // 32 + 16, np.uint8)
            size = compress(plain, target, np.full(65536, -1, np.int64))
            stream.write(struct.pack("<II", size, len(plain)) + target[:size].tobytes())


def revolution(seed: int = 0, turns: int = 512, rings: int = 16) -> dict[str, NDArray[np.float64]]:
    """Columns of one revolution in a room of 18 x 11 m, in the order of firing; times in s, sent as the driver numbers them."""
    rng = np.random.default_rng(seed)
    ring = np.tile(np.arange(rings), turns)
    time = np.repeat(np.arange(turns), rings) * (PERIOD_S / turns)
    azimuth, elevation = -2 * np.pi * time / PERIOD_S, np.radians(np.linspace(-15, 15, rings))[ring]
    along = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    with np.errstate(divide="ignore"):
        walls = np.where(along > 0, [9.3, 5.2, 7.0], [-8.4, -6.1, -1.7]) / along
    r = walls.min(1) + rng.normal(0, 0.02, len(ring))
    x, y, z = (r[:, None] * along).T
    return {
        "x": x, "y": y, "z": z, "intensity": np.round(200 * rng.random(len(r))), "ring": ring.astype(float), "time": time,
        "time_ns": np.round(1e9 * time), "stamp": 1.7e9 + time, "one": np.ones(len(r)), "noise": rng.normal(size=len(r)),
    }  # fmt: skip


def packed(columns: dict[str, NDArray[np.float64]], words: str, count: int | None = None) -> bytes:
    """Rows of the columns that `words` name, with their types."""
    parts = [word.split(":") for word in words.split()]
    table = np.zeros(len(columns["x"]), [(str(k), p[1] if len(p) > 1 else "f4") for k, p in enumerate(parts)])
    for k, (name, *_) in enumerate(parts):
        if name != "pad":
            table[str(k)] = columns[name]
    return table[:count].tobytes()
