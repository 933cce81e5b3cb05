"""The step: only where the points observe, in the directions that are allowed, and never farther than they reach."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels import gauss_newton
from lslam.core.kernels import linearisation as at

Floats = NDArray[np.float64]
# Of what makes a direction weak: with less of it, it is not followed either.
UNSEEN = 0.3


def solve(
    H: Floats, g: Floats, lever: float = 1.0, weak_share: float = 1e-3, least: float = 0.0
) -> tuple[Floats, Floats]:
    d, weak = np.full(6, np.nan), np.zeros((6, 6))
    information = float(np.trace(H[:3, :3]))
    facts = np.zeros(at.COUNT)
    facts[[at.INFORMATION, at.LEVER]] = information, information * lever**2
    count = gauss_newton.solve_guarded_step(H, g, facts, weak_share, least, UNSEEN, d, weak)
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


def test_a_direction_is_observed_by_its_share_of_information() -> None:
    H = np.diag([1.0, 1.0, 1e-3, 1.0, 1.0, 1.0])
    for share, expected, is_followed in [(1e-4, 0, True), (7e-4, 1, True), (2e-3, 1, False)]:
        d, weak = solve(H, np.ones(6), weak_share=share)
        assert len(weak) == expected
        assert d[2] == pytest.approx(-1e3 if is_followed else 0.0)


def test_a_direction_is_observed_by_its_least_information() -> None:
    H = np.diag([1.0, 1.0, 1e-2, 1.0, 1.0, 1.0])
    for least, expected, is_followed in [(0.9e-2, 0, True), (1.1e-2, 1, True), (3.2e-2, 1, True), (3.5e-2, 1, False)]:
        d, weak = solve(H, np.ones(6), least=least)
        assert len(weak) == expected
        assert d[2] == pytest.approx(-1e2 if is_followed else 0.0)


def test_no_information_gives_no_step() -> None:
    d, weak = solve(np.zeros((6, 6)), np.zeros(6))
    np.testing.assert_array_equal(d, 0.0)
    assert len(weak) == 6


def step(
    H: Floats,
    g: Floats,
    scale: float = 1.0,
    projector: Floats | None = None,
    S: Floats | None = None,
    population: float = 0.0,
) -> tuple[Floats, Floats, bool, Floats, tuple[Floats, ...]]:
    """R, t, whether they moved, the unobserved directions, and the sums as the kernel leaves them."""
    pose, d, weak = (np.eye(3), np.zeros(3)), np.zeros(6), np.zeros((6, 6))
    facts = np.zeros(at.COUNT)
    facts[[at.INFORMATION, at.LEVER, at.MATCHED, at.POPULATION]] = (
        np.trace(H[:3, :3]),
        np.trace(H[:3, :3]),
        60.0,
        population,
    )
    sums = np.triu(H), np.triu(H if S is None else S), g.copy(), facts
    limits = 1e-9, 0.0, UNSEEN
    none = np.zeros((0, 6))
    kernel = gauss_newton.step if S is None else gauss_newton.step_on_surfaces
    moved, count, move, turn = kernel(pose, sums, scale, limits, none if projector is None else projector, d, weak)
    if np.linalg.norm(d[:3]) < 2 * scale:
        np.testing.assert_allclose([move, turn], [np.linalg.norm(d[:3]), np.linalg.norm(d[3:])])
    return *pose, moved, weak[:count], sums


def test_a_step_moves_the_pose_by_the_newton_step() -> None:
    for seed in range(20):
        H, g = random_problem(seed, 6)
        expected = -np.linalg.solve(H, g)
        R, t, moved, weak, sums = step(H, g)
        assert moved
        assert len(weak) == 0
        np.testing.assert_allclose(t, expected[:3], atol=1e-9)
        np.testing.assert_allclose(R, so3.exp(expected[3:]), atol=1e-9)
        np.testing.assert_array_equal(sums[0], sums[0].T)


def test_a_step_stays_within_the_directions_allowed() -> None:
    upright = np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
    for seed in range(20):
        H, g = random_problem(seed, 6)
        R, t, _, weak, _ = step(H, g, projector=upright)
        expected = -np.linalg.solve(H[2:5, 2:5], g[2:5])
        np.testing.assert_allclose(t, [0, 0, expected[0]], atol=1e-9)
        np.testing.assert_allclose(so3.log(R), [expected[1], expected[2], 0], atol=1e-8)
        np.testing.assert_allclose(weak @ upright, 0.0, atol=1e-9)


def test_surfaces_tell_what_is_observed_where_matrices_are_full() -> None:
    H, g = random_problem(0, 6)
    _, t, _, weak, _ = step(H, g, S=np.diag([0.0, 1, 1, 1, 1, 1]))
    np.testing.assert_allclose(np.abs(weak), np.eye(6)[:1])
    assert t[0] == pytest.approx(0.0, abs=1e-12)
    assert len(step(H, g)[3]) == 0


def test_a_population_scales_the_information_and_not_the_step() -> None:
    H, g = random_problem(1, 6)
    R, t, _, _, sums = step(H, g)
    R_few, t_few, _, _, scaled = step(H, g, S=H, population=600.0)
    np.testing.assert_allclose(t_few, t, atol=1e-12)
    np.testing.assert_allclose(R_few, R, atol=1e-12)
    np.testing.assert_allclose(scaled[0], sums[0] / 10, rtol=1e-12)
    for place, factor in ((at.INFORMATION, 10), (at.LEVER, 10), (at.MATCHED, 1)):
        assert scaled[3][place] == pytest.approx(sums[3][place] / factor)


def test_a_long_step_is_cut_and_one_that_is_no_number_not_made() -> None:
    H, g = np.eye(6), np.array([-30.0, 0, 0, 0, 0, 0])
    assert step(H, g, scale=1.0)[1][0] == pytest.approx(2.0)
    assert step(H, g, scale=0.1)[1][0] == pytest.approx(1.0)
    for scale, reach in ((3.0, 6.0), (0.6, 1.2), (0.4, 1.0)):
        for share, moved in ((0.95, 0.95), (1.05, 1.0), (50.0, 1.0)):
            g[0] = -share * reach
            assert step(H, g, scale=scale)[1][0] == pytest.approx(moved * reach)
    _, t, moved, _, _ = step(H, np.array([np.nan, 0, 0, 0, 0, 0]))
    assert not moved
    np.testing.assert_array_equal(t, 0.0)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("bound", [np.inf, 0.3])
def test_trimming_keeps_the_share_of_the_nearest(share: float, bound: float) -> None:
    rng = np.random.default_rng(4)
    distance2 = np.where(rng.uniform(size=2000) < 0.2, -1.0, rng.exponential(0.2, 2000))
    limit = gauss_newton.trimming_distance2(distance2, share, bound)
    candidates = distance2[(distance2 >= 0) & (distance2 <= bound)]
    assert np.mean(candidates <= limit) == pytest.approx(share, abs=1.5 / len(candidates))
    assert gauss_newton.trimming_distance2(distance2[::-1].copy(), share, bound) == limit
    assert gauss_newton.trimming_distance2(distance2, 1.0, bound) == bound
