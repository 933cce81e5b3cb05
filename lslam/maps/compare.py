"""A map against a reference cloud."""

from __future__ import annotations

import numpy as np

from lslam.errors import InputError, UsageError
from lslam.types.cloud import ArrayCloud
from lslam.types.run_record import MapDifference

THRESHOLD = 0.2  # m


def compare(cloud: ArrayCloud, reference: ArrayCloud, threshold: float = THRESHOLD) -> MapDifference:
    """F1 and Chamfer distance of two clouds in one frame, m; points that are not finite are left out.

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
