"""Steady drift of odometry, estimated from loop closures and corrected before the graph is solved.

The drift between the ends of a loop is a random walk, of which each loop closure observes one sum, or comes of a rate that all
of them observe. A pose graph models random walks only: it distributes the error of a loop, with too large covariances where
the drift was steady. Loop closures over different distances tell the two apart (empirical Bayes).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.drift import LASTING, SIZES, chains, correct_drift, linear_basis, mean_rates, rate_roots
from lslam.backend.graph.pose_graph import Ends, check_graph, judge_loops, transport_twists, with_distances
from lslam.backend.graph.problem import EstimatedDrift, PoseGraph
from lslam.core.arrays import Floats
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile
from lslam.core.stopping import checking
from lslam.core.types.constraint import Constraint

# Loop closures used at most, evenly spread.
MOST = 30
# Variances of the random walk tried, in multiples of the configured drift.
WALKS = (0.0, 1e-4, 1e-3, 0.01, 0.1, 1.0, 10.0, 100.0)
# Constant shares of the variance of rates: none and all of it, too, since loop closures are few and observe nothing between
# them. A smooth prior would be overconfident there.
LASTS = (0.0, *LASTING, 0.9999)
# m from knot to knot, above which varying rates differ from a random walk, and intervals at the most.
KNOTS_APART_M, MOST_KNOTS = 50.0, 100
# Iterations, each linearised about the last estimate.
REWEIGHTINGS = 4
# Keyframes whose Jacobians are held in memory at a time.
BLOCK_KEYFRAMES = 256
# Least independent share of each variance, against rounding.
LEAST_OWN_SHARE = 1e-12


def without_loop_drift(graph: PoseGraph, config: GraphConfig) -> PoseGraph:
    """The graph corrected by the steady drift that its loop closures reveal, `estimated_drift`; unchanged where there is none.

    A likelihood ratio test against the null hypothesis of a random walk alone decides whether there is a mostly constant rate.
    The hyperparameters of the rates maximise the marginal likelihood; the random walk beside them is the posterior mean.

    Raises GraphError when the graph is disconnected or not finite.
    """
    check_graph(graph)
    graph = with_distances(graph)
    reasons = judge_loops(graph, config)
    loops = [loop for loop, reason in zip(graph.loops, reasons, strict=True) if not reason]
    if not loops or graph.distances[-1] <= 0:
        return graph
    loops = [loops[i] for i in np.unique(np.linspace(0, len(loops) - 1, MOST).round().astype(int))]
    at_knots = linear_basis(graph.distances, _apart(graph.distances))
    does_last = np.repeat(LASTS, len(SIZES)) > 0.5
    straight, drift = graph, np.zeros(6 * at_knots.shape[1])
    turned = np.tile(np.eye(3), (len(graph) - 1, 1, 1))
    for _ in range(REWEIGHTINGS):
        fit = _Fit(straight, loops, drift, turned, config)
        gain = float(fit.negative_log_likelihood[:, 0].min() - fit.negative_log_likelihood[:, 1:][:, does_last].min())
        if gain <= 0.0:
            return graph
        drift, covariance, walk = fit.likeliest()
        rates = at_knots @ drift.reshape(-1, 6)
        turned = _accumulate_turns(rates[:, 3:], np.diff(graph.distances))
        straight = correct_drift(graph, np.column_stack([np.einsum("kij,kj->ki", turned, rates[:, :3]), rates[:, 3:]]))
    chance = quantile(RIGHT_PROBABILITY, 6)
    if gain <= chance:
        return graph
    mean, sigma = mean_rates(graph.distances, at_knots, drift, covariance)
    estimated_drift = EstimatedDrift(-mean, sigma, gain, chance)
    return replace(straight, spread=fit.pose_covariances(covariance, walk), walk=walk, estimated_drift=estimated_drift)


class _Fit:
    """Likelihood of rates given loop closures, for the odometry of `graph` corrected by `rates` (6 n,) at the knots.

    Rates are along the axes of the original odometry, which `rotations` (K-1, 3, 3) takes into those of the graph.
    Errors are twists of the world about the middle of the way, where those of parts of the way add up.
    negative_log_likelihood : (walks, 1 + LASTS * SIZES) twice, up to a constant; column 0 is the null hypothesis without rates
    """

    def __init__(
        self,
        graph: PoseGraph,
        loops: Sequence[Constraint],
        rates: Floats,
        rotations: Floats,
        config: GraphConfig,
    ) -> None:
        self._poses = se3.make(np.eye(3), -graph.poses[:, :3, 3].mean(0)) @ graph.poses
        self._ends, self._way = Ends(loops), (graph.distances, rotations)
        ends, P = self._ends, self._poses
        at_ends = np.empty((2, len(loops), 6, len(rates)))
        for k, effects in _effects(P, *self._way):
            for at_end, end in zip(at_ends, (ends.a, ends.b), strict=True):
                is_here = (k.start <= end) & (end < k.stop)
                at_end[is_here] = effects[end[is_here] - k.start]
        self._rows = (at_ends[1] - at_ends[0]).reshape(-1, len(rates))
        self._off = se3.log(P[ends.a] @ ends.T @ se3.inverse(P[ends.b])).ravel() + self._rows @ rates
        self._chains = [noise.transport(chain, -P[:, :3, 3]) for chain in chains(graph, config)]
        self._known, self._walk = (_joint_covariance(chain, ends) for chain in self._chains)
        self._known += _on_diagonal(transport_twists(ends.covariances, P[ends.a]))
        roots = rate_roots(graph.distances[-1], config, list(range(6)), LASTS, _apart(graph.distances), is_smooth=False)
        self._kinds = [(root, size) for root in roots for size in SIZES]
        seen = [part @ part.T for part in (self._rows @ root for root in roots)]
        drifted = [np.zeros_like(self._known)] + [size**2 * part for part in seen for size in SIZES]
        self.negative_log_likelihood = np.array(
            [
                [_negative_log_likelihood(self._with_walk(walk) + D, self._off) for D in drifted]
                for walk in checking(WALKS)
            ]
        )

    def likeliest(self) -> tuple[Floats, Floats, float]:
        """Rates (6 n,) at the knots of maximum likelihood, their covariance (6 n, 6 n), and the variance of the random walk."""
        prior, walk = self._choice()
        design = self._rows @ prior
        gain = np.linalg.solve(self._with_walk(walk) + design @ self._rows.T, design).T
        return np.asarray(gain @ self._off), np.asarray(prior - gain @ design), walk

    def pose_covariances(self, covariance: Floats, walk: float) -> Floats:
        """(K, 6, 6) covariances of poses due to the `covariance` (6 n, 6 n) of the rates, as those of `Solution`.

        They add to the covariances given the rates: loop closures then take back a part of the error of wrong rates, since they
        cannot tell it from a random walk.
        """
        known, walked = self._chains
        chain, weights = known + walk * walked, np.linalg.solve(self._with_walk(walk), self._rows)
        about_middle = np.empty((len(self._poses), 6, 6))
        for k, effects in _effects(self._poses, *self._way):
            rest = effects - _walk_along(chain, np.arange(len(chain))[k], self._ends) @ weights
            spread = (rest.reshape(-1, len(covariance)) @ covariance).reshape(rest.shape)
            about_middle[k] = spread @ np.swapaxes(rest, -1, -2)
        return noise.transport(about_middle, self._poses[:, :3, 3])

    def _choice(self) -> tuple[Floats, float]:
        """The prior covariance of the rates with maximum likelihood, and the variance of the random walk."""
        likely = np.exp(-0.5 * (self.negative_log_likelihood[:, 1:] - self.negative_log_likelihood[:, 1:].min()))
        root, size = self._kinds[int(likely.sum(0).argmax())]
        return size**2 * root @ root.T, float(WALKS @ likely.sum(1) / likely.sum())

    def _with_walk(self, walk: float) -> Floats:
        """Covariance of the loop closures' residuals with a random walk of variance factor `walk` added."""
        return np.asarray(self._known + walk * self._walk)


def _apart(distances: Floats) -> float:
    """Distance between two knots, m, for keyframes reached after `distances` (K,), m."""
    return max(KNOTS_APART_M, float(distances[-1]) / MOST_KNOTS)


def _negative_log_likelihood(S: Floats, off: Floats) -> float:
    """Twice the negative log-likelihood of `off` (N,) with the covariance S, up to a constant."""
    from scipy.linalg import solve_triangular

    L = np.linalg.cholesky(S + LEAST_OWN_SHARE * np.diag(np.diag(S)))
    whitened = solve_triangular(L, off, lower=True, check_finite=False)
    return float(2.0 * np.log(np.diag(L)).sum() + whitened @ whitened)


def _accumulate_turns(turns: Floats, ways: Floats) -> Floats:
    """(K-1, 3, 3) from the axes of odometry to those of odometry corrected by `turns` (K-1, 3) per m."""
    turned = [np.eye(3)]
    for turn in so3.exp(turns * ways[:, None]):
        turned.append(turn @ turned[-1])
    return np.stack(turned[1:])


def _effects(poses: Floats, distances: Floats, rotations: Floats) -> Iterator[tuple[slice, Floats]]:
    """Blocks of keyframes with their Jacobians (k, 6, 6 n): twist about the origin by the rates at the knots.

    rotations : (K-1, 3, 3) from the axes of the rates into those of the graph
    """
    passed = np.diff(distances)[:, None] * linear_basis(distances, _apart(distances))
    passed, rotations = (np.concatenate([0.0 * rows[:1], rows]) for rows in (passed, rotations))
    before = np.zeros((6, passed.shape[1], 6))
    for begin in checking(range(0, len(poses), BLOCK_KEYFRAMES)):
        k = slice(begin, min(begin + BLOCK_KEYFRAMES, len(poses)))
        step = np.tile(np.eye(6), (k.stop - k.start, 1, 1))
        step[:, :3, :3] = rotations[k]
        step[:, :3, 3:] = so3.hat(poses[k, :3, 3])
        effects = before + np.cumsum(step[:, :, None] * passed[k, None, :, None], axis=0)
        before = effects[-1]
        yield k, effects.reshape(len(step), 6, -1)


def _walk_along(chain: Floats, keyframes: NDArray[np.intp], ends: Ends) -> Floats:
    """(k, 6, 6 L) covariance between odometry's errors at keyframes (k,) and those over the L loop closures.

    chain : (K, 6, 6) as of `_joint_covariance`
    """
    last, first = (chain[np.minimum.outer(keyframes, end)] for end in (ends.b, ends.a))
    return np.asarray((last - first).transpose(0, 2, 1, 3).reshape(len(keyframes), 6, -1))


def _joint_covariance(chain: Floats, ends: Ends) -> Floats:
    """(6 L, 6 L) covariance of the residuals of loop closures: two of them share the errors of their common way.

    chain : (K, 6, 6) of each pose's twist about the origin by errors of odometry
    """
    first = np.maximum.outer(ends.a, ends.a)
    last = np.maximum(np.minimum.outer(ends.b, ends.b), first)
    return np.asarray((chain[last] - chain[first]).transpose(0, 2, 1, 3).reshape(6 * len(first), -1))


def _on_diagonal(blocks: Floats) -> Floats:
    """(6 L, 6 L) with blocks (L, 6, 6) on the diagonal."""
    count = len(blocks)
    whole = np.zeros((count, 6, count, 6))
    whole[np.arange(count), :, np.arange(count)] = blocks
    return whole.reshape(6 * count, 6 * count)
