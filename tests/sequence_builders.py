"""Small sequences written to disk, for tests to break."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from point_writers import write_points

from lslam.core.geometry import se3

# Camera 0 of KITTI looks along the LiDAR's x: z forward, x right, y down.
T_CAM0_LIDAR = se3.make(np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([0.0, -0.08, -0.27]))


def cloud(seed: int, n: int = 300) -> NDArray[np.float32]:
    """(n, 4) float32 points no higher than 2 deg above the horizon, as of an HDL-64E."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), np.radians(rng.uniform(-24, 2, n))
    r = rng.uniform(5, 50, n)
    xyz = r[:, None] * np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return np.column_stack([xyz, rng.random(n)]).astype(np.float32)


def scans(folder: Path, count: int, suffix: str = ".bin", digits: int = 6) -> Path:
    """`count` scans of 300 points in `folder`."""
    folder.mkdir(parents=True)
    for k in range(count):
        table = cloud(k)
        write_points(folder / f"{k:0{digits}d}{suffix}", table[:, :3], table[:, 3])
    return folder


def lidar_poses(count: int) -> NDArray[np.float64]:
    """(count, 4, 4) poses along a gentle left turn at 1 m per scan."""
    step = se3.exp(np.array([1.0, 0, 0, 0, 0, 0.02]))
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def kitti_root(root: Path, count: int = 6, number: str = "07") -> Path:
    """A KITTI odometry root; returns the sequence folder."""
    folder = root / "sequences" / number
    scans(folder / "velodyne", count)
    (folder / "times.txt").write_text("".join(f"{k * 0.1:.6e}\n" for k in range(count)))
    (folder / "calib.txt").write_text("Tr: " + " ".join(map(repr, T_CAM0_LIDAR[:3].ravel().tolist())) + "\n")
    (root / "poses").mkdir(exist_ok=True)
    cam0 = T_CAM0_LIDAR @ lidar_poses(count) @ se3.inverse(T_CAM0_LIDAR)
    np.savetxt(root / "poses" / f"{number}.txt", cam0[:, :3].reshape(-1, 12), fmt="%.12e")
    return folder


def raw_drive(root: Path, count: int = 6, name: str = "2011_09_26_drive_0005_sync", pos_acc: float = 0.05) -> Path:
    """A KITTI raw drive going east at 10 m/s; returns the drive's folder."""
    folder = root / "2011_09_26" / name
    scans(folder / "velodyne_points" / "data", count, digits=10)
    (folder / "oxts" / "data").mkdir(parents=True)
    for k in range(count):
        row = np.zeros(30)
        row[:3] = 49.0, 8.4 + k * 1.3670e-5, 110.0
        row[11:14], row[23] = (0, 0, 9.81), pos_acc
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(repr, row.tolist())))
    lines = "".join(f"2011-09-26 13:04:{32 + k / 10:012.9f}\n" for k in range(count))
    (folder / "oxts" / "timestamps.txt").write_text(lines)
    day = folder.parent
    (day / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    (day / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27\n")
    return folder
