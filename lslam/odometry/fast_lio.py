"""Methods `fast-lio` and `fast-lio2`: tightly coupled LiDAR and IMU by an iterated error-state Kalman filter.

On features (Xu and Zhang 2021), or on points (Xu et al. 2022). The filter is the motion model (`lslam.odometry.inertial.filter`),
since it predicts and deskews too; where it is silent, over a gap of the IMU, a scan is registered from constant velocity.
"""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.config.odometry import rest_alone
from lslam.core.types.motion_prior import MotionPrior
from lslam.odometry.base import MapMethod
from lslam.odometry.icp import Icp, registration_of
from lslam.odometry.inertial.filter import FilterMotion
from lslam.odometry.loam import VARIANTS, Loam


def create(config: Config) -> FastLio | FastLio2:
    """Create the method that `odometry.method` names; its only recovery policy is `at_rest`."""
    recovery = rest_alone(config.recovery)
    if config.odometry.method == "fast-lio":
        return FastLio(config.model_copy(update={"recovery": recovery}), VARIANTS["floam"])
    return FastLio2(registration_of(config, recovery=recovery))


create_motion = FilterMotion


class FilterMethod(MapMethod):
    """Registers a scan with the filter's prior as one more measurement."""

    def information_of(self, prior: MotionPrior) -> Floats | None:
        """The inverse of the filter's covariance."""
        return None if prior.covariance is None else np.asarray(np.linalg.inv(prior.covariance))


class FastLio2(FilterMethod, Icp):
    """Points and the filter's prior in one estimate, on the local map of Gaussian voxels."""

    deskew = "by back propagation of the filter"


class FastLio(FilterMethod, Loam):
    """Edges, planar points and the filter's prior in one estimate, on the feature map."""

    deskew = "features, by back propagation of the filter"
