"""The IMU as motion model, fed with true poses in registration's place: what it predicts, and when it steps back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from imu_drives import drone, extrinsics_of, stream_of, truth_of, walk
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.core.types.scan import Span
from lslam.odometry.inertial.constant_velocity import ConstantVelocity, MotionModel
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.initialise import FirstPoses, start
from lslam.simulation.scenarios import SimulatedDrive

Floats = NDArray[np.float64]
SPAN = Span(0.0, 0.1)


def motion_of(
    drive: SimulatedDrive, imu: ImuStream | None = None, T: Floats | None = None, **keys: object
) -> InertialMotion:
    stamps, poses = truth_of(drive, 50)
    config = ImuConfig.model_validate(keys)
    T = extrinsics_of(drive) if T is None else T
    begun = start(
        stream_of(drive),
        extrinsics_of(drive),
        FirstPoses(stamps, poses, stamps, poses),
        int(drive.stamps_ns[-1]),
        config,
    )
    begun = dataclasses.replace(begun, imu=begun.imu if imu is None else imu, T_lidar_imu=T)
    return InertialMotion(begun, Config(imu=config))


def imu_until(imu: ImuStream, end_ns: int) -> ImuStream:
    keep = imu.stamps_ns <= end_ns
    return ImuStream(imu.stamps_ns[keep], imu.accel[keep], imu.gyro[keep])


def errors(
    motion: MotionModel, drive: SimulatedDrive, failed: range = range(0), every: int = 1, span: Span = SPAN
) -> tuple[Floats, Floats]:
    """Error of each prediction, m and rad, (N, 2), and of the turn predicted within each sweep, rad (N,)."""
    stamps, poses = (values[::every] for values in truth_of(drive))
    start_pose = np.linalg.inv(drive.city_poses[0])
    predicted, within = [], []
    for k, (stamp, true) in enumerate(zip(stamps, poses, strict=True)):
        prior = motion.sweep(int(stamp), span)
        delta = se3.relative(prior.pose, true)
        predicted.append((np.linalg.norm(delta[:3, 3]), so3.angle(delta[:3, :3])))
        if len(prior.times) > 1:
            begin, end = start_pose @ drive.vehicle.poses(np.maximum(stamp * 1e-9 + prior.times[[0, -1]], 0.0))
            moved = se3.relative(prior.poses[0], prior.poses[-1])
            within.append(so3.angle(se3.relative(moved, se3.relative(begin, end))[:3, :3]))
        ok = k not in failed
        motion.correct(int(stamp), true if ok else prior.pose, prior, ok)
    return np.array(predicted), np.array(within)


@pytest.mark.parametrize("make", [walk, drone])
def test_imu_prediction_is_better_than_constant_velocity(make: object) -> None:
    """Biases of 5 deg/s and axes that feel each other by 2 % included."""
    drive: SimulatedDrive = make()  # type: ignore[operator]
    own, own_sweep = errors(motion_of(drive), drive)
    steady, steady_sweep = errors(ConstantVelocity(), drive)
    gain = np.sqrt(np.mean(steady[10:] ** 2, axis=0) / np.mean(own[10:] ** 2, axis=0))
    assert gain[0] > 1.2
    assert gain[1] > 4
    assert np.median(own_sweep[10:]) < 0.3 * np.median(steady_sweep[10:])
    assert own[1, 0] < 0.02, "the speed is known from the first scan on"


@pytest.mark.parametrize("make", [walk, drone])
def test_imu_prediction_holds_for_sweeps_around_their_stamps(make: Callable[[], SimulatedDrive]) -> None:
    """Half of each sweep lies before the last pose's next stamp: none of it is felt twice, or not at all."""
    drive = make()
    begun, _ = errors(motion_of(drive), drive)
    motion = motion_of(drive)
    about, within = errors(motion, drive, span=Span(-0.05, 0.05))
    steady, steady_within = errors(ConstantVelocity(), drive, span=Span(-0.05, 0.05))
    rms = [np.sqrt(np.mean(e[10:] ** 2, axis=0)) for e in (begun, about, steady)]
    assert (rms[1] < 1.3 * rms[0]).all()
    assert (rms[1] < rms[2] / [1.2, 4]).all()
    assert np.median(within[10:]) < 0.3 * np.median(steady_within[10:])
    # The first sweep began before the IMU did; the last ends after it may have.
    assert motion.gap_scans <= 2


def test_a_motion_corrected_by_a_false_standstill_fails_the_gate() -> None:
    """The sentinel: an IMU that is told nothing moves is far off."""
    drive = drone()
    motion = motion_of(drive)
    stamps, poses = truth_of(drive)
    off = []
    for stamp, true in zip(stamps, poses, strict=True):
        off.append(np.linalg.norm(motion.sweep(int(stamp), Span()).pose[:3, 3] - true[:3, 3]))
        motion.correct(int(stamp), np.eye(4))
    assert np.median(off) > 10.0


def test_a_repeated_first_correction_counts_once() -> None:
    drive = drone()
    stamps, poses = truth_of(drive, 2)
    learnt = []
    for is_seen in (True, False):
        motion = motion_of(drive)
        motion.correct(int(stamps[0]), poses[0])
        if is_seen:
            motion.correct(int(stamps[1]), poses[1])
        motion.rewind(int(stamps[0]), poses[0], Span())
        motion.correct(int(stamps[1]), poses[1])
        learnt.append(motion.estimate)
    twice, once = learnt
    for values in ("velocity", "gravity", "accel_bias", "covariance"):
        np.testing.assert_array_equal(getattr(twice, values), getattr(once, values))
    np.testing.assert_array_equal(twice.gyroscope.bias, once.gyroscope.bias)


def test_half_a_second_without_registration_is_bridged_by_the_imu() -> None:
    """Half a second without registration: the walker is lost by constant velocity, not by the IMU."""
    drive = walk()
    failed = range(60, 65)
    own, _ = errors(motion_of(drive), drive, failed)
    steady, _ = errors(ConstantVelocity(), drive, failed)
    assert own[64, 0] < 0.05
    assert own[64, 1] < np.deg2rad(1.0)
    assert steady[64, 1] > 5 * own[64, 1]
    assert own[66:].mean(axis=0)[0] < 0.02, "and it goes on as before"


def test_two_seconds_between_scans_are_bridged_by_the_imu() -> None:
    drive = drone()
    own, _ = errors(motion_of(drive), drive, every=20)
    assert len(own) == 4
    assert own[:, 0].max() < 1.0
    assert own[:, 1].max() < np.deg2rad(3)


def motion_over_a_gap(drive: SimulatedDrive, last_ns: int, next_ns: int) -> InertialMotion:
    """With an IMU that is silent from `last_ns` to `next_ns`."""
    imu = stream_of(drive)
    keep = (imu.stamps_ns < last_ns) | (imu.stamps_ns > next_ns)
    return motion_of(drive, ImuStream(imu.stamps_ns[keep], imu.accel[keep], imu.gyro[keep]))


def test_gaps_fall_back_to_constant_velocity_and_are_counted() -> None:
    drive = walk()
    motion = motion_over_a_gap(drive, 6_020_000_000, 6_310_000_000)
    own, _ = errors(motion, drive)
    whole, _ = errors(motion_of(drive), drive)
    steady, _ = errors(ConstantVelocity(), drive)
    assert 3 <= motion.gap_scans <= 5
    assert not motion.refusal
    np.testing.assert_array_equal(own[:60], whole[:60])
    assert own[62:64].max() <= steady[62:64].max() + 0.02
    assert own[70:, 0].mean() < 1.5 * whole[70:, 0].mean() + 2e-3


def test_scans_at_the_edge_of_a_gap_are_predicted_by_the_imu() -> None:
    """The sweep before lacks its last samples, the step to the scan after its first ones: each less than half of `IMU_GAP_S`."""
    drive = walk()
    motion = motion_over_a_gap(drive, 5_985_000_000, 6_275_000_000)
    own, own_sweep = errors(motion, drive)
    whole, _ = errors(motion_of(drive), drive)
    _, steady_sweep = errors(ConstantVelocity(), drive)
    assert motion.gap_scans == 3
    np.testing.assert_array_equal(own[:60], whole[:60])
    assert (own_sweep[[59, 63]] < 0.1 * steady_sweep[[59, 63]]).all()


def test_wrong_extrinsics_are_refused_during_the_run() -> None:
    drive = walk()
    wrong = extrinsics_of(drive) @ se3.make(so3.exp(np.array([np.pi / 2, 0, 0])), np.zeros(3))
    motion = motion_of(drive, T=wrong)
    own, _ = errors(motion, drive, span=Span())
    steady, _ = errors(ConstantVelocity(), drive, span=Span())
    assert "T_lidar_imu" in motion.refusal
    np.testing.assert_allclose(own[45:], steady[45:], atol=1e-9)
    right = motion_of(drive)
    errors(right, drive, span=Span())
    assert not right.refusal


@pytest.mark.parametrize("velocity", ["registration", "along-x", "integrated"])
def test_an_imu_is_refused_after_thirty_scans_by_prior_errors(velocity: str) -> None:
    """Not by fewer; constant velocity has something to say from the third on. Another rule is the user's wish."""
    drive = walk()
    wrong = extrinsics_of(drive) @ se3.make(so3.exp(np.array([np.pi / 2, 0, 0])), np.zeros(3))
    motion, refused = motion_of(drive, T=wrong, velocity=velocity), []
    for stamp, pose in zip(*truth_of(drive), strict=True):
        motion.correct(int(stamp), pose, motion.sweep(int(stamp), Span()))
        refused.append(bool(motion.refusal))
    assert (refused.index(True) if any(refused) else None) == (31 if velocity == "registration" else None)


def test_one_scan_in_twenty_is_compared_with_constant_velocity_unless_in_a_gap() -> None:
    """Then constant velocity predicts it anyway, and before the second scan there is none."""
    drive = walk()
    stamps, poses = truth_of(drive)
    for motion, expected in (
        (motion_of(drive), [19, 39, 59, 79, 99]),
        (motion_over_a_gap(drive, 3_800_000_000, 4_200_000_000), [19, 59, 79, 99]),
    ):
        compared = []
        for k, (stamp, pose) in enumerate(zip(stamps, poses, strict=True)):
            compared += [k] if motion.needs_comparison(int(stamp), SPAN) else []
            motion.correct(int(stamp), pose, motion.sweep(int(stamp), SPAN))
        assert compared == expected


@pytest.mark.parametrize("seconds", [0.101, 0.03])
def test_a_sweep_is_refined_by_the_imu_when_samples_cover_it(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes after a sweep is not asked for. Of half a sweep constant velocity is as good a judge."""
    drive = walk()
    stamps, poses = truth_of(drive)
    imu, end_ns = stream_of(drive), int(stamps[30]) + round(1e9 * seconds)
    for module in ("fusion", "initialise"):
        monkeypatch.setattr(f"lslam.odometry.inertial.{module}.IMU_GAP_S", 0.05)
    whole, ending = motion_of(drive), motion_of(drive, imu_until(imu, end_ns))
    refined = []
    for motion in (whole, ending):
        for stamp, pose in zip(stamps[:30], poses[:30], strict=True):
            motion.correct(int(stamp), pose, motion.sweep(int(stamp), SPAN))
        prior = whole.sweep(int(stamps[30]), SPAN)
        refined.append(motion.refine(prior, int(stamps[30]), poses[30]))
    expected = refined[0] if seconds > 0.1 else whole.coasting.refine(prior, int(stamps[30]), poses[30])
    np.testing.assert_array_equal(refined[1].poses, expected.poses)
    assert (refined[1].poses != refined[0].poses).any() == (seconds < 0.1)


def test_a_scan_taken_already_refines_nothing() -> None:
    """A new map begins with the scan that the last one lost, which the motion went on with."""
    drive = walk()
    stamps, poses = truth_of(drive)
    motion = motion_of(drive)
    for stamp, pose in zip(stamps[:10], poses[:10], strict=True):
        motion.correct(int(stamp), pose, motion.sweep(int(stamp), SPAN))
    prior = motion.sweep(int(stamps[9]), SPAN)
    assert len(prior.times) > 1
    refined = motion.refine(prior, int(stamps[9]), poses[9])
    np.testing.assert_array_equal(refined.poses, prior.poses)


@pytest.mark.parametrize("scans", [1, 40])
def test_inertial_motion_resumes_to_the_last_bit(scans: int) -> None:
    drive = walk()
    stamps, poses = truth_of(drive)
    whole = motion_of(drive)
    for stamp, pose in zip(stamps[:scans], poses[:scans], strict=True):
        whole.correct(int(stamp), pose, whole.sweep(int(stamp), SPAN))
    again = motion_of(drive)
    again.restore(whole.state())
    for stamp, pose in zip(stamps[scans:60], poses[scans:60], strict=True):
        priors = [motion.sweep(int(stamp), SPAN) for motion in (whole, again)]
        np.testing.assert_array_equal(priors[0].poses, priors[1].poses)
        for motion, prior in zip((whole, again), priors, strict=True):
            motion.correct(int(stamp), pose, prior)
    assert whole.errors.medians == again.errors.medians


def test_velocity_from_registration_is_more_accurate_than_integrated_velocity() -> None:
    """The thesis' two rules: 0.092 against 0.927 there."""
    drive = drone()
    by_registration, _ = errors(motion_of(drive), drive)
    integrated, _ = errors(motion_of(drive, velocity="integrated"), drive)
    assert integrated[-20:, 0].mean() > 5 * by_registration[-20:, 0].mean()


def test_the_speed_along_x_is_the_way_since_the_last_scan_over_time() -> None:
    """Girolimetto, listing 5.1: whatever the direction of the way, and in a LiDAR that is level whatever it is."""
    motion = motion_of(drone(), velocity="along-x")
    tilted = se3.make(so3.from_euler_rpy(np.array([0.2, -0.1, 1.0])), np.array([0.3, 0.4, 0.0]))
    for stamp_ns, pose in ((0, np.eye(4)), (100_000_000, tilted)):
        motion.correct(stamp_ns, pose, motion.sweep(stamp_ns, Span()))
    np.testing.assert_allclose(motion.estimate.velocity, 5.0 * tilted[:3, 0], atol=1e-9)
    np.testing.assert_allclose(motion.estimate.gravity, -GRAVITY * tilted[:3, 2], atol=1e-9)


def test_the_lever_arm_of_the_imu_is_part_of_the_prediction() -> None:
    """An IMU two metres off feels other forces; told where it sits, it predicts the same."""
    drive = walk("ideal")
    arm = se3.make(so3.from_euler_rpy(np.array([0.3, -0.2, 1.0])), np.array([1.5, -1.0, 0.5]))
    assert drive.readings.imu is not None
    from lslam.simulation.imu import IMUS, simulate_imu

    far = simulate_imu(drive.vehicle, IMUS["ideal"], arm, drive.end, np.random.default_rng(0))
    stamps, poses = truth_of(drive, 50)
    begun = start(far.stream, arm, FirstPoses(stamps, poses, stamps, poses), int(drive.stamps_ns[-1]), ImuConfig())
    own, _ = errors(InertialMotion(dataclasses.replace(begun, imu=far.stream), Config()), drive, span=Span())
    assert np.median(own[10:, 0]) < 0.002
    mistaken = dataclasses.replace(begun, imu=far.stream, T_lidar_imu=se3.make(arm[:3, :3], np.zeros(3)))
    ignored, _ = errors(InertialMotion(mistaken, Config()), drive, span=Span())
    assert np.median(ignored[10:, 0]) > 5 * np.median(own[10:, 0])


def test_predictions_are_deterministic() -> None:
    drive = drone()
    np.testing.assert_array_equal(errors(motion_of(drive), drive)[0], errors(motion_of(drive), drive)[0])
