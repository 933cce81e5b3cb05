"""The features that a method saw on a recording: on one scan, on the map, and how many over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FeatureView:
    """What a feature method works on.

    scan : the one that is shown; edges (E, 2), planes (P, 2) : its sharp and flat features, m, LiDAR frame; around (K, 3) :
        all its other features there
    map_edges (M, 3), map_planes (N, 3) : less sharp edges and less planar points of the scans looked at, m, world frame
    scans : (S,) those; edge_counts, plane_counts : (S,) features of each
    """

    scan: int
    edges: Floats
    planes: Floats
    around: Floats
    map_edges: Floats
    map_planes: Floats
    scans: NDArray[np.int64]
    edge_counts: NDArray[np.int64]
    plane_counts: NDArray[np.int64]
