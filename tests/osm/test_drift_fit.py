"""Likelihood and estimate of a steady drift against all covariances written out, and the prior."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from test_wall_drift import MAP, SEEN, WAY, odometry, sighted

from lslam.backend.graph.drift import LASTING, MEMORY_M, SIZES, linear_basis, rate_roots, walk_root
from lslam.backend.graph.factors import PLANAR
from lslam.backend.graph.problem import PoseGraph
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se2
from lslam.osm import wall_drift
from lslam.osm.wall_drift import SCALES, DriftFit, Sizes, WallSightings, _effects, find_wall_drift, without_drift

Floats = NDArray[np.float64]
CHOICES = [(0.25, 0.0, 0.5), (0.25, 0.5, 0.9), (0.5, 2.0, 0.99), (1.0, 8.0, 0.5)]
ROOTS = dict(zip(LASTING, rate_roots(WAY[-1], GraphConfig(), PLANAR), strict=True))


def some(seen: WallSightings, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> WallSightings:
    rows = (seen.keyframes, seen.walls, seen.normals, seen.places, seen.offsets)
    return WallSightings(*(row[chosen] for row in rows), seen.share)  # type: ignore[arg-type]


def scene(seed: int, percent: float = 0.5, count: int = 150) -> tuple[PoseGraph, WallSightings]:
    graph = odometry(percent, 0.2)
    seen = sighted(graph, seed, 0.5)
    return graph, some(seen, np.random.default_rng(seed).permutation(len(seen.walls))[:count])


def prior_covariance(size: float, lasting: float) -> Floats:
    """Covariance of three rates at each knot, 100 m apart at most."""
    knots = np.linspace(0.0, WAY[-1], int(np.ceil(WAY[-1] / 100.0)) + 1)
    alike = lasting + (1 - lasting) * np.exp(-0.5 * ((knots[:, None] - knots) / 100.0) ** 2)
    return np.asarray(size**2 * np.kron(alike, np.diag([0.01**2, 0.01**2, np.radians(0.005) ** 2])))


class Dense:
    """The offsets as one Gaussian: what is seen, what the walls are drawn wrong by, start and shift and rates."""

    def __init__(self, graph: PoseGraph, seen: WallSightings, taken: Floats | None = None) -> None:
        self.graph, self.seen = graph, seen
        about = seen.places - graph.poses[seen.keyframes, :2, 3]
        turned = seen.normals[:, 1] * about[:, 0] - seen.normals[:, 0] * about[:, 1]
        self.effects = _effects(graph, linear_basis(graph.distances))
        axes = np.column_stack([seen.normals, turned])
        self.rows = np.stack([axis @ self.effects[k] for axis, k in zip(axes, seen.keyframes, strict=True)])
        self.given = np.append(graph.start_sigma, [graph.shift_sigma] * 2)  # type: ignore[arg-type]
        self.taken = np.zeros(self.rows.shape[1] - 5) if taken is None else taken
        self.offsets = seen.offsets - self.rows[:, 5:] @ self.taken
        self.weights = np.ones(len(seen.walls))

    def fit(self) -> DriftFit:
        return DriftFit(self.graph, self.seen, self.effects, self.taken, SEEN, MAP, self.given)

    def parts(self, scale: float, size: float, lasting: float) -> tuple[Floats, Floats, Floats]:
        """Covariances of what is seen, of all unknowns, and of the offsets."""
        of_rates = prior_covariance(size, lasting)
        prior = np.zeros((5 + len(of_rates),) * 2)
        prior[:5, :5], prior[5:, 5:] = np.diag(self.given**2), of_rates
        noise = np.diag((scale * SEEN) ** 2 / self.weights)
        drawn = MAP**2 * (self.seen.walls[:, None] == self.seen.walls)
        return noise, prior, noise + drawn + self.rows @ prior @ self.rows.T

    def negative_log_likelihood(self, scale: float, size: float, lasting: float) -> float:
        _, _, C = self.parts(scale, size, lasting)
        return float(np.linalg.slogdet(C)[1] + self.offsets @ np.linalg.solve(C, self.offsets))

    def rates(self, scale: float, size: float, lasting: float) -> tuple[Floats, Floats]:
        _, prior, C = self.parts(scale, size, lasting)
        gain = np.linalg.solve(C, self.rows @ prior).T
        return -(gain @ self.offsets)[5:], (prior - gain @ self.rows @ prior)[5:, 5:]

    def doubt(self, scale: float, size: float, lasting: float) -> None:
        """Weights of Student's t with three degrees of freedom."""
        noise, _, C = self.parts(scale, size, lasting)
        missed = noise @ np.linalg.solve(C, self.offsets)
        self.weights = 4.0 / (3.0 + (missed / (scale * SEEN)) ** 2)


def negative_log_likelihood(fit: DriftFit, scale: float, size: float, lasting: float) -> float:
    return float(fit.negative_log_likelihood(scale, ROOTS[lasting], (0.1, size))[1])


def sizes(scale: float, size: float, lasting: float) -> Sizes:
    return Sizes(scale, size * ROOTS[lasting])


def agree(fit: DriftFit, dense: Dense) -> None:
    base = negative_log_likelihood(fit, 1.0, 1.0, 0.9) - dense.negative_log_likelihood(1.0, 1.0, 0.9)
    for choice in CHOICES:
        assert negative_log_likelihood(fit, *choice) - dense.negative_log_likelihood(*choice) == pytest.approx(
            base, abs=1e-4
        )
        for found, expected in zip(fit.rates(sizes(*choice)), dense.rates(*choice), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max() + 1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_likelihood_and_rates_are_those_of_all_covariances_written_out(seed: int) -> None:
    dense = Dense(*scene(seed))
    agree(dense.fit(), dense)
    for lasting, root in ROOTS.items():
        np.testing.assert_allclose(root @ root.T, prior_covariance(1.0, lasting), rtol=1e-9)
    # And where poses are without some rates already, what is found are all of them.
    taken = 0.3 * ROOTS[0.5] @ np.random.default_rng(seed).standard_normal(len(dense.taken))
    agree(Dense(*scene(seed), taken).fit(), Dense(*scene(seed), taken))


@pytest.mark.parametrize("seed", range(3))
def test_outliers_get_less_weight(seed: int) -> None:
    dense = Dense(*scene(seed))
    fit = dense.fit()
    fit.reweight(sizes(0.5, 1.0, 0.9))
    dense.doubt(0.5, 1.0, 0.9)
    assert dense.weights.min() < 0.3 < 1.0 < dense.weights.max()
    agree(fit, dense)


def test_five_copies_with_weight_one_fifth_equal_one() -> None:
    graph, seen = scene(0)
    once, fifths = Dense(graph, seen).fit(), Dense(graph, some(seen, np.repeat(np.arange(len(seen.walls)), 5))).fit()
    fifths.count_less(0.2)
    for choice in CHOICES:
        assert negative_log_likelihood(fifths, *choice) == pytest.approx(
            negative_log_likelihood(once, *choice), abs=1e-6
        )
        np.testing.assert_allclose(
            fifths.rates(sizes(*choice))[1], once.rates(sizes(*choice))[1], rtol=1e-8, atol=1e-18
        )


@pytest.mark.parametrize(("length", "apart"), [(366.0, 20.0), (2000.0, 50.0)])
def test_wandering_rates_have_the_variance_of_a_random_walk(length: float, apart: float) -> None:
    """Its variance grows with the way, and over `MEMORY_M` it is that of rates that last as long."""
    way = np.arange(0.0, length, 2.0)
    moves = 2.0 * np.cumsum(linear_basis(way, apart), axis=0)
    root = walk_root(float(way[-1]), GraphConfig(), PLANAR, apart)[::3, ::3]
    variance = np.einsum("kn,nm,km->k", moves, root @ root.T, moves)
    middle = slice(len(way) // 3, 2 * len(way) // 3)
    np.testing.assert_allclose(variance[middle], 0.01**2 * MEMORY_M * way[1:][middle], rtol=0.2)


@pytest.mark.parametrize("seed", [0, 2])
def test_drift_is_significant_by_the_likelihood_ratio(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wall_drift, "FREEDOM", 1e12)
    graph, seen = scene(seed, 1.0, 60)
    dense = Dense(graph, seen)
    best = min(dense.negative_log_likelihood(*choice) for choice in product(SCALES, SIZES, LASTING))
    gain = min(dense.negative_log_likelihood(scale, 0.0, 0.5) for scale in SCALES) - best
    for factor, is_sure in ((0.9, True), (1.1, False)):
        level = float(chi2.cdf(factor * gain, 2))
        assert 0.5 < level < 1.0
        monkeypatch.setattr(wall_drift, "RIGHT_PROBABILITY", level)
        drift = find_wall_drift(graph, seen, SEEN, MAP, GraphConfig())
        assert drift is not None
        assert drift.is_sure == is_sure


@pytest.mark.parametrize("seed", range(3))
def test_the_fit_converges_well_within_its_sigma(seed: int) -> None:
    """The fewer sightings count as new, the less sure are the same rates: 0.5 and 0.02 of the squares that chance gives."""
    graph = odometry(0.1, 0.0)
    seen = sighted(graph, seed, 0.5)
    verdicts = [find_wall_drift(graph, replace(seen, share=share), SEEN, MAP, GraphConfig()) for share in (0.01, 3e-4)]
    assert [drift is not None and drift.is_final for drift in verdicts] == [False, True]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("metres", "lasting", "tolerance"), [(100.0, 0.5, 2e-3), (200.0, 1.0, 1e-3)])
def test_drift_is_extrapolated_by_half_or_in_full_by_its_correlation(
    metres: float, lasting: float, tolerance: float, seed: int
) -> None:
    graph = odometry(1.0, 0.0)
    seen = sighted(graph, seed, 0.3)
    drift = find_wall_drift(graph, some(seen, WAY[seen.keyframes] < metres), SEEN, MAP, GraphConfig())
    assert drift is not None
    assert WAY[-1] > 350.0
    first, last = drift.rates[:20, :2].mean(axis=0), drift.rates[-5:, :2].mean(axis=0)
    np.testing.assert_allclose(last, lasting * first, atol=tolerance)
    # What is claimed is the mean of all that, and of the heading what it is unsure by at the end.
    np.testing.assert_allclose(drift.estimated_drift.rates, -np.diff(WAY) @ drift.rates / WAY[-1], rtol=1e-9)
    assert drift.estimated_drift.sigma[2] == pytest.approx(np.sqrt(drift.spread[-1, 5, 5]) / WAY[-1])


@pytest.mark.parametrize("seed", range(4))
def test_residual_drift_is_not_underestimated_without_walls(seed: int) -> None:
    """The first 80 m are without walls, and are no surer for the rest being set right already."""
    graph = odometry(2.5, 1.0)

    def later(one: PoseGraph) -> WallSightings:
        seen = sighted(one, seed, 0.3)
        return some(seen, WAY[seen.keyframes] > 80.0)

    first = find_wall_drift(graph, later(graph), SEEN, MAP, GraphConfig())
    assert first is not None
    straight = without_drift(graph, first.rates)
    again = find_wall_drift(straight, later(straight), SEEN, MAP, GraphConfig(), first)
    anew = find_wall_drift(straight, later(straight), SEEN, MAP, GraphConfig())
    assert again is not None
    assert anew is not None
    assert again.is_sure
    assert not anew.is_sure
    np.testing.assert_allclose(again.estimated_drift.rates[:2], [-0.015, 0.02], rtol=0.1)
    assert again.estimated_drift.rates[2] == pytest.approx(np.radians(1.0) / 100, rel=0.1)
    np.testing.assert_allclose(first.rates + again.rates, linear_basis(WAY) @ again.knots, atol=1e-12)
    at = int(np.searchsorted(WAY, 80.0))
    sigma = [np.sqrt(np.diag(drift.spread[at])[[0, 1, 5]]) for drift in (first, again, anew)]
    assert (sigma[1] > 0.5 * sigma[0]).all()
    assert (sigma[1] > 1.1 * sigma[2]).all()


def test_no_table_of_all_sightings_and_all_unknowns_is_written_out() -> None:
    """Two kilometres, each wall seen from thirty keyframes."""
    count, often = 1000, 30
    rng = np.random.default_rng(0)
    way = 2.0 * np.arange(count)
    heading = 0.8 * np.sin(way / 150)
    steps = 2.0 * np.column_stack([np.cos(heading), np.sin(heading)])
    at = np.column_stack([np.cumsum(steps, axis=0) - steps[0], heading])
    drift = 1e-3 * np.array([2.0, -1.0, 0.02])
    told = at + drift * way[:, None]
    graph = PoseGraph(
        np.stack([se2.to_se3(pose) for pose in told]), [], distances=way, start_sigma=np.full(3, 0.1), shift_sigma=2.0
    )
    walls = np.repeat(np.arange(count), often)
    keyframes = np.clip(walls + np.tile(np.arange(often), count), 0, count - 1)
    places = (at[:, :2] + rng.uniform(-20, 20, (count, 2)))[walls]
    angles = rng.uniform(-np.pi, np.pi, count)[walls]
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    about = places - at[keyframes, :2]
    moved = way[keyframes, None] * (drift[:2] + drift[2] * np.column_stack([-about[:, 1], about[:, 0]]))
    noise = 0.04 * rng.standard_normal(len(walls)) + (0.5 * rng.standard_normal(count))[walls]
    offsets = np.einsum("ni,ni->n", normals, moved) + noise
    seen = WallSightings(keyframes, walls, normals, places + moved, offsets, 0.2)
    tracemalloc.start()
    try:
        found = find_wall_drift(graph, seen, SEEN, MAP, GraphConfig())
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found is not None
    assert found.is_sure
    assert np.linalg.norm(found.estimated_drift.rates[:2]) > 1e-3
    assert peak < 8 * len(walls) * (5 + found.knots.size)
