"""LIPS: a walk between houses is followed, open ground leaves directions degenerate, and an IMU is required."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from analytic_scenes import floor_only, seen_from
from stub_sequences import Stub, sample
from warmed_kernels import recorded

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import se3
from lslam.core.kernels import linalg
from lslam.core.types.imu import ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry import create_odometry
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.inertial_start import Inertial, begin_inertial
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.tracker import Tracker
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.filter import Normal
from lslam.odometry.lips import LinkedMotion, Lips
from lslam.odometry.scan_outcome import fault
from lslam.simulation.scenarios import simulate

COUNT = 20


def config_of() -> Config:
    return load_config(None, ["odometry.method=lips", "imu.start_s=1", "loops.use=false"], {})


@cache
def walk() -> Stub:
    drive = simulate("walk", lidar="vlp16", seed=100, count=COUNT, imu="icm20948", motion_compensated=False)
    return Stub(
        [drive.scan(i) for i in range(COUNT)], drive.ground_truth, drive.calibration, motion_compensated=False,
        imu=drive.imu,
    )  # fmt: skip


@cache
def start() -> Inertial:
    return begin_inertial(walk(), config_of())


def tracker() -> Tracker:
    return Tracker(create_odometry(config_of()), motion=begin_again().motion)


def begin_again() -> Inertial:
    from lslam.odometry.frontend.inertial_start import motion_of

    begun = start().start
    assert begun is not None
    return Inertial(motion_of(begun, config_of()), begun)


def tracked(sequence: Stub, motion: Inertial) -> list[ScanResult]:
    one = Tracker(create_odometry(config_of()), motion=motion.motion)
    return [one.track(loaded) for loaded in read_ahead(sequence, one.odometry.prepare, 1)]


def worst(results: list[ScanResult]) -> float:
    truth = walk().ground_truth
    assert truth is not None
    true = se3.relative(truth.poses[0], truth.poses[: len(results)])
    return float(
        np.linalg.norm([r.T_world_lidar[:3, 3] - t[:3, 3] for r, t in zip(results, true, strict=True)], axis=1).max()
    )


def test_a_walk_between_houses_is_followed_and_its_states_are_resumed(tmp_path: Path) -> None:
    whole, results = tracker(), []
    loaded = list(read_ahead(walk(), whole.odometry.prepare, 1))
    for scan in loaded:
        results.append(whole.track(scan))
        if len(results) == 12:
            write_state(tmp_path / "12.npz", whole.state())
    assert all(r.status == "ok" for r in results)
    assert worst(results) < 0.1
    assert all(r.covariance is not None for r in results)
    sigmas = [float(np.sqrt(np.trace(r.covariance[:3, :3]))) for r in results if r.covariance is not None]
    assert 0.001 < sigmas[-1] < 0.1
    again = tracker()
    again.restore(read_state(tmp_path / "12.npz", STATE_CLASSES))
    rest = [again.track(scan).T_world_lidar for scan in loaded[12:]]
    np.testing.assert_array_equal(rest, [r.T_world_lidar for r in results[12:]])


def test_planes_are_registered_over_a_gap_and_a_lost_scan() -> None:
    part = begin_again()
    assert part.motion is not None
    imu = part.motion.imu
    kept = (imu.stamps_ns < 1_000_000_000) | (imu.stamps_ns > 1_400_000_000)
    assert part.start is not None
    silent = replace(part.start, imu=ImuStream(imu.stamps_ns[kept], imu.accel[kept], imu.gyro[kept]))
    from lslam.odometry.frontend.inertial_start import motion_of

    motion = Inertial(motion_of(silent, config_of()), silent)
    scans = [*walk().scans[:8], "gone", *walk().scans[9:]]
    results = tracked(replace(walk(), scans=scans), motion)
    assert motion.motion is not None
    assert motion.motion.gap_scans >= 3
    assert [r.status for r in results].count("ok") >= COUNT - 2
    assert worst(results) < 0.3


def test_warming_up_compiles_what_the_window_is_solved_with(monkeypatch: pytest.MonkeyPatch) -> None:
    one = tracker()
    calls = recorded(monkeypatch, linalg, "inverse", "complement", "solve")
    one.odometry.warm_up()
    warm = set(calls)
    assert {name for name, _ in warm} == {"inverse", "complement", "solve"}
    for loaded in read_ahead(replace(walk(), scans=walk().scans[:3]), one.odometry.prepare, 1):
        one.track(loaded)
    assert calls == warm


def test_after_a_standstill_a_scan_is_linked_by_its_pose_and_not_by_the_imu() -> None:
    one = tracker()
    loaded = list(read_ahead(walk(), one.odometry.prepare, 1))
    results = [one.track(scan) for scan in loaded[:8]]
    stood, last = results[-1].T_world_lidar, walk().scans[13]
    assert isinstance(last, Scan)
    linked = one.motion.sweep(loaded[8].stamp_ns, last.span).link
    assert linked is not None
    assert linked.step is not None
    assert linked.step.seconds == pytest.approx(0.1, abs=0.01)
    for scan in loaded[8:13]:
        one.motion.correct(scan.stamp_ns, stood)
    prior = one.motion.sweep(last.stamp_ns, last.span)
    assert prior.link is not None
    assert prior.link.step is not None
    assert prior.link.step.seconds == 0.0
    assert np.linalg.norm(prior.link.step.position) < 0.15


def test_the_scan_after_a_rejected_one_is_linked_to_its_smoothed_pose() -> None:
    """Its planes are taken back and the window goes on by the IMU, which then falls silent."""
    one = tracker()
    loaded = list(read_ahead(walk(), one.odometry.prepare, 1))
    for scan in loaded[:5]:
        one.track(scan)
    denied, last = walk().scans[5], walk().scans[6]
    assert isinstance(denied, Scan)
    assert isinstance(last, Scan)
    assert isinstance(one.odometry, Lips)
    prior = one.motion.sweep(loaded[5].stamp_ns, denied.span)
    found = one.odometry.register(denied, loaded[5].prepared, prior)
    far = replace(found, T_world_lidar=se3.make(np.eye(3), np.array([50.0, 0.0, 0.0])) @ prior.pose)
    fused = one.motion.fuse(denied.stamp_ns, far, prior)
    reason = fault(fused.T_world_lidar, denied.stamp_ns, ScanResult(4, loaded[4].stamp_ns, np.eye(4)))
    assert "impossible jump" in reason
    result = one.odometry.update(denied, prior, fused.reject(reason, prior.pose.copy(), None))
    assert (result.status, result.covariance) == ("bridged", None)
    one.motion.correct(result.stamp_ns, result.T_world_lidar, prior, has_registration=False)
    assert isinstance(one.motion, LinkedMotion)
    one.motion.refusal = "it was silent from here on"
    after = one.motion.sweep(loaded[6].stamp_ns, last.span)
    assert after.link is not None
    assert after.link.step is not None
    assert after.link.step.seconds == 0.0
    led = one.odometry._predict(after.link).T_world_lidar @ se3.inverse(after.link.within)
    assert np.linalg.norm(led[:3, 3] - after.pose[:3, 3]) < 0.05


def test_a_sweep_with_readings_beyond_the_range_is_deskewed_again_about_its_middle() -> None:
    motion = begin_again().motion
    assert isinstance(motion, LinkedMotion)
    one = Tracker(create_odometry(config_of()), motion=motion)
    *before, last = list(read_ahead(walk(), one.odometry.prepare, 1))[:8]
    for loaded in before:
        one.track(loaded)
    assert last.scan is not None
    prior = motion.sweep(last.stamp_ns, last.scan.span)
    found = prior.pose @ se3.make(np.eye(3), np.array([0.05, 0.0, 0.0]))
    assert motion.refine(prior, last.stamp_ns, found) is prior
    motion.imu = replace(motion.imu, clipping_sigma=np.full((len(motion.imu), 6), 5.0))
    motion._increments = None
    prior = motion.sweep(last.stamp_ns, last.scan.span)
    refined = motion.refine(prior, last.stamp_ns, found)
    assert np.abs(refined.poses - prior.poses).max() > 0.01
    assert prior.link is not None
    assert refined.link is not None
    assert refined.link.step is prior.link.step
    middle = middle_of(refined, last.stamp_ns, refined.pose)[0]
    np.testing.assert_allclose(refined.pose @ refined.link.within, middle, atol=1e-9)
    assert np.abs(refined.link.within - prior.link.within).max() > 1e-3


def test_ground_alone_leaves_degenerate_directions_reported() -> None:
    truth, rng = walk().ground_truth, np.random.default_rng(0)
    assert truth is not None
    true = se3.relative(truth.poses[0], truth.poses[:12])
    scans: list[Scan | str] = [
        Scan(seen_from(floor_only(rng, 6000, (pose[0, 3], pose[1, 3])), pose), k * 100_000_000, k)
        for k, pose in enumerate(true)
    ]
    low = replace(walk(), scans=scans)
    results = tracked(low, begin_again())
    seen = [r for r in results[1:] if r.status == "ok"]
    assert len(seen) >= 9
    assert [len(r.degenerate) for r in seen] == [3] * len(seen)
    covariance, first = results[-1].covariance, results[2].covariance
    assert covariance is not None
    assert first is not None
    assert np.trace(covariance[:2, :2]) > 4 * np.trace(first[:2, :2])


def test_without_planes_scans_are_bridged_by_the_imu_with_a_reason() -> None:
    rng = np.random.default_rng(0)

    def bush(scan: Scan | str) -> Scan | str:
        assert isinstance(scan, Scan)
        return replace(scan, points=rng.normal(0, 8, scan.points.shape).astype(np.float32))

    scans = [*walk().scans[:5], *(bush(scan) for scan in walk().scans[5:10])]
    results = tracked(replace(walk(), scans=scans), begin_again())
    assert [r.status for r in results[5:]] == ["bridged"] * 5
    assert all("the IMU carries the scan" in r.reason for r in results[5:])
    assert worst(results) < 0.3


def test_a_window_without_a_solution_is_bridged_and_planes_go_on_behind_it(monkeypatch: pytest.MonkeyPatch) -> None:
    one = tracker()
    loaded = list(read_ahead(walk(), one.odometry.prepare, 1))
    before = [one.track(scan) for scan in loaded[:8]]
    with monkeypatch.context() as patch:
        patch.setattr(Normal, "step", lambda self: np.full(len(self.g), np.nan))
        without = one.track(loaded[8])
    behind = [one.track(scan) for scan in loaded[9:]]
    assert (without.status, without.reason) == (
        "bridged", "the window of planes and IMU has no solution: the IMU carries the scan"
    )  # fmt: skip
    assert [r.status for r in behind] == ["ok"] * len(behind)
    assert worst([*before, without, *behind]) < 0.1


def test_without_an_imu_there_is_no_such_method() -> None:
    with pytest.raises(InputError, match="has no IMU: run without --imu, by a method that needs none"):
        lslam.run(sample(3), config_of())
    method, scan = create_odometry(config_of()), walk().scans[0]
    assert isinstance(scan, Scan)
    with pytest.raises(UsageError, match="lips is a smoother of planes and IMU"):
        method.register(scan, method.prepare(scan), MotionPrior.at_once(np.eye(4)))
