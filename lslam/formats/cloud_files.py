"""Map files by suffix: PLY, PCD, LAS and LAZ written block by block, and any of them read back whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lslam.errors import UsageError
from lslam.formats.atomic import atomic_write
from lslam.formats.las_files import read_las, write_las
from lslam.formats.pcd_files import pcd_header
from lslam.formats.ply_files import ply_header
from lslam.formats.point_files import read_points
from lslam.types.cloud import ArrayCloud, Cloud

SUFFIXES = (".ply", ".pcd", ".las", ".laz")


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
    if suffix not in SUFFIXES:
        raise UsageError(f"{path}: no map file lslam writes; known suffixes: {', '.join(SUFFIXES)}")
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
