"""The cloud that is kept of a keyframe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.config.backend import KeyframesConfig
from lslam.config.input import PreprocessConfig
from lslam.kernels import voxel
from lslam.preprocessing.deskew import deskew_points
from lslam.preprocessing.prepare import NO_TIMES, as_cloud, gate_points
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan

# m; centroids are rounded to it. A power of two, so that rounded numbers end in zeros and compress to half; its error,
# 0.6 mm rms, is a fiftieth of a point's noise.
GRAIN = 2.0**-9


def keyframe_cloud(
    scan: Scan, motion: MotionPrior, preprocess: PreprocessConfig, config: KeyframesConfig
) -> NDArray[np.float32]:
    """Centroids (M, 3), m, of the scan's points in voxels of `keyframes.voxel`, LiDAR frame at the scan's stamp.

    motion : of the sensor within the sweep; points are deskewed by it before they are averaged

    Range gate and ego box are odometry's. The ground stays in and nothing is denoised, whatever odometry prefers: what
    looks at keyframes wants to see the place.
    """
    plain = preprocess.model_copy(update={"remove_ground": False, "denoise": False})
    raw = as_cloud(scan.points)
    kept = gate_points(raw, plain)
    times = scan.times[kept] if scan.times is not None and preprocess.deskew else None
    centroids = voxel.means(deskew_points(voxel.take(raw, kept), times, motion), NO_TIMES, config.voxel)[0]
    return np.asarray(np.round(centroids / np.float32(GRAIN)) * np.float32(GRAIN), np.float32)
