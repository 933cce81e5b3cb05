"""Registered poses combined with the IMU's prediction by both covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imu_drives import drone, extrinsics_of, stream_of, truth_of
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Span
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.imu_cleaning import IMU_GAP_S
from lslam.odometry.inertial.initialise import FirstPoses, start
from lslam.odometry.inertial.integrate import Increments, integrate
from lslam.odometry.kernels import kalman
from lslam.registration.result import RegistrationResult

Floats = NDArray[np.float64]

LEAST = np.diag([1e-6] * 3 + [1e-10] * 3)


def motion_of(imu: ImuStream | None = None, **keys: object) -> InertialMotion:
    drive, config = drone(), ImuConfig.model_validate(keys)
    stamps, poses = truth_of(drive, 50)
    first = FirstPoses(stamps, poses, stamps, poses, np.repeat(LEAST[None], 50, axis=0))
    begun = start(stream_of(drive), extrinsics_of(drive), first, int(drive.stamps_ns[-1]), config)
    return InertialMotion(begun if imu is None else replace(begun, imu=imu), Config(imu=config))


def part(imu: ImuStream, keep: slice) -> ImuStream:
    return ImuStream(imu.stamps_ns[keep], imu.accel[keep], imu.gyro[keep])


def behind_third_scan(imu: ImuStream) -> slice:
    """The samples since 50 ms after it: they do not reach back to the second scan, and do to the third."""
    return slice(int(np.searchsorted(imu.stamps_ns, drone().stamps_ns[2] + 50_000_000)), None)


def followed(
    motion: InertialMotion, sigma_m: float, sigma_rad: float, seed: int, every: int = 4
) -> tuple[Floats, Floats]:
    """Errors of steps as registered and as weighed, (N, 2) m and rad, when scans are registered on the one before."""
    rng = np.random.default_rng(seed)
    stamps, poses = (values[::every] for values in truth_of(drone()))
    C = np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
    last, rows = poses[0], []
    for k, (stamp, true) in enumerate(zip(stamps, poses, strict=True)):
        prior = motion.sweep(int(stamp), Span())
        if k:
            step = se3.relative(poses[k - 1], true)
            seen = last @ step
            seen[:3, :3] = so3.exp(rng.normal(0, sigma_rad, 3)) @ seen[:3, :3]
            seen[:3, 3] += rng.normal(0, sigma_m, 3)
            out = motion.fuse(int(stamp), RegistrationResult(seen, covariance=C), prior)
            for found in (seen, out.T_world_lidar):
                off = se3.relative(last @ step, found)
                rows.append((np.linalg.norm(off[:3, 3]), so3.angle(off[:3, :3])))
            last = out.T_world_lidar
        motion.correct(int(stamp), last, prior)
    table = np.array(rows).reshape(-1, 2, 2)
    return table[:, 0], table[:, 1]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_poorly_registered_rotations_are_taken_from_the_gyroscope(seed: int) -> None:
    seen, weighed = followed(motion_of(), 0.005, np.deg2rad(0.15), seed)
    assert np.sqrt(np.mean(weighed[:, 1] ** 2)) < 0.35 * np.sqrt(np.mean(seen[:, 1] ** 2))
    assert np.sqrt(np.mean(weighed[:, 0] ** 2)) < 1.1 * np.sqrt(np.mean(seen[:, 0] ** 2))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_registration_better_than_the_imu_is_kept(seed: int) -> None:
    seen, weighed = followed(motion_of(), 1e-3, np.deg2rad(2e-3), seed)
    assert np.abs(weighed - seen).max() < 1e-3
    assert np.sqrt(np.mean(weighed[:, 1] ** 2)) < 1.05 * np.sqrt(np.mean(seen[:, 1] ** 2))


def begun(motion: InertialMotion, count: int = 3) -> tuple[int, Floats]:
    """Some true poses taken in; stamp and true pose of the next scan."""
    stamps, poses = truth_of(drone())
    for stamp, pose in zip(stamps[:count], poses[:count], strict=True):
        motion.correct(int(stamp), pose, motion.sweep(int(stamp), Span()))
    return int(stamps[count]), poses[count]


def test_a_degenerate_direction_is_taken_from_the_imu() -> None:
    """A metre along x, tied to 0.1 rad of pitch, as a weak direction of both together is: neither may run away."""
    motion = motion_of()
    stamp, true = begun(motion)
    weak = np.array([1.0, 0, 0, 0, 0.1, 0])
    C = LEAST + np.outer(weak, weak)
    off = 0.3 * weak
    seen = se3.make(so3.exp(off[3:]) @ true[:3, :3], true[:3, 3] + off[:3])
    out = motion.fuse(stamp, RegistrationResult(seen, covariance=C), motion.sweep(stamp, Span()))
    assert np.linalg.norm(out.T_world_lidar[:3, 3] - true[:3, 3]) < 0.03
    assert so3.angle(se3.relative(out.T_world_lidar, true)[:3, :3]) < np.deg2rad(0.2)
    assert out.covariance is not None
    assert out.covariance[0, 0] < 1e-2


def test_a_poor_registration_does_not_update_the_gyroscope() -> None:
    """Neither by what it saw, nor by agreeing with the gyroscope once it was weighed against it."""
    motion = motion_of()
    stamp, true = begun(motion)
    before = motion.estimate.gyroscope
    seen = true @ se3.make(so3.exp(np.array([0, 0, 0.02])), np.zeros(3))
    prior = motion.sweep(stamp, Span())
    out = motion.fuse(stamp, RegistrationResult(seen, covariance=np.diag([1e-6] * 3 + [1.0] * 3)), prior)
    assert so3.angle(se3.relative(out.T_world_lidar, true)[:3, :3]) < 2e-3
    motion.correct(stamp, out.T_world_lidar, prior)
    after = motion.estimate.gyroscope
    np.testing.assert_allclose(after.bias, before.bias, atol=1e-6)
    np.testing.assert_allclose(after.axes, before.axes, atol=1e-6)
    assert (np.diag(after.covariance) > (1 - 1e-5) * np.diag(before.covariance)).all()


def test_a_poorly_constrained_axis_does_not_update_the_velocity_along_it() -> None:
    """Agreeing with the IMU once it was weighed against it is no proof of the velocity either."""
    motion = motion_of()
    stamp, true = begun(motion)
    seen = true.copy()
    seen[0, 3] += 0.5
    prior = motion.sweep(stamp, Span())
    out = motion.fuse(stamp, RegistrationResult(seen, covariance=np.diag([1.0, 1e-6, 1e-6] + [1e-10] * 3)), prior)
    before = motion.estimate.covariance.copy()
    motion.correct(stamp, out.T_world_lidar, prior)
    after = motion.estimate.covariance
    assert after[0, 0] > before[0, 0]
    assert (np.diag(after)[1:3] < np.diag(before)[1:3]).all()
    np.testing.assert_allclose(
        motion.sweep(stamp + 100_000_000, Span()).pose[:3, 3], truth_of(drone())[1][4, :3, 3], atol=0.03
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_velocity_is_within_its_covariance_with_poor_registration(seed: int) -> None:
    """Places known to decimetres: the velocity's error is within its own covariance, not within a good registration's."""
    motion = motion_of()
    rng = np.random.default_rng(seed)
    stamps, poses = truth_of(drone())
    C = np.diag([0.1**2] * 3 + [1e-8] * 3)
    squared = []
    for k in range(1, 60):
        prior = motion.sweep(int(stamps[k]), Span())
        seen = poses[k].copy()
        seen[:3, 3] += rng.normal(0, 0.1, 3)
        out = motion.fuse(int(stamps[k]), RegistrationResult(seen, covariance=C, map_age=1e3), prior)
        motion.correct(int(stamps[k]), out.T_world_lidar, prior)
        true = (poses[k + 1, :3, 3] - poses[k - 1, :3, 3]) / (1e-9 * float(stamps[k + 1] - stamps[k - 1]))
        off = motion.estimate.velocity - true
        squared.append(off @ np.linalg.solve(motion.estimate.covariance[:3, :3], off) / 3)
    assert np.mean(squared[10:]) < 1


def test_no_interval_is_integrated_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sweep, the step from the last scan, either correction of it, and the refined sweep."""
    motion = motion_of()
    stamp, true = begun(motion)
    calls = []

    def counted(imu: ImuStream, instants_ns: NDArray[np.int64], bias: Floats, *rest: Floats) -> Increments:
        calls.append((tuple(instants_ns), tuple(bias)))
        return integrate(imu, instants_ns, bias, *rest)

    monkeypatch.setattr("lslam.odometry.inertial.imu_estimate.integrate", counted)
    seen = true @ se3.make(so3.exp(np.array([0, 0, 4e-4])), np.zeros(3))
    prior = motion.refine(motion.sweep(stamp, Span(0.0, 0.1)), stamp, seen)
    out = motion.fuse(stamp, RegistrationResult(seen, covariance=np.diag([1e-6] * 3 + [1e-8] * 3)), prior)
    assert not np.array_equal(out.T_world_lidar, seen)
    motion.correct(stamp, out.T_world_lidar, prior)
    assert len(calls) == len(set(calls)) == 5


@pytest.mark.parametrize("why", ["another scan was expected", "restored"])
def test_the_integration_of_another_scan_is_not_reused(why: str) -> None:
    motion, other = motion_of(), motion_of()
    stamps, poses = truth_of(drone())
    begun(motion)
    begun(other)
    C = np.diag([1e-6] * 3 + [1e-8] * 3)
    if why == "restored":
        before = motion.state()
        motion.correct(int(stamps[3]), poses[3], motion.sweep(int(stamps[3]), Span()))
        motion.fuse(int(stamps[4]), RegistrationResult(poses[4], covariance=C), motion.sweep(int(stamps[4]), Span()))
        motion.restore(before)
    else:
        motion.fuse(int(stamps[5]), RegistrationResult(poses[5], covariance=C), motion.sweep(int(stamps[5]), Span()))
    for one in (motion, other):
        one.correct(int(stamps[4]), poses[4])
    np.testing.assert_array_equal(motion.estimate.velocity, other.estimate.velocity)
    np.testing.assert_array_equal(motion.estimate.gyroscope.bias, other.estimate.gyroscope.bias)
    assert motion.errors.medians == other.errors.medians


def test_registration_on_an_older_map_has_more_weight() -> None:
    motion = motion_of()
    stamp, true = begun(motion)
    seen = true @ se3.make(so3.exp(np.array([0, 0, 4e-4])), np.zeros(3))
    C = np.diag([1e-6] * 3 + [1e-8] * 3)
    moved = [
        so3.angle(
            se3.relative(
                seen,
                motion.fuse(
                    stamp, RegistrationResult(seen, covariance=C, map_age=age), motion.sweep(stamp, Span())
                ).T_world_lidar,
            )[:3, :3]
        )
        for age in (1.0, 30.0)
    ]
    assert 0 < moved[1] < 0.4 * moved[0]


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_what_poses_on_one_map_share_stays_in_the_covariance(ratio: float) -> None:
    """The error of the map lasts for its age, that of a registration is its own; the IMU goes on from the pose before."""
    rng, age = np.random.default_rng(5), 20.0
    C = np.diag([1e-6] * 3 + [1e-8] * 3)

    def drawn(variance: float) -> Floats:
        return rng.multivariate_normal(np.zeros(6), variance * C)

    fused, of_map, squares = np.zeros(6), drawn(1.0), []
    for _ in range(400):
        of_map = (1 - 1 / age) * of_map + drawn(1 - (1 - 1 / age) ** 2)
        registered, felt = of_map + drawn(1.0), fused + drawn(ratio)
        T = se3.make(so3.exp(registered[3:]), registered[:3])
        pose, covariance = kalman.fuse_poses(T, registered - felt, C, ratio * C, age)
        fused = np.concatenate([pose[:3, 3], so3.log(pose[:3, :3])])
        squares.append(float(fused @ np.linalg.solve(covariance, fused)) / 6)
    assert 0.7 < np.mean(squares) < 1.6


@pytest.mark.parametrize(
    "why", ["failed", "rejected", "no covariance", "switched off", "integrated", "gap", "behind a gap"]
)
def test_the_registered_pose_stays_where_nothing_can_be_weighed(why: str) -> None:
    keys = {"switched off": {"weigh": False}, "integrated": {"velocity": "integrated"}}.get(why, {})
    imu = motion_of().imu
    at = int(np.searchsorted(imu.stamps_ns, drone().stamps_ns[2]))
    stream = {"gap": part(imu, slice(None, at)), "behind a gap": part(imu, behind_third_scan(imu))}.get(why, imu)
    motion = motion_of(stream, **keys)
    stamp, true = begun(motion)
    seen = true @ se3.make(so3.exp(np.array([0, 2e-3, 0])), np.zeros(3))
    C = None if why == "no covariance" else np.diag([1e-4] * 3 + [1e-6] * 3)
    result = RegistrationResult(seen, ok=why != "failed", covariance=C, is_rejected=why == "rejected")
    np.testing.assert_array_equal(motion.fuse(stamp, result, motion.sweep(stamp, Span())).T_world_lidar, seen)
    good = motion_of()
    begun(good)
    if "gap" in why:
        weighed = good.fuse(stamp, result, good.sweep(stamp, Span()))
        assert not np.array_equal(weighed.T_world_lidar, seen), "with samples it would have been"


def test_the_step_from_a_scan_in_a_gap_does_not_update_the_gyroscope() -> None:
    """That scan was deskewed without the IMU: here it is off by half a degree."""
    imu = motion_of().imu
    stamps, poses = truth_of(drone())
    taught = []
    for stream in (imu, part(imu, behind_third_scan(imu))):
        motion = motion_of(stream)
        begun(motion, 2)
        tilted = poses[2] @ se3.make(so3.exp(np.array([0, np.deg2rad(0.5), 0])), np.zeros(3))
        motion.correct(int(stamps[2]), tilted, motion.sweep(int(stamps[2]), Span()))
        before = motion.estimate.gyroscope.bias
        motion.correct(int(stamps[3]), poses[3], motion.sweep(int(stamps[3]), Span()))
        taught.append(float(np.abs(motion.estimate.gyroscope.bias - before).max()))
        off = motion.sweep(int(stamps[4]), Span()).pose[:3, 3] - poses[4, :3, 3]
        assert np.linalg.norm(off) < 0.1
    assert taught[0] > 1e-6, "with samples before it would have"
    assert taught[1] == 0.0


def test_over_a_gap_between_two_sweeps_constant_velocity_predicts() -> None:
    """Samples tell of the last scan and of the next, which is the fourth after it, and of nothing between."""
    imu, (stamps, _) = motion_of().imu, truth_of(drone())
    near_ns = 10_000_000
    silent = (imu.stamps_ns > stamps[2] + near_ns) & (imu.stamps_ns < stamps[6] - near_ns)
    told, deaf = motion_of(), motion_of(ImuStream(imu.stamps_ns[~silent], imu.accel[~silent], imu.gyro[~silent]))
    for motion in (told, deaf):
        begun(motion)
    stamp = int(stamps[6])
    np.testing.assert_array_equal(deaf.sweep(stamp, Span()).pose, deaf.coasting.predict(stamp))
    assert not deaf.is_inertial
    assert not np.array_equal(told.sweep(stamp, Span()).pose, told.coasting.predict(stamp))


FALSE = se3.make(so3.exp(np.array([0, 0.2, 0])), np.array([0, 0, 2.0]))
SURE = np.diag([1e-4] * 3 + [1e-6] * 3)


def test_a_registration_that_contradicts_imu_and_constant_velocity_is_bridged() -> None:
    motion = motion_of()
    stamp, true = begun(motion)
    prior = motion.sweep(stamp, Span())
    out = motion.fuse(stamp, RegistrationResult(true @ FALSE, covariance=SURE), prior)
    assert (out.ok, out.is_rejected, out.converged) == (True, True, False)
    assert out.reason == "registration is 2.00 m and 11.5 deg from what the IMU felt"
    np.testing.assert_array_equal(out.T_world_lidar, prior.pose)
    assert np.linalg.norm(out.T_world_lidar[:3, 3] - true[:3, 3]) < 0.03
    assert out.covariance is not None
    assert 1e-4 < np.sqrt(np.linalg.eigvalsh(out.covariance[:3, :3])[-1]) < 0.05


def test_a_bridged_scan_has_the_covariance_of_the_imu() -> None:
    bridged = []
    for C in (SURE, 0.1 * SURE):
        motion = motion_of()
        stamp, true = begun(motion)
        bridged.append(motion.fuse(stamp, RegistrationResult(true @ FALSE, covariance=C), motion.sweep(stamp, Span())))
    assert [(out.ok, out.is_rejected) for out in bridged] == [(True, True)] * 2
    first, second = (out.covariance for out in bridged)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("why", ["no speed yet", "the sweep ends in a gap", "another scan was expected"])
def test_an_undecidable_contradiction_keeps_the_registered_pose(why: str) -> None:
    imu, stamps = motion_of().imu, drone().stamps_ns
    span = Span(0.0, 0.1 if why == "the sweep ends in a gap" else 0.0)
    # Samples tell of `IMU_GAP_S` more: of the middle of the sweep that begins at scan 3, not of its end.
    keep = imu.stamps_ns < stamps[3] + 75_000_000 - 1e9 * IMU_GAP_S if span.seconds else np.ones(len(imu), np.bool_)
    motion = motion_of(part(imu, keep))
    stamp, true = begun(motion, 1 if why == "no speed yet" else 3)
    prior = motion.sweep(stamp, span)
    if why == "another scan was expected":
        motion.sweep(int(stamps[4]), Span())
    out = motion.fuse(stamp, RegistrationResult(true @ FALSE, covariance=SURE), prior)
    assert out.is_accepted
    np.testing.assert_array_equal(out.T_world_lidar, true @ FALSE)


@pytest.mark.parametrize("is_restored", [False, True])
def test_a_registration_that_persists_is_accepted(is_restored: bool) -> None:
    motion = motion_of()
    stamps, poses = truth_of(drone())
    stamp, true = begun(motion)
    prior = motion.sweep(stamp, Span())
    motion.correct(
        stamp, motion.fuse(stamp, RegistrationResult(true @ FALSE, covariance=SURE), prior).T_world_lidar, prior, False
    )
    if is_restored:
        state, motion = motion.state(), motion_of()
        motion.restore(state)
    for k, is_rejected in ((4, False), (5, True)):
        stamp, seen = int(stamps[k]), poses[k] @ FALSE
        prior = motion.sweep(stamp, Span())
        out = motion.fuse(stamp, RegistrationResult(seen, covariance=SURE), prior)
        assert (out.ok, out.is_rejected) == (True, is_rejected)
        if not is_rejected:
            np.testing.assert_array_equal(out.T_world_lidar, seen)
            motion.correct(stamp, poses[k], prior)


def test_an_imu_that_contradicts_constant_velocity_keeps_the_registered_pose() -> None:
    """It was hit: for a tenth of a second its gyroscope reads three turns per second more."""
    imu, stamps = motion_of().imu, drone().stamps_ns
    gyro = imu.gyro.copy()
    gyro[(imu.stamps_ns > stamps[2]) & (imu.stamps_ns <= stamps[3]), 1] += 20.0
    motion = motion_of(ImuStream(imu.stamps_ns, imu.accel, gyro))
    stamp, true = begun(motion)
    prior = motion.sweep(stamp, Span())
    assert so3.angle(se3.relative(prior.pose, true)[:3, :3]) > 1.0
    out = motion.fuse(stamp, RegistrationResult(true, covariance=SURE), prior)
    assert out.is_accepted
    np.testing.assert_array_equal(out.T_world_lidar, true)
