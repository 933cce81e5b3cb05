"""Method `fast-lio2`: tightly coupled LiDAR and IMU by an iterated error-state Kalman filter (Xu et al. 2022)."""

from __future__ import annotations

import numpy as np

from lslam.core.config.config import Config
from lslam.core.config.odometry import rest_alone
from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.odometry.icp import Icp, registration_of
from lslam.odometry.inertial.filter import FilterMotion
from lslam.odometry.map_method import MapMethod


def create(config: Config) -> FastLio2:
    """The method as the configuration wants it: point to plane, with no recovery beside the filter."""
    return FastLio2(registration_of(config, recovery=rest_alone(config.recovery)))


create_motion = FilterMotion.of


class Filtered(MapMethod):
    """Registers a scan with the filter's prior as one more measurement."""

    def information_of(self, prior: MotionPrior) -> Floats | None:
        """The inverse of the filter's covariance."""
        return None if prior.covariance is None else np.asarray(np.linalg.inv(prior.covariance))


class FastLio2(Filtered, Icp):
    """Points and the filter's prior in one estimate, on the local map of Gaussian voxels.

    The filter is the motion model (`lslam.odometry.inertial.filter`), since it predicts and deskews too; where it is silent, over
    a gap of the IMU, a scan is registered from constant velocity.
    """

    deskew = "by back propagation of the filter"
