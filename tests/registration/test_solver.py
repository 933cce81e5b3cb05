"""One scan against one map: facts, covariance, and what stands in where there are no planes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import repeat

import numpy as np
import pytest
from analytic_scenes import (
    NOISE,
    corridor,
    distance,
    floor_only,
    is_near,
    pose_at,
    random_pose,
    rectangle,
    room,
    seen_from,
)
from numpy.typing import NDArray

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.kernels.residuals import TILT_FACTOR
from lslam.registration.alignment import solve, upright_directions
from lslam.registration.gaussian_map import FLOOR_M2, GaussianMap
from lslam.registration.optimiser import Annealing
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.residuals import PLANE, PLANES_ALONE
from lslam.registration.result import RegistrationResult

Floats = NDArray[np.float64]
# Of the points of a room.
LEVER_ARM_M = 8.0
FINE = Annealing(1.0, 20)


def as_source(points: NDArray[np.float32]) -> PreparedPoints:
    """Every point is a source point and nothing is known of its surroundings."""
    return PreparedPoints(points, points.astype(np.float64), np.zeros((len(points), 6)), len(points))


def on(
    target: GaussianMap, points: NDArray[np.float32], prior: Floats, non_planar_weight: float = 0.5
) -> RegistrationResult:
    config = RegistrationConfig(sigma=NOISE, weak_share=1e-3)
    return solve(
        (target,), as_source(points), prior, FINE, config, residual=replace(PLANE, non_planar_weight=non_planar_weight)
    )


def map_of(world: Floats) -> GaussianMap:
    target = GaussianMap(0.8)
    target.insert(world.astype(np.float32), np.eye(4))
    return target


@pytest.fixture(scope="module")
def room_map() -> GaussianMap:
    return map_of(room(np.random.default_rng(0), 8000))


def test_the_facts_are_those_of_the_registration(room_map: GaussianMap) -> None:
    rng = np.random.default_rng(1)
    T = random_pose(rng, 0.2, 2.0)
    result = on(room_map, seen_from(room(rng, 300), T), np.eye(4))
    assert result.ok
    assert result.converged
    assert is_near(T, result.T_world_lidar, 0.005, 0.05)
    assert result.source_points == len(room(rng, 300))
    assert 0.9 < result.overlap == result.matched / result.source_points <= 1.0
    assert 0.9 < result.inlier_share == result.inliers / result.matched <= 1.0
    assert 0.8 * NOISE < result.rmse < 2 * NOISE
    assert 5.0 < result.lever_arm < 11.0
    assert len(result.degenerate) == 0


@pytest.mark.parametrize("weak_share", [0.0, 1e-3])
def test_the_ground_aligns_height_and_tilt_alone(room_map: GaussianMap, weak_share: float) -> None:
    """Of a start that is wrong in all six directions, place and heading stay as they were, on a tilted sensor, too."""
    rng = np.random.default_rng(4)
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, -0.15, 0.4]))
    off = se3.exp(np.array([0.12, -0.1, 0.14, 0.02, -0.015, 0.03]))
    start = T @ off
    result = solve(
        (room_map,), as_source(seen_from(room(rng, 300), T)), start, FINE,
        RegistrationConfig(sigma=NOISE, weak_share=weak_share), directions=upright_directions(start),
    )  # fmt: skip
    moved = se3.log(se3.relative(start, result.T_world_lidar))
    left = se3.log(se3.relative(T, result.T_world_lidar))
    np.testing.assert_allclose(moved[[0, 1, 5]], 0.0, atol=5e-3)
    assert abs(left[2]) < 0.02
    np.testing.assert_allclose(left[3:5], 0.0, atol=5e-3)


def test_covariance_is_symmetric_and_shrinks_as_points_come_in(room_map: GaussianMap) -> None:
    rng = np.random.default_rng(2)
    traces = []
    for n in (100, 400, 1600):
        C = on(room_map, room(rng, n).astype(np.float32), np.eye(4)).covariance
        assert C is not None
        np.testing.assert_allclose(C, C.T, atol=1e-15)
        assert np.linalg.eigvalsh(C).min() > 0
        traces.append(np.diag(C))
    np.testing.assert_allclose(traces[0] / traces[1], 4.0, rtol=0.25)
    np.testing.assert_allclose(traces[1] / traces[2], 4.0, rtol=0.25)


def _spread_over_claim(targets: Iterable[GaussianMap], rng: np.random.Generator) -> Floats:
    """(6,) standard deviation of the results of one draw of a scan on each of the maps, over the mean of what they claim."""
    found, claimed = [], []
    for target in targets:
        result = on(target, room(rng, 40).astype(np.float32), np.eye(4))
        delta = result.T_world_lidar
        found.append(np.concatenate([delta[:3, 3], so3.log(delta[:3, :3])]))
        assert result.covariance is not None
        claimed.append(np.sqrt(np.diag(result.covariance)))
    spread: Floats = np.std(found, axis=0) / np.mean(claimed, axis=0)
    return spread


def test_covariance_is_the_spread_of_the_results(room_map: GaussianMap) -> None:
    """Forty draws of the source noise; the map, the floor under its voxels and the robust kernel widen it a little."""
    ratio = _spread_over_claim(repeat(room_map, 40), np.random.default_rng(3))
    assert ((ratio > 0.4) & (ratio < 1.6)).all()


def test_covariance_is_the_spread_over_maps_whose_scans_err() -> None:
    """Four scans make each map, and err so that points move by what these are said to share; else the ratio is 1.2 to 2."""
    rng = np.random.default_rng(3)

    def erring() -> GaussianMap:
        target = GaussianMap(0.8, scan_variance=FLOOR_M2 / TILT_FACTOR)
        for error in rng.normal(0.0, np.sqrt(FLOOR_M2), (4, 6)):
            target.insert(room(rng, 2000).astype(np.float32), se3.exp(error / np.repeat([1.0, LEVER_ARM_M], 3)))
        return target

    ratio = _spread_over_claim((erring() for _ in range(40)), rng)
    assert ((ratio > 0.7) & (ratio < 1.7)).all()


@pytest.mark.parametrize(
    ("held", "is_weak", "is_followed"), [(1.2, False, True), (0.9, True, True), (0.36, True, True), (0.25, True, False)]
)
def test_a_degenerate_direction_is_estimated_down_to_three_tenths_of_the_threshold(
    held: float, is_weak: bool, is_followed: bool
) -> None:
    """Along a corridor whose end is seen in 20 points: how much they hold is read from the covariance of a first solution."""
    rng = np.random.default_rng(5)
    ends = [rectangle(rng, n, 0, 20.0, [(-3, 3), (-1.7, 3)]) for n in (4000, 20)]
    target = map_of(np.concatenate([corridor(rng), ends[0]]))
    seen = as_source(np.concatenate([corridor(rng, 1000), ends[1]]).astype(np.float32))
    start = pose_at((0.05, 0.0, 0.0))

    def solved(weak_share: float) -> RegistrationResult:
        annealing = Annealing(0.3, 20, 0.3)
        config = RegistrationConfig(sigma=NOISE, weak_share=weak_share)
        return solve((target,), seen, start, annealing, config, residual=PLANES_ALONE)

    first = solved(1e-12)
    assert first.covariance is not None
    H = np.linalg.inv(first.covariance)
    scale = np.repeat([1.0, 1 / first.lever_arm], 3)
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    assert np.abs(vectors[0]).argmax() == 0
    share = float(values[0] / np.trace(H[:3, :3]))
    found = solved(share / held)
    assert bool((np.abs(found.degenerate[:, 0]) > 0.9).any()) == is_weak
    assert found.T_world_lidar[0, 3] == pytest.approx(0.0 if is_followed else 0.05, abs=0.01)


def test_covariance_turns_with_the_world() -> None:
    rng = np.random.default_rng(4)
    world, scan = corridor(rng), corridor(rng, 300).astype(np.float32)
    turn = pose_at((0.0, 0.0, 0.0), 90.0)
    straight = on(map_of(world), scan, np.eye(4)).covariance
    turned = on(map_of(se3.apply(turn, world)), scan, turn).covariance
    assert straight is not None
    assert turned is not None
    assert straight[0, 0] > 100 * straight[1, 1]
    assert turned[1, 1] > 100 * turned[0, 0]


@pytest.mark.parametrize(("slide", "turn"), [(0.0, 0.0), (0.3, 0.0), (-0.2, 20.0), (0.1, 45.0)])
def test_along_a_corridor_the_prior_stays(slide: float, turn: float) -> None:
    """The corridor runs along `turn`; nothing is seen of the motion along it."""
    rng = np.random.default_rng(5)
    T_world_corridor = pose_at((0.0, 0.0, 0.0), turn)
    target = map_of(se3.apply(T_world_corridor, corridor(rng, 20000)))
    prior = T_world_corridor @ pose_at((slide, 0.1, 0.05), 0.5)
    scan = se3.apply(np.eye(4), corridor(rng, 600)).astype(np.float32)
    result = on(target, scan, prior, non_planar_weight=0.0)
    assert len(result.degenerate) == 1
    along = T_world_corridor[:3, 0]
    assert abs(result.degenerate[0, :3] @ along) > 0.99
    assert np.linalg.norm(result.degenerate[0]) == pytest.approx(1.0)
    moved = T_world_corridor[:3, :3].T @ result.T_world_lidar[:3, 3]
    assert moved[0] == pytest.approx(slide, abs=2e-3)
    assert abs(moved[1]) < 0.005
    assert abs(moved[2]) < 0.005
    C = result.covariance
    assert C is not None
    assert along @ C[:3, :3] @ along == pytest.approx(1.0, rel=0.1)


def test_on_one_plane_three_directions_keep_the_prior() -> None:
    rng = np.random.default_rng(6)
    prior = pose_at((0.2, -0.1, 0.1), 3.0)
    result = on(map_of(floor_only(rng, 60000)), floor_only(rng, 1500).astype(np.float32), prior, non_planar_weight=0.0)
    assert len(result.degenerate) == 3
    # z, roll and pitch are seen, whatever the basis of the rest.
    np.testing.assert_allclose(result.degenerate[:, 2:5], 0.0, atol=0.01)
    np.testing.assert_allclose(result.T_world_lidar[:2, 3], prior[:2, 3], atol=1e-3)
    assert abs(result.T_world_lidar[2, 3]) < 0.003
    turn = so3.log(result.T_world_lidar[:3, :3])
    assert turn[2] == pytest.approx(np.deg2rad(3.0), abs=1e-4)
    assert np.abs(turn[:2]).max() < 1e-3


def balls(rng: np.random.Generator, n: int) -> Floats:
    """Sixty round things of 10 cm, each in the middle of a voxel of its own, so that none is a plane."""
    places = np.random.default_rng(0).permutation(np.indices((30, 30, 8)).reshape(3, -1).T)[:60] - [15, 15, 4]
    centres = (places + 0.5) * 0.8
    return np.asarray((centres[:, None] + rng.normal(0, 0.1, (60, n, 3))).reshape(-1, 3))


def test_where_no_voxel_is_a_plane_the_fall_back_registers() -> None:
    rng = np.random.default_rng(7)
    target = map_of(balls(rng, 400))
    used = target.planes[: len(target), 7]
    assert (used < 0).all()
    T = random_pose(rng, 0.15, 0.8)
    scan = seen_from(balls(rng, 20), T)
    with_it, without = (on(target, scan, np.eye(4), non_planar_weight=w) for w in (0.5, 0.0))
    assert with_it.converged
    assert len(with_it.degenerate) == 0
    metres, degrees = distance(T, with_it.T_world_lidar)
    assert metres < 0.02
    assert degrees < 0.15
    assert metres < 0.3 * distance(T, np.eye(4))[0]
    assert without.matched == 0
    np.testing.assert_array_equal(without.T_world_lidar, np.eye(4))
    assert without.covariance is None


def test_no_matches_leave_the_prior_and_no_covariance(room_map: GaussianMap) -> None:
    prior = pose_at((500.0, 0.0, 0.0))
    result = on(room_map, room(np.random.default_rng(8), 50).astype(np.float32), prior)
    np.testing.assert_array_equal(result.T_world_lidar, prior)
    assert result.overlap == 0.0
    assert not result.converged
    assert result.covariance is None


def test_the_prior_is_left_alone(room_map: GaussianMap) -> None:
    prior = pose_at((0.1, 0.0, 0.0))
    kept = prior.copy()
    on(room_map, room(np.random.default_rng(9), 100).astype(np.float32), prior)
    np.testing.assert_array_equal(prior, kept)
