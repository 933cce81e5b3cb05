"""How much larger odometry's errors are than its covariances say, as loops reveal it.

A registration knows its noise, not what makes every scan wrong alike (a range bias, a wheel of the calibration), and the
latter adds up. Loops see the sum: the scale is the one with which the typical loop is as far from odometry as it should be.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lslam.geometry import noise, se3, so3
from lslam.graph.problem import PoseGraph
from lslam.types.constraint import Constraint

Floats = NDArray[np.float64]

# Loops that are looked at, evenly spread, and the largest factor on a covariance.
MOST, LARGEST = 300, 1e8


def accumulated(poses: Floats, odometry: Sequence[Constraint]) -> Floats:
    """(K, 6, 6) of each pose in the world when only odometry, from each keyframe to the next, is known."""
    total = np.zeros((len(poses), 6, 6))
    steps = {c.b: c for c in odometry if c.b == c.a + 1}
    for k in range(1, len(poses)):
        moved = noise.transported(total[k - 1], poses[k, :3, 3] - poses[k - 1, :3, 3])
        added = noise.rotated(steps[k].covariance, poses[k - 1, :3, :3]) if k in steps else 0.0
        total[k] = moved + added
    return total


def odometry_scale(graph: PoseGraph, loops: Sequence[Constraint]) -> float:
    """The factor, at least 1, on odometry's covariances with which the median loop is where it should be."""
    if not loops:
        return 1.0
    few = [loops[i] for i in np.unique(np.linspace(0, len(loops) - 1, MOST).round().astype(int))]
    a, b = np.array([c.a for c in few]), np.array([c.b for c in few])
    T = np.stack([c.T_a_b for c in few])
    R_a = graph.poses[a, :3, :3]
    odometry = se3.relative(graph.poses[a], graph.poses[b])
    turn = so3.log(T[:, :3, :3] @ np.swapaxes(odometry[:, :3, :3], -1, -2))
    error = np.concatenate([T[:, :3, 3] - odometry[:, :3, 3], turn], axis=1)
    chain = accumulated(graph.poses, graph.odometry)
    grown = chain[b] - noise.transported(chain[a], graph.poses[b, :3, 3] - graph.poses[a, :3, 3])
    grown = noise.rotated(grown, np.swapaxes(R_a, -1, -2))
    own = np.stack([c.covariance for c in few])
    typical = float(chi2.median(6))

    def median(scale: float) -> float:
        solved = np.linalg.solve(scale * grown + own, error[..., None])[..., 0]
        return float(np.median(np.einsum("ij,ij->i", error, solved)))

    if median(1.0) <= typical:
        return 1.0
    low, high = 0.0, np.log(LARGEST)
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if median(float(np.exp(middle))) > typical else (low, middle)
    return float(np.exp(high))
