"""Odometry that runs away steadily, as loops reveal it, and that is set straight before the graph is solved.

What odometry drifted by between the ends of a loop is a walk, of which each loop tells its own sum, or a rate, which one loop
tells all the others. A graph knows walks only: it spreads what a loop is off by as well as it can, and is far too unsure where
that was right. Which of the two it was is told by loops over different ways.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.geometry import noise, se3, so3
from lslam.graph.chi_square import quantile
from lslam.graph.consistency import Ends, judge_loops, moved
from lslam.graph.drift import chains
from lslam.graph.pose_graph import check_graph, with_distances
from lslam.graph.problem import DriftClaim, PoseGraph
from lslam.graph.rates import LASTING, SIZES, hats, rate_roots, set_straight
from lslam.stopping import checking
from lslam.types.constraint import Constraint

Floats = NDArray[np.float64]

# Loops that are looked at, evenly spread.
MOST = 30
# Times the drift of the configuration, as variance of a walk, that are believed in.
WALKS = (0.0, 1e-4, 1e-3, 0.01, 0.1, 1.0, 10.0, 100.0)
# Shares of the variance of rates that last: none or all of it, too, since loops are few and tell nothing of places between them.
# What wanders smoothly would be known there too well.
LASTS = (0.0, *LASTING, 0.9999)
# m from knot to knot, by which rates that wander differ from a walk, and into how many parts a long way is cut at the most.
APART, PARTS = 50.0, 100
# How often the loops are asked, each time of what was set straight by the last answer.
ROUNDS = 4
# Keyframes of which it is written out at a time what each rate does to them.
PART = 256
# Share of its variance that each error has for itself at the least: what is less drowns in rounding.
LEAST = 1e-12


def without_loop_drift(graph: PoseGraph, config: GraphConfig) -> PoseGraph:
    """The graph set straight by the drift that its loops tell, which it says as `claim`; as it is where they tell none.

    Rates and a walk have unknown sizes. There is drift where rates of which most lasts are likelier than any walk alone by more
    than chance would have it; the rates are then of that kind with which the loops are likeliest, and the walk beside them is
    the mean of those that are likely.

    Raises GraphError when the graph is in pieces or not finite.
    """
    check_graph(graph)
    graph = with_distances(graph)
    reasons = judge_loops(graph, config)
    loops = [loop for loop, reason in zip(graph.loops, reasons, strict=True) if not reason]
    if not loops or graph.distances[-1] <= 0:
        return graph
    loops = [loops[i] for i in np.unique(np.linspace(0, len(loops) - 1, MOST).round().astype(int))]
    at_knots = hats(graph.distances, _apart(graph.distances))
    does_last = np.repeat(LASTS, len(SIZES)) > 0.5
    straight, found = graph, np.zeros(6 * at_knots.shape[1])
    turned = np.tile(np.eye(3), (len(graph) - 1, 1, 1))
    for _ in range(ROUNDS):
        fit = _Fit(straight, loops, found, turned, config)
        gain = float(fit.unlikeliness[:, 0].min() - fit.unlikeliness[:, 1:][:, does_last].min())
        if gain <= 0.0:
            return graph
        found, covariance, walk = fit.likeliest()
        rates = at_knots @ found.reshape(-1, 6)
        turned = _turned(rates[:, 3:], np.diff(graph.distances))
        straight = set_straight(graph, np.column_stack([np.einsum("kij,kj->ki", turned, rates[:, :3]), rates[:, 3:]]))
    chance = quantile(config.probability, 6)
    if gain <= chance:
        return graph
    share = np.diff(graph.distances) / np.ptp(graph.distances)
    mean = np.kron(share @ at_knots, np.eye(6))
    sigma = np.sqrt(np.diag(mean @ covariance @ mean.T)).astype(np.float64)
    claim = DriftClaim(-np.asarray(mean @ found, np.float64), sigma, gain, chance)
    return replace(straight, spread=fit.spread(covariance, walk), walk=walk, claim=claim)


class _Fit:
    """What loops say of the odometry of `graph`, which was set straight by `found` (6 n,), rates at the knots, already.

    Rates are those along the axes of odometry as it came, which `turned` (K-1, 3, 3) takes into those of the graph.
    Errors are twists of the world about the middle of the way: those of parts of the way add up there.
    unlikeliness : (walks, 1 + LASTS * SIZES) minus twice the logarithm of the likelihood but for a constant; column 0 is that
        without rates
    """

    def __init__(
        self, graph: PoseGraph, loops: Sequence[Constraint], found: Floats, turned: Floats,
        config: GraphConfig,
    ) -> None:  # fmt: skip
        self._poses = se3.make(np.eye(3), -graph.poses[:, :3, 3].mean(0)) @ graph.poses
        self._ends, self._way = Ends(loops), (graph.distances, turned)
        ends, P = self._ends, self._poses
        at_ends = np.empty((2, len(loops), 6, len(found)))
        for k, effects in _effects(P, *self._way):
            for at_end, end in zip(at_ends, (ends.a, ends.b), strict=True):
                is_here = (k.start <= end) & (end < k.stop)
                at_end[is_here] = effects[end[is_here] - k.start]
        self._rows = (at_ends[1] - at_ends[0]).reshape(-1, len(found))
        self._off = se3.log(P[ends.a] @ ends.T @ se3.inverse(P[ends.b])).ravel() + self._rows @ found
        self._chains = [noise.transported(chain, -P[:, :3, 3]) for chain in chains(graph, config)]
        self._known, self._walk = (_shared(chain, ends) for chain in self._chains)
        self._known += _on_diagonal(moved(ends.covariances, P[ends.a]))
        roots = rate_roots(graph.distances[-1], config, list(range(6)), LASTS, _apart(graph.distances), is_smooth=False)
        self._kinds = [(root, size) for root in roots for size in SIZES]
        seen = [part @ part.T for part in (self._rows @ root for root in roots)]
        drifted = [np.zeros_like(self._known)] + [size**2 * part for part in seen for size in SIZES]
        self.unlikeliness = np.array(
            [[_unlikely(self._walked(walk) + D, self._off) for D in drifted] for walk in checking(WALKS)]
        )

    def likeliest(self) -> tuple[Floats, Floats, float]:
        """(6 n,) rates at the knots, their covariance (6 n, 6 n), and the walk beside them."""
        prior, walk = self._choice()
        seen = self._rows @ prior
        gain = np.linalg.solve(self._walked(walk) + seen @ self._rows.T, seen).T
        return np.asarray(gain @ self._off), np.asarray(prior - gain @ seen), walk

    def spread(self, covariance: Floats, walk: float) -> Floats:
        """(K, 6, 6) what poses are unsure by when rates are by `covariance` (6 n, 6 n), as the covariances of `Solution`.

        Beside what they are unsure by when the rates are known: loops that are closed then take back a part of what wrong rates
        do, as they cannot tell it from a walk.
        """
        known, walked = self._chains
        chain, taken = known + walk * walked, np.linalg.solve(self._walked(walk), self._rows)
        about_middle = np.empty((len(self._poses), 6, 6))
        for k, effects in _effects(self._poses, *self._way):
            left = effects - _walked_along(chain, np.arange(len(chain))[k], self._ends) @ taken
            spread = (left.reshape(-1, len(covariance)) @ covariance).reshape(left.shape)
            about_middle[k] = spread @ np.swapaxes(left, -1, -2)
        return noise.transported(about_middle, self._poses[:, :3, 3])

    def _choice(self) -> tuple[Floats, float]:
        """The covariance of rates of the likeliest kind before any loop, and the walk."""
        likely = np.exp(-0.5 * (self.unlikeliness[:, 1:] - self.unlikeliness[:, 1:].min()))
        root, size = self._kinds[int(likely.sum(0).argmax())]
        return size**2 * root @ root.T, float(WALKS @ likely.sum(1) / likely.sum())

    def _walked(self, walk: float) -> Floats:
        return np.asarray(self._known + walk * self._walk)


def _apart(distances: Floats) -> float:
    """m from knot to knot."""
    return max(APART, float(distances[-1]) / PARTS)


def _unlikely(S: Floats, off: Floats) -> float:
    """Minus twice the logarithm of the likelihood of `off` (N,) with the covariance S, but for a constant."""
    from scipy.linalg import solve_triangular

    L = np.linalg.cholesky(S + LEAST * np.diag(np.diag(S)))
    whitened = solve_triangular(L, off, lower=True, check_finite=False)
    return float(2.0 * np.log(np.diag(L)).sum() + whitened @ whitened)


def _turned(turns: Floats, ways: Floats) -> Floats:
    """(K-1, 3, 3) from the axes of odometry to those of odometry that was set right by `turns` (K-1, 3) per m."""
    turned = [np.eye(3)]
    for turn in so3.exp(turns * ways[:, None]):
        turned.append(turn @ turned[-1])
    return np.stack(turned[1:])


def _effects(poses: Floats, distances: Floats, turned: Floats) -> Iterator[tuple[slice, Floats]]:
    """Keyframes, part after part, and (k, 6, 6 n) twist about the origin that rates at the knots have brought each of them.

    turned : as of `_turned`
    """
    passed = np.diff(distances)[:, None] * hats(distances, _apart(distances))
    passed, turned = (np.concatenate([0.0 * rows[:1], rows]) for rows in (passed, turned))
    before = np.zeros((6, passed.shape[1], 6))
    for begin in checking(range(0, len(poses), PART)):
        k = slice(begin, min(begin + PART, len(poses)))
        step = np.tile(np.eye(6), (k.stop - k.start, 1, 1))
        step[:, :3, :3] = turned[k]
        step[:, :3, 3:] = so3.hat(poses[k, :3, 3])
        effects = before + np.cumsum(step[:, :, None] * passed[k, None, :, None], axis=0)
        before = effects[-1]
        yield k, effects.reshape(len(step), 6, -1)


def _walked_along(accumulated: Floats, keyframes: NDArray[np.intp], ends: Ends) -> Floats:
    """(k, 6, 6 L) covariance of what errors of odometry have brought keyframes (k,) with what loops, a before b, see of it."""
    last, first = (accumulated[np.minimum.outer(keyframes, end)] for end in (ends.b, ends.a))
    return np.asarray((last - first).transpose(0, 2, 1, 3).reshape(len(keyframes), 6, -1))


def _shared(accumulated: Floats, ends: Ends) -> Floats:
    """(6 L, 6 L) covariance of what loops, a before b, are off by: two have the errors of the way in common that both go.

    accumulated : (K, 6, 6) of the twist about the origin that errors of odometry have brought each pose
    """
    first = np.maximum.outer(ends.a, ends.a)
    last = np.maximum(np.minimum.outer(ends.b, ends.b), first)
    return np.asarray((accumulated[last] - accumulated[first]).transpose(0, 2, 1, 3).reshape(6 * len(first), -1))


def _on_diagonal(blocks: Floats) -> Floats:
    """(6 L, 6 L) with blocks (L, 6, 6) on the diagonal."""
    count = len(blocks)
    whole = np.zeros((count, 6, count, 6))
    whole[np.arange(count), :, np.arange(count)] = blocks
    return whole.reshape(6 * count, 6 * count)
