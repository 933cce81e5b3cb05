"""The smoother of LIO-SAM against known motion: velocity, biases and gravity, its covariance, its reset, and its bytes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.backend.graph.inertial_smoother import InertialSmoother
from lslam.core.errors import GraphError
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import InertialState, InertialStep, SmootherNoise
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry.frontend.checkpoints import STATE_CLASSES

Floats = NDArray[np.float64]

NOISE = SmootherNoise(force=0.02, accel_walk=1e-4, gyro_walk=1e-6, gravity_walk=1e-4)
GRAVITY = np.array([0.0, 0.0, -9.81])
ACCEL_BIAS, GYRO_BIAS = np.array([0.05, -0.08, 0.03]), np.array([0.004, -0.002, 0.003])
PLACE, TURN, RATE, DT, READINGS = 0.003, 5e-4, 1e-3, 0.005, 20
# Position, rotation, velocity, biases, gravity: one sigma of the prior.
SIGMAS = np.repeat([1e-4, 1e-4, 0.3, 0.1, 0.01, 0.05], 3)


def truth_at(t: float) -> tuple[Floats, Floats]:
    """Pose (4, 4) and velocity (3,) of an IMU on a curve that climbs, sways and rolls."""
    p = np.array([2 * t, np.sin(1.3 * t), 0.3 * np.cos(0.9 * t)])
    v = np.array([2.0, 1.3 * np.cos(1.3 * t), -0.27 * np.sin(0.9 * t)])
    return se3.make(so3.exp(attitude(t)), p), v


def attitude(t: float) -> Floats:
    return np.array([0.2 * np.sin(0.7 * t), 0.1 * np.sin(1.1 * t), 0.5 * np.sin(0.6 * t)])


def readings(t: float) -> tuple[Floats, Floats]:
    """Specific force and rate in IMU axes, by differences of the curve."""
    h = 1e-4
    R = so3.exp(attitude(t))
    rate = so3.log(R.T @ so3.exp(attitude(t + h))) / h
    a = (truth_at(t + h)[1] - truth_at(t - h)[1]) / (2 * h)
    return R.T @ (a - GRAVITY), np.asarray(rate)


def steps(count: int, seed: int = 0) -> list[InertialStep]:
    """Noisy readings of an IMU with biases, and noisy poses, a tenth of a second each."""
    rng = np.random.default_rng(seed)
    made = []
    C = np.diag(np.repeat([PLACE**2, TURN**2], 3))
    for k in range(count):
        at = 0.1 * k + DT * (np.arange(READINGS) + 0.5)
        clean = [readings(float(t)) for t in at]
        accel = (
            np.stack([f for f, _ in clean]) + ACCEL_BIAS + NOISE.force / np.sqrt(DT) * rng.normal(size=(READINGS, 3))
        )
        rates = np.stack([w for _, w in clean]) + GYRO_BIAS + RATE / np.sqrt(DT) * rng.normal(size=(READINGS, 3))
        T, _ = truth_at(0.1 * (k + 1))
        seen = se3.make(so3.exp(TURN * rng.normal(size=3)) @ T[:3, :3], T[:3, 3] + PLACE * rng.normal(size=3))
        made.append(InertialStep(np.full(READINGS, DT), accel, rates, RATE**2 * np.eye(3), seen, C))
    return made


def begun(seed: int = 0, reset: int = 100) -> InertialSmoother:
    """A smoother that begins as far from the truth as its prior says."""
    off = SIGMAS * np.random.default_rng(1000 + seed).normal(size=18)
    T, v = truth_at(0.0)
    smoother = InertialSmoother(NOISE, reset)
    smoother.begin(
        InertialState(
            se3.make(so3.exp(off[3:6]) @ T[:3, :3], T[:3, 3] + off[:3]), v + off[6:9], ACCEL_BIAS + off[9:12],
            GYRO_BIAS + off[12:15], GRAVITY + off[15:], np.diag(SIGMAS**2),
        )
    )  # fmt: skip
    return smoother


def error_of(found: InertialState, k: int) -> Floats:
    """(18,) of the state after k steps against the truth, as its covariance counts it."""
    T, v = truth_at(0.1 * k)
    return np.concatenate([
        found.T_world_imu[:3, 3] - T[:3, 3], so3.log(found.T_world_imu[:3, :3] @ T[:3, :3].T), found.velocity - v,
        found.accel_bias - ACCEL_BIAS, found.gyro_bias - GYRO_BIAS, found.gravity - GRAVITY,
    ])  # fmt: skip


def test_errors_are_within_the_covariance_and_smaller_than_those_of_the_poses() -> None:
    squares, places = [], []
    for seed in range(6):
        smoother = begun(seed)
        found = [smoother.add(step) for step in steps(25, seed)]
        e = error_of(found[-1], 25)
        squares.append(e @ np.linalg.solve(found[-1].covariance, e))
        places += [error_of(state, k + 1)[:3] for k, state in enumerate(found) if k >= 5]
    # Chi square of 18 degrees of freedom, six times: 108, with a deviation of 15.
    assert 70 < sum(squares) < 160
    assert np.sqrt(np.mean(np.square(places))) < 0.8 * PLACE


def test_a_step_without_a_pose_is_predicted_by_the_imu() -> None:
    made = steps(25)
    smoother = begun()
    for step in made[:20]:
        sure = smoother.add(step)
    for step in made[20:]:
        carried = smoother.add(replace(step, T_world_imu=None, covariance=None))
    assert np.linalg.norm(error_of(carried, 25)[:3]) < 0.03
    assert np.trace(carried.covariance[:3, :3]) > 2 * np.trace(sure.covariance[:3, :3])


def test_a_restarted_graph_keeps_the_joint_marginal() -> None:
    """Only its linearisation is fixed: the joint marginal loses nothing, which marginals of single variables do."""
    made = steps(30)
    whole, often = begun(reset=100), begun(reset=7)
    for step in made:
        one, other = whole.add(step), often.add(step)
    sigmas = np.sqrt(np.diag(one.covariance))
    assert (np.abs(error_of(one, 30) - error_of(other, 30)) < 0.2 * sigmas).all()
    np.testing.assert_allclose(np.sqrt(np.diag(other.covariance)), sigmas, rtol=0.05)


def assert_same(a: InertialState, b: InertialState) -> None:
    for name in ("T_world_imu", "velocity", "accel_bias", "gyro_bias", "gravity", "covariance"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("at", [3, 8])
def test_the_smoother_resumes_to_the_last_bit(at: int, tmp_path: Path) -> None:
    made = steps(12)
    made[2] = replace(made[2], T_world_imu=None, covariance=None)
    whole = begun(reset=5)
    for k, step in enumerate(made):
        if k == at:
            write_state(tmp_path / "s.npz", whole.state())
        expected = whole.add(step)
    again = InertialSmoother(NOISE, 5)
    again.restore(read_state(tmp_path / "s.npz", STATE_CLASSES))
    for step in made[at:]:
        found = again.add(step)
    assert_same(found, expected)


def test_what_is_withdrawn_leaves_no_trace() -> None:
    made = steps(9)
    plain, tried = begun(reset=5), begun(reset=5)
    for k, step in enumerate(made):
        if k in (4, 5, 8):
            tried.add(replace(step, T_world_imu=np.eye(4)))
            tried.withdraw()
        assert_same(plain.add(step), tried.add(step))


def test_an_unsolvable_graph_raises_an_error() -> None:
    step = steps(1)[0]
    with pytest.raises(GraphError, match="smoother"):
        begun().add(replace(step, accel=np.full_like(step.accel, np.nan)))
