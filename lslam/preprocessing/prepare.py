"""A raw scan -> the points that feed the local map and the fewer points that are registered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.errors import InputError
from lslam.kernels import voxel

# A source grid never gets finer than the points it is made of, nor so coarse that walls merge.
COARSEST_SOURCE = 3.0


@dataclass(frozen=True)
class PreparedPoints:
    """What registration needs of one scan, LiDAR frame.

    map_points : (M, 3) float32, m, one centroid per small voxel
    source : (S, 3) float64, m; scatter : (S, 6) float64, m2, covariance xx xy xz yy yz zz of the points behind each
    used : points that passed the range gate
    covariance : (S, 6) float64, m2, likewise, of the surface round each source point; None where no method asked for it
    """

    map_points: NDArray[np.float32]
    source: NDArray[np.float64]
    scatter: NDArray[np.float64]
    used: int
    covariance: NDArray[np.float64] | None = None


def prepare_points(points: NDArray[Any], config: PreprocessConfig, index: int = 0) -> PreparedPoints:
    """Gate and down-sample points (N, 3), m, in the LiDAR frame. `index` seeds the random share, scan by scan.

    Centroids, not first points: the average of the points of a cell is nearer to the surface than any one of them.
    Further columns are ignored. Raises InputError for arrays of another shape.
    """
    kept = clean_points(points, config)
    map_points, _ = voxel.centroids(kept, config.map_leaf)
    source, scatter = _source_points(kept, map_points, config, index)
    return PreparedPoints(map_points, source.astype(np.float64), scatter.astype(np.float64), len(kept))


def clean_points(points: NDArray[Any], config: PreprocessConfig) -> NDArray[np.float32]:
    """The points (N, 3), m, LiDAR frame, that a method may use: (M, 3), in their order.

    Further columns are ignored. Raises InputError for arrays of another shape.
    """
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] < 3:
        raise InputError(f"points of a scan have shape {array.shape}: (N, 3) is needed, x y z in metres")
    cloud = np.ascontiguousarray(array[:, :3], np.float32)
    return cloud[gate_points(cloud, config)]


def gate_points(points: NDArray[np.float32], config: PreprocessConfig) -> NDArray[np.int64]:
    """Indices of the points (N, 3) that are finite, non-zero, within range and outside the ego box."""
    box = np.array(config.ego_box if config.ego_box is not None else (), np.float64)
    return voxel.gate(points, config.range_min, config.range_max, config.range_shape == "cylinder", box)


def _source_points(
    kept: NDArray[np.float32], map_points: NDArray[np.float32], config: PreprocessConfig, index: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    if config.downsample == "target":
        return _target_count(map_points, config)
    if config.downsample == "grid":
        return voxel.centroids(map_points, config.source_voxel)
    if config.downsample == "first":
        chosen = kept[voxel.first_points(kept, config.source_voxel)]
    elif config.downsample == "random":
        rng = np.random.default_rng((config.seed, index))
        chosen = kept[np.sort(rng.permutation(len(kept))[: round(config.random_share * len(kept))])]
    else:
        chosen = kept
    return chosen, np.zeros((len(chosen), 6), np.float32)


def _target_count(
    map_points: NDArray[np.float32], config: PreprocessConfig
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Centroids of a grid whose size gives a count between the limits, where the scan has so many points.

    Surfaces fill a grid with the inverse square of its size. The search starts afresh for each scan, so that a scan's
    points depend on this scan alone.
    """
    low, high = config.source_points_min, config.source_points_max
    size = config.source_voxel
    source, scatter = voxel.centroids(map_points, size)
    for _ in range(3):
        if len(source) > high:
            wanted = min(size * (len(source) / (0.5 * (low + high))) ** 0.5, COARSEST_SOURCE)
        elif len(source) < low and len(map_points) > len(source):
            wanted = max(size * (len(source) / (0.5 * (low + high))) ** 0.5, config.map_leaf)
        else:
            break
        if wanted == size:
            break
        size = wanted
        source, scatter = voxel.centroids(map_points, size)
    return source, scatter
