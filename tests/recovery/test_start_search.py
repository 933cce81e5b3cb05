"""The search for a first step: what stands on the ground decides between places that look alike."""

from __future__ import annotations

from copy import copy, deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from analytic_scenes import pose_at
from lslam.registration.recent_scans import RecentScans
from lslam.registration.start_search import CLEARLY, MUCH, NEAR, is_much_more, standing_points, start_offsets
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lslam.config.preprocess import PreprocessConfig
from lslam.geometry import se3
from lslam.preprocessing.prepare import prepare_points
from lslam.registration.registration import Registration
from lslam.simulation.lidar_models import lidar_named
from lslam.simulation.scenarios import SimulatedDrive, simulate

Floats = NDArray[np.float64]

STRIDE = 3


@cache
def driven(scenario: str, seed: int) -> SimulatedDrive:
    return simulate(scenario, seed=seed, motion_compensated=True)


def seen_by(lidar: str, scenario: str, seed: int = 0) -> SimulatedDrive:
    """The same drive with another LiDAR: to build the town takes longer than what is asked here."""
    drive = copy(driven(scenario, seed))
    drive.lidar = lidar_named(lidar)
    return drive


def at_every_third(scenario: str, seed: int, first: int, prior: Floats | None) -> tuple[float, int]:
    """Error of the first step, m, and how many directions nothing observes, with a prior or without one."""
    drive = driven(scenario, seed)
    truth = se3.relative(drive.ground_truth.poses[first], drive.ground_truth.poses[first + STRIDE])
    registration = Registration()
    registration.register(drive.scan(first).points)
    result = registration.register(drive.scan(first + STRIDE).points, truth if prior is None else prior)
    assert result.ok
    return float(np.linalg.norm(result.T_world_lidar[:3, 3] - truth[:3, 3])), len(result.degenerate)


@pytest.mark.parametrize(("seed", "first"), [(0, 0), (0, 217), (1, 72), (2, 145)])
def test_nine_metres_a_scan_are_found_among_posts_and_cars_that_keep_pace(seed: int, first: int) -> None:
    error, _ = at_every_third("motorway", seed, first, np.eye(4))
    assert error < 0.1


def test_what_the_search_has_found_is_not_given_up_for_a_wide_kernel() -> None:
    """Four metres and five degrees round a corner: from the true place coarse planes led to a false one 1.9 m on."""
    error, _ = at_every_third("block", 0, 42, np.eye(4))
    assert error < 0.05


@pytest.mark.parametrize(("seed", "first"), [(1, 0), (2, 290)])
def test_a_first_turn_of_more_than_twenty_degrees_is_found(seed: int, first: int) -> None:
    error, _ = at_every_third("walk", seed, first, np.eye(4))
    assert error < 0.02


def test_turns_of_thirty_degrees_that_nothing_foretells_are_found_along_the_way() -> None:
    drive = driven("walk", 0)
    registration = Registration()
    for i in range(0, 54, STRIDE):
        result = registration.register(drive.scan(i).points)
        truth = se3.relative(drive.ground_truth.poses[0], drive.ground_truth.poses[i])
        assert result.ok, result.reason
        assert np.linalg.norm(result.T_world_lidar[:3, 3] - truth[:3, 3]) < 0.02


@pytest.mark.parametrize(("seed", "first"), [(0, 10), (1, 5)])
def test_scans_that_went_missing_unnoticed_leave_no_scan_misplaced(seed: int, first: int) -> None:
    # A metre and more beyond the prior a fine map holds a scan by its own rings, with two thirds of the usual points.
    drive = driven("urban", seed)
    registration = Registration()
    for i in (*range(first, first + 9), first + 11, first + 14, first + 15):
        result = registration.register(drive.scan(i).points)
        truth = se3.relative(drive.ground_truth.poses[first], drive.ground_truth.poses[i])
        assert result.ok
        assert np.linalg.norm(result.T_world_lidar[:3, 3] - truth[:3, 3]) < 0.03


@pytest.mark.parametrize(("coarse", "is_taken"), [(0.9, True), (0.7, False)])
def test_coarse_to_fine_is_believed_only_where_it_agrees_as_usual(
    coarse: float, is_taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What hides the map from the fine registration, as passers-by do, hides it from the coarse one, which knows no better."""
    drive = simulate("block", count=8, motion_compensated=True)
    registration = Registration()
    last = [registration.register(drive.scan(i).points) for i in range(8)][-1]
    points = prepare_points(drive.scan(7).points, registration.preprocess, 7)
    found = replace(last, fine_inliers=int(0.6 * last.source_points), inliers=int(0.6 * last.source_points))
    other = replace(
        last, T_world_lidar=last.T_world_lidar @ se3.make(np.eye(3), np.array([0.05, 0, 0])),
        fine_inliers=int(coarse * last.source_points), inliers=int(coarse * last.source_points),
    )  # fmt: skip
    monkeypatch.setattr(registration._alignment, "refine", lambda *_: found)
    monkeypatch.setattr(registration._alignment, "coarse_to_fine", lambda *_: other)
    registration.agreement.usual = 1.0
    located = registration.locate(points, last.T_world_lidar)
    assert (located.T_world_lidar is other.T_world_lidar) == is_taken


@pytest.mark.parametrize("scenario", ["street", "block", "walk"])
def test_near_its_prior_a_scan_lies_on_coarse_planes_while_the_map_is_young(scenario: str) -> None:
    """Single rings of one scan pass for planes in fine voxels: they hold the next by four centimetres in the wrong place."""
    drive = seen_by("vlp16", scenario)
    first, second = (drive.ground_truth.poses[i] for i in range(2))
    registration = Registration()
    points = [prepare_points(drive.scan(i).points, registration.preprocess) for i in range(2)]
    registration.align(points[0], first)
    prior = second @ pose_at((0.1, 0.05, 0.0))
    result = registration.locate(points[1], prior, is_near=True)
    assert result.ok
    assert np.linalg.norm(result.T_world_lidar[:3, 3] - second[:3, 3]) < 0.02


def test_between_bare_walls_the_prior_stays_though_rings_match_best_where_nothing_moved() -> None:
    error, blind = at_every_third("corridor", 0, 145, None)
    assert blind == 1
    assert error < 0.02


@pytest.mark.parametrize(
    ("lidar", "seed"), [("vlp16", 0), ("vlp16", 1), ("vlp16", 4), ("os1-16", 0), ("os1-16", 1), ("os1-16", 4)]
)
def test_sixteen_beams_start_at_thirty_metres_a_second(lidar: str, seed: int) -> None:
    # Planes of so few rings lie on the road, and slide with it: by two metres in the first scan, by more in later ones.
    drive = seen_by(lidar, "motorway", seed)
    registration = Registration()
    for i in range(10):
        result = registration.register(drive.scan(i).points)
        truth = se3.relative(drive.ground_truth.poses[0], drive.ground_truth.poses[i])
        assert result.ok
        off = se3.relative(truth, result.T_world_lidar)
        assert np.linalg.norm(off[:3, 3]) < 0.5
        # What stands says little of height and tilt: 1 cm and 0.06 deg by the ground, to 0.16 m and 1 deg without it.
        assert abs(off[2, 3]) < 0.04
        assert np.rad2deg(np.linalg.norm(off[:2, 2])) < 0.13
        if i == 1:  # the prior is that it stands
            assert result.prior_error[0] == pytest.approx(np.linalg.norm(result.T_world_lidar[:3, 3]))


def test_a_start_that_is_taken_up_again_knows_what_stands() -> None:
    drive = seen_by("os1-16", "motorway", 1)
    first, again = Registration(), Registration()
    for i in range(2):
        first.register(drive.scan(i).points)
    again.restore(deepcopy(first.state()))
    poses = [one.register(drive.scan(2).points).T_world_lidar for one in (first, again)]
    np.testing.assert_array_equal(poses[0], poses[1])


@pytest.mark.parametrize("ahead", [0.15, 0.5])
def test_a_scan_that_leaves_its_prior_later_on_is_held_to_what_stands_too(ahead: float) -> None:
    """Planes of the road slide with sixteen beams, by half a metre where the prior is a little too far."""
    drive = seen_by("os1-16", "motorway", 0)
    registration, truth = Registration(), drive.ground_truth.poses
    for i in range(8):
        last = registration.register(drive.scan(i).points).T_world_lidar
    expected = last @ se3.relative(truth[7], truth[8])
    prior = expected @ se3.make(np.eye(3), np.array([ahead, 0.0, 0.0]))
    points = prepare_points(drive.scan(8).points, registration.preprocess, 8)
    result = registration.locate(points, prior)
    registration.config = registration.config.model_copy(update={"start_reach": 0.0})
    slid = registration.locate(points, prior)
    assert slid.ok
    off, held = (np.linalg.norm(r.T_world_lidar[:3, 3] - expected[:3, 3]) for r in (slid, result))
    assert off > 0.4
    assert held < 0.1
    assert result.ok
    assert result.prior_error[0] == pytest.approx(ahead, abs=0.15)


@pytest.mark.parametrize("scenario", ["residential", "urban"])
def test_a_second_scan_from_elsewhere_is_not_placed_by_the_few_points_that_agree(scenario: str) -> None:
    """Somewhere twelve metres around, a tenth of what stands has a point near by: planes refuse the scan with reason."""
    begun, other = (seen_by("vlp16", name) for name in ("street", scenario))
    registration = Registration()
    registration.register(begun.scan(0).points)
    result = registration.register(other.scan(100).points)
    assert not result.ok
    np.testing.assert_array_equal(result.T_world_lidar, np.eye(4))


def street(rng: np.random.Generator, x: float) -> NDArray[np.float32]:
    """Flat ground and irregular poles as seen from (x, 0, 1.7)."""
    ground = np.column_stack([rng.uniform(-30, 30, (4000, 2)), np.zeros(4000)])
    poles = np.random.default_rng(9).uniform(-25, 25, (40, 2)).repeat(20, axis=0)
    standing = np.column_stack([poles, np.tile(np.linspace(1.6, 4.0, 20), 40)])
    return (np.concatenate([ground, standing]) - [x, 0, 1.7]).astype(np.float32)


def recent(points: NDArray[np.float32], pose: Floats) -> RecentScans:
    scans = RecentScans(5, PreprocessConfig())
    scans.enter(points, pose)
    return scans


def test_the_share_is_that_of_points_with_a_neighbour_and_leaves_the_ground_out() -> None:
    rng = np.random.default_rng(0)
    scans = recent(street(rng, 0.0), pose_at((5.0, 0.0, 0.0), 30.0))
    first, seen = scans.standing(), scans.seen_in(street(rng, 2.0))
    assert len(seen.source) == 800
    tree = cKDTree(se3.apply(pose_at((5.0, 0.0, 0.0), 30.0), street(rng, 0.0)[4000:].astype(float)))
    true = pose_at((5.0, 0.0, 0.0), 30.0) @ pose_at((2.0, 0.0, 0.0))
    for off in np.arange(0.0, 6.0, 0.75):
        pose = true @ pose_at((off, 0.1, 0.0))
        away, _ = tree.query(se3.apply(pose, seen.source))
        # Cells stand for their points: their mean lies up to half a cell from any of them.
        assert (away < NEAR / 2).mean() - 0.02 <= first.share(seen, pose) <= (away < 1.5 * NEAR).mean() + 0.02
    assert first.share(seen, true) == 1.0
    assert first.share(seen, true) > CLEARLY * first.share(seen, true @ pose_at((1.0, 0.0, 0.0)))


def test_what_is_as_low_as_a_crash_barrier_is_asked_only_where_hardly_anything_is_higher() -> None:
    """Barriers lie along the road everywhere: the sensor's own rings match on them best where nothing moved."""
    points = street(np.random.default_rng(1), 0.0)
    along = np.arange(-20, 20, 0.1)
    barrier = np.column_stack([along, np.full_like(along, 5.0), np.full_like(along, 0.8 - 1.7)]).astype(np.float32)
    assert len(standing_points(np.concatenate([points, barrier]), PreprocessConfig())[1]) == 800
    few = np.concatenate([points[:4000], barrier, points[-20:]])
    assert len(standing_points(few, PreprocessConfig())[1]) == len(barrier) + 20


def test_bare_ground_says_nothing() -> None:
    ground = street(np.random.default_rng(1), 0.0)[:4000]
    scans = recent(ground, np.eye(4))
    assert scans.standing().share(scans.seen_in(ground), np.eye(4)) == 0.0


def hills(rng: np.random.Generator, at: float) -> NDArray[np.float32]:
    """Waves of ground, too gentle for anything to stand on them, as seen from 5 m above (at, 0)."""
    far, angle = 25 * np.sqrt(rng.uniform(0, 1, 20_000)), rng.uniform(-np.pi, np.pi, 20_000)
    x, y = far * np.cos(angle) + at, far * np.sin(angle)
    z = 0.25 * (np.sin(x / 2.3 + 0.5 * np.sin(y / 5)) + np.sin(y / 3.1 + np.sin(x / 7)))
    return np.column_stack([x - at, y, z - 5 + rng.normal(0, 0.01, len(x))]).astype(np.float32)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_where_nothing_stands_the_ground_decides(seed: int) -> None:
    rng = np.random.default_rng(seed)
    registration = Registration()
    registration.register(hills(rng, 0.0))
    result = registration.register(hills(rng, 8.0), np.eye(4))
    assert result.ok, result.reason
    np.testing.assert_allclose(result.T_world_lidar[:3, 3], [8, 0, 0], atol=0.03)


def test_starts_reach_as_far_as_asked_nearest_first() -> None:
    offsets = start_offsets(9.0, 3.0)
    lengths = np.linalg.norm(offsets, axis=1)
    assert lengths.max() == 9.0
    assert (np.diff(lengths) >= 0).all()
    assert len(start_offsets(0.0, 3.0)) == 0
    assert np.abs(start_offsets(4.0, 3.0)).max() == 4.0


def test_much_more_is_more_than_chance_and_more_than_walls_show() -> None:
    assert is_much_more(0.7, 0.6, 1000)
    assert not is_much_more(0.7, 0.6, 100)
    assert not is_much_more(0.6, 0.7, 1000)
    assert not is_much_more(0.7, 1.01 * 0.7 / MUCH, 10**6)
    # 60 points agree at both poses, 40 at either one or the other, by chance: more than two sigma once in 52 times.
    ours = np.random.default_rng(0).binomial(40, 0.5, 4000)
    by_chance = np.mean([is_much_more((60 + k) / 100, (100 - k) / 100, 100) for k in ours.tolist()])
    assert 0.01 < by_chance < 0.03


@pytest.mark.parametrize(("height", "kept"), [(0.3, 0.3), (0.5, 0.0)])
def test_height_and_tilt_come_from_planes_and_the_rest_from_what_stands(height: float, kept: float) -> None:
    """Half a metre higher nothing that stands would have its like near by: planes that say so do not hold the height."""
    rng = np.random.default_rng(3)
    tilted = se3.exp(np.array([0, 0, 0, 0.05, -0.2, 0.0]))
    level = street(rng, 0.0)
    scan = se3.apply(se3.inverse(tilted), level.astype(np.float64)).astype(np.float32)
    stands, planes = pose_at((3.0, 0.2, 0.0), 4.0), pose_at((2.8, 0.1, height), 3.5) @ se3.exp([0, 0, 0, 0.02, 0.01, 0])
    # Poses of the tilted sensor whose levelled frames are the two.
    placed = recent(scan, np.eye(4)).standing().place_on_ground(stands @ tilted, planes @ tilted, scan) @ se3.inverse(
        tilted
    )
    np.testing.assert_allclose(placed[:2, 3], stands[:2, 3], atol=0.05)
    np.testing.assert_allclose(placed[2, :3], planes[2, :3], atol=5e-3)
    assert placed[2, 3] == pytest.approx(kept, abs=0.02)
    yaw = np.rad2deg(np.arctan2(placed[1, 0], placed[0, 0]))
    assert abs(yaw - 4.0) < 0.1


def test_what_stands_in_a_scan_is_sought_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the scan is located, and not again while it is one of the recent ones."""
    sought: list[int] = []

    def seek(points: NDArray[np.float32], preprocess: PreprocessConfig) -> tuple[NDArray[np.float32], ...]:
        sought.append(len(points))
        return points, points

    monkeypatch.setattr("lslam.registration.recent_scans.standing_points", seek)
    scans = RecentScans(2, PreprocessConfig())
    for count in range(1, 5):
        points = np.zeros((count, 3), np.float32)
        assert len(scans.seen_in(points).source) == count
        scans.enter(points, np.eye(4))
        scans.standing()
    assert sought == [1, 2, 3, 4]
