"""A trajectory in another format, and of another body: LiDAR, camera 0 or IMU."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

from lslam.errors import InputError, OutputExistsError, UsageError
from lslam.formats.sequence_toml import FRAMES
from lslam.formats.trajectory_formats import FORMATS, WRITTEN
from lslam.geometry import se3
from lslam.types.sequence import Calibration
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")


def convert_trajectory(
    trajectory: Trajectory,
    kind: str,
    out: Path,
    calibration: Calibration,
    *,
    frame: str | None = None,
    overwrite: bool = False,
) -> Trajectory:
    """Write `trajectory` to `out` as `kind`, with poses of the body `frame`, by default the format's usual one; what was written.

    Raises
    ------
    InputError : the change of body needs an extrinsic that `calibration` does not have. UsageError : unknown `kind` or `frame`.
    OutputExistsError : `out` is there and `overwrite` is not set.
    """
    if kind not in WRITTEN:
        raise UsageError(f"no trajectory format {kind!r} to write: {', '.join(WRITTEN)} are")
    wanted = FORMATS[kind]
    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists already: choose another --out, or --overwrite it")
    moved = change_frame(trajectory, frame or wanted.frame or trajectory.frame, calibration)
    if not wanted.has_stamps:
        log.info("%s files have no stamps: line i is pose i", kind.upper())
    elif not trajectory.has_stamps:
        raise InputError(
            f"{trajectory.source} has no stamps and --to {kind} needs them: --times names them, one a line"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    wanted.write(out, moved)
    return moved


def change_frame(trajectory: Trajectory, frame: str, calibration: Calibration) -> Trajectory:
    """The same motion as poses of the body `frame`, by way of the LiDAR.

    Camera poses live in the world of camera 0 at the start, T_cam0 = Tr T_world_lidar inv(Tr); IMU poses share the LiDAR's
    world, T_world_imu = T_world_lidar T_lidar_imu. Raises InputError when the extrinsic for that is unknown.
    """
    if frame == trajectory.frame:
        return trajectory
    if frame not in FRAMES:
        raise UsageError(f"no frame {frame!r}: {', '.join(FRAMES)} are")
    if trajectory.frame not in FRAMES:
        raise UsageError(
            f"{trajectory.source} does not say whose poses it holds: --from-frame {'|'.join(FRAMES)} does, --frame "
            f"{trajectory.frame} leaves them as they are"
        )
    poses = trajectory.poses
    if trajectory.frame == "cam0":
        T = _known(calibration, "T_cam0_lidar", trajectory, frame)
        poses = se3.inverse(T) @ poses @ T
    elif trajectory.frame == "imu":
        poses = poses @ se3.inverse(_known(calibration, "T_lidar_imu", trajectory, frame))
    if frame == "cam0":
        T = _known(calibration, "T_cam0_lidar", trajectory, frame)
        poses = T @ poses @ se3.inverse(T)
    elif frame == "imu":
        poses = poses @ _known(calibration, "T_lidar_imu", trajectory, frame)
    log.info("poses of %s carried to %s", trajectory.frame, frame)
    return replace(trajectory, poses=se3.normalise(poses), frame=frame, covariances=None)


def _known(calibration: Calibration, name: str, trajectory: Trajectory, frame: str) -> se3.Floats:
    T: se3.Floats | None = getattr(calibration, name)
    if T is None:
        flag = (
            "--calib (a KITTI calib.txt with Tr)" if name == "T_cam0_lidar" else "--extrinsics (the IMU in the LiDAR)"
        )
        raise InputError(
            f"{trajectory.source} holds poses of {trajectory.frame} and {frame} is wanted, which needs {name}: give {flag}, or "
            f"--frame {trajectory.frame} to leave them as they are"
        )
    return T
