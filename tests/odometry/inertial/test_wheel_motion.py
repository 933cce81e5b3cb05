"""Wheels as motion model, fed with true poses in the place of registration: what they predict, learn, and are not believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import WheelStream
from lslam.core.types.scan import Span
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.odometry.inertial.wheel_calibration import OFFSET_S, YAW_OFFSET, YAW_SCALE, WheelCalibration, learn_noise
from lslam.odometry.inertial.wheel_motion import WheelMotion
from lslam.registration.result import RegistrationResult

T_LIDAR_BASE = se3.make(so3.from_euler_rpy(np.radians([1.0, 2.0, 90.0])), np.array([-0.4, 0.9, -1.7]))
STEP_NS = 100_000_000
SIGMAS = np.repeat([0.003, 0.0003], 3)
COVARIANCE = np.diag(SIGMAS**2)


def speed_at(t: Floats) -> Floats:
    return np.asarray(9.0 + 3.0 * np.sin(0.4 * t) + 1.5 * np.sin(1.1 * t))


def rate_at(t: Floats) -> Floats:
    return np.asarray(0.25 * np.sin(0.5 * t) + 0.1 * np.cos(1.3 * t))


def truth(seconds: float) -> tuple[Longs, Floats]:
    """Stamps (N,) of scans, and poses (N, 4, 4) of a LiDAR on a car that drives in the plane, in its world at the first."""
    fine = np.arange(0.0, seconds + 1.0, 0.001)
    turn = np.append(0.0, np.cumsum(0.0005 * (rate_at(fine[1:]) + rate_at(fine[:-1]))))
    place = np.cumsum(0.001 * speed_at(fine)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]), axis=0)
    at = np.arange(0, round(1000 * seconds), 100)
    poses = se3.make(so3.exp(turn[at, None] * [0.0, 0.0, 1.0]), np.column_stack([place[at], np.zeros(len(at))]))
    return at * 1_000_000, se3.relative(poses[0] @ se3.inverse(T_LIDAR_BASE), poses @ se3.inverse(T_LIDAR_BASE))


def readings(seconds: float, late_s: float = 0.0, scale: float = 1.0) -> WheelStream:
    stamps = np.arange(-500, round(1000 * seconds) + 500, 20) * 1_000_000
    rng = np.random.default_rng(1)
    t = 1e-9 * stamps - late_s
    speed = scale * speed_at(t) + rng.normal(0, 0.01, len(t))
    return WheelStream(stamps, speed, 1.03 * rate_at(t) + 0.01 + rng.normal(0, 0.001, len(t)), T_LIDAR_BASE)


def drive(
    motion: ConstantVelocity, stamps: Longs, poses: Floats, is_open: slice = slice(0), seed: int = 3
) -> tuple[Floats, Floats]:
    """Errors of predictions, m (N,), and poses (N, 4, 4) of scans that are registered within `COVARIANCE`.

    is_open : those of which surfaces do not hold the direction of travel, y of this LiDAR, which stays as predicted
    """
    rng, errors, found = np.random.default_rng(seed), [], []
    opened = set(range(len(stamps))[is_open])
    for k, (stamp, true) in enumerate(zip(stamps.tolist(), poses, strict=True)):
        prior = motion.sweep(stamp, Span())
        errors.append(float(np.linalg.norm(se3.relative(prior.pose, true)[:3, 3])))
        d = SIGMAS * rng.standard_normal(6)
        pose = se3.make(so3.exp(d[3:]) @ true[:3, :3], true[:3, 3] + d[:3])
        result = RegistrationResult(pose, covariance=COVARIANCE)
        if k in opened:
            forward = pose[:3, :3] @ T_LIDAR_BASE[:3, 0]
            pose = pose.copy()
            pose[:3, 3] += forward * (forward @ (prior.pose[:3, 3] - pose[:3, 3]))
            C = COVARIANCE.copy()
            C[:3, :3] += np.outer(forward, forward)
            result = replace(result, T_world_lidar=pose, covariance=C, degenerate=np.append(forward, np.zeros(3))[None])
        fused = motion.fuse(stamp, result, prior)
        motion.correct(stamp, fused.T_world_lidar, prior, fused.is_accepted)
        found.append(fused.T_world_lidar)
    return np.array(errors), np.stack(found)


@pytest.mark.parametrize("rate", [0.6, 0.0, -0.3])
def test_a_steady_turn_is_an_arc_about_the_axle(rate: float) -> None:
    stamps = np.arange(100) * 20_000_000
    wheels = WheelStream(stamps, np.full(100, 4.0), np.full(100, rate), T_LIDAR_BASE)
    step = WheelCalibration.of(wheels).step(wheels, 300_000_000, 1_250_000_000, 0.0)
    axle = se3.exp(0.95 * np.array([4.0, 0.0, 0.0, 0.0, 0.0, rate]))
    np.testing.assert_allclose(step.pose, T_LIDAR_BASE @ axle @ se3.inverse(T_LIDAR_BASE), atol=2e-4)
    assert step.way == pytest.approx(3.8)


def test_the_jacobian_is_that_of_the_step() -> None:
    wheels = readings(10.0)
    calibration = WheelCalibration.of(wheels)

    def step_of(states: Floats) -> Floats:
        pose = replace(calibration, states=states).step(wheels, 4_000_000_000, 4_500_000_000, 0.0).pose
        return np.append(pose[:3, 3], so3.log(pose[:3, :3]) @ calibration.up)

    jacobian = calibration.step(wheels, 4_000_000_000, 4_500_000_000, 0.0).jacobian
    for k, h in enumerate([1e-4] * 8 + [2e-3]):
        change = np.zeros(9)
        change[k] = h
        numeric = (step_of(calibration.states + change) - step_of(calibration.states - change)) / (2 * h)
        # Headings on the way are taken as half of the last.
        np.testing.assert_allclose(jacobian[:, k], numeric, atol=0.08 if k > 5 else 1e-6)


def noise_after(squares: Floats, known: float) -> float:
    noise, counts = np.array([1e-4]), np.ones(1)
    for square in squares:
        noise, counts = learn_noise(noise, counts, np.array([square]), np.array([known]), np.ones(1), np.array([1e-8]))
    return float(noise[0])


def test_noise_is_learnt_by_the_median_of_what_surfaces_tell() -> None:
    normal = np.random.default_rng(0).standard_normal(2000)
    assert noise_after((0.02 * normal) ** 2, 0.0) == pytest.approx(4e-4, rel=0.5)
    slipping = np.where(np.arange(2000) % 20 < 1, 1.0, (0.02 * normal) ** 2)
    assert noise_after(slipping, 0.0) == pytest.approx(4e-4, rel=0.6)
    assert noise_after((0.02 * normal) ** 2, 100.0) == pytest.approx(1e-4, rel=0.01)
    assert noise_after(np.full(200, 1.0), 0.01) > 0.01


def test_scale_offsets_and_latency_are_found() -> None:
    stamps, poses = truth(40.0)
    motion = WheelMotion(readings(40.0, late_s=0.05, scale=1.04))
    drive(motion, stamps, poses)
    scale, sigma = motion.calibration.scale
    assert scale == pytest.approx(1 / 1.04, abs=max(3 * sigma, 0.002))
    states = motion.calibration.states
    assert states[YAW_SCALE] == pytest.approx(1 / 1.03, abs=0.01)
    assert states[YAW_OFFSET] == pytest.approx(0.01 / 1.03, abs=0.001)
    assert states[OFFSET_S] == pytest.approx(-0.05, abs=0.01)


def test_they_predict_changes_of_speed_that_constant_velocity_does_not() -> None:
    stamps, poses = truth(40.0)
    own, _ = drive(WheelMotion(readings(40.0, scale=1.04)), stamps[::3], poses[::3])
    steady, _ = drive(ConstantVelocity(), stamps[::3], poses[::3])
    assert np.median(own[20:]) < 0.4 * np.median(steady[20:])


def test_they_carry_through_where_the_way_is_open() -> None:
    stamps, poses = truth(40.0)
    through = slice(150, 400)
    _, own = drive(WheelMotion(readings(40.0, scale=1.04)), stamps, poses, through)
    _, steady = drive(ConstantVelocity(), stamps, poses, through)
    way = np.linalg.norm(np.diff(poses[through, :3, 3], axis=0), axis=1).sum()
    off, lost = (np.linalg.norm(found[-1, :3, 3] - poses[-1, :3, 3]) for found in (own, steady))
    assert off < 0.006 * way
    assert lost > 5 * off


def test_what_is_open_teaches_no_scale() -> None:
    stamps, poses = truth(30.0)
    motion = WheelMotion(readings(30.0, scale=1.04))
    drive(motion, stamps, poses, slice(0, 300))
    scale, sigma = motion.calibration.scale
    assert scale == pytest.approx(1.0, abs=0.003)
    assert sigma > 0.04


def test_slip_is_not_followed() -> None:
    stamps, poses = truth(12.0)
    wheels = readings(12.0)
    spins = (wheels.stamps_ns > 10_000_000_000) & (wheels.stamps_ns <= 10_400_000_000)
    slipping = replace(wheels, speed=wheels.speed + 6.0 * spins)
    through = slice(95, 115)
    (_, found), (_, clean) = (drive(WheelMotion(w), stamps, poses, through) for w in (slipping, wheels))
    moved = np.linalg.norm(found[114, :3, 3] - clean[114, :3, 3])
    assert moved < 0.1 * 6.0 * 0.4


def test_wheels_of_another_robot_get_no_weight() -> None:
    stamps, poses = truth(30.0)
    wheels = readings(30.0)
    assert wheels.yaw_rate is not None
    other = replace(wheels, speed=wheels.speed[::-1] / 0.3048, yaw_rate=-3 * wheels.yaw_rate)
    motion, alone = WheelMotion(other), ConstantVelocity()
    (errors, found), (steady, without) = (drive(one, stamps, poses) for one in (motion, alone))
    assert "are they this robot's" in motion.refusal
    np.testing.assert_allclose(np.median(errors[40:]), np.median(steady[40:]), rtol=0.2)
    off, usual = (float(np.sqrt(np.mean((p[40:, :3, 3] - poses[40:, :3, 3]) ** 2))) for p in (found, without))
    assert off < 1.1 * usual
    own, constant = motion.errors.medians or (0.0, 0.0)
    assert own > 5 * constant


def test_a_registration_that_both_deny_is_bridged_and_one_that_insists_is_not() -> None:
    stamps, poses = truth(10.0)
    motion = WheelMotion(readings(10.0))
    drive(motion, stamps[:80], poses[:80])
    accepted = []
    for k in (80, 81):
        prior = motion.sweep(int(stamps[k]), Span())
        wrong = poses[k] @ se3.make(np.eye(3), 0.6 * T_LIDAR_BASE[:3, 0])
        fused = motion.fuse(int(stamps[k]), RegistrationResult(wrong, covariance=COVARIANCE), prior)
        accepted.append(fused.is_accepted)
        if not fused.is_accepted:
            assert "from what the wheels told" in fused.reason
            assert np.linalg.norm(se3.relative(fused.T_world_lidar, poses[k])[:3, 3]) < 0.05
            assert fused.covariance is not None
            assert np.sqrt(np.diag(fused.covariance)).max() < 0.1
        motion.correct(int(stamps[k]), fused.T_world_lidar, prior, fused.is_accepted)
    assert accepted == [False, True]


def test_where_nothing_places_them_direction_and_arm_are_found() -> None:
    stamps, poses = truth(40.0)
    motion = WheelMotion(replace(readings(40.0), T_lidar_base=None))
    errors, _ = drive(motion, stamps, poses)
    np.testing.assert_allclose(motion.calibration.direction, T_LIDAR_BASE[:3, 0], atol=0.03)
    assert np.median(errors[100:]) < 0.02


def test_a_pause_is_constant_velocitys() -> None:
    stamps, poses = truth(12.0)
    wheels = readings(12.0)
    keep = (wheels.stamps_ns < 6_000_000_000) | (wheels.stamps_ns > 9_000_000_000)
    assert wheels.yaw_rate is not None
    motion = WheelMotion(WheelStream(wheels.stamps_ns[keep], wheels.speed[keep], wheels.yaw_rate[keep], T_LIDAR_BASE))
    drive(motion, stamps[:75], poses[:75])
    prior = motion.sweep(int(stamps[75]), Span())
    np.testing.assert_array_equal(prior.pose, motion.predict(int(stamps[75])))
    assert motion.gap_scans > 10


def test_without_a_yaw_rate_the_turn_is_that_of_constant_velocity() -> None:
    stamps, poses = truth(30.0)
    motion = WheelMotion(replace(readings(30.0, scale=1.04), yaw_rate=None))
    drive(motion, stamps[:250], poses[:250])
    prior, steady = motion.sweep(int(stamps[250]), Span()).pose, motion.predict(int(stamps[250]))
    turned = so3.log(prior[:3, :3].T @ steady[:3, :3])
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)
    assert motion.calibration.scale[0] == pytest.approx(1 / 1.04, abs=0.003)


def test_restored_it_goes_on_as_if_nothing_had_been() -> None:
    stamps, poses = truth(20.0)
    wheels = readings(20.0)
    whole = WheelMotion(wheels)
    drive(whole, stamps[:100], poses[:100])
    other = WheelMotion(wheels)
    other.restore(whole.state())
    _, a = drive(whole, stamps[100:], poses[100:], seed=5)
    _, b = drive(other, stamps[100:], poses[100:], seed=5)
    np.testing.assert_array_equal(a, b)


def test_a_new_map_begins_with_what_was_learnt() -> None:
    stamps, poses = truth(20.0)
    motion = WheelMotion(readings(20.0, scale=1.04))
    drive(motion, stamps, poses)
    fresh = motion.fresh(poses[7])
    assert fresh.calibration is motion.calibration
    np.testing.assert_array_equal(fresh.sweep(int(stamps[7]), Span()).pose, poses[7])
