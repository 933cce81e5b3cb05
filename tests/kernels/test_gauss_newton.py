"""The solver: steps only where the points observe, known transforms found again, and an end in every case."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.geometry import so3
from lslam.kernels import gauss_newton
from lslam.registration.gaussian_map import GaussianMap

Floats = NDArray[np.float64]
STEPS = 30


def solve(
    H: Floats, g: Floats, lever: float = 1.0, weak_share: float = 1e-3, least: float = 0.0
) -> tuple[Floats, Floats]:
    d, weak = np.full(6, np.nan), np.zeros((6, 6))
    information = float(np.trace(H[:3, :3]))
    facts = np.array([information, 0, 0, 0, information * lever**2, 0])
    count = gauss_newton.solve_observed(H, g, facts, weak_share, least, gauss_newton.UNSEEN, d, weak)
    return d, weak[:count]


def random_problem(seed: int, rank: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(60, rank)) @ np.linalg.qr(rng.normal(size=(6, 6)))[0][:rank]
    return J.T @ J, J.T @ rng.normal(size=60)


@pytest.mark.parametrize("lever", [0.5, 1.0, 20.0])
def test_observed_directions_get_the_newton_step(lever: float) -> None:
    for seed in range(20):
        H, g = random_problem(seed, 6)
        d, weak = solve(H, g, lever, 1e-9)
        assert len(weak) == 0
        np.testing.assert_allclose(d, -np.linalg.solve(H, g), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("rank", [1, 3, 5])
def test_unobserved_directions_get_none(rank: int) -> None:
    for seed in range(20):
        H, g = random_problem(seed, rank)
        d, weak = solve(H, g, weak_share=1e-9)
        assert len(weak) == 6 - rank
        np.testing.assert_allclose(weak @ weak.T, np.eye(6 - rank), atol=1e-10)
        np.testing.assert_allclose(weak @ d, 0.0, atol=1e-10)
        np.testing.assert_allclose(H @ weak.T, 0.0, atol=1e-8 * np.trace(H))
        np.testing.assert_allclose(d, -np.linalg.pinv(H, 1e-10) @ g, atol=1e-8)


def test_the_share_of_information_draws_the_line() -> None:
    H = np.diag([1.0, 1.0, 1e-3, 1.0, 1.0, 1.0])
    for share, expected, is_followed in [(1e-4, 0, True), (7e-4, 1, True), (2e-3, 1, False)]:
        d, weak = solve(H, np.ones(6), weak_share=share)
        assert len(weak) == expected
        assert d[2] == pytest.approx(-1e3 if is_followed else 0.0)


def test_so_does_the_least_that_is_asked_for() -> None:
    H = np.diag([1.0, 1.0, 1e-2, 1.0, 1.0, 1.0])
    for least, expected, is_followed in [(5e-3, 0, True), (2e-2, 1, True), (5e-2, 1, False)]:
        d, weak = solve(H, np.ones(6), least=least)
        assert len(weak) == expected
        assert d[2] == pytest.approx(-1e2 if is_followed else 0.0)


def test_no_information_gives_no_step() -> None:
    d, weak = solve(np.zeros((6, 6)), np.zeros(6))
    np.testing.assert_array_equal(d, 0.0)
    assert len(weak) == 6


def room(rng: np.random.Generator, n: int, noise: float) -> Floats:
    """Floor and two walls: all six directions are seen."""
    u = rng.uniform(-6, 6, (3, n, 2))
    floor = np.column_stack([u[0], rng.normal(-1.5, noise, n)])
    wall = np.column_stack([u[1, :, 0], rng.normal(6.0, noise, n), u[1, :, 1] / 2 + 1.5])
    side = np.column_stack([rng.normal(6.0, noise, n), u[2, :, 0], u[2, :, 1] / 2 + 1.5])
    return np.concatenate([floor, wall, side])


@pytest.fixture(scope="module")
def target() -> GaussianMap:
    m = GaussianMap(0.8)
    m.insert(room(np.random.default_rng(0), 6000, 0.01).astype(np.float32), np.eye(4))
    return m


def align(
    m: GaussianMap,
    source: Floats,
    R: Floats,
    t: Floats,
    steps: int = STEPS,
    weak_share: float = 1e-3,
    farthest: float = np.inf,
    ratio: float = 1.0,
) -> tuple[Floats, Floats, Floats, int, bool, int, Floats]:
    return gauss_newton.align(
        source, np.zeros((len(source), 6)), R, t, 1.0, 0.1, 0.5, steps, 1e-3, 1e-4, farthest, ratio, 9e-4, 0.5, weak_share,
        m.size, m.planes, m.keys, m.table, False, m.size, m.planes, m.keys, m.table,
    )  # fmt: skip


def test_known_transforms_are_found_again(target: GaussianMap) -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        R_true, t_true = so3.exp(rng.normal(0, 0.5, 3)), rng.normal(0, 1.0, 3)
        source = (room(rng, 400, 0.01) - t_true) @ R_true
        R, t = so3.exp(rng.normal(0, 0.01, 3)) @ R_true, t_true + rng.uniform(-0.15, 0.15, 3)
        H, facts, step, iterations, converged, weak, _ = align(target, source, R, t)
        assert converged
        assert weak == 0
        assert 3 < iterations < STEPS
        assert np.linalg.norm(t - t_true) < 0.005
        assert so3.angle(R @ R_true.T) < 0.001
        assert np.linalg.norm(step[:3]) < 1e-3
        assert facts[3] > 0.9 * len(source)
        assert np.linalg.eigvalsh(H).min() > 0
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def test_it_stops_at_the_iterations_it_was_given(target: GaussianMap) -> None:
    source = room(np.random.default_rng(2), 400, 0.01)
    R, t = so3.exp(np.array([0.0, 0.0, 0.1])), np.array([0.3, 0.3, 0.0])
    *_, iterations, converged, _, _ = align(target, source, R, t, steps=2)
    assert (iterations, converged) == (2, False)


def test_fewer_than_six_matches_move_nothing(target: GaussianMap) -> None:
    source = room(np.random.default_rng(2), 400, 0.01)[:5]
    R, t = np.eye(3), np.array([0.1, 0.0, 0.05])
    _, facts, step, iterations, converged, _, _ = align(target, source, R, t)
    assert facts[3] < 6
    assert (iterations, converged) == (1, False)
    np.testing.assert_array_equal(t, [0.1, 0.0, 0.05])
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(step, 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_a_pose_that_is_no_pose_ends_at_once(target: GaussianMap, bad: float) -> None:
    source = room(np.random.default_rng(2), 400, 0.01)
    *_, iterations, converged, _, _ = align(target, source, np.eye(3), np.array([bad, 0.0, 0.0]))
    assert (iterations, converged) == (1, False)


def test_no_single_step_leaves_the_reach_of_the_correspondences() -> None:
    # All normals nearly alike: along x the information is tiny and an unguarded step is huge.
    rng = np.random.default_rng(3)
    m = GaussianMap(0.8)
    xy = rng.uniform(-6, 6, (20000, 2))
    m.insert(np.column_stack([xy, 0.002 * xy[:, 0] ** 2 + rng.normal(0, 0.02, 20000)]).astype(np.float32), np.eye(4))
    xy = rng.uniform(-5, 5, (300, 2))
    source = np.column_stack([xy, 0.002 * xy[:, 0] ** 2 + 0.05 * xy[:, 0]])
    R, t = np.eye(3), np.zeros(3)
    _, _, step, *_ = align(m, source, R, t, steps=1, weak_share=0.0)
    assert np.linalg.norm(step[:3]) <= 2.0 + 1e-12
    assert np.linalg.norm(t) == pytest.approx(np.linalg.norm(step[:3]))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("bound", [np.inf, 0.3])
def test_trimming_keeps_the_share_of_the_nearest(share: float, bound: float) -> None:
    rng = np.random.default_rng(4)
    away2 = np.where(rng.uniform(size=2000) < 0.2, -1.0, rng.exponential(0.2, 2000))
    limit = gauss_newton.trimmed(away2, share, bound)
    candidates = away2[(away2 >= 0) & (away2 <= bound)]
    assert np.mean(candidates <= limit) == pytest.approx(share, abs=1.5 / len(candidates))
    assert gauss_newton.trimmed(away2[::-1].copy(), share, bound) == limit
    assert gauss_newton.trimmed(away2, 1.0, bound) == bound


def test_a_bound_no_match_is_within_moves_nothing(target: GaussianMap) -> None:
    floor = np.random.default_rng(2).uniform(-4, 4, (400, 3))
    floor[:, 2] = -1.5 + 0.4
    R, t = np.eye(3), np.zeros(3)
    H, facts, *_ = align(target, floor, R, t, steps=1, farthest=0.3)
    assert facts[3] > 300
    np.testing.assert_array_equal(H, 0.0)
    np.testing.assert_array_equal(t, 0.0)
