"""The running estimate on the map: its uncertainty grows with the way and shrinks by what a match fixes, nothing else."""

import numpy as np
import pytest
from scipy.optimize import minimize

from lslam.core.geometry import se2
from lslam.core.types.building import KeyframeMatch
from lslam.osm.track import OsmTrack

MAP = np.array([0.5, 0.5, 0.02])


def track(sigma: tuple[float, float, float] = (0.1, 0.1, 0.01)) -> OsmTrack:
    return OsmTrack(np.array([10.0, 5.0, np.pi / 2]), np.array(sigma), 1.0, np.radians(0.5) / 100, MAP)


def test_prediction_follows_odometry_with_a_sigma_of_one_percent() -> None:
    one = track((0.0, 0.0, 0.0))
    for _ in range(50):
        one.move(np.array([2.0, 0.0, 0.0]), 2.0)
    np.testing.assert_allclose(one.pose, [10.0, 105.0, np.pi / 2], atol=1e-9)
    sigma = np.sqrt(np.diag(one.covariance))
    assert abs(sigma[1] - 1.0) < 1e-6  # along: its drift alone
    assert 1.0 < sigma[0] < 1.3  # across: what the heading adds
    assert abs(np.degrees(sigma[2]) - 0.5) < 1e-6


def test_a_match_of_one_direction_moves_that_direction_only() -> None:
    one = track((2.0, 2.0, 0.0))
    before = one.covariance.copy()
    one.correct(np.array([11.0, 99.0, np.pi / 2]), np.diag([400.0, 0.0, 0.0]))
    assert 10.8 < one.pose[0] < 11.0
    assert one.pose[1] == 5.0
    assert one.covariance[0, 0] < 0.1 * before[0, 0]
    assert one.covariance[1, 1] == before[1, 1]


def test_the_gate_counts_directions_that_are_seen_and_wraps_the_heading() -> None:
    one = OsmTrack(np.array([0.0, 0.0, np.pi - 0.01]), np.array([0.1, 0.1, 0.02]), 1.0, 1e-4, MAP)
    near, rank = one.squared_distance(np.array([0.0, 0.0, -np.pi + 0.01]), np.diag([100.0, 100.0, 1e4]))
    assert rank == 3
    assert near < 1.0
    far, rank = one.squared_distance(np.array([3.0, 50.0, np.pi - 0.01]), np.diag([100.0, 0.0, 1e4]))
    assert rank == 2
    # 3 m against 0.1 m of the track, 0.1 m of the match and half a metre of the map; the 50 m are along the wall.
    np.testing.assert_allclose(far, 9.0 / (0.01 + 0.01 + 0.25), rtol=1e-6)


def test_the_covariance_never_falls_below_that_of_the_map() -> None:
    one = track()
    for _ in range(200):
        one.correct(one.pose, np.diag([1e4, 1e4, 1e6]))
    assert (one.sigma >= MAP).all()


def test_the_filter_restarts_at_a_match() -> None:
    one = track()
    one.begin(np.array([1.0, 2.0, 3.0]), np.diag([100.0, 100.0, 1e4]))
    np.testing.assert_array_equal(one.pose, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(one.covariance, np.diag([0.26, 0.26, 5e-4]))
    one.move(np.array([0.0, 0.0, 1.0]), 0.0)
    assert abs(one.pose[2] - se2.wrap(4.0)) < 1e-12


SURE, WALL = np.diag([1e4, 1e4, 1e6]), np.diag([0.0, 1e4, 1e6])
START = np.array([2.0, 2.0, np.radians(5.0)])


def laid_on(
    told: np.ndarray, real: np.ndarray, information: list[np.ndarray], sigma: np.ndarray = START
) -> tuple[float, np.ndarray]:
    """Keyframes that odometry has at `told` (M, 3), 5 m after each other, on matches at `real`; the turn in deg."""
    matches = [
        KeyframeMatch(k, np.zeros((0, 2, 2)), np.zeros((1, 2)), pose, np.ones(3), pose, known, rank=3)
        for k, (pose, known) in enumerate(zip(real, information, strict=True))
    ]
    turn, squared = track().align(told, 5.0 * np.arange(len(told)), matches, sigma)
    return float(np.degrees(turn)), squared


@pytest.mark.parametrize("seed", range(4))
def test_the_heading_is_that_of_all_matches(seed: int) -> None:
    rng = np.random.default_rng(seed)
    way = se2.compose(np.array([30.0, -20.0, 2.0]), np.column_stack([5.0 * np.arange(20), np.zeros((20, 2))]))
    real = way + rng.normal(0, [0.1, 0.1, 0.005], way.shape)
    real[0] = way[0] + np.array([0.1, 0.1, np.radians(2.5)])
    real[7] += np.array([3.0, -2.0, 0.2])  # another's walls
    told = se2.compose(real[0], se2.relative(way[0], way))
    turn, squared = laid_on(told, real, [SURE] * 20)
    assert turn == pytest.approx(-2.5, abs=0.35)
    assert squared[7] > 12.0
    assert np.delete(squared, [0, 7]).max() < 1.0
    # Where the start is known that well, matches do not turn it.
    assert laid_on(told, real, [SURE] * 20, np.full(3, 1e-4))[0] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_run_is_laid_where_matches_and_what_is_known_of_its_start_are_likeliest(seed: int) -> None:
    """Against a general minimiser of Student's t of the matches and a Gaussian of the move about the first pose."""
    rng = np.random.default_rng(seed)
    told = se2.compose(np.array([300.0, -200.0, 2.0]), np.column_stack([5.0 * np.arange(12), np.zeros((12, 2))]))
    real = told + np.array([1.0, -0.7, 0.04]) + rng.normal(0, [0.4, 0.4, 0.01], told.shape)
    sigma = np.array([0.4, 0.3, 0.01])
    variances = (
        MAP**2
        + 5.0 * np.arange(12)[:, None] * 100.0 * np.array([0.01, 0.01, np.radians(0.005)]) ** 2
        + 1 / np.diag(SURE)
    )

    def negative_log_likelihood(moved: np.ndarray) -> float:
        turn = se2.compose(np.array([*told[0, :2], 0.0]) + moved, se2.inverse(np.array([*told[0, :2], 0.0])))
        squared = ((real - se2.compose(turn, told)) ** 2 / variances).sum(axis=1)
        return float((moved**2 / sigma**2).sum() + 4.0 * np.log(3.0 + squared).sum())

    best = minimize(
        negative_log_likelihood, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-10}
    ).x
    turn, _ = laid_on(told, real, [SURE] * 12, sigma)
    assert 0.5 < turn < 2.0
    assert turn == pytest.approx(np.degrees(best[2]), abs=1e-4)


def test_unobserved_directions_are_not_turned() -> None:
    """All walls lie along the way, and the matches are 9 m farther along them; or on the other side of the circle."""
    told = np.column_stack([5.0 * np.arange(10), np.zeros((10, 2))])
    assert laid_on(told, told + np.array([9.0, 0.3, 0.0]), [WALL] * 10)[0] == pytest.approx(0.0, abs=0.1)
    around = se2.compose(np.array([0.0, 0.0, np.pi - 0.01]), told)
    real = se2.compose(np.array([0.0, 0.0, -np.pi + 0.01]), told)
    assert laid_on(around, real, [SURE] * 10)[0] == pytest.approx(np.degrees(0.02), abs=0.03)


def test_far_matches_count_less_by_what_odometry_may_have_drifted_since() -> None:
    """Odometry that bends away to one side over 400 m: 2.3 deg in the mean, less where it begins."""
    way = np.column_stack([5.0 * np.arange(80), np.zeros((80, 2))])
    told = way + np.column_stack([np.zeros(80), 2e-4 * way[:, 0] ** 2 / 2, 2e-4 * way[:, 0]])
    assert -2.1 < laid_on(told, way, [SURE] * 80)[0] < -1.0


def test_a_match_has_at_best_the_sigma_of_the_map() -> None:
    assert track().is_accurate(np.diag([5.0, 5.0, 3e3]))
    assert not track().is_accurate(np.diag([3.0, 1e4, 1e6]))
    assert not track().is_accurate(np.diag([1e4, 1e4, 2e3]))
