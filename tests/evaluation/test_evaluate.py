"""The whole evaluation: frames told apart, notes, and promises about what comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_drives import disturb

from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import Evaluation, evaluate
from lslam.evaluation.frames import R_BODY_CAMERA, body_rotation, main_axis
from lslam.io.formats.kitti_layout import read_odometry_calib
from lslam.io.formats.trajectory_files import read_trajectory

T_CAM_LIDAR = se3.make(R_BODY_CAMERA.T @ so3.exp(np.array([0.01, -0.02, 0.015])), np.array([-0.005, -0.07, -0.33]))


def as_camera(t: Trajectory) -> Trajectory:
    """The same drive as KITTI states it: camera 0 in camera 0 at the start."""
    return replace(t, poses=T_CAM_LIDAR @ t.poses @ se3.inverse(T_CAM_LIDAR), frame="cam0", source="poses/07.txt")


def rmse(result: object, name: str) -> float:
    translation = result.ate[name].translation  # type: ignore[attr-defined]
    assert translation is not None
    return float(translation.rmse)


def drift(result: Evaluation) -> float:
    return float(result.scores["kitti_drift"].translation_percent)


def test_defaults_are_se3_and_origin_and_every_part_has_a_recipe(estimate: Trajectory, truth: Trajectory) -> None:
    result = evaluate(estimate, truth)
    assert list(result.ate) == ["se3", "origin"]
    assert [(e.delta, e.unit, e.pairs) for e in result.scores["rpe"]] == [(1, "scan", "consecutive"), (10, "m", "all")]
    assert (result.matched, result.possible) == (300, 300)
    assert result.path_length == pytest.approx(truth.path_lengths[-1])
    assert result.notes == []
    for part in [*result.ate.values(), *result.scores["rpe"], *list(result.scores.values())[2:]]:
        assert len(part.recipe) > 20
    assert "300 poses" in result.ate["se3"].recipe
    assert str(result.scores["rpe"][1].n_pairs) in result.scores["rpe"][1].recipe


def test_an_estimate_that_never_moves_fails_every_number(truth: Trajectory) -> None:
    """The sentinel: a method that answers identity must look bad, never good or absent."""
    sentinel = replace(truth, poses=np.tile(np.eye(4), (len(truth), 1, 1)), source="identity")
    result = evaluate(sentinel, truth)
    assert not result.ate["se3"].available
    assert rmse(result, "origin") > 20
    assert result.scores["rpe"][0].translation is not None
    assert result.scores["rpe"][0].translation.rmse > 0.5
    assert drift(result) > 50
    assert result.scores["thesis1"].thesis_rmse > 20
    assert result.scores["thesis2"].ate_mean > 20


def test_camera_truth_is_converted_when_the_calibration_is_known(estimate: Trajectory, truth: Trajectory) -> None:
    plain = evaluate(estimate, truth)
    mixed = evaluate(estimate, as_camera(truth), calibration=Calibration(T_cam0_lidar=T_CAM_LIDAR))
    assert any("converted to the LiDAR" in note for note in mixed.notes)
    for name in ("se3", "origin"):
        assert rmse(mixed, name) == pytest.approx(rmse(plain, name), abs=1e-9)
    assert drift(mixed) == pytest.approx(drift(plain), abs=1e-9)
    other = evaluate(as_camera(estimate), truth, calibration=Calibration(T_cam0_lidar=T_CAM_LIDAR))
    assert rmse(other, "origin") == pytest.approx(rmse(plain, "origin"), abs=1e-9)


def test_camera_truth_without_calibration_is_reported(
    estimate: Trajectory, truth: Trajectory, caplog: pytest.LogCaptureFixture
) -> None:
    result = evaluate(estimate, as_camera(truth))
    assert any("WRONG FRAMES" in n and "+z" in n and "+x" in n and "--calib" in n for n in result.notes)
    assert rmse(result, "origin") > 30


def test_the_frame_a_file_states_yields_to_the_motion(estimate: Trajectory, truth: Trajectory) -> None:
    """A KITTI file may hold LiDAR poses: they advance along +x."""
    result = evaluate(replace(estimate, frame="cam0"), truth, calibration=Calibration(T_cam0_lidar=T_CAM_LIDAR))
    assert any("taken as LiDAR poses" in note for note in result.notes)
    assert rmse(result, "origin") == pytest.approx(rmse(evaluate(estimate, truth), "origin"))


def test_two_camera_files_are_measured_with_z_up(estimate: Trajectory, truth: Trajectory) -> None:
    result = evaluate(as_camera(estimate), as_camera(truth))
    plain = evaluate(estimate, truth)
    assert result.notes == []
    vertical = [r.ate["origin"].vertical for r in (result, plain)]
    assert vertical[0] is not None
    assert vertical[1] is not None
    # The camera sits 0.3 m ahead and leans by a degree: heights differ by that much, not by the axis.
    assert vertical[0].rmse == pytest.approx(vertical[1].rmse, rel=0.3)


def test_a_body_turned_against_the_other_is_found(estimate: Trajectory, truth: Trajectory) -> None:
    T = se3.make(so3.exp(np.array([np.pi * 0.9, 0, 0])), np.array([0.1, 0.0, -0.2]))
    turned = replace(truth, poses=truth.poses @ T, frame="unknown")
    result = evaluate(estimate, turned)
    assert any("WRONG FRAMES" in note and "--T-est-gt" in note for note in result.notes)
    assert result.faults == tuple(result.notes[-1:])
    right = evaluate(estimate, turned, T_est_gt=T)
    assert not any("WRONG" in note for note in right.notes)
    assert (right.faults, len(right.notes)) == ((), 1)
    assert rmse(right, "origin") == pytest.approx(rmse(evaluate(estimate, truth), "origin"), abs=1e-9)


def test_the_inverse_of_the_transform_is_reported(estimate: Trajectory, truth: Trajectory) -> None:
    T = se3.make(so3.exp(np.array([0, 0, np.pi / 2])), np.zeros(3))
    turned = replace(truth, poses=truth.poses @ T, frame="unknown")
    wrong = evaluate(estimate, turned, T_est_gt=se3.inverse(T))
    assert any("may be the inverse" in note for note in wrong.notes)


def test_transform_and_calibration_say_the_same(estimate: Trajectory, truth: Trajectory) -> None:
    camera = as_camera(truth)
    by_transform = evaluate(estimate, camera, T_est_gt=se3.inverse(T_CAM_LIDAR))
    by_calibration = evaluate(estimate, camera, calibration=Calibration(T_cam0_lidar=T_CAM_LIDAR))
    for name in ("se3", "origin"):
        assert rmse(by_transform, name) == pytest.approx(rmse(by_calibration, name), abs=1e-9)
        assert np.abs(by_transform.ate[name].errors - by_calibration.ate[name].errors).max() < 1e-9


def test_directions_of_motion(estimate: Trajectory, truth: Trajectory) -> None:
    assert main_axis(truth.poses) == "+x"
    assert main_axis(as_camera(truth).poses) == "+z"
    assert main_axis(np.tile(np.eye(4), (10, 1, 1))) is None
    R = body_rotation(estimate.poses, as_camera(truth).poses)
    assert R is not None
    assert np.rad2deg(so3.angle(R @ T_CAM_LIDAR[:3, :3])) < 3
    assert body_rotation(np.tile(np.eye(4), (300, 1, 1)), truth.poses) is None


def test_a_nearly_straight_drive_is_warned_of(truth: Trajectory) -> None:
    straight = replace(truth, poses=truth.poses.copy())
    straight.poses[:, :3, 3] *= [1, 1e-3, 1e-3]
    straight.poses[:, :3, 3] += np.outer(np.arange(300), [1.0, 0, 0])
    straight.poses[:, :3, :3] = np.eye(3)
    result = evaluate(disturb(straight), straight)
    assert any("nearly straight" in note for note in result.notes)


def test_a_time_offset_is_applied_and_reported(estimate: Trajectory, truth: Trajectory) -> None:
    late = replace(estimate, stamps_ns=estimate.stamps_ns + 5 * 10**9)
    plain = evaluate(estimate, truth)
    given = evaluate(late, truth, EvalConfig(time_offset=-5.0))
    found = evaluate(late, truth, EvalConfig(time_offset="auto"))
    assert given.time_offset == found.time_offset == -5.0
    assert rmse(given, "origin") == rmse(found, "origin") == rmse(plain, "origin")
    assert any("-5.000000 s" in note for note in found.notes)
    with pytest.raises(InputError, match="needs stamps"):
        evaluate(replace(estimate, has_stamps=False), truth, EvalConfig(time_offset=1.0))


def test_poses_in_memory_are_checked_too(estimate: Trajectory, truth: Trajectory) -> None:
    broken = replace(estimate, poses=estimate.poses.copy())
    broken.poses[7, 0, 3] = np.nan
    with pytest.raises(InputError, match="pose 7 holds NaN"):
        evaluate(broken, truth)
    backwards = replace(estimate, stamps_ns=estimate.stamps_ns[::-1].copy())
    with pytest.raises(InputError, match="stamp of pose 1 is not after"):
        evaluate(backwards, truth)


def test_same_input_same_bytes(estimate: Trajectory, truth: Trajectory) -> None:
    a, b = (evaluate(estimate, truth) for _ in range(2))
    for name in a.ate:
        assert a.ate[name].errors.tobytes() == b.ate[name].errors.tobytes()
    assert a.scores["kitti_drift"] == b.scores["kitti_drift"]
    assert a.scores["thesis2"] == b.scores["thesis2"]


def test_kitti_07_in_both_frames(recordings: Callable[[str], Path]) -> None:
    root = recordings("kitti_poses") / "kitti_poses"
    Tr = read_odometry_calib(root / "calib/04_to_10_Tr_only.txt")
    assert Tr is not None
    estimate = read_trajectory(root / "estimates/simple_offline_07.txt")
    truth = read_trajectory(root / "ground_truth/07.txt")
    camera = evaluate(estimate, truth)
    lidar = replace(estimate, poses=se3.inverse(Tr) @ estimate.poses @ Tr, frame="lidar")
    converted = evaluate(lidar, truth, calibration=Calibration(T_cam0_lidar=Tr))
    # Aligned rmse of good odometry on 07 is 0.38 to 0.50 m.
    assert rmse(camera, "se3") == pytest.approx(0.3841, abs=1e-3)
    assert rmse(converted, "se3") == pytest.approx(rmse(camera, "se3"), abs=0.01)
    assert drift(converted) == pytest.approx(drift(camera), abs=0.01)
    mixed = evaluate(lidar, truth)
    assert any("WRONG FRAMES" in note for note in mixed.notes)
    assert drift(mixed) > 50


def test_reference_of_a_raw_drive_against_unix_stamps(recordings: Callable[[str], Path]) -> None:
    """Stamps in seconds of the day against Unix time: the shift is a day count, found from motion."""
    drive = recordings("kitti_raw_0005") / "2011_09_26/2011_09_26_drive_0005_sync"
    truth = read_trajectory(drive / "reference_lidar.tum")
    midnight = 1_316_995_200 * 10**9
    own = disturb(replace(truth, stamps_ns=truth.stamps_ns + midnight), size=0.01)
    with pytest.raises(InputError, match="--time-offset auto"):
        evaluate(own, truth)
    result = evaluate(own, truth, EvalConfig(time_offset="auto"))
    assert result.time_offset == -midnight / 1e9
    assert result.matched == 154
