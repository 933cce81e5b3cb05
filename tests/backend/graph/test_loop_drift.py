"""Constant drift is estimated by loops and corrected before they are closed, with consistent covariances."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from graph_builders import ate, graph_of, measured, truth
from numpy.typing import NDArray
from scipy.stats import chi2

from lslam.backend.added_drift import with_drift
from lslam.backend.graph import loop_drift
from lslam.backend.graph.drift import SIZES, correct_drift, drift_covariance, linear_basis, rate_roots
from lslam.backend.graph.loop_drift import KNOTS_APART_M, LASTS, MOST_KNOTS, WALKS, without_loop_drift
from lslam.backend.graph.pose_graph import optimise, with_distances
from lslam.backend.graph.problem import PoseGraph, Solution
from lslam.core.config.backend import DebugConfig, GraphConfig
from lslam.core.errors import GraphError
from lslam.core.geometry import se3, so3
from lslam.core.geometry.noise import RIGHT_PROBABILITY
from lslam.core.types.constraint import Constraint
from lslam.core.types.scan_result import ScanResult

Floats = NDArray[np.float64]
KINDS = [(which, size) for which in range(len(LASTS)) for size in SIZES]
CONFIG = GraphConfig()
LAPS, LAP = 3, 60
REAL = truth(LAPS * LAP + 1, LAPS)
STEP, LOOP = np.array([2e-3] * 3 + [5e-5] * 3), np.array([0.01] * 3 + [3e-4] * 3)
# Keyframes of the first lap that are seen again, and how many laps on.
SEEN = ((3, 1), (20, 2), (34, 1), (51, 1), (80, 1), (110, 1))


def away(seed: int, percent: float, degrees: float, memory: float | None = None, real: Floats = REAL) -> PoseGraph:
    """Odometry with noise, that runs away, and loops that are right."""
    rng = np.random.default_rng(seed)
    poses = [real[0]]
    for step in measured(se3.relative(real[:-1], real[1:]), STEP, rng):
        poses.append(se3.normalise(poses[-1] @ step))
    drift = DebugConfig(drift_percent=percent, drift_deg_per_100m=degrees, drift_seed=seed, drift_memory=memory)
    found = np.stack([r.T_world_lidar for r in with_drift([ScanResult(k, k, T) for k, T in enumerate(poses)], drift)])
    steps = se3.relative(found[:-1], found[1:])
    odometry = [Constraint(k, k + 1, step, np.diag(STEP**2), "odometry") for k, step in enumerate(steps)]
    loops = [
        Constraint(a, b, measured(se3.relative(real[a], real[b]), LOOP, rng), np.diag(LOOP**2))
        for a, b in ((a, a + laps * LAP) for a, laps in SEEN)
        if b < len(real)
    ]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(np.stack(poses)[:, :3, 3], axis=0), axis=1))])
    return PoseGraph(found, odometry, loops, distances=way)


def nees(solution: Solution) -> float:
    """Mean squared error over covariance per degree of freedom."""
    turn = so3.log(solution.poses[:, :3, :3] @ np.swapaxes(REAL[:, :3, :3], -1, -2))
    d = np.concatenate([solution.poses[:, :3, 3] - REAL[:, :3, 3], turn], axis=1)[5:]
    return float((d * np.linalg.solve(solution.covariances[5:], d[..., None])[..., 0]).sum(1).mean() / 6)


def test_a_constant_drift_is_corrected_before_loops_are_closed() -> None:
    before, after, unsure, sure = [], [], [], []
    for seed in range(6):
        graph = away(seed, 1.0, 0.2)
        straight = without_loop_drift(graph, CONFIG)
        assert straight.estimated_drift is not None
        assert ate(straight.poses, REAL) < 0.05 * ate(graph.poses, REAL)
        assert straight.spread is not None
        # What rates may be wrong by, less what loops take back of it.
        at_end = np.sqrt(np.diag(straight.spread[-1])[3:]) / graph.distances[-1]
        assert (at_end < 0.5 * straight.estimated_drift.sigma[3:]).all()
        plain, better = optimise(graph, CONFIG), optimise(straight, CONFIG)
        assert better.drift >= straight.walk > 0.0
        assert not any(better.loop_reasons)
        for errors, nee, solution in ((before, unsure, plain), (after, sure, better)):
            errors.append(ate(solution.poses, REAL))
            nee.append(nees(solution))
    assert np.mean(after) < 0.1 * np.mean(before)
    assert 3.0 * np.mean(unsure) < np.mean(sure)
    assert 0.3 < np.mean(sure) < 3.0


def test_a_large_drift_is_estimated_again_on_the_corrected_path() -> None:
    """Seven degrees a lap: what the first answer leaves is three times as much."""
    for seed in range(4):
        graph = away(seed, 1.0, 2.0)
        assert ate(without_loop_drift(graph, CONFIG).poses, REAL) < 0.006 * ate(graph.poses, REAL)


@pytest.mark.parametrize(("percent", "degrees"), [(1.0, 0.0), (0.0, 0.5), (1.0, 0.5)])
def test_the_estimated_drift_is_within_its_sigma(percent: float, degrees: float) -> None:
    squared = []
    for seed in range(5):
        estimated_drift = without_loop_drift(away(seed, percent, degrees), CONFIG).estimated_drift
        assert estimated_drift is not None
        rng = np.random.default_rng(seed)  # draws as `debug.drift` does
        direction = rng.normal(size=3)
        shift, turn = 0.01 * percent * direction / np.linalg.norm(direction), np.radians(degrees) / 100
        real = np.append(shift, [0.0, 0.0, turn * rng.choice([-1, 1])])
        np.testing.assert_allclose(estimated_drift.rates[:3], real[:3], atol=5e-4)
        np.testing.assert_allclose(estimated_drift.rates[3:], real[3:], atol=5e-6)
        squared.append(((estimated_drift.rates - real) / estimated_drift.sigma) ** 2)
        assert estimated_drift.chance == pytest.approx(chi2.ppf(RIGHT_PROBABILITY, 6))
    assert 0.1 < np.mean(squared) < 3.0


def test_wandering_drift_keeps_covariances_consistent() -> None:
    """Rates of some 100 m, and walks: never much worse once corrected, and covariances neither far too large nor too small."""
    ratios, known = [], []
    for seed in range(8):
        graph = away(seed, 1.0, 0.5, 60.0)
        plain, better = optimise(graph, CONFIG), optimise(without_loop_drift(graph, CONFIG), CONFIG)
        ratios.append(ate(better.poses, REAL) / ate(plain.poses, REAL))
        known.append(nees(better))
    assert np.exp(np.mean(np.log(ratios))) < 1.1
    assert 0.3 < np.mean(known) < 3.0


@pytest.mark.parametrize("inflated", [1.0, 30.0])
def test_noise_is_no_drift(inflated: float) -> None:
    """Odometry that only walks, also farther than it thinks, stays as it is."""
    for seed in range(8):
        graph = away(seed, 0.0, 0.0)
        rng = np.random.default_rng([seed, 1])
        steps = [measured(c.T_a_b, (inflated - 1) * STEP, rng) for c in graph.odometry]
        poses = [graph.poses[0]]
        for step in steps:
            poses.append(se3.normalise(poses[-1] @ step))
        odometry = [replace(c, T_a_b=step) for c, step in zip(graph.odometry, steps, strict=True)]
        graph = replace(graph, poses=np.stack(poses), odometry=odometry)
        straight = without_loop_drift(graph, CONFIG)
        assert straight.estimated_drift is None, seed
        assert straight.walk == 0.0
        assert straight.spread is None
        np.testing.assert_array_equal(straight.poses, graph.poses)


def test_wrong_loops_do_not_change_the_estimated_drift() -> None:
    for seed in range(4):
        graph = away(seed, 1.0, 0.5)
        rng = np.random.default_rng(seed)
        wrong = [
            replace(c, a=c.a + 4, b=c.b + 7, T_a_b=measured(c.T_a_b, np.array([3.0, 3.0, 0.5, 0.02, 0.02, 0.2]), rng))
            for c in graph.loops[1::3]
        ]
        estimates = [
            without_loop_drift(replace(graph, loops=[*graph.loops, *more]), CONFIG).estimated_drift
            for more in ([], wrong)
        ]
        assert estimates[0] is not None
        assert estimates[1] is not None
        np.testing.assert_allclose(estimates[1].rates, estimates[0].rates, atol=2e-4)


def test_a_slightly_wrong_loop_adds_a_walk_and_keeps_the_rates() -> None:
    """Too little to be thrown out: it makes a walk likelier beside the rates, and not the rates others."""
    graph = away(0, 1.0, 0.2)
    T = graph.loops[2].T_a_b.copy()
    T[2, 3] += 0.2
    off = [replace(c, T_a_b=T) if n == 2 else c for n, c in enumerate(graph.loops)]
    right, mixed = (without_loop_drift(replace(graph, loops=loops), CONFIG) for loops in (graph.loops, off))
    assert right.estimated_drift is not None
    assert mixed.estimated_drift is not None
    np.testing.assert_allclose(mixed.estimated_drift.rates[:3], right.estimated_drift.rates[:3], atol=1e-4)
    assert mixed.walk > 5 * right.walk


def test_loops_with_tiny_covariances_give_the_same_drift() -> None:
    """Each twice, and to a hundredth of a micrometre: large rates and walks leave no such difference in 64 bits."""
    graph = away(0, 1.0, 0.5)
    loops = [replace(c, covariance=1e-16 * np.eye(6)) for c in graph.loops for _ in range(2)]
    sure, plain = (without_loop_drift(given, CONFIG).estimated_drift for given in (replace(graph, loops=loops), graph))
    assert sure is not None
    assert plain is not None
    np.testing.assert_allclose(sure.rates[:3], plain.rates[:3], atol=5e-4)
    np.testing.assert_allclose(sure.rates[3:], plain.rates[3:], atol=5e-6)


def test_a_long_way_takes_little_memory() -> None:
    """15 km: what each rate does to each keyframe, written out at once, takes 200 MB."""
    real = truth(2000, 6, radius=400.0)
    graph = with_distances(graph_of(real, 40, 0, np.random.default_rng(0), 6))
    columns = 6 * (MOST_KNOTS + 1)
    tracemalloc.start()
    fit = loop_drift._Fit(graph, graph.loops, np.zeros(columns), np.tile(np.eye(3), (len(graph) - 1, 1, 1)), CONFIG)
    _, covariance, walk = fit.likeliest()
    spread = fit.pose_covariances(covariance, walk)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.isfinite(spread).all()
    assert peak < 80e6


def test_estimation_in_parts_equals_estimation_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Written out ten keyframes at a time or all at once: loops begin and end in any of them."""
    graph = away(0, 1.0, 0.5, real=truth(61, 2))
    loops = [
        Constraint(a, b, se3.relative(graph.poses[a], graph.poses[b]), np.diag(LOOP**2))
        for a, b in ((3, 33), (9, 29), (10, 40), (19, 60))
    ]
    found = np.random.default_rng(0).normal(0, 1e-3, 6 * linear_basis(graph.distances, KNOTS_APART_M).shape[1])
    turned = so3.exp(np.random.default_rng(1).normal(0, 0.3, (len(graph) - 1, 3)))
    told = []
    for part in (256, 10):
        monkeypatch.setattr(loop_drift, "BLOCK_KEYFRAMES", part)
        fit = loop_drift._Fit(graph, loops, found, turned, CONFIG)
        rates, covariance, walk = fit.likeliest()
        told.append((fit.negative_log_likelihood, rates, fit.pose_covariances(covariance, walk)))
    for whole, in_parts in zip(*told, strict=True):
        np.testing.assert_allclose(in_parts, whole, rtol=1e-6, atol=1e-6 * np.abs(whole).max())


def test_without_two_loops_or_a_path_there_is_no_estimate() -> None:
    graph = away(0, 1.0, 0.5)
    none, one = replace(graph, loops=[]), replace(graph, loops=graph.loops[:1])
    stays = replace(graph, distances=np.zeros(len(graph)))
    for given in (none, one, stays):
        assert without_loop_drift(given, CONFIG).estimated_drift is None
    lost = replace(graph, odometry=graph.odometry[:50])
    with pytest.raises(GraphError, match="in pieces"):
        without_loop_drift(lost, CONFIG)


def test_distances_are_computed_where_they_are_not_given() -> None:
    graph = away(0, 1.0, 0.5)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(graph.poses[:, :3, 3], axis=0), axis=1))])
    measured_by, unmeasured = (without_loop_drift(replace(graph, distances=d), CONFIG) for d in (way, np.zeros(0)))
    assert unmeasured.estimated_drift is not None
    np.testing.assert_allclose(unmeasured.poses, measured_by.poses)


def test_likelihood_and_rates_equal_those_of_all_errors_written_out() -> None:
    """Against one Gaussian of all loops, whose covariance comes of disturbing each step, rate and loop by itself."""
    real = truth(31, 2)
    graph = away(0, 0.02, 0.005, real=real)
    loops = [
        Constraint(a, b, measured(se3.relative(real[a], real[b]), LOOP, np.random.default_rng(a)), np.diag(LOOP**2))
        for a, b in ((1, 16), (4, 18), (9, 30))
    ]
    at_knots = linear_basis(graph.distances, KNOTS_APART_M)
    count, small = 6 * at_knots.shape[1], 1e-5
    turned = so3.exp(np.random.default_rng(1).normal(0, 0.3, (len(graph) - 1, 3)))
    fit = loop_drift._Fit(graph, loops, np.zeros(count), turned, CONFIG)

    def set_by(knot: int) -> Floats:
        rates = at_knots @ (small * np.eye(count)[knot]).reshape(-1, 6)
        along = np.einsum("kij,kj->ki", turned, rates[:, :3])
        return correct_drift(graph, np.column_stack([along, rates[:, 3:]])).poses

    def off(poses: Floats, seen: list[Floats]) -> Floats:
        moved = poses.copy()
        moved[:, :3, 3] -= graph.poses[:, :3, 3].mean(0)
        return np.concatenate([
            se3.log(moved[c.a] @ T @ se3.inverse(moved[c.b])) for c, T in zip(loops, seen, strict=True)
        ])  # fmt: skip

    def moved(pose: Floats) -> Floats:
        return np.append(pose[:3, 3] - last[:3, 3], so3.log(pose[:3, :3] @ last[:3, :3].T)) / small

    def disturbed(T: Floats, axis: int) -> Floats:
        d = small * np.eye(6)[axis]
        return se3.make(so3.exp(d[3:]) @ T[:3, :3], T[:3, 3] + d[:3])

    seen = [c.T_a_b for c in loops]
    zero = off(graph.poses, seen)
    by_rates = []
    for knot in range(count):
        by_rates.append((off(set_by(knot), seen) - zero) / -small)
    G = np.stack(by_rates, axis=1)
    last = graph.poses[-1]
    known, walk = np.zeros((18, 18)), np.zeros((18, 18))
    at_last = []
    for k, c in enumerate(graph.odometry):
        columns, moves = [], []
        for axis in range(6):
            after = graph.poses[k] @ disturbed(c.T_a_b, axis) @ se3.inverse(graph.poses[k + 1])
            poses = np.concatenate([graph.poses[: k + 1], after @ graph.poses[k + 1 :]])
            columns.append((off(poses, seen) - zero) / small)
            moves.append(moved(poses[-1]))
        J, at_end = np.stack(columns, axis=1), np.stack(moves, axis=1)
        walked = drift_covariance(float(np.linalg.norm(c.T_a_b[:3, 3])), CONFIG)
        known += J @ c.covariance @ J.T
        walk += J @ walked @ J.T
        at_last.append([-at_end @ C @ J.T for C in (c.covariance, walked)])
    for n, loop in enumerate(loops):
        changed = [[disturbed(T, axis) if n == m else T for m, T in enumerate(seen)] for axis in range(6)]
        J = np.stack([(off(graph.poses, some) - zero) / small for some in changed], axis=1)
        known += J @ loop.covariance @ J.T

    def negative_log_likelihood(S: Floats) -> float:
        return float(np.linalg.slogdet(S)[1] + zero @ np.linalg.solve(S, zero))

    roots = rate_roots(float(graph.distances[-1]), CONFIG, list(range(6)), LASTS, KNOTS_APART_M, is_smooth=False)
    for w in (0, 3, 6):
        alone = known + WALKS[w] * walk
        assert fit.negative_log_likelihood[w, 0] == pytest.approx(negative_log_likelihood(alone), rel=1e-3)
        for kind in (0, 4, 7, 11):
            which, size = KINDS[kind]
            prior = size**2 * roots[which] @ roots[which].T
            S = alone + G @ prior @ G.T
            assert fit.negative_log_likelihood[w, 1 + kind] == pytest.approx(negative_log_likelihood(S), rel=1e-3)
    found, covariance, mean_walk = fit.likeliest()
    likely = np.exp(-0.5 * (fit.negative_log_likelihood[:, 1:] - fit.negative_log_likelihood[:, 1:].min()))
    assert mean_walk == pytest.approx((np.array(WALKS)[:, None] * likely).sum() / likely.sum())
    which, size = KINDS[int(likely.sum(0).argmax())]
    prior = size**2 * roots[which] @ roots[which].T
    S = known + mean_walk * walk + G @ prior @ G.T
    np.testing.assert_allclose(found, prior @ G.T @ np.linalg.solve(S, zero), rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(covariance, prior - prior @ G.T @ np.linalg.solve(S, G @ prior), rtol=1e-3, atol=1e-10)
    E = np.stack([moved(set_by(knot)[-1]) for knot in range(count)], axis=1)
    by_known, by_walk = np.sum(at_last, axis=0)
    left = E - (by_known + mean_walk * by_walk) @ np.linalg.solve(known + mean_walk * walk, G)
    spread, expected = fit.pose_covariances(covariance, mean_walk)[-1], left @ covariance @ left.T
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(spread / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=5e-3)
