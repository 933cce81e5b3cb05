"""How likely a steady drift is, and what it is then, against all covariances written out; and what is believed beforehand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from test_steady_drift import MAP, SEEN, WAY, odometry, sighted

from lslam.config.graph import GraphConfig
from lslam.graph import steady_drift
from lslam.graph.problem import PoseGraph
from lslam.graph.steady_drift import SCALES, SIZES, WallSightings, _belief, _effects, _Fit, _rows, find_steady_drift

Floats = NDArray[np.float64]
CHOICES = [(0.25, 0.0), (0.25, 0.5), (0.5, 2.0), (1.0, 8.0)]


def some(seen: WallSightings, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> WallSightings:
    rows = (seen.keyframes, seen.walls, seen.normals, seen.places, seen.offsets)
    return WallSightings(*(row[chosen] for row in rows), seen.share)  # type: ignore[arg-type]


def scene(seed: int, percent: float = 0.5, count: int = 150) -> tuple[PoseGraph, WallSightings]:
    graph = odometry(percent, 0.2)
    seen = sighted(graph, seed, 0.5)
    return graph, some(seen, np.random.default_rng(seed).permutation(len(seen.walls))[:count])


class Dense:
    """The offsets as one Gaussian: what is seen, what the walls are drawn wrong by, start and shift and rates."""

    def __init__(self, graph: PoseGraph, seen: WallSightings) -> None:
        self.seen, self.rows = seen, _rows(graph, seen, _effects(graph))
        self.given = np.append(graph.start_sigma, [graph.shift_sigma] * 2) ** 2  # type: ignore[arg-type]
        self.believed = _belief(WAY[-1], GraphConfig())
        self.weights = np.ones(len(seen.walls))

    def fit(self) -> _Fit:
        return _Fit(self.seen, self.rows, SEEN, MAP, self.given, self.believed)

    def parts(self, scale: float, size: float) -> tuple[Floats, Floats, Floats]:
        """Covariances of what is seen, of all unknowns, and of the offsets."""
        prior = np.zeros((5 + len(self.believed),) * 2)
        prior[:5, :5], prior[5:, 5:] = np.diag(self.given), size**2 * self.believed
        noise = np.diag((scale * SEEN) ** 2 / self.weights)
        drawn = MAP**2 * (self.seen.walls[:, None] == self.seen.walls)
        return noise, prior, noise + drawn + self.rows @ prior @ self.rows.T

    def unlikeliness(self, scale: float, size: float) -> float:
        _, _, C = self.parts(scale, size)
        return float(np.linalg.slogdet(C)[1] + self.seen.offsets @ np.linalg.solve(C, self.seen.offsets))

    def rates(self, scale: float, size: float) -> tuple[Floats, Floats]:
        _, prior, C = self.parts(scale, size)
        gain = np.linalg.solve(C, self.rows @ prior).T
        return -(gain @ self.seen.offsets)[5:], (prior - gain @ self.rows @ prior)[5:, 5:]

    def doubt(self, scale: float, size: float) -> None:
        """Weights of Student's t with three degrees of freedom."""
        noise, _, C = self.parts(scale, size)
        missed = noise @ np.linalg.solve(C, self.seen.offsets)
        self.weights = 4.0 / (3.0 + (missed / (scale * SEEN)) ** 2)


def agree(fit: _Fit, dense: Dense) -> None:
    base = fit.unlikeliness(1.0, 1.0) - dense.unlikeliness(1.0, 1.0)
    for choice in CHOICES:
        assert fit.unlikeliness(*choice) - dense.unlikeliness(*choice) == pytest.approx(base, abs=1e-4)
        for found, expected in zip(fit.rates(*choice), dense.rates(*choice), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max() + 1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_likelihood_and_rates_are_those_of_all_covariances_written_out(seed: int) -> None:
    dense = Dense(*scene(seed))
    agree(dense.fit(), dense)


@pytest.mark.parametrize("seed", range(3))
def test_what_lies_far_off_is_believed_less(seed: int) -> None:
    dense = Dense(*scene(seed))
    fit = dense.fit()
    fit.doubt(0.5, 1.0)
    dense.doubt(0.5, 1.0)
    assert dense.weights.min() < 0.3 < 1.0 < dense.weights.max()
    agree(fit, dense)


def test_five_copies_that_count_a_fifth_are_one() -> None:
    graph, seen = scene(0)
    once, fifths = Dense(graph, seen).fit(), Dense(graph, some(seen, np.repeat(np.arange(len(seen.walls)), 5))).fit()
    fifths.count_less(0.2)
    for choice in CHOICES:
        assert fifths.unlikeliness(*choice) == pytest.approx(once.unlikeliness(*choice), abs=1e-6)
        np.testing.assert_allclose(fifths.rates(*choice)[1], once.rates(*choice)[1], rtol=1e-8, atol=1e-18)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_drift_is_sure_when_it_explains_more_than_chance(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steady_drift, "FREEDOM", 1e12)
    graph, seen = scene(seed, 1.0, 60)
    dense = Dense(graph, seen)
    best = min(dense.unlikeliness(scale, size) for scale in SCALES for size in SIZES)
    gain = min(dense.unlikeliness(scale, 0.0) for scale in SCALES) - best
    for factor, is_sure in ((0.9, True), (1.1, False)):
        level = float(chi2.cdf(factor * gain, len(dense.believed)))
        assert 0.5 < level < 1.0
        drift = find_steady_drift(graph, seen, SEEN, MAP, GraphConfig(probability=level))
        assert drift is not None
        assert drift.is_sure == is_sure


@pytest.mark.parametrize("seed", range(3))
def test_a_drift_is_settled_well_below_what_it_is_unsure_by(seed: int) -> None:
    """The fewer sightings count as new, the less sure are the same rates: 0.5 and 0.02 of the squares that chance gives."""
    graph = odometry(0.1, 0.0)
    seen = sighted(graph, seed, 0.5)
    verdicts = [
        find_steady_drift(graph, replace(seen, share=share), SEEN, MAP, GraphConfig()) for share in (0.01, 3e-4)
    ]
    assert [drift is not None and drift.is_settled for drift in verdicts] == [False, True]


@pytest.mark.parametrize("seed", range(3))
def test_where_no_wall_is_seen_half_of_the_drift_is_believed_to_last(seed: int) -> None:
    graph = odometry(1.0, 0.0)
    seen = sighted(graph, seed, 0.3)
    drift = find_steady_drift(graph, some(seen, WAY[seen.keyframes] < 100.0), SEEN, MAP, GraphConfig())
    assert drift is not None
    assert WAY[-1] > 350.0
    np.testing.assert_allclose(drift.rates[-5:, :2].mean(axis=0), 0.5 * drift.rates[:20, :2].mean(axis=0), atol=2e-3)
