"""A box room with pillars, seen ring by ring: the engine of the LOAM family finds the motion that was made."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from analytic_scenes import distance, random_pose
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.config.odometry import LoamConfig, RecoveryConfig
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import StageClock
from lslam.odometry.feature_map import feature_scan
from lslam.odometry.feature_policies import ALL_POINTS, CONSTRAINED_SCANS, LessPlanar, feature_policies
from lslam.odometry.feature_solver import (
    NONE,
    FeatureNoise,
    ScanStep,
    joint_step,
    remap_solution,
    solve_on_scan,
    two_steps,
    upright_directions,
)
from lslam.odometry.feature_target import FeatureTarget, LoamVariant
from lslam.registration.optimiser import Annealing
from lslam.registration.preprocessing.features import Features, extract_features
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult

Floats = NDArray[np.float64]

HALF = np.array([9.0, 7.0, 2.0])  # m, of the room
PILLARS = np.array([[4.0, 3.0], [-5.0, 2.0], [3.0, -4.0], [-4.0, -4.5], [0.5, 5.0]])
PILLAR = 0.4  # m, half a side
ANNEALING = Annealing(1.0, 30)
NOISE = FeatureNoise(0.15, 0.03, 1e-3)


def scan_of_room(pose: Floats, seed: int = 0, with_pillars: bool = True) -> Scan:
    """What 32 rings see from `pose` (4, 4) in the room, ranges with 1 cm of noise."""
    azimuth, elevation = np.linspace(-np.pi, np.pi, 900, endpoint=False), np.linspace(-0.4, 0.4, 32)
    a, e = np.meshgrid(azimuth, elevation)
    beams = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    rays, origin = beams @ pose[:3, :3].T, pose[:3, 3]
    ranges = np.min(np.where(rays > 0, HALF - origin, -HALF - origin) / np.where(rays == 0, 1e-12, rays), axis=1)
    for x, y in PILLARS if with_pillars else ():
        sides = np.array([[x, y]]) + np.array([[-PILLAR], [PILLAR]])
        near, far = np.sort((sides[:, None] - origin[:2]) / np.where(rays[:, :2] == 0, 1e-12, rays[:, :2]), axis=0)
        enter, leave = near.max(axis=1), far.min(axis=1)
        ranges = np.where((enter < leave) & (enter > 0), np.minimum(ranges, enter), ranges)
    ranges += np.random.default_rng(seed).normal(0, 0.01, len(ranges))
    rings = np.repeat(np.arange(32, dtype=np.uint16), len(azimuth))
    return Scan((beams * ranges[:, None]).astype(np.float32), 0, 0, rings=rings)


def features_at(pose: Floats, seed: int = 0, with_pillars: bool = True) -> Features:
    return extract_features(scan_of_room(pose, seed, with_pillars))


def engine(
    step: ScanStep | None, with_map: bool, loam: LoamConfig | None = None, recovery: RecoveryConfig | None = None
) -> Registration:
    config = Config(loam=loam or LoamConfig(), recovery=recovery or RecoveryConfig())
    target = FeatureTarget(config, LoamVariant(step, with_map))
    return Registration(config.registration, target=target, policies=feature_policies(config.recovery))


VARIANTS = [(joint_step, False), (joint_step, True), (None, True), (two_steps, True)]


@pytest.mark.parametrize(("step", "with_map"), VARIANTS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_known_motion_is_recovered(step: ScanStep | None, with_map: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    registration = engine(step, with_map)
    first = features_at(np.eye(4))
    registration.update(registration.locate(first, np.eye(4)))
    way, axis = rng.normal(size=(2, 3))
    truth = se3.exp(np.concatenate([0.4 * way / np.linalg.norm(way), np.deg2rad(3.0) * axis / np.linalg.norm(axis)]))
    features = features_at(truth, seed)
    result = registration.locate(features, np.eye(4))
    assert result.ok
    assert result.converged
    assert len(result.degenerate) == 0
    metres, degrees = distance(result.T_world_lidar, truth)
    assert metres < 0.02
    assert degrees < 0.15
    # That nothing moved would be no answer.
    assert distance(np.eye(4), truth)[0] > 0.3


@pytest.mark.parametrize(("grid_step", "voxel"), [(1.5, 0.1), (1.5, 1.5), (2.0, 0.5), (0.2, 0.1), (0.2, 3.0)])
@pytest.mark.parametrize("step", [joint_step, None])
def test_neither_a_coarse_grid_nor_a_fine_map_starves_the_registration(
    step: ScanStep | None, grid_step: float, voxel: float
) -> None:
    """Six points make a plane, however far the grid that thinned them has set them apart."""
    loam = LoamConfig(grid_step=grid_step, feature_map_voxel=voxel)
    registration = engine(step, True, loam)
    prior = np.eye(4)
    for k in range(8):
        truth = se3.exp(np.array([0.3 * k, -0.1 * k, 0.02 * k, 0, 0, np.deg2rad(k)]))
        features = extract_features(scan_of_room(truth, k), loam)
        result = registration.locate(features, prior)
        assert result.ok, result.reason
        metres, degrees = distance(result.T_world_lidar, truth)
        assert metres < 0.05
        assert degrees < 0.3
        registration.update(result)
        prior = result.T_world_lidar


@pytest.mark.parametrize("grid_step", [0.2, 1.5, 3.0])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_coarse_grid_takes_neither_counterparts_nor_normals_from_scan_to_scan(grid_step: float, seed: int) -> None:
    """Points are sought as far as the grid has set them apart; where rings are dense it leaves enough for normals near by."""
    loam = LoamConfig(grid_step=grid_step)
    registration = engine(joint_step, False, loam)
    first = extract_features(scan_of_room(np.eye(4)), loam)
    registration.update(registration.locate(first, np.eye(4)))
    target = registration.target.scan
    assert target is not None
    assert np.any(target.normals, axis=1).mean() > 0.6
    truth = se3.exp(np.array([0.2, -0.1, 0.05, 0, 0, np.deg2rad(1)]))
    result = registration.locate(extract_features(scan_of_room(truth, seed), loam), np.eye(4))
    assert not result.reason
    assert result.matched > 0.95 * result.source_points
    assert distance(result.T_world_lidar, truth)[0] < 0.02


def test_edges_alone_find_the_plan_and_planes_the_upright_directions() -> None:
    """Each step of two moves only its own directions, in the sensor's axes at the prior, and both together arrive."""
    prior = random_pose(np.random.default_rng(7), 0.5, 20.0)
    truth = prior @ se3.exp(np.array([0.1, -0.08, 0.06, 0.01, -0.015, 0.02]))
    target = feature_scan(features_at(prior), prior)
    features = features_at(truth, 1)
    upright = upright_directions(prior)
    ground = solve_on_scan(target, ANNEALING, NOISE, True, NONE, features.planes.points, prior, upright)
    moved = se3.relative(prior, ground.T_world_lidar)
    np.testing.assert_allclose(moved[:2, 3], 0.0, atol=1e-3)
    assert abs(np.arctan2(moved[1, 0], moved[0, 0])) < 1e-3
    assert abs(moved[2, 3] - 0.06) < 0.02
    np.testing.assert_allclose(upright @ upright, upright, atol=1e-12)
    assert np.trace(upright) == pytest.approx(3.0)
    clock = StageClock()
    both = two_steps(partial(solve_on_scan, target, ANNEALING, NOISE, True), features, prior, clock)
    assert list(clock.seconds) == ["ground", "edges"]
    assert distance(both.T_world_lidar, truth)[0] < distance(ground.T_world_lidar, truth)[0] < distance(prior, truth)[0]
    assert distance(both.T_world_lidar, truth)[0] < 0.05


def test_planes_of_two_walls_leave_their_direction_open_and_the_prior_there() -> None:
    """Only floor and the two long walls: nothing is known along x, and the result says which direction that is."""
    prior = se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    target = feature_scan(features_at(np.eye(4), with_pillars=False), np.eye(4))
    seen = features_at(se3.exp(np.array([0.3, 0.05, 0.03, 0, 0, 0])), 1, with_pillars=False).planes.points
    flat = seen[np.abs(seen[:, 0]) < 5.0]
    result = solve_on_scan(target, ANNEALING, NOISE, True, NONE, flat, prior)
    assert len(result.degenerate) == 1
    along = result.degenerate[0, :3] / np.linalg.norm(result.degenerate[0, :3])
    assert abs(along[0]) > np.cos(np.deg2rad(10))
    assert abs(result.T_world_lidar[0, 3] - 0.3) < 5e-3
    assert abs(result.T_world_lidar[1, 3] - 0.05) < 0.02
    assert result.covariance is not None
    assert result.covariance[0, 0] > 0.5
    assert result.covariance[1, 1] < 0.01


def test_less_planar_points_may_stand_in_and_leave_a_direction_open() -> None:
    """Floor and long walls, hardly a feature on them: the pose across is found all the same, the prior kept along."""

    def between_walls(pose: Floats, seed: int) -> Features:
        whole = features_at(pose, seed, with_pillars=False)
        few, all_less = whole.planes, whole.less_planes
        flat, near = np.abs(all_less.points[:, 0]) < 5.0, np.flatnonzero(np.abs(few.points[:, 0]) < 5.0)[::20]
        nothing = replace(whole.edges, points=NONE)
        return replace(
            whole, edges=nothing, less_edges=nothing, planes=replace(few, points=few.points[near]),
            less_planes=replace(all_less, points=all_less.points[flat]),
        )  # fmt: skip

    registration = engine(None, True)
    first = between_walls(np.eye(4), 0)
    registration.update(registration.locate(first, np.eye(4)))
    for k in range(1, 8):
        truth = se3.make(np.eye(3), np.array([0.2 * k, 0.03, 0.02]))
        prior = se3.make(np.eye(3), np.array([0.2 * k, 0.0, 0.0]))
        features = between_walls(truth, k)
        result = registration.locate(features, prior)
        registration.update(result)
    assert result.ok, result.reason
    assert (result.pose_source, result.reason) == (LessPlanar.name, "")
    assert len(result.degenerate) == 1
    assert abs(result.T_world_lidar[0, 3] - prior[0, 3]) < 5e-3
    assert np.abs(result.T_world_lidar[1:3, 3] - truth[1:3, 3]).max() < 0.01


def test_a_map_of_all_points_is_given_up_when_features_are_fed_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    registration = engine(None, True, recovery=RecoveryConfig(fallback="all-points"))
    features = features_at(np.eye(4))
    registration.update(registration.locate(features, np.eye(4)))
    assert registration.target.all_points is not None
    entered = []
    for is_starved in (False, True, *[False] * (CONSTRAINED_SCANS + 2)):
        monkeypatch.setattr(
            "lslam.odometry.feature_policies.holds_position", lambda *_, starved=is_starved: not starved
        )
        result = registration.locate(features, np.eye(4))
        assert (result.pose_source == ALL_POINTS) == is_starved
        registration.update(result)
        entered.append(registration.target.all_points.state()["_icp"]["history"]["inserted"])
    assert entered[0] == 0
    assert np.diff(entered[1:]).tolist() == [1] * (CONSTRAINED_SCANS - 1) + [0] * 3


@pytest.mark.parametrize(
    ("inliers", "before", "after", "is_taken"),
    [(200, 1, 0, True), (200, 2, 1, True), (200, 1, 1, False), (10, 0, 0, True), (10, 1, 1, True), (10, 0, 1, False)],
)
def test_less_planar_points_are_taken_when_fewer_directions_stay_degenerate(
    monkeypatch: pytest.MonkeyPatch, inliers: int, before: int, after: int, is_taken: bool
) -> None:
    registration = engine(None, True)
    other = RegistrationResult(se3.exp(np.full(6, 0.1)), degenerate=np.eye(6)[:after])
    monkeypatch.setattr(registration.target, "on_planes", lambda *_: other)
    few = RegistrationResult(np.eye(4), degenerate=np.eye(6)[:before], inliers=inliers)
    attempt = registration.attempt(features_at(np.eye(4)), np.eye(4))
    result = LessPlanar().recover(attempt, few)
    assert (result.T_world_lidar is other.T_world_lidar) == is_taken
    assert (result.pose_source == LessPlanar.name) == is_taken


def test_what_led_astray_where_nothing_is_observed_is_taken_back_and_nothing_else() -> None:
    """In coordinates whose rotation is scaled by the lever arm, as those of the unobserved directions are."""
    rng, arm = np.random.default_rng(4), 12.0
    for _ in range(20):
        weak = np.linalg.qr(rng.normal(size=(6, 6)))[0][:2]
        expected = random_pose(rng, 5.0, 90.0)
        moved = rng.normal(0, 0.05, 6)

        def after(step: Floats, start: Floats = expected) -> Floats:
            turned = se3.exp(np.r_[np.zeros(3), step[3:] / arm])[:3, :3] @ start[:3, :3]
            return se3.make(turned, start[:3, 3] + step[:3])

        astray = RegistrationResult(after(moved), degenerate=weak, lever_arm=arm)
        kept = remap_solution(astray, expected)
        right = after(moved - weak.T @ (weak @ moved))
        # Small rotations add up but for the product of two of them.
        np.testing.assert_allclose(kept.T_world_lidar, right, atol=2e-4)


def test_the_least_information_of_a_direction_follows_the_error_of_the_prior() -> None:
    """A prior that is wrong by 0.3 m knows a direction as one planar point in a hundred would: 3 cm over 0.3 m, squared."""
    registration = engine(joint_step, False)
    for error, least in [(0.3, 0.01), (0.06, 0.25), (0.03, 1.0), (0.001, 1.0), (0.0, 1.0)]:
        for _ in range(4000):
            registration.history.threshold.observe(error)
        assert registration.target.noise(registration.history).least == pytest.approx(least)


@pytest.mark.parametrize(("step", "with_map"), VARIANTS)
def test_no_features_at_all_keep_the_prior_and_its_covariance(step: ScanStep | None, with_map: bool) -> None:
    registration = engine(step, with_map)
    first = features_at(np.eye(4))
    registration.update(registration.locate(first, np.eye(4)))
    none = extract_features(scan_of_room(np.eye(4)).select(np.arange(8)))
    prior = se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    result = registration.locate(none, prior)
    assert not result.ok
    assert "0 edges and 0 planar points" in result.reason
    np.testing.assert_array_equal(result.T_world_lidar, prior)
    before = registration.target.scan
    registration.update(result)
    assert registration.target.scan is before


def test_surfaces_are_known_however_far_from_the_start() -> None:
    far = se3.make(np.eye(3), np.array([600.0, -400.0, 0.0]))
    near, away = (feature_scan(features_at(np.eye(4)), pose) for pose in (np.eye(4), far))
    known, known_away = (np.any(target.normals, axis=1).mean() for target in (near, away))
    assert known_away == pytest.approx(known, abs=0.05)
