"""Scores of a map: mean map entropy, mean plane variance, and distances to a reference cloud."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, UsageError
from lslam.core.types.cloud import ArrayCloud, Cloud, in_memory
from lslam.core.types.run_record import Crispness, MapDifference
from lslam.maps.merge import MergedMap

RADIUS = 0.5  # m
LEAST_POINTS = 10  # points in a neighbourhood
SAMPLES = 50_000
THRESHOLD = 0.2  # m


def crispness(cloud: Cloud, radius: float = RADIUS, least: int = LEAST_POINTS, samples: int = SAMPLES) -> Crispness:
    """Score a map. A merged one may exceed memory, any other is read as a whole.

    radius : of a neighbourhood, m; least : points it must have, at least 4
    samples : approximate number of points, evenly spread, whose neighbourhoods are evaluated
    Raises UsageError: a radius or numbers that make no sense.

    >>> crispness(ArrayCloud.of([[0, 0, 0]])).entropy is None
    True
    """
    from lslam.maps.kernels.crispness import cell_keys, shapes

    if not (np.isfinite(radius) and radius > 0) or least < 4 or samples < 1:
        raise UsageError(f"radius {radius} and at least {least} points: a radius above 0 m and 4 points or more")
    step = max(1, -(-len(cloud) // samples))
    total, used, sampled = np.zeros(2), 0, 0
    for points, queries in _slabs(cloud, radius, step):
        low = points.min(0)
        keys = cell_keys(points, low, radius)
        order = np.argsort(keys, kind="stable")
        scores = shapes(points[order], keys[order], queries, low, radius, least)
        good = scores[np.isfinite(scores[:, 0])]
        total += good.sum(0)
        used += len(good)
        sampled += len(queries)
    entropy, variance = (float(v) / used for v in total) if used else (None, None)
    return Crispness(entropy, variance, used, sampled, len(cloud), radius, least)


def plane_variances(points: Floats, queries: Floats) -> Floats:
    """(Q,) m2, variance of the points (N, 3) about the plane through those around each query (Q, 3); NaN where these are few."""
    from lslam.maps.kernels.crispness import cell_keys, shapes

    if not len(points):
        return np.zeros(0)
    low = points.min(0)
    keys = cell_keys(points, low, RADIUS)
    order = np.argsort(keys, kind="stable")
    at = np.ascontiguousarray(queries)
    return np.asarray(shapes(points[order], keys[order], at, low, RADIUS, LEAST_POINTS)[:, 1])


def _slabs(cloud: Cloud, radius: float, step: int) -> Iterator[tuple[Floats, Floats]]:
    """Slabs of the cloud in x: points (N, 3), m, and queries (M, 3), every `step`-th point, whose neighbours they contain.

    Neighbours lie within `radius`, m. Each query is in one slab only.
    """
    if not isinstance(cloud, MergedMap):
        points = in_memory(cloud).points
        points = points[np.isfinite(points).all(1)]
        if len(points):
            yield points, points[::step]
        return
    slack = cloud.voxel  # its points are sorted by the voxel of x
    kept, waiting, seen = np.zeros((0, 3)), np.zeros((0, 3)), 0
    for block in cloud.blocks():
        kept = np.concatenate([kept, block.points])
        waiting = np.concatenate([waiting, block.points[-seen % step :: step]])
        seen += len(block)
        # What comes after this block lies beyond `edge`.
        edge = float(block.points[-1, 0]) - slack
        ready = waiting[:, 0] <= edge - radius
        if seen == len(cloud):
            ready[:] = True
        if ready.any():
            yield kept, waiting[ready]
            waiting = waiting[~ready]
            first = min(float(waiting[:, 0].min()), edge) if len(waiting) else edge
            kept = kept[kept[:, 0] >= first - radius - slack]


def warm_up() -> None:
    """Compile or load the kernels, so that a caller can do it under the compile lock."""
    crispness(ArrayCloud.of(np.random.default_rng(0).random((8, 3))), least=4)


def compare(cloud: ArrayCloud, reference: ArrayCloud, threshold: float = THRESHOLD) -> MapDifference:
    """F1 and Chamfer distance, m, of two clouds in one frame; points that are not finite are left out.

    A cloud that is denser in some places weighs these more: compare clouds of the same voxel size.
    Raises InputError when one of them has no points, UsageError for a threshold that is none.
    """
    from scipy.spatial import cKDTree

    if not (np.isfinite(threshold) and threshold > 0):
        raise UsageError(f"--threshold {threshold:g}: a distance above 0 m, for example 0.2")
    ours, theirs = (c.points[np.isfinite(c.points).all(1)] for c in (cloud, reference))
    if not len(ours) or not len(theirs):
        raise InputError(f"{'the map' if not len(ours) else 'the reference cloud'} has no points to compare")
    forward = cKDTree(theirs).query(ours)[0]
    backward = cKDTree(ours).query(theirs)[0]
    precision, recall = float(np.mean(forward <= threshold)), float(np.mean(backward <= threshold))
    f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    means = float(np.mean(forward)), float(np.mean(backward))
    return MapDifference(threshold, precision, recall, f1, sum(means) / 2, *means, len(ours), len(theirs))
