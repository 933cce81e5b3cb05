"""Rates at which odometry runs away along the way, what is believed of them, and odometry set right by them.

Rates are given at knots and straight between: a calibration has one for the whole run, what bends or slips another for a
while; and those that wander are others wherever one looks.
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


def hats(distances: NDArray[np.float64], apart: float = MEMORY) -> Floats:
    """(K-1, n) how much each knot counts halfway between two keyframes that were reached after `distances` (K,), m.

    apart : m from knot to knot at the most
    """
    middle, knots = 0.5 * (distances[1:] + distances[:-1]), _knots(distances[-1], apart)
    return np.column_stack([np.interp(middle, knots, unit) for unit in np.eye(len(knots))])


def rate_roots(
    length: float, config: GraphConfig, axes: list[int], lasting: tuple[float, ...] = LASTING, apart: float = MEMORY,
    is_smooth: bool = True,
) -> list[Floats]:  # fmt: skip
    """(n d, n d) each, roots of covariances of the rates at the knots of so many m, one for each share that lasts.

    axes : the d that are asked about, of x, y, z and the turns about them
    apart : m from knot to knot at the most
    is_smooth : whether what does not last comes and goes gently; else it wanders as a Markov process does
    """
    knots = _knots(length, apart)
    gap = np.abs(knots[:, None] - knots) / MEMORY
    alike = np.exp(-0.5 * gap**2 if is_smooth else -gap)
    size = _believed(config, axes)
    return [np.asarray(np.kron(np.linalg.cholesky(share + (1.0 - share) * alike), size)) for share in lasting]


def walk_root(length: float, config: GraphConfig, axes: list[int], apart: float) -> Floats:
    """(n d, n d) as `rate_roots`, of rates no two of which are alike: a walk, as far over `MEMORY` as rates that last."""
    knots = _knots(length, apart)
    times = np.sqrt(MEMORY / (knots[1] - knots[0]))
    return np.asarray(np.kron(times * np.eye(len(knots)), _believed(config, axes)))


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


def _believed(config: GraphConfig, axes: list[int]) -> Floats:
    """(d, d) diagonal: one sigma of each rate."""
    percent, turn = 0.01 * config.drift_percent, np.radians(config.drift_deg_per_100m) / 100
    return np.diag(np.repeat([percent, turn], 3)[axes])


def _knots(length: float, apart: float) -> Floats:
    return np.linspace(0.0, length, int(np.ceil(length / apart)) + 1)
