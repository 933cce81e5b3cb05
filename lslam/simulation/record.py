"""A simulated drive on disk, in KITTI's odometry layout with `sequence.toml`; written whole or not at all."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lslam.errors import OutputError, OutputExistsError
from lslam.formats.atomic import atomic_write
from lslam.formats.point_files import write_points
from lslam.formats.pose_rows import seconds_text
from lslam.formats.sequence_toml import FILE_NAME, SequenceInfo, write_sequence_toml
from lslam.formats.trajectory_files import write_kitti
from lslam.geometry import se3
from lslam.simulation.osm_extract import write_extracts
from lslam.simulation.scenarios import SimulatedDrive
from lslam.simulation.sensors import GNSS_FILE, IMU_FILE, TRUTH, write_readings, write_truth
from lslam.types.scan import Scan
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")

NUMBER = "00"  # of the one sequence in the folder
PER_POINT = "per_point"
_MAP_SEED = 2**32 - 9  # of the faults in the perturbed map


@dataclass(frozen=True)
class Recorded:
    """What was written: the sequence folder, its poses, the number of points and of bytes."""

    sequence: Path
    poses: Path
    points: int
    size: int


def record(
    drive: SimulatedDrive,
    out: Path,
    overwrite: bool = False,
    on_scan: Callable[[Scan], None] | None = None,
) -> Recorded:
    """Trace all scans of `drive` and write `out`/sequences/00 and `out`/poses/00.txt.

    The poses are of camera 0, as KITTI's; everything else in `out` is left alone. `on_scan` is called after each scan.

    Raises
    ------
    OutputExistsError : `out` holds something and `overwrite` is not set
    OutputError : `out` cannot be written, or the disk is too small
    """
    sequence, poses = out / "sequences" / NUMBER, out / "poses" / f"{NUMBER}.txt"
    check_target(out, overwrite)
    part = sequence.with_name(NUMBER + ".part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        for folder in (part / "velodyne", part / PER_POINT, poses.parent):
            folder.mkdir(parents=True, exist_ok=True)
        _check_space(out, drive)
        points = _write_scans(drive, part, on_scan)
        _write_texts(drive, part)
        write_readings(part, drive.readings)
        if drive.city.footprints:
            write_extracts(part, drive.city, drive.readings.origin, np.random.default_rng([drive.seed, _MAP_SEED]))
        write_truth(part / TRUTH, drive.vehicle, drive.stamps_ns, drive.end, drive.readings)
        if sequence.exists():
            shutil.rmtree(sequence)
        os.replace(part, sequence)
        write_kitti(poses, _in_camera(drive))
    except OSError as error:
        raise OutputError(f"{error.filename or out} cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
        _remove_empty(out)
    size = sum(file.stat().st_size for file in sequence.rglob("*") if file.is_file())
    return Recorded(sequence, poses, points, size)


def check_target(out: Path, overwrite: bool) -> None:
    """Raise OutputExistsError when `out` is a file, or holds something and `overwrite` is not set."""
    try:
        if out.exists() and not out.is_dir():
            raise OutputExistsError(f"{out} is a file: give --out a folder that does not exist yet")
        if not overwrite and out.is_dir() and any(out.iterdir()):
            raise OutputExistsError(
                f"{out} exists already: choose another --out, or --overwrite to replace the sequence in it"
            )
    except OSError as error:
        raise OutputError(f"{out} cannot be read: {error.strerror or error}") from None


def _check_space(out: Path, drive: SimulatedDrive) -> None:
    """Refuse at once what will not fit, instead of failing hours later."""
    needed = len(drive) * drive.lidar.rays * (16 + 2)
    free = shutil.disk_usage(out).free
    if needed > free:
        raise OutputError(
            f"{out} needs up to {needed / 1e9:.1f} GB, the disk has {free / 1e9:.1f} GB left: use fewer scans (--count)"
        )
    log.info("%d scans of up to %d points, at most %.1f MB", len(drive), drive.lidar.rays, needed / 1e6)


def _remove_empty(out: Path) -> None:
    """What failed leaves no folders behind, so that the same command can be given again."""
    for folder in (out / "sequences", out / "poses", out):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _write_scans(drive: SimulatedDrive, folder: Path, on_scan: Callable[[Scan], None] | None) -> int:
    """Points as KITTI's .bin; times and rings beside them. Returns the number of points."""
    total = 0
    for scan in drive:
        write_points(folder / "velodyne" / f"{scan.index:06d}.bin", scan.points, scan.intensity)
        # All rays of a compensated scan were fired at its stamp.
        times = np.zeros(len(scan), np.float32) if scan.times is None else scan.times
        with atomic_write(folder / PER_POINT / f"{scan.index:06d}.npz") as stream:
            np.savez_compressed(stream, t=times, ring=scan.rings)  # type: ignore[arg-type]
        total += len(scan)
        if on_scan is not None:
            on_scan(scan)
    return total


def _write_texts(drive: SimulatedDrive, folder: Path) -> None:
    """times.txt, calib.txt and sequence.toml."""
    T_cam0_lidar = drive.calibration.T_cam0_lidar
    assert T_cam0_lidar is not None
    with atomic_write(folder / "times.txt") as stream:
        stream.write("".join(f"{seconds_text(int(stamp))}\n" for stamp in drive.stamps_ns).encode())
    with atomic_write(folder / "calib.txt") as stream:
        stream.write(("Tr: " + " ".join(f"{v:.12e}" for v in T_cam0_lidar[:3].ravel()) + "\n").encode())
    info = SequenceInfo(
        name=drive.name,
        sensor=f"simulated {drive.lidar.name}",
        rings=drive.lidar.rings,
        rate_hz=drive.rate_hz,
        motion_compensated=drive.motion_compensated,
        compensated_to="scan_start" if drive.motion_compensated else None,
        vertical_correction_deg=0.0,
        per_point=PER_POINT,
        ground_truth=f"../../poses/{NUMBER}.txt",
        ground_truth_frame="cam0",
        imu=None if drive.imu is None else IMU_FILE,
        gnss=None if drive.gnss is None else GNSS_FILE,
        T_cam0_lidar=T_cam0_lidar,
        T_lidar_imu=drive.calibration.T_lidar_imu,
        T_lidar_gnss=drive.calibration.T_lidar_gnss,
    )
    write_sequence_toml(folder / FILE_NAME, info)


def _in_camera(drive: SimulatedDrive) -> Trajectory:
    """The ground truth as KITTI has it: camera 0 in camera 0 at the start."""
    truth, T_cam0_lidar = drive.ground_truth, drive.calibration.T_cam0_lidar
    assert truth is not None
    assert T_cam0_lidar is not None
    poses = T_cam0_lidar @ truth.poses @ se3.inverse(T_cam0_lidar)
    return Trajectory(truth.stamps_ns, poses, "cam0", source=truth.source)
