"""The pose graph on a map: a drift that its walls reveal is taken out, walls are found anew, and none is invented."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from test_location import HOUSES, ORIGIN, Outline, config, driven, extract_of, street

from lslam.backend.georeferencing import Placement
from lslam.backend.graph.problem import PoseGraph
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.outcome import BackEndInput, solve
from lslam.core.config import Config
from lslam.core.config.config import load_config
from lslam.core.errors import UsageError
from lslam.core.geometry import se2, se3
from lslam.core.types.constraint import Constraint
from lslam.core.types.gnss import Georeference
from lslam.core.types.scan_result import ScanResult
from lslam.osm import MATCHERS
from lslam.osm.hold import find_on_map, hold_by_buildings, on_map, sightings
from lslam.osm.location import MapLocations, locate
from lslam.osm.source import OsmServer
from lslam.pipeline.check import check_config

SURE = np.diag([1e-6] * 3 + [1e-8] * 3)


def drawn_wrong(seed: int, size: float) -> list[Outline]:
    """The houses, each off by some `size` m on the map."""
    rng = np.random.default_rng(seed)
    off = size * rng.standard_normal((len(HOUSES), 2))
    return [[(x + dx, y + dy) for x, y in ring] for ring, (dx, dy) in zip(HOUSES, off, strict=True)]


def graph_of(store: KeyframeStore) -> PoseGraph:
    poses = np.stack([k.T_world_lidar for k in store.keyframes])
    steps = se3.relative(poses[:-1], poses[1:])
    links = [Constraint(k, k + 1, step, SURE, "odometry") for k, step in enumerate(steps)]
    return PoseGraph(poses, links, distances=np.array([k.distance for k in store.keyframes]))


def runaway(way: np.ndarray, percent: float, degrees: float) -> np.ndarray:
    """Odometry that shifts to the north by so much of the way, and turns to the left by so much per 100 m."""
    told = [way[0]]
    for a, b in pairwise(way):
        far = float(np.linalg.norm(b[:2] - a[:2]))
        there = se2.compose(told[-1], se2.relative(a, b))
        told.append(there + np.array([0.0, 0.01 * percent * far, np.radians(degrees) / 100 * far]))
    return np.stack(told)


def laid(store: KeyframeStore, outlines: list[Outline], given: Config | None = None) -> tuple[MapLocations, PoseGraph]:
    return find_on_map(extract_of(outlines), graph_of(store), store, None, None, given or config())


def off(poses: np.ndarray, way: np.ndarray) -> float:
    """m, mean distance of planar poses from the way when both begin at one place."""
    planar = se2.of_se3(poses)
    return float(np.linalg.norm(planar[:, :2] - planar[0, :2] - way[:, :2] + way[0, :2], axis=1).mean())


@pytest.mark.parametrize("seed", range(2))
def test_drift_is_corrected_by_a_perturbed_map(seed: int, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "lslam")
    way = street(60.0)
    store = driven(HOUSES, way, runaway(way, 4.0, 3.0))
    before = graph_of(store)
    located, held = laid(store, drawn_wrong(seed, 0.3))
    assert not located.problem
    assert held.spread is not None
    wrong = off(on_map(before, located, config()).poses, way)
    assert wrong > 0.7
    assert off(held.poses, way) < 0.2 * wrong
    steps = se3.relative(held.poses[:-1], held.poses[1:])
    np.testing.assert_allclose([c.T_a_b for c in held.odometry], steps, atol=1e-9)
    # All of it: submaps are smeared by the drift and show the greater part only, so it is looked for again.
    said = re.search(r"steady drift of odometry, (\S+) % and (\S+) deg/100 m, is corrected", caplog.text)
    assert said is not None
    assert [float(number) for number in said.groups()] == pytest.approx([4.0, 3.0], abs=0.15)
    # What the manifest calls the largest correction is that of odometry, with the drift corrected before the graph.
    results = [ScanResult(k.scan, k.stamp_ns, k.T_world_lidar) for k in store.keyframes]
    on_walls = Georeference(ORIGIN, located.T_enu_odometry, None, "osm")
    done = solve(held, BackEndInput(results, store, config(), []), on_walls)
    assert done is not None
    moved = done.keyframes[:, :3, 3] - (located.T_enu_odometry @ before.poses)[:, :3, 3]
    assert done.facts["largest_correction_m"] == pytest.approx(np.linalg.norm(moved, axis=1).max(), abs=1e-4)
    assert done.facts["largest_correction_m"] > 2 * wrong
    # And the drift itself, each rate within what it is unsure by.
    told = done.facts["steady_drift"]
    for name, real in (("east_percent", 0.0), ("north_percent", 4.0), ("left_deg_per_100m", 3.0)):
        assert 0.0 < told[name]["sigma"] < 0.5
        assert abs(told[name]["estimate"] - real) < 4.0 * told[name]["sigma"], name
    assert told["log_likelihood_gain"] > told["gain_by_chance"] > 5.0


def test_wandering_drift_is_reported_as_such(caplog: pytest.LogCaptureFixture) -> None:
    """To the north for a third of the way, to the south as long, and back."""
    caplog.set_level("INFO", "lslam")
    way = street(60.0)
    third = len(way) // 3
    side = np.concatenate([np.full(third, 1.0), np.full(third, -1.0), np.full(len(way) - 2 * third, 1.0)])
    north = 0.04 * np.concatenate([[0.0], np.cumsum(side[1:] * np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1))])
    store = driven(HOUSES, way, way + north[:, None] * [0.0, 1.0, 0.0])
    _, held = laid(store, drawn_wrong(0, 0.1))
    # As seen from the first pose: the map may be turned as a whole.
    shapes = (
        se2.relative(planar[0], planar) for planar in (se2.of_se3(p) for p in (held.poses, graph_of(store).poses))
    )
    after, before = (np.linalg.norm((shape - se2.relative(way[0], way))[:, :2], axis=1).mean() for shape in shapes)
    assert after < 0.5 * before
    said = re.search(r"OSM: varying drift of odometry, (\S+) % and (\S+) deg/100 m, is corrected", caplog.text)
    assert said is not None
    assert 1.0 < float(said[1]) < 5.0
    done = solve(
        held,
        BackEndInput([ScanResult(k.scan, k.stamp_ns, k.T_world_lidar) for k in store.keyframes], store, config(), []),
    )
    assert done is not None
    assert "steady_drift" not in done.facts
    told = done.facts["wandering_drift"]
    assert told["north_percent"]["rms"] > 2.0 * abs(told["north_percent"]["estimate"])
    assert told["log_likelihood_gain"] > told["gain_by_chance"] > 5.0


@pytest.mark.parametrize("size", [0.0, 0.5])
def test_a_run_that_does_not_drift_stays_as_it_is(size: float) -> None:
    way = street(60.0)
    store = driven(HOUSES, way)
    located, held = laid(store, drawn_wrong(3, size))
    assert not located.problem
    assert held.spread is None
    assert held.estimated_drift is None
    given = graph_of(store)
    np.testing.assert_array_equal([c.T_a_b for c in held.odometry], [c.T_a_b for c in given.odometry])
    np.testing.assert_allclose(held.poses, located.T_enu_odometry @ given.poses, atol=1e-12)


def test_trusted_poses_and_the_baseline_are_not_corrected_for_drift() -> None:
    way = street(24.0)
    store = driven(HOUSES, way, runaway(way, 4.0, 3.0))
    for given in (config(90.0, "osm.matcher=baseline"), config(90.0, "odometry.method=poses")):
        _, held = laid(store, HOUSES, given)
        assert held.spread is None


def test_each_wall_seen_is_measured_from_its_own_line_on_the_map() -> None:
    """The map has all walls 0.4 m too far east, and the run stands where it does: walls that look east tell it, north none."""
    way = street(24.0)
    store = driven(HOUSES, way)
    shifted = [[(x + 0.4, y) for x, y in ring] for ring in HOUSES]
    located = locate(extract_of(shifted), store, None, config())
    seen = sightings(located, np.stack([se2.to_se3(at) for at in way]), config())
    assert len(np.unique(seen.walls)) > 8
    np.testing.assert_allclose(np.median(seen.offsets + 0.4 * seen.normals[:, 0]), 0.0, atol=0.03)
    assert np.percentile(np.abs(seen.offsets + 0.4 * seen.normals[:, 0]), 80) < 0.06
    walls = located.osm.walls[seen.walls]
    away = np.einsum("ni,ni->n", seen.normals, seen.places - walls[:, 1])
    np.testing.assert_allclose(away, seen.offsets, atol=1e-9)
    assert np.linalg.norm(seen.places - way[seen.keyframes, :2], axis=1).max() < 60.0


def test_walls_are_searched_from_the_matched_pose_or_else_the_predicted_one() -> None:
    """What is not asked lies 9 m off, where no building would be found."""
    given = config(90.0, "keyframes.submap_size=3")
    located = locate(extract_of(HOUSES), driven(HOUSES, street(12.0)), None, given)
    poses = np.stack([se2.to_se3(at) for at in street(12.0)])
    away = np.array([9.0, -9.0, 0.3])
    laid_out = [replace(m, verdict="accepted", prior=m.pose + away) for m in located.matches]
    refused = [replace(m, verdict="rejected", prior=m.pose, pose=m.pose + away) for m in located.matches]
    expected = sightings(located, poses, given)
    assert len(expected.walls) > 20
    assert expected.share == pytest.approx(1 / 3)
    for matches in (laid_out, refused):
        seen = sightings(replace(located, matches=matches), poses, given)
        np.testing.assert_array_equal(seen.walls, expected.walls)
        np.testing.assert_array_equal(seen.offsets, expected.offsets)


def test_without_a_building_there_is_no_wall_to_see() -> None:
    store = driven([], street(12.0))
    located, held = laid(store, [[(x + 900.0, y) for x, y in ring] for ring in HOUSES])
    assert located.problem
    assert held.spread is None
    assert not len(sightings(located, held.poses, config()).walls)


def test_a_run_without_enough_fixes_reports_what_is_needed() -> None:
    store = driven(HOUSES, street(6.0))
    given = BackEndInput([], store, load_config(), [])
    nobody_asks = OsmServer(ORIGIN, None, given.config.osm, lambda bounds: {})
    assert hold_by_buildings(nobody_asks, graph_of(store), Placement(), given) is None
    (said,) = given.problems
    assert said.startswith(
        "OSM: without its fixes the run has no place on the map: give --origin LAT,LON of the first scan;"
    )


def test_an_unknown_matcher_is_refused_before_a_run() -> None:
    assert all(callable(matcher.fit_buildings) for matcher in MATCHERS.values())
    with pytest.raises(UsageError, match=r"no matcher 'wals' \(osm.matcher\); did you mean 'walls'"):
        check_config(load_config(None, ["osm.matcher=wals"], {}))
