"""The start of a drive in a map: found where it is, refused where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from revisited import CONFIG, Revisited, error_of, revisit, town_map
from turned_sensor import TURNS, turn, turned_pose, turned_store

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.localization.locate import SPACING_M, PlaceFinder, Start, StartPrior, Vote
from lslam.backend.localization.prior_map import PlaceSearch, Region, make_prior_map
from lslam.backend.localization.sessions import Session, locate_session
from lslam.backend.loops.level_submap import make_level_submap
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3, so3
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


@pytest.mark.quick
def test_a_drive_on_the_other_lane_is_found_anywhere_in_the_map(world: Revisited, search: PlaceFinder) -> None:
    start = search.find()
    assert start is not None, search.reasons
    assert start.votes >= 2
    move, turn = placed(start, world, map_pose(world))
    assert move < 0.1
    assert turn < 0.5


def test_a_drive_in_another_town_is_refused(search: PlaceFinder, world: Revisited) -> None:
    other = make_prior_map(town_map("street", 5, 120, every=3), REGISTRATION)
    lost = PlaceFinder(PlaceSearch(other, REGISTRATION), world.store, CONFIG)
    assert lost.find() is None
    assert lost.reasons


@pytest.mark.parametrize("inside", [(0.0, 24.0), (101.0, 126.0), (370.0, 400.0), None])
def test_a_drive_that_enters_the_map_late_is_found_and_tries_grow_rare(
    inside: tuple[float, float] | None, search: PlaceFinder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 400 m with a keyframe every two: a rejection like the last ones says little, and an agreement is looked for at once."""
    ways = np.arange(0.0, 401.0, 2.0)
    monkeypatch.setattr(search, "_distances", ways)
    monkeypatch.setattr(search, "_poses", np.tile(np.eye(4), (len(ways), 1, 1)))
    tried: list[float] = []

    def vote(b: int, region: None) -> Vote | None:
        tried.append(ways[b])
        is_inside = inside is not None and inside[0] <= ways[b] <= inside[1]
        return Vote(b, np.eye(4), np.eye(6), 0.6) if is_inside else None

    monkeypatch.setattr(search, "vote", vote)
    start = search.find()
    assert tried[: 1 + (inside is not None)] == ([0.0, 6.0][: 1 + (inside is not None)])
    if inside is None:
        assert start is None
        assert len(tried) < 26
        assert np.diff(tried).max() == SPACING_M * 3
    else:
        assert start is not None
        assert (start.votes, start.tried) == (2, len(tried))
        assert tried[-1] - tried[-2] == SPACING_M


@pytest.mark.parametrize("degrees", [0.0, 64.0, 151.0, 238.0, 331.0])
def test_a_place_is_guessed_whatever_the_heading(degrees: float, search: PlaceFinder) -> None:
    place = search.search
    around = place.whole.non_ground[:, :2]
    centre = np.array([*np.median(around, axis=0), 0.0])
    R = so3.exp(np.array([0.0, 0.0, np.deg2rad(degrees)]))
    points = np.concatenate([place.whole.fine.planes[place.whole.fine.planes[:, 7] > -2, :3]]) - centre
    near = points[np.linalg.norm(points[:, :2], axis=1) < 50.0] @ R
    cloud = np.repeat(near, 8, axis=0) + np.random.default_rng(0).normal(0, 0.1, (8 * len(near), 3))
    query = make_level_submap(cloud.astype(np.float32), REGISTRATION)
    guesses = place.guesses(query)
    best = se3.relative(se3.make(R, centre), guesses[0])
    assert np.linalg.norm(best[:2, 3]) < 1.5
    assert np.rad2deg(so3.angle(best[:3, :3])) < 1.6
    # Where it cannot be it is not looked for.
    away = Region(centre[:2] + 20.0, 5.0)
    assert all(np.linalg.norm(T[:2, 3] - away.centre) < 8.0 for T in place.guesses(query, away))


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


@pytest.mark.parametrize("name", TURNS)
def test_a_drive_with_a_turned_sensor_is_found_with_a_start_and_without(
    name: str, world: Revisited, search: PlaceFinder
) -> None:
    R, T_map_level = turn(name), map_pose(world)
    up = CONFIG.preprocess.model_copy(update={"up": tuple(R[2])})
    config = CONFIG.model_copy(update={"preprocess": up})
    finder = PlaceFinder(search.search, turned_store(world.store, R), config)
    T = se3.inverse(T_map_level) @ T_MAP_TOWN @ world.true_poses[0]
    heading = float(np.arctan2(T[1, 0], T[0, 0]))
    for prior in (None, StartPrior(T[:2, 3] + [4.0, -3.0], heading + 0.2)):
        start = finder.find(prior)
        assert start is not None, finder.reasons
        scan = world.store.keyframes[start.vote.keyframe].scan
        found = T_map_level @ start.vote.T_level_odometry @ turned_pose(world.results[scan].T_world_lidar, R)
        move, angle = error_of(found, T_MAP_TOWN @ world.true_poses[scan] @ se3.make(R, np.zeros(3)))
        assert move < 0.1
        assert angle < 0.5


def test_a_map_upside_down_is_levelled_where_its_up_is_known(world: Revisited) -> None:
    R = turn("upside down")
    hanging = make_prior_map(world.points @ R, REGISTRATION, up=R[2])
    assert np.rad2deg(np.arccos(hanging.T_map_level[:3, 2] @ R[2])) < 1.0


def part(world: Revisited, first: int, R: np.ndarray) -> Session:
    """Half of the drive as a session of its own, by a turned sensor."""
    whole, store = turned_store(world.store, R), KeyframeStore()
    for n, k in enumerate(whole.keyframes[first : first + 2 * len(whole) // 3]):
        store.add(replace(k, number=n), whole.points(k.number))
    preprocess = PreprocessConfig(up=None if R[2, 2] == 1.0 else tuple(R[2]))
    return Session("part", store, store.keyframes, [], preprocess=preprocess)


@pytest.mark.parametrize("name", TURNS)
@pytest.mark.parametrize("is_first", [False, True])
def test_a_session_with_a_turned_sensor_is_tied_to_others(name: str, is_first: bool, world: Revisited) -> None:
    R = turn(name)
    ways = (R, np.eye(3)) if is_first else (np.eye(3), R)
    known, other = part(world, 0, ways[0]), part(world, len(world.store) // 3, ways[1])
    tied, why = locate_session(other, [known], CONFIG)
    assert tied is not None, why
    move, angle = error_of(tied.T_town_session, se3.make(R.T if is_first else R, np.zeros(3)))
    assert move < 0.1
    assert angle < 0.5
