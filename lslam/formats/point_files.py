"""Point files by suffix: clouds in `.bin`, PCD, PLY and NumPy; maps in PLY, PCD, LAS and LAZ, written block by block."""

from __future__ import annotations

from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, UsageError, cause
from lslam.formats.array_headers import HEADERS
from lslam.formats.atomic import atomic_write
from lslam.formats.las_files import read_las, write_las
from lslam.formats.pcd_files import pcd_header, read_pcd, write_pcd
from lslam.formats.ply_files import ply_header, read_ply, write_ply
from lslam.formats.point_cloud import PointCloud
from lslam.remote import RemotePath
from lslam.types.cloud import ArrayCloud, Cloud
from lslam.untrusted import MISFIT

SUFFIXES = (".bin", ".pcd", ".ply", ".npy")
# Record sizes other data sets use, to tell a truncated file from one of another kind.
_OTHER_RECORDS = {12: "x, y, z", 20: "x, y, z, intensity, ring", 24: "x, y, z, intensity, ring, time"}
MAP_SUFFIXES = (".ply", ".pcd", ".las", ".laz")


def read_points(path: Path) -> PointCloud:
    """Read one point file, chosen by its suffix; NaN, Inf and zero points are kept as they are.

    Raises InputError naming the file and the place when it is missing, truncated or of another kind.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        raw = read_bin(path)
        return PointCloud(np.ascontiguousarray(raw[:, :3]), np.ascontiguousarray(raw[:, 3]))
    if suffix == ".pcd":
        return read_pcd(path)
    if suffix == ".ply":
        return read_ply(path)
    if suffix == ".npy":
        return _read_npy(path)
    if suffix == ".txt":
        return _read_text(path)
    raise InputError(f"{path}: no point file lslam reads; known suffixes: {', '.join(SUFFIXES)}")


def read_bin(path: Path) -> NDArray[np.float32]:
    """(N, 4) float32 x, y, z (m) and intensity of a KITTI `.bin` file.

    Raises InputError naming the file and its size when that is no multiple of 16 bytes.
    """
    try:
        if isinstance(path, RemotePath):
            raw = np.frombuffer(bytearray(path.read_bytes()), np.uint8)
        else:
            with path.open("rb") as stream:
                raw = np.fromfile(stream, np.uint8)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    if len(raw) % 16:
        others = [f"{size} bytes ({what})" for size, what in _OTHER_RECORDS.items() if len(raw) % size == 0]
        could = f"or its records are of {' or '.join(others)}: convert them" if others else "fetch it again"
        raise InputError(
            f"{path}: {len(raw)} bytes are no multiple of 16 (x, y, z, intensity as float32): the file is truncated "
            f"after point {len(raw) // 16}, {could}"
        )
    return raw.view("<f4").reshape(-1, 4)


def write_points(path: Path, points: NDArray[Any], intensity: NDArray[Any] | None = None, *, comment: str = "") -> None:
    """Write points (N, 3), m, and intensity (N,) as float32 to a .ply, .pcd (both binary), .bin or .npy file, atomically.

    `comment` goes into PLY headers only. Raises UsageError on another suffix or arrays that do not match, OutputError
    when the file cannot be written.
    """
    if np.ndim(points) != 2 or np.shape(points)[1] != 3 or (intensity is not None and len(intensity) != len(points)):
        raise UsageError(f"{path}: points must be (N, 3) and intensity (N,), not {np.shape(points)}")
    suffix = path.suffix.lower()
    if suffix == ".ply":
        write_ply(path, points, intensity, comment)
    elif suffix == ".pcd":
        write_pcd(path, points, intensity)
    elif suffix in (".bin", ".npy"):
        table = np.zeros((len(points), 4), "<f4")
        table[:, :3] = points
        if intensity is not None:
            table[:, 3] = intensity
        with atomic_write(path) as stream:
            if suffix == ".npy":
                np.save(stream, table)
            else:
                stream.write(table.data)
    else:
        raise UsageError(f"{path}: no point file lslam writes; known suffixes: {', '.join(SUFFIXES)}")


def _read_npy(path: Path) -> PointCloud:
    from lslam.formats.point_cloud import cloud_from_fields

    try:
        with HEADERS, path.open("rb") as stream:
            table = np.load(stream, allow_pickle=False)
    except (OSError, *MISFIT, EOFError, SyntaxError, MemoryError, TokenError) as error:
        raise InputError(f"{path} cannot be read as a NumPy array: {error}") from None
    if table.dtype.names:
        flat = table.ravel()
        return cloud_from_fields(path, {name: flat[name] for name in table.dtype.names})
    # Organised clouds (rows, cols, 3 or 4) are flattened row by row.
    if table.ndim not in (2, 3) or table.shape[-1] < 3 or table.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: array of shape {table.shape} and type {table.dtype}, expected (N, 3) or (N, 4) numbers"
        )
    table = table.reshape(-1, table.shape[-1])
    points = np.ascontiguousarray(table[:, :3], np.float32)
    return PointCloud(points, np.ascontiguousarray(table[:, 3], np.float32) if table.shape[1] > 3 else None)


def _read_text(path: Path) -> PointCloud:
    """KITTI raw `extract` scans: x y z intensity, one point per line."""
    try:
        text = path.read_text(encoding="ascii")
        table = np.loadtxt(text.splitlines(), np.float32, ndmin=2) if text.strip() else np.zeros((0, 4), np.float32)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path} cannot be read as lines of x y z intensity: {error}") from None
    if table.shape[1] != 4:
        raise InputError(f"{path}: {table.shape[1]} numbers a line where x y z intensity are 4")
    return PointCloud(np.ascontiguousarray(table[:, :3]), np.ascontiguousarray(table[:, 3]))


def write_cloud(path: Path, cloud: Cloud, *, comment: str = "", wkt: str = "") -> None:
    """Write a cloud, m, atomically and without holding it in memory.

    Parameters
    ----------
    path : its suffix chooses: .ply and .pcd hold float32, .las and .laz millimetres about an offset
    comment : goes into PLY headers; wkt : coordinate reference system of the points, for LAS and LAZ

    Raises
    ------
    UsageError : another suffix. OutputError : the file cannot be written
    """
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz"):
        write_las(path, cloud, wkt)
        return
    if suffix not in MAP_SUFFIXES:
        raise UsageError(f"{path}: no map file lslam writes; known suffixes: {', '.join(MAP_SUFFIXES)}")
    names = ["x", "y", "z", "intensity"] if cloud.has_intensity else ["x", "y", "z"]
    with atomic_write(path) as stream:
        stream.write(ply_header(len(cloud), names, comment) if suffix == ".ply" else pcd_header(len(cloud), names))
        for block in cloud.blocks():
            table = np.empty((len(block), len(names)), "<f4")
            table[:, :3] = block.points
            if block.intensity is not None:
                table[:, 3] = block.intensity
            stream.write(table.data)


def read_cloud(path: Path) -> ArrayCloud:
    """Read any map or point file whole, its points as float64, m; LAS and LAZ keep their millimetres at any offset.

    Raises InputError naming the file when it is missing, damaged or of another kind.
    """
    if path.suffix.lower() in (".las", ".laz"):
        return read_las(path)[0]
    read = read_points(path)
    return ArrayCloud.of(read.points, read.intensity)
