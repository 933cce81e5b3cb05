"""Scores of a frame of the robot that the LiDAR does not sit in: `eval.frame`, equation 4.1 of Del Tufo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluation_drives import disturb, drive

from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.frames import carry
from lslam.simulation.scenarios import kitti_like_cam0

BASE = EvalConfig(frame="base_link", align=("origin",))


def turned(axis: int, deg: float) -> np.ndarray:
    return so3.exp(np.deg2rad(deg) * np.eye(3)[axis])


def three_poses(last_turn_deg: float) -> Trajectory:
    """10 m ahead between poses that look along x, the last of which may look elsewhere."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 10.0, 20.0]
    poses[2, :3, :3] = turned(2, last_turn_deg)
    return Trajectory(np.arange(3) * 10**8, poses, frame="lidar")


@pytest.mark.parametrize("own_turn_deg", [0.0, 30.0, 90.0])
def test_a_lever_arm_makes_an_error_of_rotation_one_of_position(own_turn_deg: float) -> None:
    """The robot's middle lies 3 m behind and 1 m to the left: a quarter turn moves it by 3 + 1 and 3 - 1, sqrt(20) m."""
    T_lidar_base = se3.make(turned(2, own_turn_deg), np.array([-3.0, 1.0, -1.7]))
    calibration = Calibration(frames={"base_link": T_lidar_base})
    pair = three_poses(90.0), three_poses(0.0)
    of_lidar = evaluate(*pair, EvalConfig(align=("origin",)), calibration=calibration).scores["thesis2"]
    of_base = evaluate(*pair, BASE, calibration=calibration).scores["thesis2"]
    assert of_lidar.ate_mean == pytest.approx(0.0, abs=1e-12)
    assert of_base.ate_mean == pytest.approx(np.sqrt(20) / 3)
    assert of_base.rpe_translation_mean == pytest.approx(np.sqrt(20) / 2)
    assert of_base.rpe_rotation_mean == pytest.approx(of_lidar.rpe_rotation_mean) == pytest.approx(np.pi / 4)


def test_the_plane_is_that_of_the_body_and_not_of_a_lidar_that_looks_down() -> None:
    """A robot that goes 2 m ahead and is taken to go 3 m is 1 m off in its plane, and cos(60 deg) m in that of its LiDAR."""
    T_base_lidar = se3.make(turned(1, 60.0), np.array([0.4, 0.0, 1.2]))
    calibration = Calibration(frames={"base_link": se3.inverse(T_base_lidar)})

    def seen(metres: float) -> Trajectory:
        robot = np.tile(np.eye(4), (3, 1, 1))
        robot[:, 0, 3] = [0.0, 1.0, metres]
        return Trajectory(np.arange(3) * 10**8, se3.inverse(T_base_lidar) @ robot @ T_base_lidar, frame="lidar")

    lidar = evaluate(seen(3.0), seen(2.0), EvalConfig(align=("origin",)), calibration=calibration)
    base = evaluate(seen(3.0), seen(2.0), BASE, calibration=calibration)
    assert 3 * lidar.scores["thesis2"].ate_mean == pytest.approx(0.5)
    assert 3 * base.scores["thesis2"].ate_mean == pytest.approx(1.0)


def test_the_world_of_the_earth_stays_where_it_is() -> None:
    T_lidar_base = se3.make(turned(1, 20.0), np.array([-1.0, 0.2, -1.5]))
    on_earth = se3.make(turned(2, 50.0), np.array([100.0, 200.0, 3.0])) @ drive(5).poses
    np.testing.assert_allclose(carry(on_earth, T_lidar_base)[2], on_earth[2] @ T_lidar_base)
    moved = carry(drive(5).poses, T_lidar_base, is_world_of_body=True)
    np.testing.assert_allclose(moved[0], np.eye(4), atol=1e-12)


def test_whoever_holds_the_poses_the_body_is_scored_alike(truth: Trajectory, estimate: Trajectory) -> None:
    T_lidar_base = se3.make(turned(2, 10.0), np.array([-1.4, 0.3, -1.7]))
    T_cam0, T_lidar_imu = kitti_like_cam0(), se3.make(turned(0, 5.0), np.array([0.1, -0.2, 0.3]))
    calibration = Calibration(T_cam0, T_lidar_imu, frames={"base_link": T_lidar_base})

    def camera(t: Trajectory) -> Trajectory:
        return replace(t, poses=T_cam0 @ t.poses @ se3.inverse(T_cam0), frame="cam0")

    def imu(t: Trajectory) -> Trajectory:
        return replace(t, poses=t.poses @ T_lidar_imu, frame="imu")

    def score(a: Trajectory, b: Trajectory) -> float:
        return evaluate(a, b, BASE, calibration=calibration).scores["thesis2"].ate_mean

    expected = score(estimate, truth)
    assert expected > 0.01
    assert score(estimate, camera(truth)) == pytest.approx(expected)
    assert score(camera(estimate), camera(truth)) == pytest.approx(expected)
    assert score(imu(estimate), imu(truth)) == pytest.approx(expected)


def test_frames_that_nobody_placed_and_positions_alone_are_refused(truth: Trajectory) -> None:
    with pytest.raises(InputError, match=r"nothing says where frame base_link sits \(known: lidar\)"):
        evaluate(disturb(truth), truth, BASE)
    calibration = Calibration(frames={"base_link": np.eye(4)})
    with pytest.raises(InputError, match="poses of base_link need rotations of both"):
        evaluate(disturb(truth), replace(truth, has_rotations=False), BASE, calibration=calibration)
