"""What a run found of the calibration of its IMU: the rotation of its extrinsics and its clock, for the manifest."""

from __future__ import annotations

from typing import Any

import numpy as np

from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.initialise import InertialStart

# An IMU whose turns lie so far beside those of the scans, and by so many sigma, is turned against T_lidar_imu: axes two per
# cent askew (a consumer device's data sheet) show 1.6 deg.
LEAST_TURN_RAD, SIGMAS = np.deg2rad(2.0), 4.0


def mounting_problem(motion: InertialMotion) -> str:
    """A sentence where the turns contradict the rotation of T_lidar_imu and it is not estimated; else empty.

    Turns about one axis do not tell a turned device from one whose axes are askew; those about a second one do. The advice is
    one that the method of this motion model takes.
    """
    gyroscope = motion.estimate.gyroscope
    angle, sigma = gyroscope.tilt
    if gyroscope.is_mounted or angle < LEAST_TURN_RAD or angle < SIGMAS * sigma:
        return ""
    first = "" if motion.HAS_DEVICE else "--method fast-lio2 "
    if motion.config.velocity == "integrated":
        first = "--set imu.velocity=registration "
    cause = "correct T_lidar_imu, or have it estimated"
    if not _is_turned(gyroscope):
        cause = (
            "the gyroscope's axes are askew or T_lidar_imu is turned, turns about one axis do not tell which; the latter is "
            "estimated"
        )
    return (
        f"IMU: it turns about an axis {np.rad2deg(angle):.1f} deg (sigma {np.rad2deg(sigma):.1f}) beside that of the scans: "
        f"{cause} by {first}--set imu.estimate_extrinsics=true"
    )


def _is_turned(gyroscope: Gyroscope) -> bool:
    """Whether a rotation of the whole device is certain, whatever its axes may be askew."""
    rotation, covariance = gyroscope.rotation[0], gyroscope.rotation_covariance
    angle = float(np.linalg.norm(rotation))
    return angle**2 > SIGMAS * float(np.sqrt(rotation @ covariance @ rotation))


def calibration_found(gyroscope: Gyroscope, begun: InertialStart) -> dict[str, Any]:
    """For the manifest: what was estimated, with its sigma; empty where nothing was to be.

    `mounting_deg` turns readings into the axes of the T_lidar_imu that was given, a rotation vector; `T_lidar_imu` is that with
    it.
    """
    found: dict[str, Any] = {}
    if gyroscope.has_offset:
        found["time_offset_sigma_s"] = round(float(np.sqrt(gyroscope.covariance[12, 12])), 6)
    if gyroscope.is_mounted:
        vector, sigma = gyroscope.rotation
        T = begun.T_lidar_imu.copy()
        mounting = gyroscope.mounting
        assert mounting is not None
        T[:3, :3] = T[:3, :3] @ mounting
        found["mounting_deg"] = [round(float(v), 3) for v in np.rad2deg(vector)]
        found["mounting_sigma_deg"] = round(float(np.rad2deg(sigma)), 3)
        found["T_lidar_imu"] = [round(float(v), 6) for v in T[:3].ravel()]
    return found
