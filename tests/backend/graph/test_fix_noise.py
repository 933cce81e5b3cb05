"""The common error of fixes: found where it is, not where it is not, and a Gauss-Markov process in the graph."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.backend.fixes import align
from lslam.backend.graph import factors, fix_noise
from lslam.backend.graph.fix_noise import DriftOfFixes, GaussMarkovNoise, fit_gauss_markov
from lslam.backend.graph.problem import PositionFix
from lslam.core.geometry import se3

Floats = NDArray[np.float64]
VERTICAL = np.array([1.0, 1.0, 1.8])


METRE = np.diag([1e-4] * 3 + [np.radians(0.5) ** 2 / 1e4] * 3)


def drift_of(path: Floats, metre: Floats = METRE) -> DriftOfFixes:
    """Odometry that claims a millimetre a metre, and a walk of factor 1 along `path` (F, 3), from fix to fix."""
    steps = np.diff(path, axis=0)
    unit = np.zeros((len(path), 6, 6))
    for i, step in enumerate(steps):
        J = np.eye(6)
        J[:3, 3:] = [[0, step[2], -step[1]], [-step[2], 0, step[0]], [step[1], -step[0], 0]]
        unit[i + 1] = J @ unit[i] @ J.T + np.linalg.norm(step) * metre
    return DriftOfFixes(1e-2 * unit, unit, path, metre, np.arange(len(path)))


def fixes(
    count: int, gap: float, white: float, slow: float, memory: float, seed: int, percent: float = 0.0
) -> tuple[GaussMarkovNoise | None, float]:
    """What is found of fixes about a drive at 5 m/s along an arc, stated as they err; odometry runs off by `percent`, east."""
    rng = np.random.default_rng(seed)
    seconds = gap * np.arange(count)
    error, kept = slow * rng.normal(size=(count, 3)), np.exp(-gap / memory)
    for i in range(1, count):
        error[i] = kept * error[i - 1] + np.sqrt(1 - kept**2) * error[i]
    error = (error + white * rng.normal(size=error.shape)) * VERTICAL
    path = 60 * np.column_stack([np.cos(seconds / 12), np.sin(seconds / 12), 0 * seconds])
    sigmas = np.tile(np.hypot(white, slow) * VERTICAL, (count, 1))
    run_off = path + np.column_stack([0.01 * percent * 5 * seconds, np.zeros((count, 2))])
    found = align(run_off, path + error, sigmas, 0.01 * percent * 5 * seconds, np.array([0.0, 0, 1]), 0.01, 5)
    assert found is not None
    return fit_gauss_markov(seconds, found.residuals, sigmas, path, 0.999, drift_of(run_off))


@pytest.mark.parametrize(("count", "gap"), [(30, 1.0), (300, 0.2)])
def test_fixes_with_their_stated_scatter_have_no_common_part(count: int, gap: float) -> None:
    assert [fixes(count, gap, 1.0, 0.0, 100.0, seed) for seed in range(12)] == [(None, 0.0)] * 12


@pytest.mark.parametrize(
    ("count", "gap", "white", "slow", "memory"),
    [(90, 1.0, 0.3, 0.8, 120.0), (500, 1.0, 0.5, 0.8, 20.0), (700, 0.2, 0.3, 2.0, 60.0)],
)  # fmt: skip
def test_the_common_part_and_its_memory_are_found(
    count: int, gap: float, white: float, slow: float, memory: float
) -> None:
    found = [fixes(count, gap, white, slow, memory, seed)[0] for seed in range(5)]
    assert all(f is not None for f in found)
    np.testing.assert_allclose([f.sigma for f in found if f], [slow * VERTICAL] * 5, rtol=0.12)
    assert memory / 2 < np.median([f.memory for f in found if f]) < 2 * memory


@pytest.mark.parametrize("percent", [0.02, 0.05])
def test_what_is_tried_does_not_show(monkeypatch: pytest.MonkeyPatch, percent: float) -> None:
    """Half an hour knows the time constant far better than the distance of those that are tried."""
    found = []
    for memories in (fix_noise.MEMORIES, 4 * fix_noise.MEMORIES):
        monkeypatch.setattr(fix_noise, "MEMORIES", memories)
        found.append([fixes(1800, 1.0, 0.3, 0.8, 30.0, seed, percent) for seed in range(3)])
    for (few, walk), (many, fine) in zip(*found, strict=True):
        assert few is not None
        assert many is not None
        assert few.memory == pytest.approx(many.memory, rel=1.5 * fix_noise.LOG_STEP)
        assert walk == pytest.approx(fine, rel=1.5 * fix_noise.LOG_STEP)


def test_wrong_fixes_do_not_change_the_common_part() -> None:
    rng = np.random.default_rng(2)
    seconds = np.arange(200.0)
    residuals = 0.8 + 0.3 * rng.normal(size=(200, 3))
    residuals[::7] += [0.0, 33.0, 0.0]
    path = 5 * rng.normal(size=(200, 3)).cumsum(0)
    found, _ = fit_gauss_markov(seconds, residuals, np.full((200, 3), 0.85), path, 0.999, drift_of(path))
    assert found is not None
    assert found.sigma[0] == pytest.approx(0.8, abs=0.05)
    assert not set(found.seconds.tolist()) & set(seconds[::7].tolist())


@pytest.mark.parametrize(("share", "wanders"), [(0.9, True), (1.1, False)])
def test_fixes_err_together_that_scatter_less_than_one_of_a_thousand_drives(share: float, wanders: bool) -> None:
    """Against draws of fixes that err alone: what the mean square of two neighbours' difference is below by chance."""
    rng, count = np.random.default_rng(0), 41
    alone = 0.5 * (np.diff(rng.normal(size=(100_000, count, 2)), axis=1) ** 2).mean(axis=(1, 2))
    white = share * np.quantile(alone, 0.001)
    # Neighbours lie to either side, so that each differs from the next by as much.
    side = np.sqrt(white / 2) * np.where(np.arange(count) % 2, 1.0, -1.0)
    path = np.outer(np.arange(count), [3.0, 4.0, 0.5])
    residuals = np.repeat(side[:, None], 3, axis=1)
    found, _ = fit_gauss_markov(np.arange(1.0 * count), residuals, np.ones((count, 3)), path, 0.999, drift_of(path))
    assert (found is not None) == wanders


@pytest.mark.parametrize("ahead", [(5.0, 0.0, 0.0), (3.0, 4.0, 0.5)])
def test_the_common_part_is_found_on_a_way_without_a_bend(ahead: tuple[float, float, float]) -> None:
    """A roll about it moves no antenna, so that it cannot have been fitted."""
    rng, seconds = np.random.default_rng(1), np.arange(200.0)
    residuals = 0.8 * np.sin(seconds / 30)[:, None] + 0.2 * rng.normal(size=(200, 3))
    path = np.outer(seconds, ahead)
    found, _ = fit_gauss_markov(seconds, residuals, np.full((200, 3), 0.7), path, 0.999, drift_of(path))
    assert found is not None
    assert found.sigma[0] == pytest.approx(np.hypot(0.8 / np.sqrt(2), 0.2), abs=0.15)


def test_the_alignment_of_the_trajectory_does_not_change_the_noise_of_fixes() -> None:
    """Place and heading were fitted: another place, and a little turn, are as likely (restricted likelihood)."""
    rng, seconds = np.random.default_rng(5), 3.0 * np.arange(40.0)
    path = 60 * np.column_stack([np.cos(seconds / 12), np.sin(seconds / 12), 0 * seconds])
    residuals = 0.6 * np.sin(seconds / 9)[:, None] * [1.0, -1.0, 0.5] + 0.2 * rng.normal(size=(40, 3))
    moved = residuals + np.cross([0.0, 0.0, 1e-3], path) + np.array([30.0, -20.0, 10.0])
    one, other = (
        fit_gauss_markov(seconds, r, np.ones((40, 3)), path, 0.999, drift_of(path)) for r in (residuals, moved)
    )
    assert one[0] is not None
    assert other[0] is not None
    assert (other[1], other[0].memory) == (one[1], one[0].memory)
    np.testing.assert_allclose(other[0].sigma, one[0].sigma, rtol=1e-3)


def test_unordered_or_single_fixes_give_no_estimate() -> None:
    flat, one = np.zeros((3, 3)), np.ones((3, 3))
    assert fit_gauss_markov(np.array([0.0, 1.0, 1.0]), flat, one, flat, 0.999, drift_of(flat)) == (None, 0.0)
    assert fit_gauss_markov(np.zeros(1), flat[:1], one[:1], flat[:1], 0.999, drift_of(flat[:1])) == (None, 0.0)


def test_perfect_fixes_have_a_memory() -> None:
    seconds = np.arange(60.0)
    path = np.column_stack([seconds, seconds**2 / 60, 0 * seconds])
    found, walk = fit_gauss_markov(seconds, np.zeros((60, 3)), np.ones((60, 3)), path, 0.999, drift_of(path))
    assert found is not None
    assert found.memory > 60
    assert walk == 0


@pytest.mark.parametrize(("percent", "drifts"), [(0.0, (0, 3)), (3.0, (11, 12))])
def test_odometry_drifts_where_fixes_cannot_err_so_much(percent: float, drifts: tuple[int, int]) -> None:
    """Fixes wander by 0.8 m for two minutes; within a drive of 450 m odometry runs off by nothing or 13 m."""
    walks = [fixes(90, 1.0, 0.3, 0.8, 120.0, seed, percent)[1] for seed in range(12)]
    assert drifts[0] <= sum(walk > 0 for walk in walks) <= drifts[1]
    if percent == 3.0:
        # After the way of 445 m a walk of that factor comes to as much.
        at_end = np.sqrt(np.median(walks) * METRE[0, 0] * 445)
        assert 13.0 / 4 < at_end < 13.0 * 4


def test_the_covariance_of_drift_along_a_path_is_that_of_drawn_drives() -> None:
    """Against drives drawn step by step; rates that last come to the walk's size at the end of the way."""
    angle = np.linspace(0, 2, 6)
    path = np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), 3 * angle])
    # Turns move what lies ahead by more than the way itself errs.
    rng, metre = np.random.default_rng(0), np.diag([1e-4] * 3 + [4e-6] * 3)
    root = np.linalg.cholesky(1e4 * metre)
    drawn = np.zeros((20_000, 6, 3))
    turn = np.zeros((20_000, 3))
    for i, step in enumerate(np.diff(path, axis=0)):
        d = np.sqrt(np.linalg.norm(step)) * rng.normal(size=(20_000, 6)) @ root.T
        drawn[:, i + 1] = drawn[:, i] + np.cross(turn, step) + d[:, :3]
        turn += d[:, 3:]
    flat = drawn.reshape(20_000, -1)
    expected = 1e4 * fix_noise._joint_covariance(drift_of(path, metre).unit, path)
    np.testing.assert_allclose(flat.T @ flat / 20_000, expected, atol=0.04 * expected.max())
    way = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    lasting = fix_noise._lasting(np.diag([1e-4] * 3 + [0.0] * 3), path)
    np.testing.assert_allclose(np.diag(lasting)[-3:], 1e-4 * way)


def test_the_graph_has_the_covariance_of_the_process() -> None:
    fix_noise = GaussMarkovNoise(np.array([0.0, 1.0, 1.5, 40.0, 41.0, 4000.0]), np.array([0.5, 1.0, 2.0]), 30.0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors._add_fix_noise(graph, fix_noise)
    for i in range(6):
        values.insert(factors.FIX_NOISE + i, np.zeros(3))
    information, _ = graph.linearize(values).hessian()
    expected = np.exp(-np.abs(fix_noise.seconds[:, None] - fix_noise.seconds) / fix_noise.memory)
    np.testing.assert_allclose(np.linalg.inv(information), np.kron(expected, np.diag(fix_noise.sigma**2)), atol=1e-8)


def test_a_fix_with_zero_common_error_equals_an_independent_fix() -> None:
    pose = se3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 0.5]))
    alone, together = (
        factors.position(PositionFix(0, np.array([1.5, 2.0, 2.0]), np.array([1.0, 2.0, 3.0]), np.array([0.3, 0.2, 0.9]), k))
        for k in (None, 3)
    )  # fmt: skip
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3(pose))
    values.insert(factors.FIX_NOISE + 3, np.zeros(3))
    assert together.error(values) == pytest.approx(alone.error(values), rel=1e-9)
    (A, b), (A_own, b_own) = ((f.linearize(values).jacobian()) for f in (together, alone))
    np.testing.assert_allclose(A[:, :6], A_own, atol=1e-9)
    np.testing.assert_allclose(A[:, 6:], np.diag([1.0, 1 / 2, 1 / 3]), atol=1e-12)
    np.testing.assert_allclose(b, b_own, atol=1e-9)
