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

from lslam.errors import OutputError, OutputExistsError, cause
from lslam.formats.kitti_layout import PER_POINT, POINTS, in_camera, write_calib, write_times
from lslam.formats.sequence_toml import FILE_NAME, SequenceInfo, write_sequence_toml
from lslam.formats.trajectory_files import write_kitti
from lslam.simulation.manifest import write_manifest
from lslam.simulation.osm_extract import write_extracts
from lslam.simulation.scenarios import SimulatedDrive
from lslam.simulation.sensors import GNSS_FILE, IMU_FILE, TRUTH, write_readings, write_truth
from lslam.simulation.stream import MARK, fingerprint, read_mark, write_mark, write_scans
from lslam.simulation.target import NUMBER, check_target, part_of

log = logging.getLogger("lslam")

_MAP_SEED = 2**32 - 9  # of the faults in the perturbed map
_SIDES, _HOUSE = 80e3, 4e3  # bytes beside the scans: per second of readings and truth, and per building of the maps


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
    on_scan: Callable[[int], None] | None = None,
    resume: bool = False,
    command: str = "",
) -> Recorded:
    """Trace all scans of `drive` and write `out`/sequences/00 and `out`/poses/00.txt.

    The poses are of camera 0, as KITTI's; everything else in `out` is left alone. `on_scan` is called after each scan. What
    is interrupted keeps its scans in `sequences/00.part`, and `resume` goes on there with the same bytes. Last comes the
    sequence's `manifest.json`, with `command`, what was typed.

    Raises
    ------
    OutputExistsError : `out` holds something and neither `overwrite` nor `resume` is set, or what was begun is another drive
    OutputError : `out` cannot be written, or the disk is too small
    """
    sequence, poses = out / "sequences" / NUMBER, out / "poses" / f"{NUMBER}.txt"
    check_target(out, overwrite, resume)
    part = part_of(out)
    done = False
    try:
        if not resume or not part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
        elif read_mark(part) != fingerprint(drive):
            done = True
            raise OutputExistsError(f"{part} was begun with other settings: give the same ones, or --overwrite it")
        for folder in (part / POINTS, part / PER_POINT, poses.parent):
            folder.mkdir(parents=True, exist_ok=True)
        _check_space(out, part, drive)
        write_mark(part, drive)
        points = write_scans(drive, part, on_scan)
        _write_sides(drive, part)
        truth, T_cam0_lidar = drive.ground_truth, drive.calibration.T_cam0_lidar
        assert truth is not None
        assert T_cam0_lidar is not None
        write_kitti(poses, in_camera(truth, T_cam0_lidar))
        (part / MARK).unlink()
        if sequence.exists():
            shutil.rmtree(sequence)
        os.replace(part, sequence)
        done = True
    except OSError as error:
        raise OutputError(f"{error.filename or out} cannot be written: {cause(error)}") from None
    finally:
        if not done:
            _keep_what_is_worth_it(out, part)
    size = poses.stat().st_size + sum(file.stat().st_size for file in sequence.rglob("*") if file.is_file())
    write_manifest(sequence, drive, command, points, size)
    return Recorded(sequence, poses, points, size)


def _check_space(out: Path, part: Path, drive: SimulatedDrive) -> None:
    """Say how much disk it takes, and refuse at once what will not fit, instead of failing hours later."""
    left = len(drive) - sum(1 for _ in (part / PER_POINT).glob("*.npz"))
    beside = _SIDES * drive.end + _HOUSE * len(drive.city.footprints)
    needed = left * drive.lidar.rays * (16 + 2) + beside
    free = shutil.disk_usage(out).free
    if needed > free:
        raise OutputError(
            f"{out} needs up to {_size(needed)}, the disk has {_size(free)} left: use fewer scans (--scans)"
        )
    kept = f", {len(drive) - left} of them are there already" if left < len(drive) else ""
    log.info("%d scans of up to %d points%s: at most %.1f MB", len(drive), drive.lidar.rays, kept, needed / 1e6)


def _size(amount: float) -> str:
    return f"{amount / 1e9:.1f} GB" if amount >= 1e9 else f"{amount / 1e6:.1f} MB"


def _keep_what_is_worth_it(out: Path, part: Path) -> None:
    """Whole scans stay for --resume; where there are none, nothing is left behind, so that the command can be given again."""
    with contextlib.suppress(OSError):
        kept = sum(1 for _ in (part / PER_POINT).glob("*.npz"))
        if kept and read_mark(part) is not None:
            log.warning("%d scans are kept in %s: the same command with --resume goes on", kept, part)
            return
    shutil.rmtree(part, ignore_errors=True)
    for folder in (out / "sequences", out / "poses", out):
        with contextlib.suppress(OSError):
            folder.rmdir()


def _write_sides(drive: SimulatedDrive, folder: Path) -> None:
    """Everything beside the scans."""
    _write_texts(drive, folder)
    write_readings(folder, drive.readings)
    if drive.city.footprints:
        write_extracts(folder, drive.city, drive.readings.origin, np.random.default_rng([drive.seed, _MAP_SEED]))
    write_truth(folder / TRUTH, drive.vehicle, drive.stamps_ns, drive.end, drive.readings)


def _write_texts(drive: SimulatedDrive, folder: Path) -> None:
    """times.txt, calib.txt and sequence.toml."""
    T_cam0_lidar = drive.calibration.T_cam0_lidar
    assert T_cam0_lidar is not None
    write_times(folder, drive.stamps_ns)
    write_calib(folder, T_cam0_lidar)
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
