"""Matching of walls: known offsets recovered, free directions free, ambiguity rejected, the fitness as printed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from test_walls import SAMPLE, submap
from wall_scenes import Floats, box_at, turned

from lslam.core.config.backend import OsmConfig
from lslam.core.types.building import Building, Footprint
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.readers import open_sequence
from lslam.osm.kernels import wall_matching
from lslam.osm.wall_match import LIKENESS, WallMatch, find_heading, match_walls
from lslam.osm.walls import find_walls, walls_of

SIGMA = np.array([1.5, 1.5, np.radians(4.0)])


def outline(corners: list[tuple[float, float]], turn: float = 0.0) -> Floats:
    ring = turned(np.array(corners), (0.0, 0.0, turn))
    return np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)


def village() -> Floats:
    """Six houses of different size and direction about a crossing: all their walls."""
    places = [(8, 6, 11, 8, 0.05), (-21, 7, 12, 9, -0.1), (10, -19, 9, 10, 0.02), (-20, -17, 10, 8, 0.2),
              (26, 8, 8, 12, -0.15), (-38, 5, 9, 9, 0.3)]  # fmt: skip
    return np.concatenate([outline(box_at(x, y, w, d), turn) for x, y, w, d, turn in places])


def seen(walls: Floats) -> Floats:
    """Those that face the origin."""
    along = walls[:, 1] - walls[:, 0]
    return np.asarray(walls[along[:, 0] * walls[:, 0, 1] - along[:, 1] * walls[:, 0, 0] > 0])


def inverse(pose: tuple[float, float, float]) -> tuple[float, float, float]:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return (-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2])


def off(match: WallMatch | None, pose: tuple[float, float, float]) -> tuple[float, float]:
    """Distance, m, and angle, deg, from the true pose."""
    assert match is not None
    turn = (match.pose[2] - pose[2] + np.pi) % (2 * np.pi) - np.pi
    return float(np.hypot(match.pose[0] - pose[0], match.pose[1] - pose[1])), float(np.degrees(abs(turn)))


def scene(seed: int) -> tuple[Floats, Floats, tuple[float, float, float]]:
    """What a sensor shows of the village (cut short, noisy, with hedges among it), a map with gaps, and the true pose."""
    rng = np.random.default_rng(seed)
    pose = (float(rng.uniform(-3, 3)), float(rng.uniform(-3, 3)), float(rng.uniform(-3, 3)))
    walls = seen(village())
    share = rng.uniform(0, 0.3, (len(walls), 2, 1))
    cut = np.stack([walls[:, 0] * (1 - share[:, 0]) + walls[:, 1] * share[:, 0],
                    walls[:, 1] * (1 - share[:, 1]) + walls[:, 0] * share[:, 1]], axis=1)  # fmt: skip
    noisy = cut + rng.normal(0, 0.02, cut.shape)
    middles, angles = rng.uniform(-25, 25, (4, 2)), rng.uniform(-3, 3, 4)
    half = 1.5 * np.column_stack([np.cos(angles), np.sin(angles)])
    source = np.concatenate([noisy, np.stack([middles - half, middles + half], axis=1)])
    known = np.delete(village(), rng.choice(24, 4, replace=False), axis=0)
    return source, turned(known, pose), pose


@pytest.mark.parametrize("seed", range(8))
def test_a_known_offset_is_recovered_through_clutter_and_gaps(seed: int) -> None:
    source, target, pose = scene(seed)
    rng = np.random.default_rng(100 + seed)
    match = match_walls(source, target, np.array(pose) + rng.uniform(-1.5, 1.5, 3) * SIGMA, SIGMA)
    away, turn = off(match, pose)
    assert away < 0.05
    assert turn < 0.5
    assert match is not None
    assert (match.rank, match.kind, match.is_ambiguous) == (3, "edges", False)
    assert np.linalg.eigvalsh(match.information).min() > 0
    assert all(0 <= i < len(source) and 0 <= j < len(target) for i, j in match.pairs)
    lies, _ = wall_gap(turned(source[match.pairs[:, 0]], tuple(match.pose)), target[match.pairs[:, 1]])
    assert np.median(lies) < 0.1


def test_matches_on_a_perturbed_map_seldom_depend_on_the_prior() -> None:
    """It did in most villages while the last walls with half weight still pulled; some have two answers that fit alike."""
    spread = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        source, _, pose = scene(seed)
        drawn = turned(village() + np.repeat(rng.uniform(-1.0, 1.0, (6, 1, 2)), 4, axis=0), pose)
        priors = np.array(pose) + rng.uniform(-0.5, 0.5, (12, 3)) * SIGMA
        matches = [match_walls(source, drawn, prior, SIGMA) for prior in priors]
        spread.append(np.ptp([match.pose[:2] for match in matches if match is not None], axis=0).max())
    assert np.sum(np.array(spread) < 0.005) >= 7


def wall_gap(one: Floats, other: Floats) -> tuple[Floats, Floats]:
    """Of pairs of segments: largest distance of an end from the other's line, m, and cosine of their directions."""
    u = other[:, 1] - other[:, 0]
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    away = one - other[:, :1]
    v = one[:, 1] - one[:, 0]
    cosine = (u * v).sum(1) / np.linalg.norm(v, axis=1)
    return np.abs(away[..., 1] * u[:, None, 0] - away[..., 0] * u[:, None, 1]).max(1), cosine


@pytest.mark.parametrize("seed", range(6))
def test_any_heading_is_found_from_ten_metres_off(seed: int) -> None:
    source, target, pose = scene(seed)
    angle = 1.1 * seed
    match = find_heading(source, target, np.array(pose[:2]) + 9.5 * np.array([np.cos(angle), np.sin(angle)]), 15.0)
    away, turn = off(match, pose)
    assert (away < 0.08, turn < 0.5) == (True, True)
    assert match is not None
    assert not match.is_ambiguous


def test_a_simulated_town_is_found_on_its_map_with_houses_missing() -> None:
    extract = read_buildings(SAMPLE / "sequences" / "00" / "map.osm", np.array([49.0, 8.4, 115.0]))[1]
    kept = [b for k, b in enumerate(extract.buildings) if k % 6]
    target, _ = walls_of(kept)
    rng = np.random.default_rng(0)
    for first in (5, 40, 70):
        walls, centre = submap(list(range(first, first + 10)))
        pose = (float(centre[0]), float(centre[1]), 0.0)
        match = match_walls(walls.segments, target, np.array(pose) + rng.normal(0, 0.8, 3) * SIGMA, SIGMA)
        away, turn = off(match, pose)
        assert away < 0.05
        assert turn < 0.5
        heading = 2.0 + first
        start = find_heading(turned(walls.segments, (0, 0, -heading)), target, centre + np.array([6.0, -6.0]), 12.0)
        away, turn = off(start, (pose[0], pose[1], heading))
        assert away < 0.1
        assert turn < 0.5


@pytest.mark.parametrize("number", [4, 24, 44])
def test_a_real_scan_is_found_on_the_real_map(recordings: Callable[[str], Path], number: int) -> None:
    folder = recordings("mcd_kth_day_06") / "mcd_kth_day_06"
    sequence = open_sequence(folder)
    assert sequence.ground_truth is not None
    T = sequence.ground_truth.poses[number]
    # The recording's README says where the world lies; houses of this map are a metre off against each other.
    heading = float(np.arctan2(T[1, 0], T[0, 0]))
    pose = (float(T[0, 3] - 64.3932532565158), float(T[1, 3] - 66.4832330946657), heading)
    c, s = np.cos(heading), np.sin(heading)
    level = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ T[:3, :3]
    walls = find_walls(sequence.scan(number).points @ level.T)
    target, _ = walls_of(read_buildings(folder / "kth.osm", np.array([59.348268650, 18.073204280, 0.0]))[1].buildings)
    off_by_three = np.array(pose) + np.array([1.8, -2.4, np.radians(10)])
    near = match_walls(walls.segments, target, off_by_three, np.array([2, 2, np.radians(5)]))
    start = find_heading(walls.segments, target, np.array(pose[:2]) + np.array([6.0, -5.0]), 15.0)
    for match in (near, start):
        away, turn = off(match, pose)
        assert away < 1.7
        assert turn < 4.0
        assert match is not None
        assert match.rank == 3
        assert not match.is_ambiguous


def test_the_map_of_another_town_is_no_start() -> None:
    extract = read_buildings(SAMPLE / "sequences" / "00" / "map.osm", np.array([49.0, 8.4, 115.0]))[1]
    target, _ = walls_of(extract.buildings)
    for seed in range(6):
        source, _, _ = scene(seed)
        match = find_heading(source, target, np.array([3.0 * seed, -10.0]), 15.0)
        assert match is None or match.is_ambiguous


def test_a_match_ambiguous_in_heading_is_rejected() -> None:
    # Inside a square court every quarter turn fits as well.
    court = outline(box_at(-10, -10, 20, 20))[:, ::-1]
    match = find_heading(court, turned(court, (3.0, 1.0, 0.4)), np.array([2.0, 2.0]), 8.0)
    assert match is not None
    assert match.is_ambiguous
    row = np.concatenate([outline(box_at(x, 6, 5, 8)) for x in np.arange(-36, 36, 9.0)])
    part = row[12:24]
    wide = match_walls(part, row, np.array([4.5, 0.0, 0.0]), np.array([4.0, 1.0, 0.05]))
    assert wide is not None
    assert wide.is_ambiguous, "one house further fits as well"
    narrow = match_walls(part, row, np.array([1.0, 0.2, 0.01]), np.array([0.8, 0.8, 0.05]))
    assert narrow is not None
    assert not narrow.is_ambiguous
    assert off(narrow, (0.0, 0.0, 0.0))[0] < 0.05


@pytest.mark.parametrize(("period", "turn"), [(4.0, 0.0), (5.0, 0.8), (6.0, 2.0), (8.0, -0.4)])
def test_repeated_gables_are_limited_by_the_window_or_rejected(period: float, turn: float) -> None:
    # One side of each house is seen, and no corner: across these walls the next house fits as well.
    gables = turned(np.array([[[k * period, 6.0], [k * period, 14.0]] for k in range(-20, 21)]), (0.0, 0.0, turn))
    rng = np.random.default_rng(int(period))
    for count in (1, 3):
        part = gables[20 - count // 2 : 21 + count // 2] + rng.normal(0, 0.03, (count, 2, 2))
        for share in (-1.4, -0.6, 0.2, 1.0):
            for sigma, is_refused in ((0.1 * period, False), (0.8 * period, True)):
                prior = np.append(turned(np.array([share * sigma, 0.2]), (0.0, 0.0, turn)), 0.01)
                match = match_walls(part, gables, prior, np.array([sigma, sigma, 0.03]))
                assert match is not None
                assert match.is_ambiguous == is_refused
                across = np.array([np.cos(turn), np.sin(turn)])
                assert is_refused or abs(across @ match.pose[:2]) < 0.2


def gables(*places: float) -> Floats:
    return np.array([[[x, 6.0], [x, 14.0]] for x in places])


@pytest.mark.parametrize("turn", [0.0, 0.8, 2.5])
@pytest.mark.parametrize("beside", [2.0, 4.0, 5.5, -2.0, -4.0, -5.5, 10.0, -10.0])
def test_a_neighbouring_gable_is_an_alternative_within_the_window(beside: float, turn: float) -> None:
    """The window is 6 m along each axis; what lies beyond it is no answer, on whichever side it is."""
    known = turned(gables(0.0, beside), (0.0, 0.0, turn))
    match = match_walls(gables(0.0), known, np.array([0.2, 0.1, turn]), np.array([2.0, 2.0, 0.03]))
    assert match is not None
    assert match.is_ambiguous == (abs(beside) < 6.0)


@pytest.mark.parametrize("off_by", [-5.0, -3.0, 4.0])
@pytest.mark.parametrize("gap", [2.5, 4.0, 5.0])
def test_two_gables_are_matched_with_two_though_one_is_nearer_the_prior(gap: float, off_by: float) -> None:
    both = gables(0.0, gap)
    match = match_walls(both, both, np.array([off_by, 0.1, 0.0]), np.array([2.0, 2.0, 0.03]))
    assert match is not None
    assert not match.is_ambiguous
    assert abs(match.pose[0]) < 0.02
    assert match.coverage > 0.95


def test_a_wall_without_final_correspondences_is_no_match() -> None:
    wall, beside = (np.array([[[-8.0, y], [8.0, y]]]) for y in (4.0, 5.6))
    between = np.concatenate([wall, beside])
    known = np.array([[[-8.0, 4.8], [8.0, 4.8]]])
    loose = OsmConfig(min_coverage=0.0, max_distance=0.5)
    assert match_walls(between, known, np.zeros(3), SIGMA, loose) is None


@pytest.mark.parametrize("turn", [0.0, 0.6, 2.2])
def test_the_direction_along_parallel_walls_is_free(turn: float, monkeypatch: pytest.MonkeyPatch) -> None:
    street = np.array([[[-30, 5], [30, 5]], [[30, -5], [-30, -5]]], np.float64)[:, ::-1]
    pose = (0.0, 0.0, turn)
    part = np.array([[[12, 5.02], [-9, 4.98]], [[-11, -5], [10, -5]]])
    assert (wall_gap(part, street)[1] > 0.99).all()
    prior = np.append(turned(np.array([1.7, 0.6]), pose), turn + 0.02)
    match = match_walls(part, turned(street, pose), prior, SIGMA)
    assert match is not None
    assert (match.rank, match.kind) == (2, "lines")
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    assert abs(across @ match.pose[:2]) < 0.05
    assert along @ match.pose[:2] == pytest.approx(1.7, abs=0.05), "left where the odometry had it"
    free = np.append(along, 0.0)
    np.testing.assert_allclose(match.information @ free, 0, atol=1e-9)
    fixed = np.append(across, 0.0)
    assert fixed @ match.information @ fixed > 1.0
    assert not match.is_ambiguous, "the same wall further along is no other answer"
    monkeypatch.setattr("lslam.osm.wall_match.LINE_WEIGHT", 1.0)
    full = match_walls(part, turned(street, pose), prior, SIGMA)
    assert full is not None
    np.testing.assert_allclose(match.information, 0.25 * full.information, rtol=1e-9, atol=1e-9)


def test_walls_that_are_nearly_parallel_do_not_slide_along_each_other() -> None:
    street = np.array([[[30.0, 5.0], [-30.0, 5.0]], [[-30.0, -7.0], [30.0, -3.0]]])
    seen_there = street.copy()
    seen_there[1, :, 1] -= 0.15  # as if one house were drawn that much too near: 2.2 m along, for 4 deg between them
    match = match_walls(seen_there, street, np.array([0.4, 0.3, 0.01]), SIGMA)
    assert match is not None
    assert match.rank == 2
    assert match.pose[0] == pytest.approx(0.4, abs=0.1)
    assert abs(match.pose[1]) < 0.15
    assert np.linalg.eigvalsh(match.information)[0] == pytest.approx(0.0, abs=1e-9)


def test_information_rotates_with_the_map_and_refers_to_the_sensor() -> None:
    source, target, pose = scene(3)
    one = match_walls(source, target, np.array(pose), SIGMA)
    turn = (0.0, 0.0, 0.9)
    c, s = np.cos(0.9), np.sin(0.9)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    assert one is not None
    other = match_walls(source, turned(target, turn), np.append(R[:2, :2] @ pose[:2], pose[2] + 0.9), SIGMA)
    assert other is not None
    np.testing.assert_allclose(other.information, R @ one.information @ R.T, rtol=0.02, atol=0.5)
    far = np.array([[[60, -4], [60, 6]], [[55, 6], [62, 6.0]]])
    match = match_walls(far, far, np.zeros(3), SIGMA)
    assert match is not None
    covariance = np.linalg.inv(match.information)
    assert covariance[1, 1] > 10 * covariance[0, 0], "far ahead, their angle is what says how far left we are"


def test_the_back_of_a_wall_is_not_its_front() -> None:
    wall = np.array([[[-8.0, 4.0], [8.0, 4.0]]])
    raised = wall + np.array([0.0, 0.3])
    front = match_walls(wall, raised, np.zeros(3), SIGMA)
    assert front is not None
    assert front.rank == 2
    assert match_walls(wall[:, ::-1], raised, np.zeros(3), SIGMA) is None


def test_without_walls_or_without_partners_there_is_no_match() -> None:
    walls, none = seen(village()), np.zeros((0, 2, 2))
    assert match_walls(none, walls, np.zeros(3), SIGMA) is None
    assert match_walls(walls, none, np.zeros(3), SIGMA) is None
    assert match_walls(walls, walls + 300.0, np.zeros(3), SIGMA) is None
    assert find_heading(walls, walls + 300.0, np.zeros(2), 15.0) is None
    assert find_heading(walls[:2], village(), np.zeros(2), 15.0) is None, "two walls could be any corner"


@pytest.mark.parametrize("shift", [(1.2, -0.9, 0.04), (-0.6, 1.4, -0.05)])
def test_one_building_is_matched_with_the_walls_seen_of_it(shift: tuple[float, float, float]) -> None:
    house = Building("way/1", (Footprint(np.array(box_at(6.0, -4.0, 12.0, 9.0))),))
    source, _ = walls_of([house])
    front = np.array([[[6.0, 5.0], [6.0, -4.0]], [[16.0, 5.0], [6.0, 5.0]]])
    around = seen(village()) + np.array([0.0, 60.0])
    target = np.concatenate([turned(front, shift), around])
    match = match_walls(source, target, np.zeros(3), SIGMA, by_coverage=True)
    away, turn = off(match, shift)
    assert away < 0.05
    assert turn < 0.3
    assert match is not None
    assert match.coverage == pytest.approx(19 / 42, abs=0.02)
    assert match.distance == pytest.approx((42 - 21) / 42 * 2.0, abs=0.02), "two walls have no partner"


def test_one_building_has_weights_of_its_own() -> None:
    config = OsmConfig(weights=(0.7, 1.0, 0.1), building_weights=(1.5, 1.5, 0.1), building_max_distance=1.0)
    own = config.of_one_building
    assert (own.weights, own.max_distance) == ((1.5, 1.5, 0.1), 1.0)
    assert OsmConfig(weights=(0.7, 1.0, 0.1)).of_one_building == OsmConfig(weights=(0.7, 1.0, 0.1))


def reference(source: Floats, target: Floats, farthest: float, by_coverage: bool) -> tuple[float, float]:
    """Mean distance and coverage by the words of Del Tufo, wall by wall."""
    distance = covered = total = 0.0
    for a, b in source:
        length = np.linalg.norm(b - a)
        best, cover = farthest, 0.0
        for p, q in target:
            u = (q - p) / np.linalg.norm(q - p)
            if (b - a) @ u / length < LIKENESS:
                continue
            s = np.array([(a - p) @ u, (b - p) @ u])
            inside = np.clip(s, 0, np.linalg.norm(q - p))
            shared = max(inside[1] - inside[0], 0.0)
            if by_coverage:
                if shared <= 0:
                    continue
                at = [a + (b - a) * (k - s[0]) / (s[1] - s[0]) for k in inside]
                d = np.mean([np.linalg.norm(x - p - u * ((x - p) @ u)) for x in at])
            else:
                d = np.mean([np.linalg.norm(x - p - u * k) for x, k in zip((a, b), inside, strict=True)])
            if d < best:
                best, cover = float(d), min(shared, length)
        distance, covered, total = distance + length * best, covered + cover, total + length
    return distance / total, covered / total


@pytest.mark.parametrize("by_coverage", [False, True])
def test_distance_and_coverage_are_those_of_the_thesis(by_coverage: bool) -> None:
    rng = np.random.default_rng(5)
    for _ in range(5):
        middles: NDArray[np.float64] = rng.uniform(-6, 6, (24, 2))
        angles, halves = rng.uniform(0, 0.6, 24), rng.uniform(0.5, 4, (24, 1))
        along = halves * np.column_stack([np.cos(angles), np.sin(angles)])
        walls = np.stack([middles - along, middles + along], axis=1)
        source, target = walls[:8], walls[8:]
        got = wall_matching.fit(
            source.reshape(-1, 4), target.reshape(-1, 4), np.zeros(3), 2.5, float(LIKENESS), by_coverage
        )
        np.testing.assert_allclose(got[:2], reference(source, target, 2.5, by_coverage), rtol=1e-9)


def test_fitness_is_equation_3_4() -> None:
    source, target, pose = scene(1)
    config = OsmConfig(weights=(0.7, 1.3, 0.2), max_distance=1.5)
    prior = np.array(pose) + np.array([0.9, -0.4, 0.02])
    match = match_walls(source, target, prior, SIGMA, config)
    assert match is not None
    distance, coverage = reference(turned(source, tuple(match.pose)), target, 1.5, False)
    translation = np.hypot(*(match.pose[:2] - prior[:2])) / (3 * np.hypot(*SIGMA[:2]))
    expected = -0.7 * min(distance, 1.5) / 1.5 * 100 + 1.3 * coverage * 100 - 0.2 * min(translation, 1.0) * 100
    assert match.fitness == pytest.approx(expected, abs=1e-6)
