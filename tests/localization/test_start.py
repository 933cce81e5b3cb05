"""The start of a drive in a map: found where it is, refused where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from revisited import CONFIG, Revisited, error_of, revisit, town_map

from lslam.geometry import se3, so3
from lslam.localization.place_search import PlaceSearch
from lslam.localization.prior_map import make_prior_map
from lslam.localization.start import PlaceFinder, Start, StartPrior
from lslam.simulation.routes import Visit

REGISTRATION = CONFIG.registration
# A map has a frame of its own, here tilted against the vertical as that of a run that nobody levelled.
T_MAP_TOWN = se3.make(so3.exp(np.array([0.06, -0.04, 2.1])), np.array([30.0, -12.0, 4.0]))


@pytest.fixture(scope="module")
def world() -> Revisited:
    return revisit("block", 7, Visit(1, is_reversed=True, shift=40.0), 45)


@pytest.fixture(scope="module")
def search(world: Revisited) -> PlaceFinder:
    prior_map = make_prior_map(se3.apply(T_MAP_TOWN, world.points), REGISTRATION)
    return PlaceFinder(PlaceSearch(prior_map, REGISTRATION), world.store, CONFIG)


def placed(start: Start, world: Revisited, prior_map_pose: np.ndarray) -> tuple[float, float]:
    scan = world.store.keyframes[start.vote.keyframe].scan
    T = prior_map_pose @ start.vote.T_level_odometry @ world.results[scan].T_world_lidar
    return error_of(T, T_MAP_TOWN @ world.true_poses[scan])


def map_pose(world: Revisited) -> np.ndarray:
    return make_prior_map(se3.apply(T_MAP_TOWN, world.points), REGISTRATION).T_map_level


def test_a_tilted_map_is_levelled(world: Revisited) -> None:
    up = map_pose(world)[:3, 2]
    assert np.rad2deg(np.arccos(up @ T_MAP_TOWN[:3, 2])) < 1.0


def test_a_drive_on_the_other_lane_is_found_anywhere_in_the_map(world: Revisited, search: PlaceFinder) -> None:
    start = search.find()
    assert start is not None, search.reasons
    assert start.votes >= 2
    move, turn = placed(start, world, map_pose(world))
    assert move < 0.1
    assert turn < 0.5


def test_a_drive_in_another_town_is_refused(search: PlaceFinder, world: Revisited) -> None:
    other = make_prior_map(town_map("street", 5, 120), REGISTRATION)
    lost = PlaceFinder(PlaceSearch(other, REGISTRATION), world.store, CONFIG)
    assert lost.find() is None
    assert lost.reasons


def test_a_given_start_is_searched_about(world: Revisited, search: PlaceFinder) -> None:
    T = se3.inverse(map_pose(world)) @ T_MAP_TOWN @ world.true_poses[0]
    heading = float(np.arctan2(T[1, 0], T[0, 0]))
    start = search.find(StartPrior(T[:2, 3] + [4.0, -3.0], heading + 0.2))
    assert start is not None, search.reasons
    assert placed(start, world, map_pose(world))[0] < 0.1


def test_a_wrong_start_is_refused_and_not_corrected_from_afar(world: Revisited, search: PlaceFinder) -> None:
    T = se3.inverse(map_pose(world)) @ T_MAP_TOWN @ world.true_poses[0]
    away = T[:2, 3] + 45.0 * np.array([np.cos(0.7), np.sin(0.7)])
    start = search.find(StartPrior(away, float(np.arctan2(T[1, 0], T[0, 0])) + np.pi / 2, 5.0, 0.2))
    assert start is None


def test_votes_that_odometry_cannot_compare_do_not_agree(search: PlaceFinder, world: Revisited) -> None:
    found = search.find()
    assert found is not None
    vote = found.vote
    count = len(search.store.keyframes)
    near = replace(vote, keyframe=min(vote.keyframe + 2, count - 1))
    assert search._same(vote, near)
    distances = search._distances
    try:
        # The same two keyframes half a kilometre of way apart: odometry may be wrong by a street.
        search._distances = distances + np.where(np.arange(count) >= near.keyframe, 500.0, 0.0)
        assert not search._same(vote, near)
    finally:
        search._distances = distances
