"""The window of states and planes: derivatives, exact marginalisation, and which plane is which landmark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic_scenes import random_pose

from lslam.core.geometry import se3
from lslam.core.types.imu import MotionState, PreintegratedStep
from lslam.odometry import plane_window
from lslam.odometry.plane_factors import SHARED, STATE_SIZE, sighting_residuals, step_residual
from lslam.odometry.plane_segmentation import Planes, transform_planes
from lslam.odometry.plane_window import PlaneWindow, associate

# A room round the way, in the world.
WALLS = np.array([[0, 0, -1.7], [12, 0, 0.1], [-8, 0.3, 0], [0, 7, 0], [0.2, -6, 0]])
T_IMU_LIDAR = se3.make(np.eye(3), np.array([0.1, 0.0, 0.3]))
GRAVITY = np.array([0.0, 0.0, -9.8])


def state_of(rng: np.random.Generator) -> MotionState:
    sigmas = np.repeat([1e-3, 1e-3, 0.1, 0.05, 0.05, 1e-3, 0.01, 0.01, 0.01], 3)
    return MotionState(
        np.eye(4), np.array([1.0, 0.0, 0.0]), GRAVITY, 0.01 * rng.normal(size=3), 1e-3 * rng.normal(size=3), np.eye(3),
        np.diag(sigmas**2),
    )  # fmt: skip


def step_of(rng: np.random.Generator, t: float = 0.1) -> PreintegratedStep:
    """So many seconds straight on, as an IMU feels it that stands upright, roughly."""
    arms = t * np.eye(3), 0.5 * t**2 * np.eye(3)
    C = np.diag(np.repeat([3e-3, 1e-3, 0.02, 1e-3, 1e-4], 3) ** 2)
    rotation = random_pose(rng, 0, 0.05)[:3, :3]
    columns = t * np.concatenate([np.eye(3), 0.1 * rng.normal(size=(3, 9))], axis=1)
    return PreintegratedStep(
        t, rotation, -t * GRAVITY, -0.5 * t**2 * GRAVITY, *arms, columns, *np.zeros((2, 3)), np.eye(3), C
    )


def seen_planes(T_world_lidar: np.ndarray, rng: np.random.Generator) -> Planes:
    """The room's walls from a LiDAR, with noise."""
    count = len(WALLS)
    C = np.broadcast_to(1e-4 * np.eye(3), (count, 3, 3)).copy()
    cp = transform_planes(WALLS, T_world_lidar) + 0.01 * rng.normal(size=(count, 3))
    none = np.zeros(count)
    return Planes(cp, C, none + 100, cp, np.zeros((count, 3, 3)), none, cp - 2, cp + 2)


def added(window: PlaneWindow, planes: Planes) -> PlaneWindow:
    information = np.linalg.inv(planes.covariance)
    if len(window.landmarks) == 0:
        return window.with_planes(planes.cp, information, planes.lows, planes.highs)
    return window.with_sightings(np.arange(len(planes)), planes.cp, information, planes.lows, planes.highs)


def driven(count: int, seed: int = 0) -> PlaneWindow:
    """So many states, nothing marginalised."""
    rng = np.random.default_rng(seed)
    window = PlaneWindow.begin(state_of(rng), T_IMU_LIDAR)
    for k in range(count):
        true = se3.make(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) @ T_IMU_LIDAR
        window = window.extend(step_of(rng)) if k else window
        solution, _ = added(window, seen_planes(true, rng)).solve()
        assert solution is not None
        window = solution
    return window


def test_derivatives_of_the_factors_are_those_of_differences() -> None:
    window, rng = driven(2), np.random.default_rng(1)
    values = window.values.retract(0.02 * rng.normal(size=window.values.size))
    # Rotations enter by their logarithm, whose derivative is the identity at zero: biases as they are, the end turned to it.
    felt = {"gyro_bias": values.gyro_biases[0], "gyro_axes": values.axes}
    step, h = replace(step_of(rng, 1.0), accel_bias=np.full(3, 0.1), **felt), 1e-6
    turn = np.zeros(values.size)
    turn[SHARED + STATE_SIZE + 3 : SHARED + STATE_SIZE + 6] = -step_residual(values, 0, step)[0][3:6]
    values = values.retract(turn)
    r, J = step_residual(values, 0, step)
    np.testing.assert_allclose(r[3:6], 0.0, atol=1e-12)
    assert np.linalg.norm(r[:3]) > 0.1
    seen = window.sightings.only(window.sightings.states == 1)
    s, by_pose, by_plane = sighting_residuals(values, seen, window.landmarks.anchors, T_IMU_LIDAR)
    for k in range(SHARED + 2 * STATE_SIZE):
        d = np.zeros(values.size)
        d[k] = h
        moved = values.retract(d)
        np.testing.assert_allclose((step_residual(moved, 0, step)[0] - r) / h, J[:, k], atol=1e-4)
        own = k - SHARED - STATE_SIZE
        if 0 <= own < 6:
            other = sighting_residuals(moved, seen, window.landmarks.anchors, T_IMU_LIDAR)[0]
            np.testing.assert_allclose((other - s) / h, by_pose[:, :, own], atol=1e-3)
    for k in range(3):
        d = np.zeros(values.size)
        d[values.first_plane + k :: 3] = h
        other = sighting_residuals(values.retract(d), seen, window.landmarks.anchors, T_IMU_LIDAR)[0]
        np.testing.assert_allclose((other - s) / h, by_plane[:, :, k], atol=1e-3)


def test_an_extended_window_has_a_state_where_the_step_leads() -> None:
    window = driven(1).extend(step_of(np.random.default_rng(5)))
    r, _ = step_residual(window.values, 0, window.steps[0])
    np.testing.assert_allclose(r, 0.0, atol=1e-5)


def test_marginalising_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Newest state and covariance are those of the whole; a plane that is left out leaves its information, too."""
    whole = driven(4)
    monkeypatch.setattr(plane_window, "LAG_SCANS", 2)
    few = whole.marginalise()
    assert few.values.states == 2
    np.testing.assert_allclose(few.joint_covariance(), whole.joint_covariance(), rtol=1e-5, atol=1e-12)
    again, _ = few.solve()
    assert again is not None
    np.testing.assert_allclose(again.values.poses[-1], whole.values.poses[-1], atol=2e-4)
    unseen = few.landmarks.unseen.copy()
    unseen[2] = plane_window.UNSEEN_SCANS
    kept = few.sightings.only(few.sightings.planes != 2)
    one_less = replace(few, landmarks=replace(few.landmarks, unseen=unseen), sightings=kept)
    assert len(one_less.marginalise().landmarks) == len(WALLS) - 1
    state = slice(0, 27)
    np.testing.assert_allclose(
        one_less.marginalise().joint_covariance()[state, state], one_less.joint_covariance()[state, state], rtol=1e-5,
        atol=1e-12,
    )  # fmt: skip


def test_the_path_through_a_room_is_within_its_covariance() -> None:
    squares = []
    for seed in range(12):
        window = driven(8, seed)
        off = window.values.poses[-1, :3, 3] - [0.7, 0.0, 0.0]
        squares.append(off @ np.linalg.solve(window.joint_covariance()[SHARED : SHARED + 3, SHARED : SHARED + 3], off))
        assert np.linalg.norm(off) < 0.05
    assert 0.3 < np.mean(squares) / 3 < 2.0


def test_planes_are_associated_with_their_landmarks_and_others_with_none() -> None:
    rng = np.random.default_rng(3)
    window = driven(3).extend(step_of(rng))
    planes = seen_planes(window.T_world_lidar, rng)
    np.testing.assert_array_equal(associate(window, planes, window.joint_covariance()), np.arange(len(WALLS)))
    # 0.3 m deeper, leaning by 5 deg, or in another part of the wall's plane: another surface.
    turned = planes.cp @ random_pose(rng, 0, 5)[:3, :3].T
    away = replace(planes, lows=planes.lows + 60, highs=planes.highs + 60)
    for other in (replace(planes, cp=planes.cp * (1 + 0.3 / 1.7)), replace(planes, cp=turned), away):
        assert (associate(window, other, window.joint_covariance()) < 0).sum() >= 4
