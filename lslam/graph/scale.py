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
    """The factor, at least 1, on odometry's covariances with which the median loop and fix are where they should be."""
    if not loops and len(graph.fixes) < 2:
        return 1.0
    chain = accumulated(graph.poses, graph.odometry)
    by_loops = _fitting(*_against_loops(graph, loops, chain)) if loops else 1.0
    return max(by_loops, _of_fixes(graph, chain))


def _against_loops(graph: PoseGraph, loops: Sequence[Constraint], chain: Floats) -> tuple[Floats, Floats, Floats]:
    """(P, 6) where loops put b against odometry, in the axes of a; covariances of loop and odometry there."""
    few = [loops[i] for i in np.unique(np.linspace(0, len(loops) - 1, MOST).round().astype(int))]
    a, b = np.array([c.a for c in few]), np.array([c.b for c in few])
    T = np.stack([c.T_a_b for c in few])
    R_a = graph.poses[a, :3, :3]
    odometry = se3.relative(graph.poses[a], graph.poses[b])
    turn = so3.log(T[:, :3, :3] @ np.swapaxes(odometry[:, :3, :3], -1, -2))
    error = np.concatenate([T[:, :3, 3] - odometry[:, :3, 3], turn], axis=1)
    grown = chain[b] - noise.transported(chain[a], graph.poses[b, :3, 3] - graph.poses[a, :3, 3])
    grown = noise.rotated(grown, np.swapaxes(R_a, -1, -2))
    return error, np.stack([c.covariance for c in few]), grown


def _of_fixes(graph: PoseGraph, chain: Floats) -> float:
    """By pairs of fixes, half the fixes apart: how the way between them differs from odometry's."""
    half = len(graph.fixes) // 2
    if not half:
        return 1.0
    first = np.unique(np.linspace(0, len(graph.fixes) - half - 1, MOST).round().astype(int))
    k = np.array([f.keyframe for f in graph.fixes])
    arms = np.stack([f.arm for f in graph.fixes])
    antenna = np.einsum("fij,fj->fi", graph.poses[k, :3, :3], arms) + graph.poses[k, :3, 3]
    off = np.stack([f.position for f in graph.fixes]) - antenna
    own = np.stack([f.sigma for f in graph.fixes]) ** 2
    a, b = k[first], k[first + half]
    grown = chain[b] - noise.transported(chain[a], graph.poses[b, :3, 3] - graph.poses[a, :3, 3])
    noise_of_pair = (own[first] + own[first + half])[:, :, None] * np.eye(3)
    return _fitting(off[first + half] - off[first], noise_of_pair, grown[:, :3, :3])


def _fitting(error: Floats, own: Floats, grown: Floats) -> float:
    """The factor on `grown` (P, n, n) with which the median error (P, n) is as large as it should be."""

    typical = float(chi2.median(error.shape[1]))

    def is_enough(scale: float) -> bool:
        solved = np.linalg.solve(scale * grown + own, error[..., None])[..., 0]
        return bool(np.median(np.einsum("ij,ij->i", error, solved)) <= typical)

    if is_enough(1.0):
        return 1.0
    low, high = 0.0, float(np.log(LARGEST))
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if is_enough(float(np.exp(middle))) else (middle, high)
    return float(np.exp(high))
