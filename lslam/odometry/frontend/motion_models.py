"""Which motion model a tightly coupled method predicts with; the loosely coupled IMU serves all others.

A new one is one function and one line here, and its method's name in `TIGHTLY_COUPLED` of `lslam.core.config.odometry`.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

from lslam.backend.graph.inertial_smoother import InertialSmoother
from lslam.core.config import Config
from lslam.core.types.imu import SmootherNoise
from lslam.odometry.inertial.filter import FilterMotion
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.gyroscope import ImuNoise
from lslam.odometry.inertial.imu_estimate import GRAVITY_WALK
from lslam.odometry.inertial.initialise import InertialStart
from lslam.odometry.inertial.linked_motion import LinkedMotion
from lslam.odometry.inertial.smoothing import SmootherMotion
from lslam.odometry.inertial.window_motion import WindowMotion


def smoother_noise(noise: ImuNoise) -> SmootherNoise:
    """The noise of an IMU as factors take it."""
    return SmootherNoise(noise.force, noise.accel_walk, noise.gyro_walk, GRAVITY_WALK)


def _plain(kind: type[InertialMotion]) -> Callable[[InertialStart, Config], InertialMotion]:
    """Makes a model that takes nothing but the IMU and its section."""
    return lambda opening, config: kind(opening.imu, opening.T_lidar_imu, opening.estimate, config.imu)


def _smoother(opening: InertialStart, config: Config) -> InertialMotion:
    smoother = InertialSmoother(smoother_noise(opening.estimate.gyroscope.noise), config.lio_sam.reset_scans)
    return SmootherMotion(opening.imu, opening.T_lidar_imu, opening.estimate, config.imu, smoother)


def _window(opening: InertialStart, config: Config) -> InertialMotion:
    return WindowMotion(opening.imu, opening.T_lidar_imu, opening.estimate, config.imu, config.lio_mapping.window)


MOTION_MODELS: dict[str, Callable[[InertialStart, Config], InertialMotion]] = {
    "fast-lio2": _plain(FilterMotion),
    "lio-sam": _smoother,
    "lio-mapping": _window,
    "lips": _plain(LinkedMotion),
}


def motion_of(opening: InertialStart, config: Config) -> InertialMotion:
    """The motion model that the method asks for."""
    return MOTION_MODELS.get(config.odometry.method, _plain(InertialMotion))(opening, config)


def copy_of(motion: InertialMotion, opening: InertialStart, config: Config) -> InertialMotion:
    """A second model of the same IMU that goes on where `motion` is."""
    other = motion_of(opening, config)
    other.restore(deepcopy(motion.state()))
    return other
