"""Submaps, clouds of neighbouring keyframes in one frame, and the up direction that they and the mounting tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3
from lslam.core.kernels import voxel as voxels
from lslam.core.kernels.transform import transform
from lslam.core.types.arrays import Floats
from lslam.registration.preprocessing.ground import Z, find_up, world_up_of
from lslam.registration.preprocessing.prepare import NO_TIMES


def neighbours(count: int, number: int, size: int) -> range:
    """Numbers of the `size` keyframes about `number` out of `count`; fewer where the run begins or ends.

    >>> neighbours(10, 4, 5), neighbours(10, 0, 5), neighbours(10, 9, 4)
    (range(2, 7), range(0, 3), range(7, 10))
    """
    return range(max(number - size // 2, 0), min(number + (size + 1) // 2, count))


def submap(
    store: KeyframeStore,
    poses: Floats,
    number: int,
    size: int,
    voxel: float | None = None,
    T_world_frame: Floats | None = None,
) -> NDArray[np.float32]:
    """Points (M, 3), m, of the `size` keyframes about keyframe `number`, in its LiDAR frame or in `T_world_frame` (4, 4).

    poses : (K, 4, 4) T_world_lidar of all keyframes, odometry's or optimised ones
    voxel : m, one averaged point per voxel is left; None leaves all
    """
    frame = poses[number] if T_world_frame is None else T_world_frame
    clouds = {k: store.points(k) for k in neighbours(len(store), number, size)}
    points = np.empty((sum(map(len, clouds.values())), 3), np.float32)
    first = 0
    for k, cloud in clouds.items():
        transform(cloud, se3.relative(frame, poses[k]), points[first : first + len(cloud)])
        first += len(cloud)
    return points if voxel is None else voxels.means(points, NO_TIMES, voxel)[0]


def submap_labels(store: KeyframeStore, number: int, size: int) -> NDArray[np.uint16]:
    """Classes (M,) of the points of `submap` where all are left; 0, unlabeled, of keyframes whose classes are unknown."""
    parts = []
    for k in neighbours(len(store), number, size):
        labels = store.labels(k)
        parts.append(np.zeros(len(store.points(k)), np.uint16) if labels is None else labels)
    return np.concatenate(parts)


# Keyframes in whose clouds the ground is looked for: rings of a sensor on its side cross it in a line, those of 20 m cover it.
GROUND_KEYFRAMES = 10


def mounted_up(store: KeyframeStore, poses: Floats, config: PreprocessConfig) -> Floats:
    """(3,) unit vector up in the world of the poses (K, 4, 4), T_world_lidar of all keyframes.

    By `preprocess.up`, or else by the ground about the first keyframes: z unless it is more than 45 deg off.
    """
    if config.up is not None or not len(store):
        return world_up_of(config, poses[0]) if len(poses) else Z
    middle = min(GROUND_KEYFRAMES, len(store)) // 2
    frame = np.eye(4)
    frame[:3, 3] = poses[middle, :3, 3]
    return find_up(submap(store, poses, middle, GROUND_KEYFRAMES, T_world_frame=frame)).direction
