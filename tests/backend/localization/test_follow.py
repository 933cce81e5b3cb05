"""Scans on a fixed map: held where it is, carried where it has changed or ends, and back again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from revisited import CONFIG, Revisited, error_of, revisit

from lslam.backend.localization.locate import MapFollower, mark_doubts
from lslam.backend.localization.prior_map import LocalView, PlaceSearch, PriorMap, make_prior_map
from lslam.core.geometry import se3
from lslam.core.types.constraint import MapFix
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.simulation.routes import Visit

FIRST_P = np.diag([0.05**2] * 3 + [np.deg2rad(0.5) ** 2] * 3)


@pytest.fixture(scope="module")
def world() -> Revisited:
    return revisit("block", 7, Visit(1, shift=20.0), 60)


def followed(
    world: Revisited, points: np.ndarray, P: np.ndarray = FIRST_P, off: tuple[float, float] = (0.0, 0.0)
) -> tuple[PriorMap, list[MapFix]]:
    """The fixes of all scans, from the true first pose moved by `off`, m along x and y."""
    prior_map = make_prior_map(points, CONFIG.registration)
    view = LocalView(prior_map, CONFIG.registration, 100.0)
    T = se3.inverse(prior_map.T_map_level) @ world.true_poses[0]
    T[:2, 3] += off
    follower = MapFollower(view, T, P, CONFIG)
    fixes = []
    for k, (scan, result) in enumerate(zip(world.drive, world.results, strict=True)):
        if k:
            follower.predict(world.results[k - 1], result)
        fixes.append(follower.correct(k, prepare_points(scan.points, CONFIG.preprocess, scan.index)))
    return prior_map, fixes


def errors(world: Revisited, prior_map: PriorMap, fixes: list[MapFix]) -> np.ndarray:
    return np.array([
        error_of(prior_map.T_map_level @ fix.T_map_lidar, truth)[0] for fix, truth in zip(fixes, world.true_poses, strict=True)
    ])  # fmt: skip


def test_the_map_holds_every_scan_to_centimetres(world: Revisited) -> None:
    prior_map, fixes = followed(world, world.points)
    assert all(fix.is_binding for fix in fixes), [fix.reason for fix in fixes if not fix.is_binding]
    assert errors(world, prior_map, fixes).max() < 0.03


def test_a_start_that_is_metres_off_is_caught_when_its_covariance_says_so(world: Revisited) -> None:
    wide = np.diag([1.0] * 3 + [np.deg2rad(2.0) ** 2] * 3)
    prior_map, fixes = followed(world, world.points, wide, (1.5, -1.0))
    assert errors(world, prior_map, fixes)[5:].max() < 0.03


def test_odometry_carries_beyond_the_end_of_the_map_and_comes_back(world: Revisited) -> None:
    ahead = se3.apply(se3.inverse(world.true_poses[25]), world.points)
    near = np.linalg.norm(ahead[:, :2], axis=1) < 22.0
    prior_map, fixes = followed(world, world.points[~near])
    away = errors(world, prior_map, fixes)
    carried = [k for k, fix in enumerate(fixes) if not fix.is_binding]
    assert carried, "the hole is passed"
    assert fixes[0].is_binding
    assert fixes[-1].is_binding
    assert away.max() < 0.1
    assert all(fixes[k].reason for k in carried)
    size = [float(np.trace(fix.covariance[:3, :3])) for fix in fixes]
    assert all(size[k] > size[k - 1] for k in carried), "what nothing holds grows less certain"


def test_a_street_that_was_rebuilt_is_flagged_and_does_not_drag(world: Revisited) -> None:
    changed = world.points.copy()
    ahead = se3.apply(se3.inverse(world.true_poses[30]), world.points)
    is_moved = (np.linalg.norm(ahead[:, :2], axis=1) < 30.0) & (np.abs(ahead[:, 2] + 1.7) > 0.4)
    # The street is wider than the map knows: either side stands 1.2 m farther out.
    out = np.sign(ahead[:, 1])[:, None] * world.true_poses[30, :3, 1]
    changed[is_moved] -= 1.2 * out[is_moved]
    prior_map, fixes = followed(world, changed)
    marked = mark_doubts(fixes)
    assert sum(fix.is_doubtful for fix in marked[25:36]) > 5
    assert not any(fix.is_doubtful for fix in marked[45:])
    assert errors(world, prior_map, fixes).max() < 0.1


def test_the_map_stays_as_it_is(world: Revisited) -> None:
    prior_map = make_prior_map(world.points, CONFIG.registration)
    before = prior_map.points.tobytes()
    view = LocalView(prior_map, CONFIG.registration, 100.0)
    T = se3.inverse(prior_map.T_map_level) @ world.true_poses[0]
    alignment = view.at(T[:3, 3])
    moments = [level.moments.copy() for level in alignment.map.levels]
    scan = next(iter(world.drive))
    MapFollower(view, T, FIRST_P, CONFIG).correct(0, prepare_points(scan.points, CONFIG.preprocess, 0))
    assert prior_map.points.tobytes() == before
    assert all(np.array_equal(a, b.moments) for a, b in zip(moments, alignment.map.levels, strict=True))


def test_a_scan_without_points_is_carried(world: Revisited) -> None:
    prior_map = make_prior_map(world.points, CONFIG.registration)
    view = LocalView(prior_map, CONFIG.registration, 100.0)
    follower = MapFollower(view, np.eye(4), FIRST_P, CONFIG)
    fix = follower.correct(0, None)
    assert fix.status == "unread"
    assert np.array_equal(fix.T_map_lidar, np.eye(4))


def test_beyond_the_map_it_may_be_off_as_odometry_drifts_steadily(world: Revisited) -> None:
    """A drift at the rate that loops allow for lies within three sigmas after any way, and a random walk alone forbids it."""
    prior_map = make_prior_map(world.points, CONFIG.registration)
    view = LocalView(prior_map, CONFIG.registration, 100.0)
    follower = MapFollower(view, np.eye(4), np.diag([1e-4] * 3 + [1e-10] * 3), CONFIG)
    c, before = CONFIG.loops, world.results[0]
    for k in range(1, 301):
        pose = before.T_world_lidar @ se3.make(np.eye(3), np.array([2.0, 0.0, 0.0]))
        after = replace(before, index=k, T_world_lidar=pose, covariance=None, registration_covariance=None)
        follower.predict(replace(before, covariance=None, registration_covariance=None), after)
        before = after
    way = 600.0
    turn = np.deg2rad(c.drift_deg) / 100 * way
    off = np.hypot(0.01 * c.drift_percent * way, 0.5 * turn * way)
    across = follower.T[:3, 1]
    allowed = 3.0 * float(np.sqrt(across @ follower.covariance[:3, :3] @ across))
    assert off < allowed < 4 * off
    walked = 3.0 * float(np.sqrt(across @ follower.P[:3, :3] @ across))
    assert walked < allowed
    # The map holds it again: nothing of that way is left.
    follower.way = 0.0
    np.testing.assert_array_equal(follower.covariance, follower.P)


def test_what_is_searched_is_near_the_map(world: Revisited) -> None:
    prior_map = make_prior_map(world.points, CONFIG.registration)
    search = PlaceSearch(prior_map, CONFIG.registration)
    low, high = prior_map.points[:, :2].min(0), prior_map.points[:, :2].max(0)
    assert search.is_near((se3.inverse(prior_map.T_map_level) @ world.true_poses[0])[:2, 3], 5.0)
    beyond = np.array([high[0] + 30.0, 0.5 * (low + high)[1]])
    assert not search.is_near(beyond, 20.0)
    assert search.is_near(beyond, 30.0 + float(high[0] - low[0]))


def test_the_part_of_the_map_along_a_drive_has_all_points_within_reach_and_none_far_away() -> None:
    rng = np.random.default_rng(1)
    prior_map = PriorMap(rng.uniform((-200, -150, 0), (200, 150, 9), (40_000, 3)).astype(np.float32), np.eye(4))
    drive = np.stack([np.linspace(-60, 70, 40), np.linspace(0, 90, 40), np.zeros(40)], 1)
    found = prior_map.along(drive, 40.0)
    away = np.linalg.norm(prior_map.points[:, None, :2] - drive[None, :, :2], axis=2).min(axis=1)
    known = {point.tobytes() for point in found}
    assert len(known) == len(found)
    assert all(point.tobytes() in known for point in prior_map.points[away < 40.0])
    assert all(point.tobytes() not in known for point in prior_map.points[away > 40.0 + 3 * 32.0])
    assert len(prior_map.along(drive + 5000.0, 40.0)) == 0
