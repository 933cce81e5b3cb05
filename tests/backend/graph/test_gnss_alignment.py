"""Trajectories aligned with satellite fixes: noise, jumps, mirrors, and paths that leave directions free."""

from __future__ import annotations

import numpy as np
import pytest
from graph_builders import truth
from scipy.stats import chi2

from lslam.backend.fixes import align
from lslam.core.geometry import se3, so3

PATH = truth(200, 2, radius=80.0)[:, :3, 3]
T_ENU_WORLD = se3.make(so3.from_euler_rpy(np.array([0.04, -0.05, 2.1])), np.array([300.0, -40.0, 7.0]))
UP = T_ENU_WORLD[2, :3]  # up, in the world of the path
SIGMAS = np.array([1.0, 1.0, 1.8])


def fit(path: np.ndarray, fixes: np.ndarray, up: np.ndarray = UP, up_sigma: float = 0.01):
    n = len(path)
    return align(path, fixes, np.tile(SIGMAS, (n, 1)), np.full(n, 0.1), up, up_sigma, 5)


def noisy(path: np.ndarray, seed: int = 0) -> np.ndarray:
    return se3.apply(T_ENU_WORLD, path) + SIGMAS * np.random.default_rng(seed).normal(size=path.shape)


def test_noise_averages_out() -> None:
    found = fit(PATH, noisy(PATH))
    off = se3.apply(found.T_enu_world, PATH) - se3.apply(T_ENU_WORLD, PATH)
    assert np.linalg.norm(off[:, :2], axis=1).max() < 0.5
    assert np.abs(off[:, 2]).max() < 0.8
    assert found.inliers.mean() > 0.98


@pytest.mark.parametrize("share", [0.2, 0.45])
def test_jumps_are_left_out(share: float) -> None:
    fixes = noisy(PATH, 1)
    bad = np.arange(200) < 200 * share
    fixes[bad] += [40.0, -25.0, 3.0]
    found = fit(PATH, fixes)
    np.testing.assert_array_equal(found.inliers[bad], False)
    assert found.inliers[~bad].mean() > 0.97
    off = se3.apply(found.T_enu_world, PATH) - se3.apply(T_ENU_WORLD, PATH)
    assert np.linalg.norm(off[:, :2], axis=1).max() < 1.0


def test_tilt_of_a_wide_path_is_found_without_knowing_up() -> None:
    tilted = se3.make(so3.exp(np.array([0.08, -0.05, 0.0])), np.zeros(3))
    found = fit(se3.apply(se3.inverse(tilted), PATH), noisy(PATH, 2), np.array([0.0, 0, 1]), np.deg2rad(10))
    error = so3.angle(found.T_enu_world[:3, :3].T @ T_ENU_WORLD[:3, :3] @ tilted[:3, :3])
    assert error < np.deg2rad(1.0)


def test_a_straight_path_keeps_the_roll_that_up_gives() -> None:
    line = np.column_stack([np.linspace(0, 150, 100), np.zeros(100), np.zeros(100)])
    found = fit(line, noisy(line, 3))
    assert so3.angle(found.T_enu_world[:3, :3].T @ T_ENU_WORLD[:3, :3]) < np.deg2rad(1.5)


def test_no_rotation_undoes_a_mirror() -> None:
    """Fixes with a wrong sign of latitude run the other way round."""
    assert fit(PATH, noisy(PATH, 4) * [1, -1, 1]) is None


@pytest.mark.parametrize("fixes", ["random", "few", "nowhere"])
def test_fixes_that_agree_on_nothing_fit_nothing(fixes: str) -> None:
    rng = np.random.default_rng(5)
    if fixes == "few":
        assert fit(PATH[:4], noisy(PATH[:4])) is None
    elif fixes == "random":
        assert fit(PATH, rng.uniform(-200, 200, PATH.shape)) is None
    else:
        assert fit(PATH, np.full(PATH.shape, 1e9)) is None


def test_a_sensor_that_stood_has_no_heading() -> None:
    still = np.zeros((50, 3))
    assert fit(still, noisy(still, 6)) is None


@pytest.mark.parametrize(("metres", "is_told"), [(0.45, False), (0.55, True)])
def test_half_a_metre_is_the_shortest_way_that_has_a_heading(metres: float, is_told: bool) -> None:
    """However well a fix is known: what moves by less may as well be the antenna's mast."""
    to_and_fro = np.column_stack([0.5 * metres * np.where(np.arange(40) % 2, 1.0, -1.0), np.zeros((40, 2))])
    fixes = se3.apply(T_ENU_WORLD, to_and_fro)
    found = align(to_and_fro, fixes, np.full((40, 3), 1e-3), np.zeros(40), UP, 0.01, 5)
    assert (found is not None) == is_told
    if found is not None:
        np.testing.assert_allclose(se3.apply(found.T_enu_world, to_and_fro), fixes, atol=1e-3)


@pytest.mark.parametrize(("sigma", "slack"), [(0.1, 0.0), (5.0, 0.0), (0.3, 2.0)])
def test_a_fix_is_an_inlier_within_its_own_sigma_and_what_odometry_drifts(sigma: float, slack: float) -> None:
    """Three axes at 99.9 %: one fix of two hundred that is so far off by itself."""
    limit = np.sqrt(chi2.ppf(0.999, 3)) * np.hypot(sigma, slack)
    for share, is_inlier in ((0.95, True), (1.05, False)):
        fixes = se3.apply(T_ENU_WORLD, PATH)
        fixes[60] += [0.0, share * limit, 0.0]
        found = align(PATH, fixes, np.full((200, 3), sigma), np.full(200, slack), UP, 1e-6, 5)
        assert found is not None
        assert found.inliers[60] == is_inlier
        assert found.inliers.sum() == 199 + is_inlier


@pytest.mark.parametrize(("metres", "is_inlier"), [(0.7, True), (1.3, False)])
def test_a_tilt_lifts_what_lies_aside_and_not_what_is_above(metres: float, is_inlier: bool) -> None:
    """A shaft of 100 m, 10 m wide, and a height that is wrong: 0.05 rad of tilt lift by 0.25 m there, however high it is."""
    limit = np.sqrt(chi2.ppf(0.999, 3)) * np.hypot(0.05, 0.05 * 5.0)
    phase = np.linspace(0, 2 * np.pi * 9, 200)
    shaft = np.column_stack([5 * np.cos(phase), 5 * np.sin(phase), np.linspace(-50, 50, 200)])
    fixes = shaft.copy()
    fixes[[3, 190], 2] += metres
    assert 0.7 < limit < 1.3
    found = align(shaft, fixes, np.full((200, 3), 0.05), np.zeros(200), np.array([0.0, 0.0, 1.0]), 0.05, 5)
    assert found is not None
    assert found.inliers.sum() == 198 + 2 * is_inlier
    assert found.inliers[[3, 190]].tolist() == [is_inlier] * 2


def test_two_fixes_have_a_heading_where_no_more_are_asked_for() -> None:
    ends = PATH[[0, 50]]
    fixes = se3.apply(T_ENU_WORLD, ends)
    found = align(ends, fixes, np.full((2, 3), 0.1), np.zeros(2), UP, 1e-6, 2)
    assert found is not None
    np.testing.assert_allclose(found.T_enu_world, T_ENU_WORLD, atol=1e-3)
