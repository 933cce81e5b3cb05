"""Rates at which odometry runs away along the way, what is believed of them, and odometry set right by them.

Rates are given at knots and straight between: a calibration has one for the whole run, and what bends or slips another for a
while.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.geometry import se3, so3
from lslam.graph.problem import PoseGraph

Floats = NDArray[np.float64]

# m over which a rate is about one and the same.
MEMORY = 100.0
# Shares of the variance of rates that last for the whole run, as a calibration does, and times the drift that the configuration
# believes in: the likeliest are taken.
LASTING, SIZES = (0.5, 0.9, 0.99), (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


def hats(distances: NDArray[np.float64]) -> Floats:
    """(K-1, n) how much each knot counts halfway between two keyframes that were reached after `distances` (K,), m."""
    middle, knots = 0.5 * (distances[1:] + distances[:-1]), _knots(distances[-1])
    return np.column_stack([np.interp(middle, knots, unit) for unit in np.eye(len(knots))])


def rate_roots(
    length: float, config: GraphConfig, axes: list[int], lasting: tuple[float, ...] = LASTING
) -> list[Floats]:
    """(n d, n d) each, roots of covariances of the rates at the knots of so many m, one for each share that lasts.

    axes : the d that are asked about, of x, y, z and the turns about them
    """
    knots = _knots(length)
    alike = np.exp(-0.5 * ((knots[:, None] - knots) / MEMORY) ** 2)
    percent, turn = 0.01 * config.drift_percent, np.radians(config.drift_deg_per_100m) / 100
    size = np.diag(np.repeat([percent, turn], 3)[axes])
    return [np.asarray(np.kron(np.linalg.cholesky(share + (1.0 - share) * alike), size)) for share in lasting]


def set_straight(graph: PoseGraph, rates: NDArray[np.float64]) -> PoseGraph:
    """The graph with poses and odometry set right by `rates` (K-1, 6) per m: m along the axes of the world, rad about them."""
    steps = se3.relative(graph.poses[:-1], graph.poses[1:])
    by = rates * np.diff(graph.distances)[:, None]
    poses = [graph.poses[0]]
    for step, turn, shift in zip(steps, so3.exp(by[:, 3:]), by[:, :3], strict=True):
        pose = poses[-1] @ step
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += shift
        poses.append(pose)
    moved = se3.normalise(np.stack(poses))
    odometry = [
        replace(
            c, T_a_b=se3.relative(moved[c.a], graph.poses[c.a] @ c.T_a_b @ se3.relative(graph.poses[c.b], moved[c.b]))
        )
        for c in graph.odometry
    ]
    return replace(graph, poses=moved, odometry=odometry)


def _knots(length: float) -> Floats:
    return np.linspace(0.0, length, int(np.ceil(length / MEMORY)) + 1)
