"""Rates of odometry's drift along the way: their linear basis, their priors, and odometry corrected by them.

Rates are given at knots and interpolated linearly. A calibration error has one rate for the whole run, bending and slip change
over some distance; varying rates are a Markov process or a random walk.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.geometry import se3, so3
from lslam.graph.problem import PoseGraph

Floats = NDArray[np.float64]

# m, correlation length of a rate.
MEMORY = 100.0
# Hyperparameters tried: share of the variance of rates that is constant over the run, and scale of the configured drift.
LASTING, SIZES = (0.5, 0.9, 0.99), (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


def linear_basis(distances: NDArray[np.float64], apart: float = MEMORY) -> Floats:
    """(K-1, n) linear (hat) basis functions of the knots, halfway between keyframes reached after `distances` (K,), m.

    apart : m from knot to knot at the most
    """
    middle, knots = 0.5 * (distances[1:] + distances[:-1]), _knots(distances[-1], apart)
    return np.column_stack([np.interp(middle, knots, unit) for unit in np.eye(len(knots))])


def rate_roots(
    length: float, config: GraphConfig, axes: list[int], lasting: tuple[float, ...] = LASTING, apart: float = MEMORY,
    is_smooth: bool = True,
) -> list[Floats]:  # fmt: skip
    """(n d, n d) each, square roots of the prior covariance of the rates at the knots over `length` m, per constant share.

    axes : the d among x, y, z and the rotations about them
    apart : m from knot to knot at the most
    is_smooth : whether the varying part has a squared exponential kernel; else it is a Markov process
    """
    knots = _knots(length, apart)
    gap = np.abs(knots[:, None] - knots) / MEMORY
    alike = np.exp(-0.5 * gap**2 if is_smooth else -gap)
    size = _prior_sigmas(config, axes)
    return [np.asarray(np.kron(np.linalg.cholesky(share + (1.0 - share) * alike), size)) for share in lasting]


def walk_root(length: float, config: GraphConfig, axes: list[int], apart: float) -> Floats:
    """(n d, n d) as `rate_roots`, of independent rates: a random walk, over `MEMORY` as far as constant rates."""
    knots = _knots(length, apart)
    times = np.sqrt(MEMORY / (knots[1] - knots[0]))
    return np.asarray(np.kron(times * np.eye(len(knots)), _prior_sigmas(config, axes)))


def correct_drift(graph: PoseGraph, rates: NDArray[np.float64]) -> PoseGraph:
    """The graph with poses and odometry corrected by `rates` (K-1, 6) per m: m along the axes of the world, rad about them."""
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


def _prior_sigmas(config: GraphConfig, axes: list[int]) -> Floats:
    """(d, d) diagonal: one sigma of each rate."""
    percent, turn = 0.01 * config.drift_percent, np.radians(config.drift_deg_per_100m) / 100
    return np.diag(np.repeat([percent, turn], 3)[axes])


def _knots(length: float, apart: float) -> Floats:
    return np.linspace(0.0, length, int(np.ceil(length / apart)) + 1)
