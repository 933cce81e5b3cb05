"""Up in the world of a run's keyframes, by how its sensor is mounted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.config.input import PreprocessConfig
from lslam.keyframes.store import KeyframeStore
from lslam.keyframes.submaps import submap
from lslam.preprocessing.ground import Z, world_up_of
from lslam.preprocessing.up import find_up

Floats = NDArray[np.float64]

# Keyframes in whose clouds the ground is looked for: rings of a sensor on its side cross it in a line, those of 20 m cover it.
KEYFRAMES = 10


def mounted_up(store: KeyframeStore, poses: Floats, config: PreprocessConfig) -> Floats:
    """(3,) unit vector up in the world of the poses (K, 4, 4), T_world_lidar of all keyframes.

    By `preprocess.up`, or else by the ground about the first keyframes: z unless it is more than 45 deg off.
    """
    if config.up is not None or not len(store):
        return world_up_of(config, poses[0]) if len(poses) else Z
    middle = min(KEYFRAMES, len(store)) // 2
    frame = np.eye(4)
    frame[:3, 3] = poses[middle, :3, 3]
    return find_up(submap(store, poses, middle, KEYFRAMES, T_world_frame=frame)).direction
