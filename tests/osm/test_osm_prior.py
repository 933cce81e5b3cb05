"""Walls seen against the walls of a map: why a match does not count, and what each of many counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from wall_scenes import box_at

from lslam.core.config.backend import OsmConfig
from lslam.core.types.building import Building, Footprint, KeyframeMatch
from lslam.osm.kernels import segments, wall_matching
from lslam.osm.wall_match import match_buildings, match_keyframe, shares, warm_up
from lslam.osm.walls import OsmMap

CORNERS = [box_at(4, 6, 10, 8), box_at(-14, 5, 9, 9), box_at(2, -16, 12, 7)]
TOWN = OsmMap([Building(f"way/{n}", (Footprint(np.array(ring, float)),)) for n, ring in enumerate(CORNERS)])


def view(walls: np.ndarray, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> KeyframeMatch:
    pose = np.array(at)
    return KeyframeMatch(7, walls, np.zeros((1, 2)), pose, np.array([0.5, 0.5, 0.02]), pose, np.zeros((3, 3)))


def test_a_map_finds_buildings_and_walls_within_a_distance() -> None:
    assert TOWN.near(np.zeros(2), 7.1).tolist() == [1]
    assert TOWN.near(np.zeros(2), 7.3).tolist() == [0, 1]
    assert TOWN.distance(np.array([4.0, -30.0])) == 14.0
    assert TOWN.near(np.array([4.0, -30.0]), 20.0).tolist() == [2]
    assert (TOWN.owners[TOWN.walls_near(np.array([4.0, -30.0]), 20.0)] == 2).all()
    assert OsmMap([]).distance(np.zeros(2)) == np.inf


def test_walls_of_the_map_match_themselves_with_numbers_of_the_map() -> None:
    near = TOWN.walls[TOWN.owners != 1]
    found = match_keyframe(view(near - np.array([0.3, -0.2])), TOWN, OsmConfig())
    np.testing.assert_allclose(found.pose, [0.3, -0.2, 0.0], atol=1e-3)
    assert (found.verdict, found.reason, found.rank) == ("rejected", "", 3)
    assert (TOWN.owners[found.pairs[:, 1]] != 1).all()


def test_rejected_matches_have_a_reason() -> None:
    nothing = np.zeros((0, 2, 2))
    assert match_keyframe(view(nothing), TOWN, OsmConfig()).reason == "no walls seen"
    assert match_keyframe(view(TOWN.walls, (900.0, 0.0, 0.0)), TOWN, OsmConfig()).reason == "no building near"
    fences = np.array([[[-20.0, 2.5 * k - 11.2], [20.0, 2.5 * k - 10.0]] for k in range(9)])
    assert "too few of the walls" in match_keyframe(view(fences), TOWN, OsmConfig()).reason
    assert match_buildings(view(nothing), np.zeros(3), np.zeros(2), TOWN, OsmConfig()) == []


def test_a_building_is_matched_under_a_common_shift_of_the_map() -> None:
    """Everything stands 2.4 m off the map; sought with that known, each house is found there."""
    shift = np.array([2.0, -1.3])
    match = view(TOWN.walls + shift)
    found = match_buildings(match, np.zeros(3), shift, TOWN, OsmConfig(map_sigma=0.15))
    assert [one.building for one in found if one.verdict == "accepted"] == [0, 1, 2]
    for one in found:
        moved = one.displacement(np.zeros(3), TOWN.buildings[one.building].middle)
        np.testing.assert_allclose(moved, [*shift, 0.0], atol=1e-3)


def test_buildings_are_searched_at_their_places_on_the_map() -> None:
    """Ten metres about a place that is thirty metres away from the same place of the map."""
    shift = np.array([30.0, -1.0])
    found = match_buildings(view(TOWN.walls), np.append(shift, 0.0), shift, TOWN, OsmConfig(use_radius=10.0))
    assert [one.building for one in found] == [0, 1, 2]


def test_an_ambiguous_building_is_not_moved() -> None:
    house = OsmMap(TOWN.buildings[:1])
    off = np.array([1.6, 1.0])
    twice = np.concatenate([house.walls + off, house.walls - off])
    found = match_buildings(view(twice), np.zeros(3), np.zeros(2), house, OsmConfig())
    assert [(one.verdict, one.reason) for one in found] == [("rejected", "another place fits nearly as well")]
    alone = match_buildings(view(house.walls + off), np.zeros(3), np.zeros(2), house, OsmConfig())
    assert [(one.verdict, one.reason) for one in alone] == [("accepted", "")]


def test_repeated_sightings_count_once() -> None:
    one = view(TOWN.walls)
    pairs = [[[0, 0], [1, 1]], [[0, 0]], [[0, 0], [2, 5]], [[0, 0]]]
    matches = [replace(one, pairs=np.array(p)) for p in pairs]
    assert shares(matches, 12) == [(1 / 4 + 1) / 2, 1 / 4, (1 / 4 + 1) / 2, 1 / 4]


def test_warming_up_compiles_everything() -> None:
    warm_up()
    for kernel in (segments.flat_walls, segments.find_segments, wall_matching.fit, wall_matching.refine):
        assert kernel.signatures  # type: ignore[attr-defined]
