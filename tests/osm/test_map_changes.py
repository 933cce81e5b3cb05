"""Changes of a map: absent houses are seen through, new houses give new walls, all others are unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import intersection, length, linestrings, union_all
from wall_scenes import box_at

from lslam.core.geometry import se2
from lslam.core.types.building import Building, Footprint, KeyframeMatch, footprint_polygon
from lslam.osm.corrections import absent_buildings, new_walls
from lslam.osm.walls import walls_of

Floats = NDArray[np.float64]

FRONT, BEHIND = 9.0, 24.0  # m from the street


def house(x: float, y: float, width: float = 10.0, depth: float = 9.0, **tags: str) -> Building:
    return Building(f"way/{int(x * 100 + y)}", (Footprint(np.array(box_at(x, y, width, depth))),), tags=tags)


def street() -> list[Building]:
    """A front row of houses with gaps, and a long hall behind it."""
    return [house(-20, FRONT), house(0, FRONT), house(20, FRONT), house(-45, BEHIND, 90, 12)]


def drive(real: list[Building], keyframes: int = 9, seed: int = 0) -> tuple[list[KeyframeMatch], dict[int, Floats]]:
    """What a sensor on the street y = 0 sees: of every wall that faces it the parts that nothing stands before."""
    rng = np.random.default_rng(seed)
    solid = union_all([footprint_polygon(b.footprints[0]) for b in real])
    walls, _ = walls_of(real)
    sights, poses = [], {}
    for k in range(keyframes):
        pose = np.array([-16.0 + 4.0 * k, 0.0, rng.uniform(-3, 3)])
        views = np.array([[-16.0 + 4.0 * k + d, 0.0] for d in (-2.0, 0.0, 2.0)])
        seen = []
        for a, b in walls:
            shares = np.linspace(0, 1, 2 * int(np.linalg.norm(b - a)) + 2)
            spots = a + shares[:, None] * (b - a)
            rays = np.stack(np.broadcast_arrays(views[:, None], spots[None]), axis=2)
            free = (length(intersection(linestrings(rays), solid)) < 0.01).any(axis=0)
            runs = np.split(np.arange(len(spots)), np.flatnonzero(np.diff(free.astype(int))) + 1)
            seen += [spots[[run[0], run[-1]]] for run in runs if free[run[0]] and len(run) > 4]
        found = np.array(seen).reshape(-1, 2, 2) + rng.normal(0, 0.03, (len(seen), 2, 2))
        back = se2.inverse(pose)
        sights.append(
            KeyframeMatch(k, se2.apply(back, found), se2.apply(back, views), pose, np.ones(3), pose, np.eye(3))
        )
        poses[k] = pose
    return sights, poses


@pytest.mark.parametrize("seed", range(3))
def test_an_absent_building_is_seen_through(seed: int) -> None:
    on_map = street()
    sights, poses = drive([b for k, b in enumerate(on_map) if k != 1], seed=seed)
    assert absent_buildings(on_map, sights, poses).tolist() == [False, True, False, False]
    assert len(new_walls(on_map, sights, poses)) == 0


@pytest.mark.parametrize("seed", range(3))
def test_a_new_building_gives_a_new_wall(seed: int) -> None:
    real = street()
    sights, poses = drive(real, seed=seed)
    on_map = [b for k, b in enumerate(real) if k != 1]
    found = new_walls(on_map, sights, poses)
    assert len(found) >= 1
    front = found[np.argmin(found[:, :, 1].mean(axis=1))]
    np.testing.assert_allclose(np.sort(front[:, 0]), [0, 10], atol=0.3)
    np.testing.assert_allclose(front[:, 1], FRONT, atol=0.15)
    assert not absent_buildings(on_map, sights, poses).any()


def test_an_exact_map_has_no_changes_and_occluded_buildings_are_not_absent() -> None:
    hidden = house(2, BEHIND + 30)
    sights, poses = drive([*street(), hidden])
    assert not absent_buildings([*street(), hidden], sights, poses).any()
    assert len(new_walls([*street(), hidden], sights, poses)) == 0


def test_two_keyframes_do_not_support_a_change() -> None:
    on_map = street()
    sights, poses = drive([b for k, b in enumerate(on_map) if k != 1])
    assert not absent_buildings(on_map, sights[4:6], poses).any()
    assert not absent_buildings(on_map, sights, {k: poses[k] for k in (4, 5)}).any()
    sights, poses = drive(on_map)
    assert len(new_walls([on_map[0], *on_map[2:]], sights[4:6], poses)) == 0


def thrice(walls: list[list[list[float]]], views: list[list[float]]) -> tuple[list[KeyframeMatch], dict[int, Floats]]:
    """Three keyframes at the origin that saw these walls from these places."""
    pose = np.zeros(3)
    sight = KeyframeMatch(0, np.array(walls), np.array(views), pose, np.ones(3), pose, np.eye(3))
    return [replace(sight, keyframe=k) for k in range(3)], dict.fromkeys(range(3), pose)


def test_a_house_is_absent_only_when_all_rays_pass_through_it() -> None:
    on_map = [house(0, FRONT)]
    behind = [[[8.0, 30.0], [2.0, 30.0]]]
    assert absent_buildings(on_map, *thrice(behind, [[5.0, 0.0], [4.0, 0.0]])).all()
    assert not absent_buildings(on_map, *thrice(behind, [[5.0, 0.0], [-60.0, 0.0]])).any()
    grazed = [[[0.1, 30.0], [0.1, 36.0]]]
    assert not absent_buildings(on_map, *thrice(grazed, [[0.1, 0.0], [0.1, 2.0]])).any()


def test_short_walls_and_those_inside_a_house_are_not_new() -> None:
    on_map = [house(0, FRONT)]
    front, hedge, room = ([[[x + n, y], [x, y]]] for x, y, n in ((30.0, 5.0, 8.0), (30.0, 5.0, 5.0), (1.5, 13.5, 7.0)))
    assert len(new_walls(on_map, *thrice(front, [[0.0, 0.0]]))) == 1
    assert len(new_walls(on_map, *thrice(hedge, [[0.0, 0.0]]))) == 0
    assert len(new_walls(on_map, *thrice(room, [[0.0, 0.0]]))) == 0
    assert len(new_walls([house(0, 100.0)], *thrice(room, [[0.0, 0.0]]))) == 1
    for ends in ([[1.0, 8.0], [9.0, 8.0]], [[9.0, 8.0], [1.0, 8.0]]):
        assert len(new_walls(on_map, *thrice([ends], [[0.0, 0.0]]))) == 0, (
            "a metre before the front, whichever way it is told"
        )


def test_canopies_are_never_absent() -> None:
    on_map = street()
    on_map[1] = replace(on_map[1], tags={"building": "roof"})
    sights, poses = drive([b for k, b in enumerate(on_map) if k != 1])
    assert not absent_buildings(on_map, sights, poses).any()


def test_without_walls_or_buildings_there_are_no_changes() -> None:
    sights, poses = drive(street(), 4)
    blind = [replace(s, walls=np.zeros((0, 2, 2))) for s in sights]
    assert not absent_buildings(street(), blind, poses).any()
    assert new_walls(street(), blind, poses).shape == (0, 2, 2)
    assert absent_buildings([], sights, poses).shape == (0,)
    assert len(new_walls([], sights, poses)) > 0
