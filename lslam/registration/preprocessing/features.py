"""A scan with rings -> edges and planes (Zhang and Singh 2014; Girolimetto, section 2.4.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import LoamConfig
from lslam.core.errors import InputError
from lslam.core.geometry import so3
from lslam.core.kernels.linearisation import RARE_SIGMAS, SIGNIFICANT_SIGMAS
from lslam.core.types.scan import Scan
from lslam.registration.kernels import curvature
from lslam.registration.kernels.curvature import WIDEST_STEP
from lslam.registration.preprocessing.ground import NEAR_Z, Z
from lslam.registration.preprocessing.prepare import gate_points

# What a point is allowed to become: an edge, a less planar point, a planar one (which is less planar as well).
MAY_BE_EDGE, MAY_BE_FLAT, MAY_BE_PLANE = 1, 2, 4
# A beam that turns back more often than this is not given in the order it was fired.
_MANY_TURNS = 0.1
# A beam of which less of its way about the axis is progress does not spin: it sweeps to and fro.
_SPINS = 0.5
# Neighbours farther apart than this many steps have missing returns between them: one lost return is bridged.
_GAP_STEPS = 2.5
# Curvature of equation 2.21 over the angle between beams: edges have more, planes less; a right angle has 2.7.
EDGE_CURVATURE, PLANAR_CURVATURE = 1.0, 0.5
# m; a jump in range from beam to beam that hides what is behind.
OCCLUSION_M = 0.3
# Angle of incidence above which a surface is parallel to the beam.
PARALLEL_DEG = 80.0
# m; grid of the points that are no feature: they only tell what stands where.
_NEITHER_GRID = LoamConfig().grid_step


@dataclass(frozen=True)
class FeaturePoints:
    """Points of one kind of feature.

    points : (M, 3) float64, m, LiDAR frame; rings : (M,) uint16, not decreasing
    times : (M,) float32, s from the scan's stamp, None when the scan has none
    """

    points: Floats
    rings: NDArray[np.uint16]
    times: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Features:
    """What LOAM sees in a scan.

    edges : the sharpest of each region; less_edges : these and more, what the next scan's edges are matched with
    planes : the flattest of each region; less_planes : all that is flat, down-sampled along each ring
    neither : all else, down-sampled likewise: silhouettes, single returns from posts, leaves
    labels : (N,) int8, of each point of the scan: EDGE 2, LESS_EDGE 1, NEITHER 0, LESS_PLANE -1, PLANE -2
    """

    edges: FeaturePoints
    less_edges: FeaturePoints
    planes: FeaturePoints
    less_planes: FeaturePoints
    neither: FeaturePoints
    labels: NDArray[np.int8]

    @property
    def cloud(self) -> NDArray[np.float32]:
        """The points of all parts (N, 3), m, LiDAR frame."""
        parts = (self.less_planes, self.planes, self.less_edges, self.neither)
        return np.concatenate([part.points for part in parts], dtype=np.float32)

    def each(self, change: Callable[[FeaturePoints], FeaturePoints]) -> Features:
        """The features after `change` of each of their parts."""
        names = ("edges", "less_edges", "planes", "less_planes", "neither")
        parts: dict[str, Any] = {name: change(getattr(self, name)) for name in names}
        return replace(self, **parts)


@dataclass(frozen=True)
class RingWalk:
    """The points of a scan ring after ring, each ring in the order its beam went.

    order : (K,) indices of points of the scan; starts : (max ring + 2,) where each ring starts in it
    points : (K, 3) float64, m; ranges : (K,) m; steps : (K,) rad to the next point of the ring, inf after the last
    step : their median, rad
    """

    order: Longs
    starts: Longs
    points: Floats
    ranges: Floats
    steps: Floats
    step: float


def extract_features(scan: Scan, config: LoamConfig | None = None, gate: PreprocessConfig | None = None) -> Features:
    """Edges and planes of a scan that has rings, by their curvature along the ring (equation 2.21).

    gate : which points are used at all: range and ego box

    Raises InputError for a scan without rings, and where neighbours on a ring are too far apart to lie on one surface.
    """
    return features_along(scan, walk_rings(scan, gate or PreprocessConfig()), config or LoamConfig())


def features_along(scan: Scan, walk: RingWalk, config: LoamConfig, may_be: NDArray[np.uint8] | None = None) -> Features:
    """Features of a scan along the given `walk` of its rings, as `extract_features`.

    may_be : (N,) of each point of the scan, a sum of MAY_BE_EDGE, MAY_BE_FLAT and MAY_BE_PLANE; None allows all
    """
    slope = np.tan(np.radians(PARALLEL_DEG))
    curved, bend, breaks = curvature.curvatures(
        walk.points,
        walk.ranges,
        walk.steps,
        walk.starts,
        _GAP_STEPS * walk.step,
        OCCLUSION_M,
        slope * walk.step,
        slope,
    )
    noise = curvature_noise(walk.ranges)
    both = np.full(len(scan), 7, np.uint8) if may_be is None else np.ascontiguousarray(may_be, np.uint8)
    labels = curvature.pick(
        curved,
        bend,
        walk.ranges,
        breaks,
        both[walk.order],
        walk.starts,
        config.regions,
        (config.max_edge_points, config.max_less_edge_points, config.max_planar_points),
        EDGE_CURVATURE * walk.step,
        PLANAR_CURVATURE * walk.step,
        RARE_SIGMAS * noise,
        SIGNIFICANT_SIGMAS * noise,
    )
    return gather_features(scan, walk, labels, config.grid_step)


def curvature_noise(ranges: Floats, side: int = curvature.SIDE_POINTS) -> float:
    """Standard deviation, m, of curvature times range that the noise of `ranges` (K,), m, along the rings makes.

    side : neighbours on either side that the curvature takes

    The noise is that of second differences, whose median knows nothing of edges and little of curved surfaces.
    """
    thinned = np.abs(ranges[:-2:4] - 2 * ranges[1:-1:4] + ranges[2::4])
    sigma = 1.4826 * float(np.median(thinned)) / np.sqrt(6) if len(thinned) else 0.0
    n = 2 * side
    return sigma * float(np.sqrt(n * n + n)) / (n + 1)


def walk_rings(scan: Scan, gate: PreprocessConfig) -> RingWalk:
    """The gated points of a scan along each of its rings. Raises InputError as `extract_features`.

    The order of the file is kept where it follows the beam; else rings are walked by azimuth, about the axis of their cones.
    """
    if scan.rings is None:
        raise InputError(
            f"scan {scan.index} has no rings, which LOAM's features need: see --rings, or use --method loam-livox"
        )
    order, starts = curvature.into_rings(scan.rings, gate_points(scan.points, gate))
    points, ranges, steps, step, turns, progress = curvature.walk(scan.points, order, starts)
    if step > WIDEST_STEP or turns > _MANY_TURNS or progress < _SPINS:
        about = scan.points @ so3.level_frame(_spin_axis(points / ranges[:, None], starts)).T.astype(np.float32)
        progress = curvature.walk(about, order, starts)[-1]
    if step > WIDEST_STEP or turns > _MANY_TURNS or progress < _SPINS:
        azimuth = np.arctan2(about[order, 1], about[order, 0])
        order = order[np.lexsort((azimuth, scan.rings[order]))]
        points, ranges, steps, step, _, _ = curvature.walk(scan.points, order, starts)
    if step > WIDEST_STEP and len(order) > len(starts):
        raise InputError(
            f"scan {scan.index}: neighbours on a ring are more than {np.degrees(WIDEST_STEP):.0f} deg apart, so they "
            "lie on no common surface (a pattern that does not repeat, or rings that are none): use --method loam-livox, "
            "which needs no rings, or another --rings"
        )
    return RingWalk(order, starts, points, ranges, steps, min(step, WIDEST_STEP))


def _spin_axis(directions: Floats, starts: Longs) -> Floats:
    """(3,) unit vector about which the rings of directions (K, 3) are circles: the sensor's axis of rotation.

    z where there is no such axis, or it is within 45 deg of z. starts : first point of each ring
    A circle about an axis has no extent along it, and errors of elevation are far smaller than the widest step.
    """
    sizes = np.diff(starts)
    means = np.add.reduceat(directions, starts[:-1][sizes > 0], axis=0) / sizes[sizes > 0, None]
    away = directions - np.repeat(means, sizes[sizes > 0], axis=0)
    variances, axes = np.linalg.eigh(away.T @ away / max(len(away), 1))
    are_circles = variances[0] < (WIDEST_STEP / 4) ** 2
    return axes[:, 0] if are_circles and abs(axes[2, 0]) <= NEAR_Z else Z


def gather_features(scan: Scan, walk: RingWalk, labels: NDArray[np.int8], grid_step: float) -> Features:
    """The features of a scan with rings, as the walk along them is labelled (K,).

    grid_step : m, of the cells that thin less planar points; 0 keeps all
    """
    assert scan.rings is not None
    rings, times = scan.rings[walk.order], None if scan.times is None else scan.times[walk.order]

    def those(mask: Bools) -> FeaturePoints:
        at = np.flatnonzero(mask)
        return FeaturePoints(walk.points[at], rings[at], None if times is None else times[at])

    back = np.zeros(len(scan), np.int8)
    back[walk.order] = labels
    return Features(
        edges=those(labels == curvature.EDGE),
        less_edges=those(labels > 0),
        planes=those(labels == curvature.PLANE),
        less_planes=_thin(walk, labels < 0, rings, times, grid_step),
        neither=_thin(walk, labels == curvature.NEITHER, rings, times, _NEITHER_GRID),
        labels=back,
    )


def _thin(
    walk: RingWalk,
    mask: Bools,
    rings: NDArray[np.uint16],
    times: NDArray[np.float32] | None,
    grid_step: float,
) -> FeaturePoints:
    """The points of the `mask` (K,) along the walk, or, for a `grid_step` above 0, m, their centroids ring by ring.

    rings, times : (K,) of the walk's points
    """
    at = np.flatnonzero(mask)
    if grid_step == 0:
        return FeaturePoints(walk.points[at], rings[at], None if times is None else times[at])
    centroids, first, mean_times = curvature.thin(
        walk.points, at, rings, np.zeros(0, np.float32) if times is None else times, grid_step
    )
    return FeaturePoints(centroids, rings[first], None if times is None else mean_times)
