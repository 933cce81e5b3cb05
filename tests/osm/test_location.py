"""Localisation on a map, in scenes of known truth: a street, and places where walls leave directions free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from wall_scenes import box_at, plain, upright

from lslam.backend.graph.problem import Solution
from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.config import Config, load_config
from lslam.core.config.backend import OsmConfig
from lslam.core.geometry import se2, se3, so3
from lslam.core.types.building import Building, Footprint, KeyframeMatch
from lslam.core.types.trajectory import Keyframe
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm import location
from lslam.osm.location import MapLocations, finish, locate
from lslam.osm.wall_match import match_keyframe
from lslam.osm.walls import OsmMap

Outline = list[tuple[float, float]]
ORIGIN = np.array([49.0, 8.4, 115.0])
HEIGHT = 1.8  # m of the sensor above the ground
HOUSES: list[Outline] = [
    box_at(-12, 8, 9, 8), box_at(2, 9, 12, 7), box_at(18, 7.5, 8, 11), box_at(31, 10, 13, 8), box_at(48, 8, 9, 9),
    box_at(-8, -17, 11, 8), box_at(7, -19, 8, 10), box_at(20, -16, 14, 7), box_at(38, -18, 9, 9), box_at(52, -17, 10, 9),
]  # fmt: skip


def seen_from(outlines: list[Outline], at: np.ndarray) -> np.ndarray:
    """Points (N, 3) on the walls whose outside the sensor is on, and on the ground, within 50 m."""
    walls = [plain(50.0, 2.0) + np.array([np.round(at[0]), np.round(at[1]), 0.0])]
    for ring in outlines:
        for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
            if (b[0] - a[0]) * (at[1] - a[1]) - (b[1] - a[1]) * (at[0] - a[0]) < 0:
                walls.append(upright(a, b, 0.0, 5.0, 0.3))
    points = np.concatenate(walls)
    return points[np.linalg.norm(points[:, :2] - at[:2], axis=1) < 50.0]


def driven(outlines: list[Outline], way: np.ndarray, odometry: np.ndarray | None = None) -> KeyframeStore:
    """Keyframes at planar poses `way` (K, 3) of the map among buildings, which odometry has at others, in its own world."""
    store = KeyframeStore()
    rng = np.random.default_rng(0)
    for k, (at, told) in enumerate(zip(way, way if odometry is None else odometry, strict=True)):
        T = se2.to_se3(at)
        T[2, 3] = HEIGHT
        cloud = se3.apply(se3.inverse(T), seen_from(outlines, at))
        pose = se2.to_se3(se2.relative((way if odometry is None else odometry)[0], told))
        store.add(
            Keyframe(k, k, k * 10**9, pose, None, 2.0 * k),
            (cloud + rng.normal(0, 0.02, cloud.shape)).astype(np.float32),
        )
    return store


def extract_of(outlines: list[Outline]) -> BuildingExtract:
    buildings = [Building(f"way/{n + 1}", (Footprint(np.array(ring)),)) for n, ring in enumerate(outlines)]
    return BuildingExtract(buildings, {}, ORIGIN, None, "town.osm")


def street(length: float = 36.0) -> np.ndarray:
    x = np.arange(0.0, length, 2.0)
    return np.column_stack([x, 0.5 * np.sin(x / 15), np.arctan(np.cos(x / 15) / 30)])


def config(heading: float | None = 90.0, *more: str) -> Config:
    """The run is said to begin at the origin of the map; east is where x goes."""
    given = [] if heading is None else [f"osm.heading_deg={heading}"]
    return load_config(None, ["osm.origin=[49.0, 8.4, 115.0]", *given, *more])


def off(located: MapLocations, way: np.ndarray) -> np.ndarray:
    """(K, 3) m, m, deg, of the accepted matches."""
    accepted = [m for m in located.matches if m.verdict == "accepted"]
    error = np.array([m.pose - way[m.keyframe] for m in accepted]).reshape(-1, 3)
    error[:, 2] = np.degrees(se2.wrap(error[:, 2]))
    return np.abs(error)


@pytest.mark.parametrize(("shift", "heading"), [((0, 0), 90.0), ((5, -4), 102.0), ((-7, 6), 80.0)])
def test_a_street_is_found_from_a_start_that_is_off(shift: tuple[float, float], heading: float) -> None:
    """The run is told to begin at the map's origin, and the houses are elsewhere."""
    houses = [[(x + shift[0], y + shift[1]) for x, y in ring] for ring in HOUSES]
    way = street() + np.array([*shift, 0.0])
    located = locate(extract_of(houses), driven(houses, way), None, config(heading))
    assert not located.problem
    assert len(located.priors) >= 16
    assert (off(located, way) < [0.1, 0.1, 0.3]).all()
    start = located.T_enu_odometry
    assert np.abs(se2.of_se3(start) - way[0]).max() < 0.1
    assert abs(start[2, 3]) < 1e-9


@pytest.mark.parametrize("turn", [0.4, 2.5, -1.7])
def test_the_heading_is_found_among_all(turn: float) -> None:
    houses = [[tuple(se2.apply(np.array([4.0, -5.0, turn]), np.array(p))) for p in ring] for ring in HOUSES]
    way = se2.compose(np.array([4.0, -5.0, turn]), street(24.0))
    located = locate(extract_of(houses), driven(houses, way), None, config(None))
    assert not located.problem
    assert (off(located, way) < [0.1, 0.1, 0.3]).all()


@pytest.mark.parametrize("heading", [90.0, None])
def test_a_fixed_start_stays_at_its_prior(heading: float | None) -> None:
    """Houses half a metre north of where the map has them: the place is what was given, a heading that was sought the walls'."""
    houses = [[(x, y - 0.5) for x, y in ring] for ring in HOUSES]
    keyframes = driven(HOUSES, street(24.0))
    held = locate(extract_of(houses), keyframes, None, config(heading, "osm.hold_start=true", "osm.start_radius=1.5"))
    assert held.start is not None
    np.testing.assert_array_equal(held.start[:2], 0.0)
    np.testing.assert_allclose(held.start_sigma[:2], 0.5)
    assert abs(held.start[2]) < 2 * held.start_sigma[2] < np.radians(15)
    free = locate(extract_of(houses), keyframes, None, config(heading))
    assert free.start is None
    np.testing.assert_allclose((free.T_enu_odometry[:2, 3]), [0.0, -0.5], atol=0.1)


def test_drifting_odometry_is_tracked() -> None:
    """3 % too long and 4 deg per 100 m to the left: where it ends it would be 3 m off."""
    way = street()
    told = way * 1.03
    told[:, 2] = way[:, 2] + np.radians(4) / 100 * way[:, 0]
    located = locate(extract_of(HOUSES), driven(HOUSES, way, told), None, config())
    assert len(located.priors) >= 16
    assert (off(located, way) < [0.1, 0.1, 0.3]).all()


@pytest.mark.parametrize(
    ("wrong", "known"), [((0.0, 0.0, 2.5), 1.0), ((0.3, 2.0, -3.0), 1.0), ((0.3, 1.5, -2.0), 2e-4)]
)
def test_a_wrong_or_uncertain_first_match_does_not_move_the_run(
    wrong: tuple[float, float, float], known: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    way, error = street(60.0), np.array([*wrong[:2], np.radians(wrong[2])])

    def askew(view: KeyframeMatch, osm: OsmMap, given: OsmConfig) -> KeyframeMatch:
        match = match_keyframe(view, osm, given)
        spoilt = replace(match, pose=match.pose + error, information=known * match.information)
        return spoilt if match.keyframe == 0 else match

    monkeypatch.setattr(location, "match_keyframe", askew)
    store = driven(HOUSES, way)
    located = locate(extract_of(HOUSES), store, None, config())
    assert located.accepted[0].keyframe == 0
    laid = se2.of_se3(located.T_enu_odometry @ np.stack([k.T_world_lidar for k in store.keyframes])) - way
    assert np.abs(laid[:, :2]).max() < 0.3
    assert np.abs(np.degrees(laid[:, 2])).max() < 0.4


def test_the_first_keyframe_is_at_height_zero_wherever_odometry_has_it() -> None:
    way = street(12.0)
    store = driven(HOUSES, way)
    odometry = np.stack([k.T_world_lidar for k in store.keyframes])
    odometry[:, 2, 3] += 7.0
    located = locate(extract_of(HOUSES), store, None, config(), None, odometry)
    assert (located.T_enu_odometry @ odometry[0])[2, 3] == pytest.approx(0.0, abs=1e-9)
    assert (off(located, way) < [0.1, 0.1, 0.3]).all()


def test_on_the_way_back_the_first_match_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The houses begin 60 m ahead, so the first keyframes are laid on them only from the first match back."""
    ahead = [[(x + 72.0, y) for x, y in ring] for ring in HOUSES]
    way = 2.0 * street()
    way[:, 2] = np.arctan2(np.gradient(way[:, 1]), np.gradient(way[:, 0]))
    asked: list[int] = []

    def counted(view: KeyframeMatch, osm: OsmMap, config: OsmConfig) -> KeyframeMatch:
        asked.append(view.keyframe)
        return match_keyframe(view, osm, config)

    monkeypatch.setattr(location, "match_keyframe", counted)
    located = locate(extract_of(ahead), driven(ahead, way), None, config())
    first = next(m.keyframe for m in located.matches if m.verdict == "accepted" and m.rank == 3)
    assert first > 2
    assert asked == [*range(len(way)), *range(first - 1, -1, -1)]
    assert [m.keyframe for m in located.matches] == list(range(len(way)))
    assert (off(located, way) < [0.1, 0.1, 0.3]).all()


def test_many_keyframes_that_see_one_wall_count_as_one() -> None:
    located = locate(extract_of(HOUSES), driven(HOUSES, street()), None, config())
    seen = np.zeros(len(located.osm.walls))
    for match, prior in zip(located.matches, located.priors, strict=True):
        seen[np.unique(match.pairs[:, 1])] += prior.share
    assert seen.max() < 3.0


def test_no_building_in_range_is_reported_with_the_distance() -> None:
    far = [box_at(500.0, 0.0, 20, 10)]
    located = locate(extract_of(far), driven(HOUSES, street(12.0)), None, config())
    assert not located.priors
    assert "no building of town.osm comes near the run, the nearest is 490 m away" in located.problem


def test_without_walls_nothing_is_matched() -> None:
    located = locate(extract_of(HOUSES), driven([], street(12.0)), None, config())
    assert not located.priors
    assert "most often: no walls seen" in located.problem


def test_walls_of_a_tunnel_are_not_matched_with_buildings_above() -> None:
    """Parallel walls that are on no map, 5 m aside; house fronts run as they do."""
    tunnel = [box_at(-60, 5, 160, 1), box_at(-60, -6, 160, 1)]
    for given in (config(), config(None)):
        located = locate(extract_of(HOUSES), driven(tunnel, street(20.0)), None, given)
        assert not located.priors
        assert "goes on without the buildings" in located.problem


def test_one_long_wall_does_not_determine_the_start() -> None:
    hall = [box_at(-80, 8, 200, 30)]
    for given in (config(), config(None)):
        located = locate(extract_of(hall), driven(hall, street(12.0)), None, given)
        assert not located.priors
        assert "OSM: " in located.problem


def test_along_one_long_wall_the_pose_is_that_of_odometry() -> None:
    """After the houses a hall of 200 m: across it the run is held, along it nothing is claimed."""
    town = [*HOUSES[:4], *HOUSES[5:8], box_at(90, 8, 260, 30)]
    way = np.column_stack([np.arange(20.0, 190.0, 4.0), np.zeros(43), np.zeros(43)])
    told = way.copy()
    told[:, 0] = 20 + 1.02 * (way[:, 0] - 20)
    told[:, 1] = 0.01 * (way[:, 0] - 20)
    houses = extract_of([[(x - 20, y) for x, y in ring] for ring in town])
    located = locate(houses, driven(town, way, told), None, config())
    hall = [m for m in located.matches if m.keyframe >= 36]
    assert sum(m.verdict == "accepted" for m in hall) > 3
    for match in hall:
        if match.verdict == "accepted":
            assert match.rank == 2
            values, axes = np.linalg.eigh(match.information[:2, :2])
            assert abs(axes[0, 0]) > 0.999
            assert values[0] < 1e-9 * values[1]
            assert abs(match.pose[1]) < 0.15


def test_a_round_building_gives_no_false_match() -> None:
    """It has no corner; what is claimed of it has to be right."""
    angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    tower: Outline = [(20 + 9 * np.cos(a), 16 + 9 * np.sin(a)) for a in angles]
    way = street(40.0)
    located = locate(extract_of([tower]), driven([tower], way), None, config())
    assert (off(located, way) < [0.5, 0.5, 3.0]).all()
    lost = locate(extract_of([tower]), driven([tower], way), None, config(None))
    assert not lost.priors
    assert "OSM: " in lost.problem


def test_an_ambiguous_start_is_rejected() -> None:
    rows = [box_at(12.0 * i, y, 8, 8) for i in range(-6, 9) for y in (8, -16)]
    located = locate(extract_of(rows), driven(rows, street(8.0)), None, config(None))
    assert not located.priors
    assert "several places and headings fit alike" in located.problem
    assert "--heading" in located.problem


def test_each_building_is_matched_from_the_final_poses() -> None:
    """One house of the map stands 0.8 m off: it and no other is to be moved, whatever the graph rejected."""
    moved = [ring if n != 2 else [(x + 0.8, y) for x, y in ring] for n, ring in enumerate(HOUSES)]
    way = street()
    extract = extract_of(moved)
    located = locate(extract, driven(HOUSES, way), None, config())
    doubts = ["", "twice as far as it may be", *[""] * (len(located.priors) - 2)]
    poses = np.stack([se2.to_se3(at) for at in way])
    none = np.zeros(2)
    solution = Solution(poses, np.zeros((0, 6, 6)), [], [], np.zeros(0, bool), doubts, none, none, 0.0, 1, 0.0)
    matches = finish(located, extract, poses, solution, config().osm)
    assert len(matches.accepted_matches) == len(located.priors) - 1
    second = [m.keyframe for m in located.matches if m.verdict == "accepted"][1]
    assert (matches.keyframes[second].verdict, matches.keyframes[second].reason) == ("rejected", doubts[1])
    for number, building in enumerate(matches.buildings):
        own = [m for m in matches.local if m.building == number and m.verdict == "accepted" and m.rank == 3]
        assert own, building.osm_id
        shifts = np.array([m.displacement(way[m.keyframe], building.middle) for m in own])
        np.testing.assert_allclose(np.median(shifts[:, :2], axis=0), [-0.8 if number == 2 else 0.0, 0.0], atol=0.1)


def test_a_tilted_world_is_levelled_by_the_ground() -> None:
    way = street(20.0)
    store = driven(HOUSES, way)
    lean = se3.make(so3.exp(np.array([0.06, -0.05, 0.0])), np.zeros(3))
    tilted = KeyframeStore()
    for k in store.keyframes:
        tilted.add(
            Keyframe(k.number, k.scan, k.stamp_ns, lean @ k.T_world_lidar @ se3.inverse(lean), None, k.distance),
            se3.apply(lean, store.points(k.number)).astype(np.float32),
        )
    located = locate(extract_of(HOUSES), tilted, None, config())
    assert np.degrees(np.arccos((located.T_enu_odometry @ lean)[2, 2])) < 0.3
    assert (off(located, way) < [0.15, 0.15, 0.5]).all()
