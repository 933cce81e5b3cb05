"""Method `fast-lio`: tightly coupled LiDAR and IMU by an iterated error-state Kalman filter on features (Xu and Zhang 2021)."""

from __future__ import annotations

from lslam.core.config.config import Config
from lslam.core.config.odometry import rest_alone
from lslam.odometry.fast_lio2 import Filtered
from lslam.odometry.inertial.filter import FilterMotion
from lslam.odometry.loam import VARIANTS, Loam


def create(config: Config) -> FastLio:
    """The method as the configuration wants it, with no recovery beside the filter but `at_rest`."""
    return FastLio(config.model_copy(update={"recovery": rest_alone(config.recovery)}), VARIANTS["floam"])


create_motion = FilterMotion.of


class FastLio(Filtered, Loam):
    """Edges, planar points and the filter's prior in one estimate, on the feature map.

    The filter is that of `fast-lio2` (`lslam.odometry.inertial.filter`); over a gap of the IMU features are registered from
    constant velocity.
    """

    deskew = "features, by back propagation of the filter"
