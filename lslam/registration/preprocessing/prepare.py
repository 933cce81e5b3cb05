"""A raw scan -> the points that feed the local map and the fewer points that are registered.

The weather filter removes returns of rain, snow, dust and multi-path by the number of neighbouring pulses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Ints, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError
from lslam.core.kernels import voxel
from lslam.registration.preprocessing.ground import above_ground, up_of

# The field of view of a spinning scanner, 360 x 45 deg. With a smaller one the test is more lenient.
FIELD_OF_VIEW_SR = 4.8
# m; wide enough for several pulses of one ring at fifty metres, and as the source points' grid begins.
WIDE_CELL_M = 1.0
# Least share of sparse cells: edges make up to a fifth of a clear scan's cells sparse.
SPARSE_CELLS_SHARE = 0.25
# Largest share of returns to remove: beyond, the scan was downsampled before.
MOST_REMOVED_SHARE = 0.5
# Statistical outlier removal: nearest points asked, the point included as Open3D counts, and standard deviations allowed.
DENOISE_NEIGHBOURS, DENOISE_DEVIATIONS = 10, 2.0


def on_surfaces(centroids: NDArray[np.float32], counts: Ints, leaf: float, least_line: float) -> Longs:
    """Indices of the centroids (M, 3), m, LiDAR frame, of cells of edge `leaf`, m, that a surface may lie in.

    A drop occupies a cell of its own where a surface has many returns per cell: a tenth of the returns can be two thirds of
    the cells. `counts` (M,) are the returns in each. The angle between pulses is the root of field of view over returns, so a
    surface at range r that crosses a cell has a line of edge / (r times that) returns, part of a ring or of a column; a drop
    has one. Cells with less than `least_line` of such a line are removed if their surroundings of WIDE_CELL_M have less, too:
    far away a small cell has one return at most. (The radius in which Charron et al. 2018 count neighbours of snow grows with
    range for the same reason.) All are kept where few cells would be removed, or most returns.
    """
    pulses = int(counts.sum())
    needed = least_line / np.sqrt(FIELD_OF_VIEW_SR / max(pulses, 1))
    is_accompanied = voxel.find_neighboured_cells(centroids, counts, leaf * needed, WIDE_CELL_M, WIDE_CELL_M * needed)
    is_clear = len(counts) - len(is_accompanied) < SPARSE_CELLS_SHARE * len(counts)
    are_most_gone = int(counts[is_accompanied].sum()) < MOST_REMOVED_SHARE * pulses
    return np.arange(len(counts)) if is_clear or are_most_gone else is_accompanied


def dense_points(
    points: NDArray[np.float32], neighbours: int = DENOISE_NEIGHBOURS, deviations: float = DENOISE_DEVIATIONS
) -> Longs:
    """Indices of the points (N, 3), m, that are no outliers, increasing.

    As Rusu et al. (2008), with the counting of Open3D: a point's mean distance to its `neighbours` nearest, itself
    among them, must lie below the mean of all points plus `deviations` standard deviations (ddof 1). Points whose
    neighbours all coincide with them have no distance and go too.
    """
    from scipy.spatial import cKDTree

    if len(points) <= neighbours:
        return np.arange(len(points))
    cloud = points.astype(np.float64)
    # Splitting in the middle builds in a tenth of the time; a scan has no clusters that would unbalance the tree.
    tree = cKDTree(cloud, balanced_tree=False, compact_nodes=False)
    distances, _ = tree.query(cloud, neighbours)
    mean = np.reshape(distances, (len(cloud), neighbours)).mean(1)
    positive = mean[mean > 0]
    if len(positive) < 2:
        return np.arange(len(points))
    limit = mean.mean() + deviations * np.sqrt(((positive - mean.mean()) ** 2).sum() / (len(mean) - 1))
    return np.flatnonzero((mean > 0) & (mean < limit))


# A source grid never gets finer than the points it is made of, nor so coarse that walls merge.
COARSEST_SOURCE_M = 3.0

NO_TIMES = np.zeros(0, np.float32)


@dataclass(frozen=True)
class PreparedPoints:
    """What registration needs of one scan, LiDAR frame.

    map_points : (M, 3) float32, m, one centroid per small voxel
    source : (S, 3) float64, m; scatter : (S, 6) float64, m2, covariance xx xy xz yy yz zz of the points behind each
    in_range : points that passed the range gate
    map_times (M,), source_times (S,) : float32, s from the scan's stamp, mean over the points behind each; None when the scan
        has no times
    covariance : (S, 6) float64, m2, likewise, of the surface round each source point; None where no method asked for it
    gaps : (S,) float64, m, how far from each source point the next ring lies on a surface that faces the sensor; None likewise
    """

    map_points: NDArray[np.float32]
    source: Floats
    scatter: Floats
    in_range: int
    map_times: NDArray[np.float32] | None = None
    source_times: NDArray[np.float32] | None = None
    covariance: Floats | None = None
    gaps: Floats | None = None


def prepare_points(
    points: NDArray[Any], config: PreprocessConfig, index: int = 0, times: NDArray[np.float32] | None = None
) -> PreparedPoints:
    """Gate and down-sample points (N, 3), m, in the LiDAR frame. `index` seeds the random share, scan by scan.

    `times` (N,), s from the scan's stamp, are averaged along, so that the centroids can be deskewed instead of the points.

    The weather filter removes drops from the map points, and from source points made of these (`on_surfaces`).
    Centroids, not first points: the average of the points of a cell is nearer to the surface than any one of them.
    Further columns are ignored. Raises InputError for arrays of another shape.
    """
    times_of = NO_TIMES if times is None else np.ascontiguousarray(times, np.float32)
    cloud, cloud_times = _gate_cloud(as_cloud(points), times_of, config)
    map_points, map_times, counts = voxel.means(cloud, cloud_times, config.map_leaf)
    if config.least_line > 0:
        solid = on_surfaces(map_points, counts, config.map_leaf, config.least_line)
        if len(solid) < len(map_points):
            map_points, map_times = voxel.take(map_points, solid), map_times[solid] if len(map_times) else map_times
    source, source_times, scatter = _source_points(cloud, cloud_times, map_points, map_times, config, index)
    return PreparedPoints(
        map_points,
        source.astype(np.float64),
        scatter.astype(np.float64),
        len(cloud),
        None if times is None else map_times,
        None if times is None else source_times,
    )


def thin(points: PreparedPoints, step: int) -> PreparedPoints:
    """The points with every `step`-th source point only; the map points stay."""
    return subset(points, slice(None, None, step))


# Source points that tell good poses from bad ones: the share of them that agree is known to 1.5 %.
FEW_POINTS = 1200


def few_of(points: PreparedPoints) -> PreparedPoints:
    """At most about `FEW_POINTS` of the source points, evenly."""
    return thin(points, 1 + len(points.source) // FEW_POINTS)


def subset(points: PreparedPoints, which: slice | Bools | Longs) -> PreparedPoints:
    """The points with the source points that `which` selects or reorders, and all that belongs to each; map points stay."""
    times, covariance, gaps = points.source_times, points.covariance, points.gaps
    return replace(
        points,
        source=np.ascontiguousarray(points.source[which]),
        scatter=np.ascontiguousarray(points.scatter[which]),
        source_times=None if times is None else times[which],
        covariance=None if covariance is None else np.ascontiguousarray(covariance[which]),
        gaps=None if gaps is None else np.ascontiguousarray(gaps[which]),
    )


def clean_points(points: NDArray[Any], config: PreprocessConfig) -> NDArray[np.float32]:
    """The points (N, 3), m, LiDAR frame, that a method may use: (M, 3), in their order.

    Further columns are ignored. Raises InputError for arrays of another shape.
    """
    cloud = as_cloud(points)
    return cloud[gate_points(cloud, config)]


def as_cloud(points: NDArray[Any]) -> NDArray[np.float32]:
    """The first three columns as (N, 3) float32. Raises InputError for arrays of another shape."""
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] < 3:
        raise InputError(f"points of a scan have shape {array.shape}: (N, 3) is needed, x y z in metres")
    return np.ascontiguousarray(array[:, :3], np.float32)


def small_room() -> NDArray[np.float32]:
    """(3000, 3) m, points in a room and on three of its walls, to compile kernels with."""
    rng = np.random.default_rng(0)
    room = rng.uniform(-8, 8, (3000, 3)).astype(np.float32)
    room[np.arange(3000), rng.integers(0, 3, 3000)] = 8.0
    return room


def gate_points(points: NDArray[np.float32], config: PreprocessConfig) -> Longs:
    """Indices of the points (N, 3), m, that are finite, non-zero, within range and outside the ego box.

    With `remove_ground` and `denoise` also neither on the ground nor, among the rest, an outlier. Every method's points
    pass here.
    """
    index = voxel.gate(points, *_gate_of(config))
    if config.remove_ground:
        index = index[above_ground(points[index], up_of(config))]
    if config.denoise:
        index = index[dense_points(points[index])]
    return index


def _gate_of(config: PreprocessConfig) -> tuple[float, float, bool, Floats]:
    """Range limits, m, whether ranges are horizontal, and ego box, as `voxel.gate` takes them."""
    box = np.array(config.ego_box if config.ego_box is not None else (), np.float64)
    return config.range_min, config.range_max, config.range_shape == "cylinder", box


def _gate_cloud(
    cloud: NDArray[np.float32], times: NDArray[np.float32], config: PreprocessConfig
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The points (N, 3), m, that `gate_points` keeps, and their times.

    Without `remove_ground` and `denoise` one kernel does both.
    """
    if not (config.remove_ground or config.denoise):
        return voxel.select_in_gate(cloud, times, *_gate_of(config))
    rows = gate_points(cloud, config)
    return voxel.take(cloud, rows), times[rows] if len(times) else times


Down = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


def _source_points(
    cloud: NDArray[np.float32],
    cloud_times: NDArray[np.float32],
    map_points: NDArray[np.float32],
    map_times: NDArray[np.float32],
    config: PreprocessConfig,
    index: int,
) -> Down:
    """Source points (S, 3), m, their times and scatter (S, 6), m2, by `config.downsample`.

    Centroids are of `map_points`, the thinned scan; chosen points are of `cloud`, the raw scan. index : of the scan, a seed
    """
    if config.downsample == "target":
        return _target_count(map_points, map_times, config)
    if config.downsample == "grid":
        return voxel.centroids(map_points, map_times, config.source_voxel)[:3]
    if config.downsample == "first":
        rows = voxel.first_points(cloud, config.source_voxel)
    elif config.downsample == "random":
        rng = np.random.default_rng((config.seed, index))
        rows = np.sort(rng.permutation(len(cloud))[: round(config.random_share * len(cloud))])
    else:
        rows = np.arange(len(cloud))
    times = cloud_times[rows] if len(cloud_times) else cloud_times
    return cloud[rows], times, np.zeros((len(rows), 6), np.float32)


def _target_count(map_points: NDArray[np.float32], map_times: NDArray[np.float32], config: PreprocessConfig) -> Down:
    """Centroids, times and scatter of `map_points` in a grid whose size gives a count between the limits, if there are so many.

    Surfaces fill a grid with the inverse square of its size. The search starts afresh for each scan, so that a scan's
    points depend on this scan alone.
    """
    low, high = config.source_points_min, config.source_points_max
    size = config.source_voxel
    down = voxel.centroids(map_points, map_times, size)[:3]
    for _ in range(3):
        count = len(down[0])
        if count > high:
            next_size = min(size * (count / (0.5 * (low + high))) ** 0.5, COARSEST_SOURCE_M)
        elif count < low and len(map_points) > count:
            next_size = max(size * (count / (0.5 * (low + high))) ** 0.5, config.map_leaf)
        else:
            break
        if next_size == size:
            break
        size = next_size
        down = voxel.centroids(map_points, map_times, size)[:3]
    return down
