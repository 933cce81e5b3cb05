"""Information of poses beside LiDAR: against the covariance of a dense system, of which LiDAR's part is taken away."""

from __future__ import annotations

import gtsam
import numpy as np

from lslam.backend.graph import factors
from lslam.backend.graph.fix_noise import GaussMarkovNoise
from lslam.backend.graph.marginals import pose_prior
from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PoseGraph, PositionFix
from lslam.core.arrays import Floats
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.types.constraint import Constraint

COUNT = 5


def graph(seed: int = 0) -> PoseGraph:
    """A curve whose fixes have independent errors and errors that wander."""
    rng = np.random.default_rng(seed)
    turns = so3.exp(np.column_stack([0.05 * rng.normal(size=(COUNT, 2)), 0.4 * np.arange(COUNT)]))
    poses = se3.make(turns, np.column_stack([4.0 * np.arange(COUNT), rng.normal(size=COUNT), 0.1 * np.arange(COUNT)]))
    steps = [
        Constraint(k, k + 1, se3.relative(poses[k], poses[k + 1]), np.diag([1e-4] * 3 + [1e-6] * 3))
        for k in range(COUNT - 1)
    ]
    fixes = [
        PositionFix(k, poses[k, :3, 3] + 0.2 * rng.normal(size=3), np.array([0.2, 0.3, 0.5]), np.zeros(3), instant=i)
        for i, k in enumerate((0, 2, 4))
    ]
    wandering = GaussMarkovNoise(np.array([0.0, 2.0, 4.0]), np.array([0.8, 0.8, 1.5]), 1e4)
    return PoseGraph(poses=poses, odometry=steps, fixes=fixes, is_anchored=False, fix_noise=wandering)


def dense(parts: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Floats:
    """Information of all unknowns, keyframes first, in gtsam's axes."""
    ordering = gtsam.Ordering()
    for key in sorted(values.keys()):
        ordering.push_back(key)
    return np.asarray(parts.linearize(values).hessian(ordering)[0])


def test_it_is_the_information_of_all_with_the_other_unknowns_eliminated() -> None:
    made = graph()
    values = factors.start_values(made, made.poses)
    parts = factors.fixed_part(made, with_lidar=False)
    for fix in made.fixes:
        parts.add(factors.position(fix))
    H = dense(parts, values)
    own, rest = slice(0, 18), slice(18, None)
    reduced = H[own, own] - H[own, rest] @ np.linalg.solve(H[rest, rest], H[rest, own])
    seen = [0, 2, 4]  # of the others nothing is known
    J = noise.into_body(made.poses[seen])
    prior = pose_prior(parts, values, COUNT)
    x = np.random.default_rng(1).normal(size=(COUNT, 6))
    body = np.einsum("kij,kj->ki", J, x[seen]).ravel()
    expected = np.zeros((COUNT, 6))
    expected[seen] = np.einsum("kji,kj->ki", J, (reduced @ body).reshape(-1, 6))
    np.testing.assert_allclose(prior.product(x), expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(prior.blocks[2], J[1].T @ H[6:12, 6:12] @ J[1], rtol=1e-6, atol=1e-6)


def test_a_wandering_error_holds_the_shape_and_not_the_place() -> None:
    """All poses moved as one cost as much as the wandering error may be; one moved by itself costs its fix."""
    made = graph()
    prior = optimise(made, GraphConfig(refine=True)).pose_prior
    assert prior is not None
    whole, one = np.zeros((COUNT, 6)), np.zeros((COUNT, 6))
    whole[:, 0], one[2, 0] = 1.0, 1.0
    assert float(np.sum(whole * prior.product(whole))) < 1.01 / 0.8**2
    assert float(np.sum(one * prior.product(one))) > 5.0


def test_it_is_made_where_it_is_asked_for_alone() -> None:
    assert optimise(graph(), GraphConfig()).pose_prior is None
