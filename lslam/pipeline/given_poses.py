"""--poses: a trajectory file's stamps and body are made those of the sequence's LiDAR."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lslam.errors import InputError
from lslam.evaluation.frames import main_axis
from lslam.geometry import se3
from lslam.odometry.given import GivenMotion, GivenPoses
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")


def bind(odometry: GivenPoses, sequence: Sequence) -> list[str]:
    """Give the poses the stamps of the whole `sequence` when their file has none, and carry them to the LiDAR.

    What was decided, one sentence each. Raises InputError when poses and scans do not belong together.
    """
    notes: list[str] = []
    trajectory = odometry.trajectory
    if not trajectory.has_stamps:
        if len(trajectory) != len(sequence):
            raise InputError(
                f"{trajectory.source} has {len(trajectory)} poses without stamps and {sequence.name} has {len(sequence)} scans: "
                "give a file with stamps, or one pose per scan"
            )
        trajectory = replace(trajectory, stamps_ns=np.asarray(sequence.stamps_ns, np.int64), has_stamps=True)
        notes.append("poses without stamps: line i is scan i")
    trajectory, said = _of_lidar(trajectory, sequence)
    notes += said
    (first, last), (begin, end) = ((1e-9 * s[0], 1e-9 * s[-1]) for s in (trajectory.stamps_ns, sequence.stamps_ns))
    if first > end or last < begin:
        raise InputError(
            f"{trajectory.source} shares no time with {sequence.name}: its poses run from {first:.3f} to {last:.3f} s, the "
            f"scans from {begin:.3f} to {end:.3f} s"
        )
    odometry.trajectory, odometry.motion = trajectory, GivenMotion(trajectory)
    for note in notes:
        log.info("%s", note)
    return notes


def _of_lidar(trajectory: Trajectory, sequence: Sequence) -> tuple[Trajectory, list[str]]:
    """The trajectory of the LiDAR; a file's word for its body counts unless the motion says otherwise."""
    axis = main_axis(trajectory.poses)
    is_camera = trajectory.frame == "cam0" and axis not in ("+x", "-x")
    T = sequence.calibration.T_cam0_lidar
    if is_camera and T is not None:
        moved = se3.inverse(T) @ trajectory.poses @ T
        return replace(trajectory, poses=moved, frame="lidar"), [
            "poses of camera 0 converted to the LiDAR with T_cam0_lidar"
        ]
    if trajectory.frame == "imu" and (T_lidar_imu := sequence.calibration.T_lidar_imu) is not None:
        moved = trajectory.poses @ se3.inverse(T_lidar_imu)
        return replace(trajectory, poses=moved, frame="lidar"), [
            "poses of the IMU converted to the LiDAR with T_lidar_imu"
        ]
    if axis in ("+z", "-z") or is_camera or trajectory.frame == "imu":
        body = {"cam0": "the camera", "imu": "the IMU"}.get(
            trajectory.frame, "a camera (they advance along its z axis)"
        )
        raise InputError(
            f"{trajectory.source} has poses of {body}, and {sequence.name} does not say where that sits on the LiDAR: convert "
            "them with `lslam convert --frame lidar`, or give the calibration (calib.txt, --extrinsics)"
        )
    return trajectory, []
