"""RPE, KITTI drift and the theses' numbers: laws and cases with a known answer."""

from __future__ import annotations

import numpy as np
import pytest
from evaluation_drives import drive

from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation import parse_delta
from lslam.evaluation.kitti_drift import kitti_drift
from lslam.evaluation.relative import by_index, by_path, by_time, relative_error
from lslam.evaluation.thesis import axis_errors, planar


def seconds(t: Trajectory) -> np.ndarray:
    return t.stamps_ns / 1e9


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("1scan", (1, "scan", "consecutive")),
        ("10m", (10, "m", "all")),
        ("0.5 s / consecutive", (0.5, "s", "consecutive")),
        ("5scans/all", (5, "scan", "all")),
    ],
)
def test_distances_are_understood(text: str, meaning: tuple[float, str, str]) -> None:
    assert parse_delta(text) == meaning


@pytest.mark.parametrize("text", ["", "m", "10q", "-1m", "0m", "1.5scan", "10m/some", "1e999m", "1.2.3m", "nan m"])
def test_distances_that_are_none(text: str) -> None:
    with pytest.raises(UsageError):
        parse_delta(text)


@pytest.mark.parametrize(
    "recipe", ["1scan/consecutive", "7scan/all", "10m/all", "10m/consecutive", "2s/all", "2s/consecutive"]
)
def test_rigid_motion_of_either_side_changes_nothing(recipe: str, estimate: Trajectory, truth: Trajectory) -> None:
    T = se3.exp(np.array([100, -50, 3, 0.3, 1.1, -2]))
    here = relative_error(estimate.poses, truth.poses, seconds(truth), recipe)
    moved = relative_error(T @ estimate.poses, se3.inverse(T) @ truth.poses, seconds(truth), recipe)
    assert here.n_pairs == moved.n_pairs > 5
    assert here.translation is not None
    assert moved.translation is not None
    assert moved.translation.rmse == pytest.approx(here.translation.rmse, rel=1e-6)
    zero = relative_error(truth.poses, truth.poses, seconds(truth), recipe).translation
    assert zero is not None
    assert zero.max < 1e-9


def test_a_turn_per_scan_has_a_known_answer(truth: Trajectory) -> None:
    turn = se3.exp(np.array([0, 0, 0, 0, 0, np.deg2rad(0.1)]))
    poses = [truth.poses[0]]
    for motion in se3.relative(truth.poses[:-1], truth.poses[1:]):
        poses.append(poses[-1] @ motion @ turn)
    error = relative_error(np.array(poses), truth.poses, None, "1scan")
    assert error.rotation_deg is not None
    assert error.rotation_deg.min == pytest.approx(0.1)
    assert error.rotation_deg.max == pytest.approx(0.1)


def test_pairs_by_index() -> None:
    assert by_index(7, 3, False).tolist() == [[0, 3], [3, 6]]
    assert by_index(5, 3, True).tolist() == [[0, 3], [1, 4]]
    assert by_index(3, 3, True).tolist() == []


def test_pairs_by_path() -> None:
    x = np.zeros((6, 3))
    x[:, 0] = [0, 1, 2, 2, 3, 4]
    assert by_path(x, 2.0, False).tolist() == [[0, 2], [2, 5]]
    assert by_path(x, 2.0, True).tolist() == [[0, 2], [1, 4], [2, 5], [3, 5]]
    assert by_path(x, 50.0, True).tolist() == []


def test_pairs_by_time_skip_a_gap() -> None:
    t = np.array([0.0, 0.5, 1.0, 1.5, 9.0, 9.5, 10.0])
    assert by_time(t, 1.0, True).tolist() == [[0, 2], [1, 3], [4, 6]]
    assert by_time(t, 1.0, False).tolist() == [[0, 2], [4, 6]]


def test_pairs_that_cannot_be_compared_are_reported(estimate: Trajectory, truth: Trajectory) -> None:
    error = relative_error(estimate.poses, truth.poses, None, "1s")
    assert (error.translation, error.note) == (None, "n/a (no stamps)")
    far = relative_error(estimate.poses, truth.poses, None, "5000m")
    assert (far.translation, far.n_pairs) == (None, 0)
    assert "5000 m" in far.note


def test_drift_of_a_wrong_scale_is_that_scale() -> None:
    truth = drive(400)
    longer = truth.poses.copy()
    longer[:, :3, 3] *= 1.01
    drift = kitti_drift(longer, truth.poses)
    # The chord of a curved segment is shorter than its path, so 1 % of scale is at most 1 % of drift.
    assert 0.5 < drift.translation_percent <= 1.02
    assert drift.rotation_deg_per_100m < 1e-3
    assert set(drift.by_length) == {100, 200, 300}
    assert drift.segments == sum(n for _, _, n in drift.by_length.values())


def test_kitti_drift_is_given_for_each_length() -> None:
    """Straight ahead, a metre a scan, while the estimate is 2 % long and turns by a millirad a metre.

    A segment of so many metres ends a scan beyond them: of 100 m it has 101, which turn by 101 mrad.
    """
    truth = np.tile(np.eye(4), (350, 1, 1))
    truth[:, 0, 3] = np.arange(350)
    step = se3.exp(np.array([1.02, 0, 0, 0, 0, 1e-3]))
    estimate = [np.eye(4)]
    for _ in range(349):
        estimate.append(estimate[-1] @ step)
    drift = kitti_drift(np.array(estimate), truth)
    assert {length: n for length, (_, _, n) in drift.by_length.items()} == {100: 25, 200: 15, 300: 5}
    for length, (translation, rotation, _) in drift.by_length.items():
        assert rotation == pytest.approx(np.rad2deg(1e-3) * 100 * (length + 1) / length)
        end = (np.exp(1j * 1e-3 * (length + 1)) - 1) / 1j * 1.02e3
        assert translation == pytest.approx(100 * abs(end - (length + 1)) / length, rel=1e-3)


def test_drift_under_100_m_is_not_zero_but_not_available() -> None:
    short = drive(60).poses
    drift = kitti_drift(short, short)
    assert not drift.available
    assert np.isnan(drift.translation_percent)
    assert "n/a" in drift.note


def test_thesis1_is_the_rmse_over_root_three(estimate: Trajectory, truth: Trajectory) -> None:
    moved = se3.exp(np.array([5, 6, 7, 0.1, 0.2, 0.3])) @ estimate.poses
    result = axis_errors(moved, truth.poses)
    assert result.thesis_rmse == pytest.approx(result.rmse / np.sqrt(3))
    assert result.thesis_rmse == pytest.approx(np.sqrt(np.mean(np.square(result.xyz_rmse))))
    assert np.abs(result.xyz[0]).max() < 1e-9


def test_thesis1_angles_per_axis_have_a_known_answer(truth: Trajectory) -> None:
    turned = truth.poses.copy()
    turned[10:, :3, :3] = so3.exp(np.array([0, 0, np.deg2rad(2)])) @ turned[10:, :3, :3]
    result = axis_errors(turned, truth.poses)
    np.testing.assert_allclose(result.rpy_deg[10:], np.tile([0, 0, 2], (len(truth) - 10, 1)), atol=1e-9)
    np.testing.assert_allclose(result.angular[10:], 2)
    assert result.angular_max_deg == pytest.approx(2)


def test_thesis2_ignores_height_and_keeps_the_sign(truth: Trajectory) -> None:
    lifted = truth.poses.copy()
    lifted[:, 2, 3] += np.linspace(0, 5, len(truth))
    assert planar(lifted, truth.poses).ate_mean < 1e-9
    turn = se3.exp(np.array([0, 0, 0, 0, 0, -1e-3]))
    poses = [truth.poses[0]]
    for motion in se3.relative(truth.poses[:-1], truth.poses[1:]):
        poses.append(poses[-1] @ motion @ turn)
    result = planar(np.array(poses), truth.poses)
    assert result.rpe_rotation_mean == pytest.approx(-1e-3, rel=0.01)
    assert result.rpe_rotation_std < 1e-4
    assert result.ate_mean > 1


def test_thesis2_ate_is_the_planar_distance(estimate: Trajectory, truth: Trajectory) -> None:
    """On a flat drive with a shared start it is the mean distance, and needs no SE(2) to be computed."""
    flat = truth.poses.copy()
    flat[:, 2, 3] = 0
    flat[:, :3, :3] = so3.exp(so3.euler_rpy(truth.poses[:, :3, :3]) * [0, 0, 1])
    shifted = flat.copy()
    shifted[1:, :2, 3] += [0.3, -0.4]
    result = planar(shifted, flat)
    assert result.ate_mean == pytest.approx(0.5 * (len(flat) - 1) / len(flat))
    assert result.spacing == pytest.approx(np.linalg.norm(np.diff(flat[:, :2, 3], axis=0), axis=1).mean())
