"""Cameras of folders and of KITTI's layouts. Images are listed when cameras are asked for, and read one by one."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.camera import Camera, Image
from lslam.io.formats.calibration_files import read_projection, read_raw_cam0_lidar
from lslam.io.formats.camera_info import CameraInfo
from lslam.io.formats.image_files import SUFFIXES, image_size, read_image
from lslam.io.formats.sequence_toml import FILE_NAME
from lslam.io.formats.time_columns import read_stamps
from lslam.io.readers.listing import list_scans, rows_of


def folder_cameras(folder: Path, infos: Mapping[str, CameraInfo]) -> list[Camera]:
    """Cameras that `sequence.toml` names. Raises InputError where images or stamps are missing, or their numbers differ."""
    return [_camera_of(folder, name, info) for name, info in infos.items()]


def _camera_of(folder: Path, name: str, info: CameraInfo) -> Camera:
    files = _images(folder / info.images, f"named by cameras.{name} of {folder / FILE_NAME}")
    path = folder / info.stamps_file
    if not path.is_file():
        raise InputError(f"{path} does not exist: camera {name} needs a file with a stamp for each of its images")
    stamps = read_stamps(path)
    if len(stamps) != len(files):
        raise InputError(f"{path} has {len(stamps)} stamps for {len(files)} images of camera {name}")
    stamps = stamps + round(1e9 * info.time_offset_s)
    return stamped(name, info, files, stamps, path)


def stamped(name: str, info: CameraInfo, files: list[Path], stamps: Longs, source: Path) -> Camera:
    """Camera of image files and their stamps. Raises InputError when time goes back."""
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back):
        raise InputError(
            f"{source}: time does not increase at line {back[0] + 2}: camera {name} needs increasing stamps"
        )
    return Camera(name, info.lens(image_size(files[0])), info.T_lidar_camera, stamps, partial(_read, files))


def kitti_cameras(folder: Path, scans: list[Path], stamps_ns: Longs, T_cam0_lidar: Floats | None) -> list[Camera]:
    """Camera 2 of a KITTI odometry sequence, rectified: image_2 with P2 of calib.txt, taken when the scanner looks ahead."""
    place = folder / "image_2"
    if not place.is_dir():
        return []
    if T_cam0_lidar is None:
        raise InputError(f"the camera of {folder} has no calibration: {folder / 'calib.txt'} with P2 and Tr is missing")
    files = _images(place, "of KITTI's layout")
    stamps = _stamps_by_name(files, scans, stamps_ns)
    return [_rectified("image_2", folder / "calib.txt", "P2", T_cam0_lidar, files, stamps)]


def kitti_raw_cameras(folder: Path) -> list[Camera]:
    """Camera 2 of a KITTI raw drive, rectified (`sync`): image_02 with the calibration of its day."""
    place = folder / "image_02"
    if not (place / "data").is_dir():
        return []
    day = folder.parent
    if not (day / "calib_cam_to_cam.txt").is_file():
        raise InputError(f"the camera of {folder} has no calibration: {day / 'calib_cam_to_cam.txt'} is missing")
    if folder.name.endswith("_extract"):
        raise InputError(
            f"{place} is not rectified: the images of a _sync drive are read, or [cameras.NAME] in {FILE_NAME}"
        )
    T_cam0_lidar = read_raw_cam0_lidar(day)
    files = _images(place / "data", "of KITTI's layout")
    stamps = read_stamps(place / "timestamps.txt")
    rows, _ = rows_of(files, len(stamps))
    if not len(stamps) or (rows < 0).any():
        raise InputError(f"{place / 'timestamps.txt'} has {len(stamps)} stamps for {len(files)} images")
    return [_rectified("image_02", day / "calib_cam_to_cam.txt", "P_rect_02", T_cam0_lidar, files, stamps[rows])]


def _stamps_by_name(files: list[Path], scans: list[Path], stamps_ns: Longs) -> Longs:
    """Stamps of images that have the names of their scans. Raises InputError where one has no scan."""
    known = dict(zip((path.stem for path in scans), stamps_ns.tolist(), strict=True))
    lonely = [path for path in files if path.stem not in known]
    if lonely:
        raise InputError(f"{lonely[0]} has no scan of its name, whose stamp it would have: remove it")
    return np.array([known[path.stem] for path in files], np.int64)


def _rectified(name: str, calib: Path, key: str, T_cam0_lidar: Floats, files: list[Path], stamps: Longs) -> Camera:
    """Camera of rectified images by its projection P = K [1 | t] of points of the rectified camera 0."""
    P = read_projection(calib, key)
    T_camera_cam0 = se3.make(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
    T_lidar_camera = se3.inverse(T_camera_cam0 @ T_cam0_lidar)
    intrinsics = (float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]))
    return stamped(name, CameraInfo(name, intrinsics, T_lidar_camera), files, stamps, calib)


def _images(folder: Path, whose: str) -> list[Path]:
    files = list_scans(folder, SUFFIXES)[0] if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}, {whose}, holds no images ({', '.join('*' + suffix for suffix in SUFFIXES)})")
    return files


def _read(files: list[Path], k: int) -> Image:
    return read_image(files[k])
