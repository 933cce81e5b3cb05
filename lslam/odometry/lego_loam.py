"""Method `lego-loam`: ground and clusters first, then scan to scan in two steps, then the feature map.

Shan and Englot 2018, "LeGO-LOAM: Lightweight and ground-optimized lidar odometry and mapping on variable terrain". Edges
come from clusters off the ground, planar points from the ground; z, roll and pitch are found from these, then x, y and yaw
from those. Its mapping takes the less planar points of ground and clusters, as the paper's does.
"""

from __future__ import annotations

from lslam.core.config.config import Config
from lslam.core.types.scan import Scan
from lslam.odometry.feature_solver import two_steps
from lslam.odometry.feature_target import LoamVariant
from lslam.odometry.loam import Loam
from lslam.registration.preprocessing.features import Features
from lslam.registration.preprocessing.segments import lego_features

LEGO = LoamVariant(two_steps, with_map=True, with_less_planes=True)


def create(config: Config) -> LegoLoam:
    """The method as the configuration wants it."""
    return LegoLoam(config, LEGO)


class LegoLoam(Loam):
    """LOAM on what the segmentation of the range image leaves."""

    def prepare(self, scan: Scan) -> Features:
        """Edges off the ground, planar points on it, clutter left out. Raises InputError for a scan without usable rings."""
        features, _ = lego_features(scan, self.config.loam, self.config.preprocess)
        return features
