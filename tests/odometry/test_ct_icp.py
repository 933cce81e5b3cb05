"""CT-ICP: both ends of a sweep are found, which the motion within it follows; without times it is `icp`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from analytic_scenes import pose_at, room
from numpy.typing import NDArray
from stub_sequences import Stub, sample

from lslam.core.config import load_config
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.core.types.scan_result import ScanResult
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry import create_odometry
from lslam.odometry.base import Odometry
from lslam.odometry.ct_icp import FORGETTING_FACTOR, LAG_RATIO, LEAST_CHANGE, MISS_RATIO, LastSweep
from lslam.odometry.elastic import (
    LEAST_SKEW,
    SWEEP_PARTS,
    ElasticConstraints,
    ElasticSweep,
    SweepPoints,
    register_elastic,
)
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.inertial_start import begin_inertial
from lslam.odometry.frontend.register_scans import estimate, read_ahead
from lslam.odometry.frontend.tracker import Tracker
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.registration.optimiser import Annealing
from lslam.registration.preprocessing.deskew import deskew_points, knots_over
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.registration.registration import Registration
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
COUNT = 24
SPAN = Span(0.0, 0.1)
ANNEALING = Annealing(1.0, 20)


def method(name: str, *settings: str) -> Odometry:
    return create_odometry(load_config(None, [f"odometry.method={name}", *settings], {}))


@cache
def walk() -> Stub:
    """A sensor that is carried and turned by hand; its sweeps hold that motion."""
    drive = simulate("walk", lidar="vlp16", seed=100, count=COUNT, motion_compensated=False)
    scans = [drive.scan(i) for i in range(COUNT)]
    return Stub(scans, drive.ground_truth, drive.calibration, motion_compensated=False)


def tracked(tracker: Tracker, sequence: Stub, begin: int = 0) -> tuple[list[ScanResult], list[MotionPrior]]:
    results, sweeps = [], []
    for loaded in list(read_ahead(sequence, tracker.odometry.prepare, 1))[begin:]:
        results.append(tracker.track(loaded))
        sweeps.append(tracker.sweep)
    return results, sweeps


@cache
def followed(name: str) -> tuple[list[ScanResult], list[MotionPrior]]:
    return tracked(Tracker(method(name)), walk())


# -- one sweep in a room


def elastic(begin: Floats, end: Floats) -> ElasticSweep:
    return ElasticSweep(begin, end, knots_over(SPAN))


def scanned(sweep: ElasticSweep, registration: Registration | None = None) -> SweepPoints:
    """A room whose points are seen one azimuth after the other on the way, against a map of the same room."""
    if registration is None:
        registration = Registration()
        registration.register(room(np.random.default_rng(0)), np.eye(4))
    world = room(np.random.default_rng(1))
    times = (0.1 * (np.arctan2(world[:, 1], world[:, 0]) / (2 * np.pi) + 0.5)).astype(np.float32)
    order = np.argsort(times)
    world, times = world[order], times[order]
    seen = np.empty_like(world)
    for part in np.array_split(np.arange(len(times)), 200):
        share = float(times[part].mean()) / 0.1
        t = (1 - share) * sweep.begin[:3, 3] + share * sweep.end[:3, 3]
        R = sweep.begin[:3, :3] @ so3.exp(share * so3.log(sweep.begin[:3, :3].T @ sweep.end[:3, :3]))
        seen[part] = (world[part] - t) @ R
    points = prepare_points(seen, registration.preprocess, 0, times)
    return SweepPoints(points, registration.map.levels, registration.config.sigma)


def test_both_poses_of_a_sweep_are_found_from_a_wrong_start() -> None:
    true = elastic(pose_at((0.1, -0.05, 0.0), 1.0), pose_at((0.5, 0.1, 0.05), 9.0))
    start = elastic(pose_at(), pose_at((0.2, 0.0, 0.0), 3.0))
    none = np.zeros((6, 6))
    free = ElasticConstraints(start, none, none, 0.0, np.zeros(6), 1e12 * np.eye(6))
    result = register_elastic(scanned(true), start, free, ANNEALING, 1e-3)
    assert result.result.converged
    for found, wanted in ((result.sweep.begin, true.begin), (result.sweep.end, true.end)):
        error = se3.relative(wanted, found)
        assert np.linalg.norm(error[:3, 3]) < 0.02
        assert np.rad2deg(so3.angle(error[:3, :3])) < 0.15
    errors = np.concatenate([_off(result.sweep.begin, true.begin), _off(result.sweep.end, true.end)])
    nees = errors @ np.linalg.solve(result.covariance[:12, :12], errors) / 12
    assert 0.1 < nees < 6
    assert len(result.result.degenerate) == 0
    np.testing.assert_allclose(result.result.T_world_lidar, result.sweep.begin, atol=1e-12)


def _off(found: Floats, true: Floats) -> Floats:
    return np.concatenate([found[:3, 3] - true[:3, 3], so3.log(found[:3, :3] @ true[:3, :3].T)])


def test_points_lie_where_the_sensor_was_at_their_times() -> None:
    """Translation linear, rotation along the geodesic: at a third of the sweep a third of both."""
    sweep = elastic(pose_at((1.0, 0.0, 0.0), 0.0), pose_at((1.9, 0.3, 0.0), 30.0))
    point = np.array([[2.0, 0.0, 0.0]])
    seen = deskew_points(point, np.full(1, 0.1 / 3, np.float32), sweep.prior)
    expected = np.array([1.3, 0.1, 0.0]) + 2.0 * np.array([np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10)), 0.0])
    np.testing.assert_allclose(se3.apply(sweep.prior.pose, seen)[0], expected, atol=1e-4)


def test_the_motion_measured_by_an_imu_keeps_its_shape_as_the_ends_move() -> None:
    times = knots_over(SPAN)
    bow = se3.make(np.eye(3), np.column_stack([10 * times, times * (0.1 - times), 0 * times]))
    sweep = ElasticSweep.of(MotionPrior(times, bow, has_imu_motion=True))
    np.testing.assert_allclose(sweep.poses, bow, atol=1e-12)
    assert np.abs(ElasticSweep.of(MotionPrior(times, bow)).poses - bow).max() > 2e-3
    shift = np.tile([0.3, -0.1, 0.2, 0.0, 0.0, 0.0], (2, 1))
    np.testing.assert_allclose(sweep.move(shift).poses[:, :3, 3], bow[:, :3, 3] + [0.3, -0.1, 0.2], atol=1e-12)


def test_the_parts_of_a_sweep_add_up_to_the_whole() -> None:
    """What moves all of it is told by the sum of what moves its parts, about one place."""
    true = elastic(pose_at(), pose_at())
    points = scanned(true)
    H, _, _ = points.linearise(true.prior, (0.15, 0.15, np.inf))
    assert H.shape == (SWEEP_PARTS, 6, 6)
    shift = np.array([0.01, -0.02, 0.01, 0.001, 0.002, -0.001])
    moved = true.move(np.tile(shift, (2, 1)))
    _, g_moved, _ = points.linearise(moved.prior, (10.0, 10.0, np.inf))
    H0, g0, _ = points.linearise(true.prior, (10.0, 10.0, np.inf))
    assert np.linalg.norm(g_moved.sum(0) - g0.sum(0) - H0.sum(0) @ shift) < 0.1 * np.linalg.norm(H0.sum(0) @ shift)


# -- sweep after sweep


def test_the_motion_within_a_walks_sweeps_is_nearer_to_the_truth_than_constant_velocity() -> None:
    truth = walk().ground_truth
    assert truth is not None
    assert all(result.status == "ok" for result in followed("ct-icp")[0])
    moves, turns = {}, {}
    for name in ("ct-icp", "icp"):
        # From stamp to stamp is from a sweep's begin to its end. The first ones only undo what the map was begun with.
        errors = [
            se3.log(se3.relative(se3.relative(a, b), se3.relative(s.poses[0], s.poses[-1])))
            for a, b, s in list(zip(truth.poses, truth.poses[1:], followed(name)[1], strict=False))[10:]
        ]
        moves[name], turns[name] = np.sqrt(np.mean(np.square(errors), axis=0).reshape(2, 3).sum(1))
    assert moves["ct-icp"] < 0.8 * moves["icp"]
    assert turns["ct-icp"] < 0.9 * turns["icp"]


def test_a_sweep_has_the_shape_of_the_imu_except_over_a_gap() -> None:
    drive = simulate("walk", lidar="vlp16", seed=100, count=COUNT, imu="icm20948", motion_compensated=False)
    assert drive.imu is not None
    kept = (drive.imu.stamps_ns < 1_500_000_000) | (drive.imu.stamps_ns > 1_900_000_000)
    imu = ImuStream(drive.imu.stamps_ns[kept], drive.imu.accel[kept], drive.imu.gyro[kept])
    scans = [drive.scan(i) for i in range(COUNT)]
    sequence = Stub(scans, drive.ground_truth, drive.calibration, motion_compensated=False, imu=imu)
    config = load_config(None, ["odometry.method=ct-icp", "imu.use=true", "imu.start_s=1"], {})
    tracker, felt, results = Tracker(create_odometry(config), motion=begin_inertial(sequence, config).motion), [], []
    assert isinstance(tracker.motion, InertialMotion)
    for loaded in read_ahead(sequence, tracker.odometry.prepare, 1):
        felt.append(tracker.motion.sweep(loaded.stamp_ns, loaded.scan.span).has_imu_motion)
        results.append(tracker.track(loaded))
    assert felt == [k < 15 or k > 19 for k in range(COUNT)]
    assert all(result.status == "ok" for result in results)
    found, truth = np.stack([result.T_world_lidar for result in results]), drive.ground_truth
    assert truth is not None
    assert np.linalg.norm((found - se3.relative(truth.poses[0], truth.poses))[:, :3, 3], axis=1).max() < 0.1


def test_every_scan_has_a_covariance_and_one_registration() -> None:
    results, sweeps = followed("ct-icp")
    for result, sweep in zip(results[2:], sweeps[2:], strict=True):
        assert result.covariance is not None
        assert np.linalg.eigvalsh(result.covariance)[0] > 0
        np.testing.assert_allclose(sweep.pose, result.T_world_lidar, atol=1e-9)
    assert max(result.iterations for result in results[8:]) <= 10


def test_scans_without_times_have_one_pose_that_of_icp() -> None:
    sequence = sample(6)
    one, other = (list(estimate(sequence, method(name))) for name in ("ct-icp", "icp"))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.T_world_lidar, b.T_world_lidar)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_ct_icp_resumes_to_the_last_bit(tmp_path: Path) -> None:
    results, _ = followed("ct-icp")
    tracker = Tracker(method("ct-icp"))
    for loaded in list(read_ahead(walk(), tracker.odometry.prepare, 1))[:12]:
        tracker.track(loaded)
    write_state(tmp_path / "12.npz", tracker.state())
    again = Tracker(method("ct-icp"))
    again.restore(read_state(tmp_path / "12.npz", STATE_CLASSES))
    for one, other in zip(results[12:], tracked(again, walk(), 12)[0], strict=True):
        np.testing.assert_array_equal(one.T_world_lidar, other.T_world_lidar)
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_miss_and_lag_are_the_constants_of_random_acceleration() -> None:
    """A way with an acceleration of its own in each of many sweeps, a line fitted to each."""
    a, n = np.random.default_rng(0).normal(size=4000), 200
    u = (np.arange(n) + 0.5) / n
    v = np.concatenate([[0.0], np.cumsum(a)[:-1]])
    x = np.concatenate([[0.0], np.cumsum(v + a / 2)[:-1]])
    way = x[:, None] + v[:, None] * u + 0.5 * a[:, None] * u**2
    slope, offset = np.polyfit(u, way.T, 1)
    middle = offset + slope / 2
    change = np.diff(middle, 2).std()
    assert (offset[1:] - offset[:-1] - slope[:-1]).std() / change == pytest.approx(MISS_RATIO, rel=0.03)
    assert (slope[1:] - np.diff(middle)).std() / change == pytest.approx(LAG_RATIO, rel=0.03)


def test_the_skew_of_a_map_is_found_where_the_sweep_is_known() -> None:
    """Of the motion that the map was begun without, each part lacks share - 1/2: nothing else tells that from motion."""
    skew = np.array([0.12, -0.06, 0.03, 0.0, 0.0, 0.004])
    registration, world = Registration(), room(np.random.default_rng(0))
    share = np.arctan2(world[:, 1], world[:, 0]) / (2 * np.pi) + 0.5
    turned = np.cross(skew[3:], world)
    registration.register((world - (share - 0.5)[:, None] * (skew[:3] + turned)).astype(np.float32), np.eye(4))
    true, none = elastic(pose_at(), pose_at((0.4, 0.1, 0.0), 5.0)), np.zeros((6, 6))
    points = scanned(true, registration)
    sure, free = 1e8 * np.eye(6), 1e-8 * np.eye(6)
    known = ElasticConstraints(true, sure, sure, 0.0, np.zeros(6), free)
    np.testing.assert_allclose(register_elastic(points, true, known, ANNEALING, 1e-3).skew, skew, atol=0.01)
    # Where the map is known to have none, the sweep takes all of it on itself.
    straight = ElasticConstraints(true, none, none, 0.0, np.zeros(6), sure)
    found = register_elastic(points, true, straight, ANNEALING, 1e-3)
    taken = _off(found.sweep.begin, true.begin) - _off(found.sweep.end, true.end)
    np.testing.assert_allclose(taken, skew, atol=0.02)


def test_the_skew_of_the_map_decays_over_five_scans() -> None:
    last, steady = LastSweep(), elastic(pose_at(), pose_at((1.0, 0.0, 0.0))).prior
    found = MotionPrior(steady.times, pose_at((0.2, 0.0, 0.0)) @ steady.poses)
    P = np.kron(np.eye(3), 1e-4 * np.eye(6))
    last.follow(0, found.pose, found, steady, np.full(6, 0.01), P, 0.25)
    held = last.constraints(100_000_000, steady)
    np.testing.assert_allclose(held.skew, 0.0075)
    sigma2 = 1e-4 * (0.25**2 + 0.25**2 + 0.75**2) + LEAST_SKEW**2
    np.testing.assert_allclose(np.linalg.inv(held.skew_information), sigma2 * np.eye(6), rtol=1e-9, atol=1e-15)
    changes = []
    for k in range(1, 6):
        changes.append(1.0 / held.velocity[0, 0] / LAG_RATIO**2 - 2 * LEAST_CHANGE**2)
        last.follow(100_000_000 * k, steady.pose, steady, steady, np.zeros(6), P, 0.1)
        held = last.constraints(100_000_000 * (k + 1), steady)
    np.testing.assert_allclose(np.divide(changes[1:], changes[:-1]), FORGETTING_FACTOR, rtol=0.01)


@pytest.mark.parametrize("gap", [0, 1])
def test_location_consistency_applies_to_consecutive_sweeps_only(gap: int) -> None:
    last, times = LastSweep(), knots_over(SPAN)
    before = elastic(pose_at(), pose_at((1.0, 0.0, 0.0))).prior
    last.follow(0, np.eye(4), before, before, np.zeros(6), 1e-6 * np.eye(18), 0.1)
    prior = MotionPrior(times, before.poses + (1 + gap) * (before.poses[-1] - before.poses[0]) + 0.01)
    found = last.constraints(100_000_000 * (1 + gap), MotionPrior(times, prior.poses))
    if gap:
        assert not found.location.any()
        np.testing.assert_allclose(found.expected.begin, prior.poses[0])
    else:
        assert found.location[0, 0] > 1e4
        np.testing.assert_allclose(found.expected.end[:3, 3], [2.0, 0.0, 0.0], atol=1e-9)
