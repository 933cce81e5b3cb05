"""Submaps: the clouds of neighbouring keyframes in one frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3
from lslam.kernels import voxel as voxels
from lslam.kernels.transform import transform
from lslam.keyframes.store import KeyframeStore
from lslam.preprocessing.prepare import NO_TIMES


def neighbours(count: int, number: int, size: int) -> range:
    """Numbers of the `size` keyframes about `number` out of `count`; fewer where the run begins or ends.

    >>> neighbours(10, 4, 5), neighbours(10, 0, 5), neighbours(10, 9, 4)
    (range(2, 7), range(0, 3), range(7, 10))
    """
    return range(max(number - size // 2, 0), min(number + (size + 1) // 2, count))


def submap(
    store: KeyframeStore, poses: NDArray[np.float64], number: int, size: int, voxel: float | None = None,
    T_world_frame: NDArray[np.float64] | None = None,
) -> NDArray[np.float32]:  # fmt: skip
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
