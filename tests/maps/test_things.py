"""What stands on the ground, in scenes where that is known, and floors against plain Python."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.maps.clean import ABOVE, GAP, REACH_M, SQUARE, Floor, floor_of, label_objects, standing, whole

SENSOR = np.array([1234.5, -987.25, 40.0])


def things_in(points: NDArray[np.float32], sensor: NDArray[np.float64], floors: list[Floor]) -> NDArray[np.int64]:
    return label_objects(points, standing(points, sensor, floors))


def ground(rng: np.random.Generator, slope: float = 0.0) -> NDArray[np.float32]:
    """As the sensor, 1.7 m above it, sees a plane."""
    x, y = rng.uniform(-30, 30, (2, 20_000))
    return np.column_stack([x, y, slope * x - 1.7 + rng.normal(0, 0.02, len(x))]).astype(np.float32)


def box(rng: np.random.Generator, x: float, y: float, width: float = 1.0, high: float = 1.5) -> NDArray[np.float32]:
    """Four walls on the ground whose middle is (x, y); their lowest points are well above it."""
    along, up = rng.uniform(-0.5, 0.5, 600) * width, rng.uniform(0.3, high, 600) - 1.7
    side = np.where(rng.random(600) < 0.5, -0.5, 0.5) * width
    xy = np.column_stack([along, side])
    xy[::2] = xy[::2, ::-1]
    return np.column_stack([xy + np.array([x, y]), up]).astype(np.float32)


@pytest.mark.parametrize("slope", [0.0, 0.05])
def test_each_box_is_a_thing_and_the_ground_is_none(slope: float) -> None:
    rng = np.random.default_rng(0)
    parts = [ground(rng, slope), box(rng, 8, 3), box(rng, 8, 4.5, 0.6), box(rng, -15, -9, 3.0)]
    for part in parts[1:]:
        part[:, 2] += slope * part[:, 0]
    points = np.concatenate(parts)
    labels = np.split(things_in(points, SENSOR, [floor_of(points, SENSOR)]), np.cumsum([len(p) for p in parts])[:-1])
    assert np.mean(labels[0] == 0) > 0.999
    assert len({0, *(int(own[0]) for own in labels[1:])}) == 4
    for own in labels[1:]:
        assert (own == own[0]).all()


def test_ground_that_another_scan_saw_counts() -> None:
    """Seen alone, a box without ground around it stands on its own lowest points; `whole` never takes those."""
    rng = np.random.default_rng(1)
    plane, thing = ground(rng), box(rng, 8, 3)
    there = SENSOR + np.array([-6.4, 13.3, 0.0])
    assert (things_in(thing, SENSOR, [floor_of(thing, SENSOR)]) == 0).any()
    assert (things_in(thing, SENSOR, [floor_of(thing, SENSOR), floor_of(plane, there)]) == 1).all()


def test_floors_are_the_lowest_of_each_square_whoever_saw_it() -> None:
    rng = np.random.default_rng(2)
    clouds = [rng.uniform(-120, 120, (3000, 3)).astype(np.float32) for _ in range(3)]
    sensors = SENSOR + np.array([[0.0, 0.0, 0.0], [40.3, -77.7, 5.0], [1000.0, 0.0, 0.0]])
    clouds[0][:2] = [[np.nan] * 3, [np.inf] * 3]
    lowest: dict[tuple[int, int], float] = {}
    for points, sensor in zip(clouds, sensors, strict=True):
        for p in points[np.abs(points).max(axis=1) < REACH_M]:
            square = tuple(np.floor((p[:2] + sensor[:2]) / SQUARE).astype(int).tolist())
            lowest[square] = min(lowest.get(square, np.inf), float(p[2] + sensor[2]))
    points, floors = clouds[0], [floor_of(p, s) for p, s in zip(clouds, sensors, strict=True)]
    labels = things_in(points, SENSOR, floors)
    for p, label in zip(points, labels, strict=True):
        if not np.abs(p).max() < REACH_M:
            assert label == 0
            continue
        x, y = np.floor((p[:2] + SENSOR[:2]) / SQUARE).astype(int)
        around = [lowest.get((x + a, y + b), np.inf) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        margin = float(p[2]) + SENSOR[2] - min(around) - ABOVE
        assert abs(margin) < 1e-4 or (label > 0) == (margin > 0)
    assert 100 < (labels > 0).sum() < 3000


def test_two_things_are_one_only_by_what_is_chosen() -> None:
    points = np.zeros((5, 3), np.float32)
    points[:, 0] = np.arange(5) * GAP + 0.5 * GAP
    points[4, 0] += 3 * GAP
    assert label_objects(points, np.ones(5, np.bool_)).tolist() == [1, 1, 1, 1, 2]
    assert label_objects(points, np.array([True, True, False, True, True])).tolist() == [1, 1, 0, 2, 3]


def test_nothing_in_reach_is_nothing() -> None:
    far = np.full((5, 3), 2 * REACH_M, np.float32)
    for points in (far, far[:0], far * np.float32(np.nan)):
        assert things_in(points, SENSOR, [floor_of(points, SENSOR)]).tolist() == [0] * len(points)


def test_a_thing_goes_whole_when_enough_of_it_moves() -> None:
    labels = np.repeat([0, 1, 2, 3], [10, 10, 10, 4])
    moves = np.zeros(34, np.bool_)
    moves[[0, 1, 2, 3, 4, 5]] = True  # of the ground
    moves[10:14] = moves[20:23] = moves[30:32] = True  # the last: half of it, but only two points
    expected = moves.copy()
    expected[10:20] = True
    assert whole(moves, labels, share=0.4, least=3).tolist() == expected.tolist()
