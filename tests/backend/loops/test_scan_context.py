"""Scan Context: rotation is a column shift, height of the sensor is nothing, places are told apart."""

from __future__ import annotations

import numpy as np
import pytest
from known_town import pose, seen, town
from numpy.typing import NDArray

from lslam.backend.loops.scan_context import COMPARED, PlaceIndex, describe, distances
from lslam.core.geometry import so3

SECTORS = 60
WIDTH = 2 * np.pi / SECTORS


def turned(points: NDArray[np.float32], angle: float) -> NDArray[np.float32]:
    return (points @ so3.exp(np.array([0, 0, angle])).T).astype(np.float32)


@pytest.fixture(scope="module")
def cloud() -> NDArray[np.float32]:
    """Seen in the street; kept off the borders of sectors, so that rounding moves no point to the next."""
    points = seen(town(), pose(10, -45), np.random.default_rng(1))
    place = np.arctan2(points[:, 1], points[:, 0]) / WIDTH % 1
    return points[(place > 1e-3) & (place < 1 - 1e-3)]


@pytest.mark.parametrize("shift", [1, 17, 30, 59])
def test_turning_by_whole_sectors_shifts_columns(cloud: NDArray[np.float32], shift: int) -> None:
    before, after = (describe(c, 20, SECTORS, 80.0) for c in (cloud, turned(cloud, shift * WIDTH)))
    assert np.allclose(np.roll(before, shift, axis=1), after, atol=1e-5)
    found = distances(before, after[None])[0]
    assert found.argmin() == shift
    assert found[shift] == pytest.approx(0.0, abs=1e-6)


def test_distances_equal_the_definition() -> None:
    rng = np.random.default_rng(3)
    images = (rng.uniform(0, 5, (3, 6, 12)) * (rng.random((3, 6, 12)) < 0.3)).astype(np.float32)
    images[:, :, 2] = 0
    for n in range(12):
        for image in images[1:]:
            terms = []
            for j in range(12):
                q, c = images[0][:, j], image[:, (j + n) % 12]
                if q.any() or c.any():
                    both = q.any() and c.any()
                    terms.append(1 - q @ c / (np.linalg.norm(q) * np.linalg.norm(c)) if both else 1.0)
            expected = np.mean(terms)
            assert distances(images[0], image[None])[0, n] == pytest.approx(expected, abs=1e-6)


def test_height_of_the_sensor_does_not_matter(cloud: NDArray[np.float32]) -> None:
    drone = cloud - np.array([0, 0, 10], np.float32)
    assert np.allclose(describe(cloud, 20, SECTORS, 80.0), describe(drone, 20, SECTORS, 80.0), atol=1e-5)


def test_finds_the_place_among_many_and_the_turn() -> None:
    world, rng = town(), np.random.default_rng(5)
    index = PlaceIndex(20, SECTORS, 80.0)
    places = [(x, -45.0) for x in range(-40, 41, 8)] + [(45.0, y) for y in range(-40, 41, 8)]
    for k, (x, y) in enumerate(places):
        index.add(k, seen(world, pose(x, y), rng))
    index.add(100, seen(world, pose(9.0, -44.0, yaw_deg=-90.0), rng))
    best = index.nearest(100, np.arange(len(places)))[0]
    assert places[best.number] == (8.0, -45.0)
    assert np.rad2deg(best.yaw) == pytest.approx(-90.0, abs=6.0)
    # A heading that odometry excludes is not found; what is then best looks less alike.
    limited = index.nearest(100, np.arange(len(places)), turn=np.deg2rad(20))[0]
    assert abs(limited.yaw) <= np.deg2rad(24)
    assert limited.distance > best.distance


def test_nothing_seen_is_like_nothing() -> None:
    empty = describe(np.zeros((0, 3), np.float32), 20, SECTORS, 80.0)
    assert not empty.any()
    assert (distances(empty, empty[None]) == 1).all()
    index = PlaceIndex()
    index.add(0, np.zeros((0, 3), np.float32))
    assert index.nearest(0, np.zeros(0, np.int64)) == []


def test_grows_beyond_its_first_room(cloud: NDArray[np.float32]) -> None:
    index = PlaceIndex()
    for k in range(130):
        index.add(k, cloud[k::7])
    assert len(index) == 130
    assert index.nearest(129, np.arange(0, 129))[0].distance < 0.3


def test_a_pit_does_not_lift_the_ground(cloud: NDArray[np.float32]) -> None:
    """Three points from deep below, in cells of their own far out, change those cells only."""
    pit = np.array([[75, 1, -12], [-70, 3, -9], [2, -78, -15]], np.float32)
    before, after = (describe(c, 20, SECTORS, 80.0) for c in (cloud, np.concatenate([cloud, pit])))
    assert before.max() == pytest.approx(after.max(), abs=0.05)
    assert np.abs(before - after)[before > 0].max() < 0.05
    assert ((after > 0) & (before == 0)).sum() == 3


@pytest.mark.parametrize(("cells", "is_ground"), [(4, False), (7, True)])
def test_the_ground_is_what_the_lowest_twentieth_stands_on(cells: int, is_ground: bool) -> None:
    """A floor seen in 100 cells, of which 4 are pits of 5 m, or 7: the floor is 2 m high then, the lift, or 7 m."""
    angles = (np.arange(10) + 0.5) * 2 * np.pi / 10
    reach = np.repeat(np.arange(10) + 0.5, 10)
    z = np.where(np.arange(100) < cells, -6.7, -1.7)
    points = np.column_stack([reach * np.tile(np.cos(angles), 10), reach * np.tile(np.sin(angles), 10), z])
    image = describe(points.astype(np.float32), 10, 10, 10.0)
    np.testing.assert_allclose(image.ravel()[cells:], 7.0 if is_ground else 2.0, atol=1e-5)
    np.testing.assert_allclose(image.ravel()[:cells], 2.0, atol=1e-5)


def test_the_place_is_found_among_more_than_are_compared(cloud: NDArray[np.float32]) -> None:
    """Ring keys choose who is compared: places of other heights per ring are not."""
    rng = np.random.default_rng(2)
    index = PlaceIndex(20, SECTORS, 80.0)
    others = 3 * COMPARED
    for k in range(others):
        index.add(k, rng.uniform([-70, -70, 0], [70, 70, 1 + k % 9], (2000, 3)).astype(np.float32))
    index.add(others, cloud)
    index.add(others + 1, turned(cloud, 7 * WIDTH))
    best = index.nearest(others + 1, np.arange(others + 1))
    assert len(best) == COMPARED
    assert best[0].number == others
    assert best[0].distance == pytest.approx(0.0, abs=1e-6)
