"""KITTI's odometry layout as lslam writes it: `sequences/NN` with scans, their times and rings beside, and `poses/NN.txt`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import portable, se3
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.atomic import atomic_write, write_text
from lslam.io.formats.point_files import write_bin
from lslam.io.formats.text_tables import seconds_text

POINTS, PER_POINT = "velodyne", "per_point"


def scan_files(folder: Path, number: int) -> tuple[Path, Path]:
    """The points of scan `number` in the sequence folder, and the file with their times and rings."""
    return folder / POINTS / f"{number:06d}.bin", folder / PER_POINT / f"{number:06d}.npz"


def write_scan(
    folder: Path,
    number: int,
    points: NDArray[np.float32],
    intensity: NDArray[np.float32] | None,
    times: NDArray[np.float32] | None,
    rings: NDArray[np.uint16] | None,
) -> None:
    """Write points, and beside them what is known of times, s from the scan's stamp, and rings. That file comes last, always."""
    cloud, beside = scan_files(folder, number)
    write_bin(cloud, points, intensity)
    known: dict[str, Any] = {name: v for name, v in (("t", times), ("ring", rings)) if v is not None}
    with atomic_write(beside) as stream:
        np.savez_compressed(stream, **known)


def write_times(folder: Path, stamps_ns: Longs) -> None:
    """Write `times.txt`, seconds with all nine decimals."""
    write_text(folder / "times.txt", "".join(f"{seconds_text(int(stamp))}\n" for stamp in stamps_ns))


def write_calib(folder: Path, T_cam0_lidar: Floats) -> None:
    """Write `calib.txt` with the line `Tr`."""
    write_text(folder / "calib.txt", "Tr: " + " ".join(f"{v:.12e}" for v in T_cam0_lidar[:3].ravel()) + "\n")


def in_camera(truth: Trajectory, T_cam0_lidar: Floats) -> Trajectory:
    """LiDAR poses as KITTI has them: camera 0 in camera 0 at the start."""
    poses = portable.product(portable.product(T_cam0_lidar, truth.poses), se3.inverse(T_cam0_lidar))
    return Trajectory(truth.stamps_ns, poses, "cam0", truth.has_stamps, source=truth.source)
