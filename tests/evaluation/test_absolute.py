"""ATE: laws that any implementation must obey, and cases with a known answer."""

from __future__ import annotations

import numpy as np
import pytest
from evaluation_drives import disturb, drive
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.absolute import absolute_error
from lslam.evaluation.metric import describe
from lslam.evaluation.thesis import axis_errors

TRUTH, ESTIMATE = drive().poses, disturb(drive()).poses
ALL = ("none", "origin", "se3", "sim3", "posyaw")
twists = arrays(np.float64, 6, elements=st.floats(-3, 3))


@pytest.mark.parametrize("alignment", ALL)
def test_identical_is_zero(alignment: str, truth: Trajectory) -> None:
    error = absolute_error(truth.poses, truth.poses, alignment)
    assert error.available
    assert error.translation is not None
    assert error.rotation_deg is not None
    assert error.translation.max < 1e-9
    assert error.rotation_deg.max < 1e-6
    assert error.percent_of_length < 1e-9


def test_a_sensor_that_stood_still_has_no_length_to_be_a_share_of() -> None:
    """Poses read back from text differ by rounding: that is no path."""
    still = np.tile(np.eye(4), (5, 1, 1))
    still[::2, 0, 3] = 1e-12
    estimate = still.copy()
    estimate[:, 1, 3] = np.linspace(0, 0.02, 5)
    error = absolute_error(estimate, still, "origin")
    assert error.translation is not None
    assert error.translation.max == pytest.approx(0.02)
    assert np.isnan(error.percent_of_length)
    assert np.isnan(axis_errors(estimate, still).percent_of_length)
    still[:, 0, 3] = np.arange(5)
    assert absolute_error(
        still @ se3.exp(np.array([0, 0.1, 0, 0, 0, 0])), still, "none"
    ).percent_of_length == pytest.approx(2.5)


@given(twists)
@settings(max_examples=25)
def test_moving_the_estimate_changes_nothing_under_se3_and_origin(xi: np.ndarray) -> None:
    T = se3.exp(xi * np.array([50, 50, 50, 1, 1, 1]))
    for alignment in ("origin", "se3", "sim3"):
        here = absolute_error(ESTIMATE, TRUTH, alignment).translation
        moved = absolute_error(T @ ESTIMATE, TRUTH, alignment).translation
        assert here is not None
        assert moved is not None
        assert moved.rmse == pytest.approx(here.rmse, rel=1e-7)


@given(st.floats(-3, 3), arrays(np.float64, 3, elements=st.floats(-100, 100)))
@settings(max_examples=25)
def test_posyaw_aligns_the_directions_that_gravity_leaves_free(yaw: float, t: np.ndarray) -> None:
    T = se3.make(so3.exp(np.array([0, 0, yaw])), t)
    here = absolute_error(ESTIMATE, TRUTH, "posyaw").translation
    moved = absolute_error(T @ ESTIMATE, TRUTH, "posyaw").translation
    assert here is not None
    assert moved is not None
    assert moved.rmse == pytest.approx(here.rmse, rel=1e-7)


def test_posyaw_does_not_align_a_tilt(truth: Trajectory) -> None:
    tilt = se3.exp(np.array([0, 0, 0, 0.05, 0, 0]))
    error = absolute_error(tilt @ truth.poses, truth.poses, "posyaw")
    assert error.translation is not None
    assert error.vertical is not None
    assert error.horizontal is not None
    assert error.translation.rmse > 0.5
    assert error.vertical.rmse > 5 * error.horizontal.rmse


def test_freer_alignments_fit_better(estimate: Trajectory, truth: Trajectory) -> None:
    rmse = {}
    for alignment in ALL:
        translation = absolute_error(estimate.poses, truth.poses, alignment).translation
        assert translation is not None
        rmse[alignment] = translation.rmse
    assert rmse["sim3"] <= rmse["se3"] <= rmse["posyaw"] <= rmse["none"]
    assert rmse["se3"] < rmse["origin"]


def test_scale_is_found_by_sim3_only(truth: Trajectory) -> None:
    shrunk = truth.poses.copy()
    shrunk[:, :3, 3] *= 0.8
    sim3, rigid = (absolute_error(shrunk, truth.poses, name) for name in ("sim3", "se3"))
    assert sim3.translation is not None
    assert rigid.translation is not None
    assert sim3.scale == pytest.approx(1.25)
    assert sim3.translation.max < 1e-9
    assert rigid.scale == 1
    assert rigid.translation.rmse > 1


def test_the_transform_reproduces_the_errors(estimate: Trajectory, truth: Trajectory) -> None:
    for alignment in ALL:
        e = absolute_error(estimate.poses, truth.poses, alignment)
        again = e.scale * estimate.positions @ e.T_gt_est[:3, :3].T + e.T_gt_est[:3, 3]
        np.testing.assert_allclose(again, e.aligned_positions, atol=1e-9)
        np.testing.assert_allclose(e.aligned_positions - truth.positions, e.errors, atol=1e-9)


def test_a_constant_shift_has_a_known_answer(truth: Trajectory) -> None:
    shifted = truth.poses.copy()
    shifted[:, :3, 3] += [3.0, 0.0, 4.0]
    e = absolute_error(shifted, truth.poses, "none")
    assert e.translation is not None
    assert (e.horizontal and e.horizontal.rmse, e.vertical and e.vertical.rmse) == (pytest.approx(3), pytest.approx(4))
    assert e.translation.rmse == pytest.approx(5)
    assert e.translation.std == pytest.approx(0, abs=1e-9)
    assert e.percent_of_length == pytest.approx(100 * 5 / truth.path_lengths[-1])


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_a_straight_path_is_not_aligned(alignment: str) -> None:
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = np.arange(50)
    e = absolute_error(poses, poses, alignment)
    assert (e.available, e.note, e.translation) == (False, "n/a (collinear)", None)
    assert absolute_error(poses, poses, "origin").available


def test_standing_still_has_no_yaw() -> None:
    poses = np.tile(np.eye(4), (50, 1, 1))
    assert not absolute_error(poses, poses, "posyaw").available
    assert not absolute_error(poses, poses, "se3").available


def test_the_error_about_an_unknown_alignment_names_the_nearest(truth: Trajectory) -> None:
    with pytest.raises(UsageError, match="did you mean 'sim3'"):
        absolute_error(truth.poses, truth.poses, "sim33")


@given(arrays(np.float64, st.integers(1, 50), elements=st.floats(0, 1e3)))
def test_statistics_fit_together(errors: np.ndarray) -> None:
    s = describe(errors)
    assert s is not None
    assert s.n == len(errors)
    assert s.min <= s.median <= s.max
    assert s.rmse**2 == pytest.approx(s.mean**2 + s.std**2, rel=1e-6, abs=1e-9)
    assert s.sse == pytest.approx(s.n * s.rmse**2, rel=1e-9, abs=1e-12)
    assert describe(errors[:0]) is None
