"""Point files of all kinds, for readers to read."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.formats.atomic import atomic_write
from lslam.formats.pcd_files import pcd_header
from lslam.formats.point_cloud import float_table
from lslam.formats.point_files import write_bin, write_cloud
from lslam.kernels.lzf import compress
from lslam.types.cloud import ArrayCloud

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
    header = pcd_header(len(table), ["x", "y", "z", "intensity"]).replace(b"DATA binary", f"DATA {encoding}".encode())
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
