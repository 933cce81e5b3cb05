"""Overlap removal: party walls are aligned, displacements are weighted by information, remaining overlaps are reported."""

from __future__ import annotations

import logging
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from shapely import LineString, Point, unary_union
from shapely.affinity import rotate, scale, translate
from wall_scenes import box_at

from lslam.core.types.building import Building, Footprint, footprint_polygon
from lslam.osm.overlap import LARGEST_TURN_RAD, Separation, remove_overlaps

Floats = NDArray[np.float64]

WEAK = np.array([1.0, 1.0, 1 / np.radians(2.0) ** 2])
STRONG = 400.0  # times as much as the map knows: 5 cm, 0.1 deg


def house(x: float, y: float, width: float, depth: float, number: int = 1, **tags: str) -> Building:
    return shaped(box_at(x, y, width, depth), number, **tags)


def shaped(corners: list[tuple[float, float]], number: int = 1, **tags: str) -> Building:
    return Building(f"way/{number}", (Footprint(np.array(corners, np.float64)),), tags={"building": "yes", **tags})


def information(seen: list[bool]) -> Floats:
    return np.array([np.diag(WEAK) * (STRONG if is_seen else 1.0) for is_seen in seen])


def polygons(buildings: list[Building], displacements: Floats) -> list[object]:
    """An oracle of its own: shapely turns and shifts the outlines."""
    return [placed(footprint_polygon(b.footprints[0]), b, d) for b, d in zip(buildings, displacements, strict=True)]


def placed(shape: object, building: Building, displacement: Floats) -> object:
    """A shape of the map where the building's displacement takes it."""
    turned = rotate(shape, displacement[2], tuple(building.middle), use_radians=True)
    return translate(turned, displacement[0], displacement[1])


def penetrates(one: object, other: object, depth: float = 0.02) -> bool:
    """True when the two stand in each other by more than `depth` m."""
    return bool(one.buffer(-depth / 2).intersects(other.buffer(-depth / 2)))  # type: ignore[attr-defined]


def check_apart(buildings: list[Building], found: Separation) -> None:
    shapes = polygons(buildings, found.displacements)
    assert not [(i, j) for i in range(len(shapes)) for j in range(i) if penetrates(shapes[i], shapes[j])]
    assert found.left == ()
    for contact in found.contacts:
        (owner, other), d = (buildings[contact.owner], buildings[contact.other]), found.displacements
        wall = placed(LineString(contact.wall), other, d[contact.other])
        point = placed(Point(contact.point), owner, d[contact.owner])
        line = scale(wall, 100.0, 100.0, origin="centroid")
        assert line.distance(point) < 0.005  # type: ignore[attr-defined]


@pytest.mark.parametrize("seed", range(4))
def test_party_walls_in_a_row_stay_aligned_whichever_house_was_seen(seed: int) -> None:
    rng = np.random.default_rng(seed)
    row = [house(8.0 * k, rng.uniform(-1, 1), 8.0, 11.0, k) for k in range(5)]
    seen = [bool(k) for k in rng.integers(0, 2, 5)]
    seen[int(rng.integers(5))] = True
    moved = np.where(np.array(seen)[:, None], rng.normal(0, [0.4, 0.4, 0.02], (5, 3)), 0.0)
    found = remove_overlaps(row, moved, information(seen))
    check_apart(row, found)
    shapes = polygons(row, found.displacements)
    assert all(a.distance(b) < 0.02 for a, b in pairwise(shapes))  # type: ignore[attr-defined]
    # One block: grown by a centimetre and shrunk again it has no slit, so its walls are flush all along.
    merged = unary_union([s.buffer(0.01, join_style="mitre") for s in shapes])  # type: ignore[attr-defined]
    assert merged.geom_type == "Polygon"
    assert not merged.interiors
    assert np.ptp(found.displacements[:, 2]) < np.radians(0.05)


def test_displacements_are_weighted_by_information() -> None:
    pair = [house(0, 0, 10, 10, 1), house(12, 1, 9, 8, 2)]
    found = remove_overlaps(pair, np.array([[2.5, 0, 0], [0, 0, 0]]), information([True, False]))
    check_apart(pair, found)
    np.testing.assert_allclose(found.displacements[0], [2.5, 0, 0], atol=0.01)
    np.testing.assert_allclose(found.displacements[1], [0.5, 0, 0], atol=0.01)
    equal = remove_overlaps(pair, np.array([[2.5, 0, 0], [0, 0, 0]]), information([False, False]))
    np.testing.assert_allclose(equal.displacements[:, 0], [2.25, 0.25], atol=0.005)


def test_a_rotated_building_is_aligned_with_its_party_wall() -> None:
    pair = [house(0, 0, 10, 10, 1), house(10.2, 0, 10, 10, 2)]
    found = remove_overlaps(pair, np.array([[0.0, 0, 0], [0, 0, np.radians(4)]]), information([True, False]))
    check_apart(pair, found)
    assert abs(found.displacements[1, 2] - found.displacements[0, 2]) < np.radians(0.05)
    assert len(found.contacts) == 2


def test_corners_are_aligned_where_one_wall_is_not_enough() -> None:
    court = shaped([(0, 0), (20, 0), (20, 8), (8, 8), (8, 20), (0, 20)], 1)
    tenant = house(9, 9, 6, 6, 2)
    found = remove_overlaps([court, tenant], np.array([[0, 0, 0], [-1.6, -1.5, 0.03]]), information([True, False]))
    check_apart([court, tenant], found)
    np.testing.assert_allclose(found.displacements[1] - found.displacements[0], [-1, -1, 0], atol=0.03)


def test_rotations_to_align_party_walls_are_bounded() -> None:
    pair = [house(0, 0, 12, 12, 1), house(12.5, 2, 8, 8, 2)]
    found = remove_overlaps(pair, np.array([[0, 0, 0], [0, 0, np.radians(45)]]), information([True, False]))
    check_apart(pair, found)
    assert np.abs(found.displacements[:, 2] - [0, np.radians(45)]).max() < np.radians(1)
    assert np.degrees(LARGEST_TURN_RAD) == pytest.approx(60)


@pytest.mark.parametrize("seed", range(6))
def test_no_overlaps_remain_in_a_perturbed_town(seed: int) -> None:
    rng = np.random.default_rng(seed)
    town = [house(11.0 * (k % 4), 12.0 * (k // 4), rng.uniform(8, 11), rng.uniform(8, 12), k) for k in range(16)]
    moved = np.column_stack([rng.uniform(-1.5, 1.5, (16, 2)), rng.uniform(-0.05, 0.05, 16)])
    found = remove_overlaps(town, moved, information([bool(k % 2) for k in range(16)]))
    check_apart(town, found)
    assert np.abs(found.displacements - moved)[:, :2].max() < 3.0


def test_buildings_without_contacts_keep_their_displacement_exactly() -> None:
    town = [house(0, 0, 10, 10, 1), house(9, 0, 10, 10, 2), house(40, 0, 7, 7, 3)]
    moved = np.array([[0.1, 0, 0], [0, 0.2, 0.01], [0.123456789, 0.3, 0.02]])
    found = remove_overlaps(town, moved, information([True] * 3))
    assert np.array_equal(found.displacements[2], moved[2])
    assert not np.array_equal(found.displacements[0], moved[0])
    nothing = remove_overlaps([], np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert nothing.displacements.shape == (0, 3)


def test_canopies_and_building_parts_are_not_moved() -> None:
    town = [house(0, 0, 20, 20, 1), house(5, 5, 6, 6, 2), house(15, 0, 10, 10, 3, building="roof")]
    moved = np.array([[0.3, 0, 0], [0.0, 0.1, 0], [0.0, 0, 0]])
    found = remove_overlaps(town, moved, information([True] * 3))
    assert np.array_equal(found.displacements, moved)
    assert found.left == ()


def test_overlaps_that_no_small_move_removes_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    crossed = [house(-30, -4, 60, 8, 1), house(-4, -30, 8, 60, 2)]
    with caplog.at_level(logging.WARNING, logger="lslam"):
        found = remove_overlaps(crossed, np.zeros((2, 3)), information([True, True]))
    assert found.left == ((0, 1),)
    assert np.array_equal(found.displacements, np.zeros((2, 3)))
    assert "1 pairs of buildings overlap" in caplog.text


@pytest.mark.parametrize(("inside", "is_meant"), [(0.45, False), (0.55, True)])
def test_a_nested_building_is_not_separated(inside: float, is_meant: bool) -> None:
    """A shed of 1 m x 8 m, less or more than half of it in a house: the one is drawn askew, the other is a part."""
    pair = [house(0, 0, 10, 10, 1), house(10 - inside, 1, 1, 8, 2)]
    found = remove_overlaps(pair, np.zeros((2, 3)), information([True, False]))
    assert found.left == ()
    if is_meant:
        assert np.array_equal(found.displacements, np.zeros((2, 3)))
    else:
        check_apart(pair, found)
        np.testing.assert_allclose(found.displacements[1], [inside, 0, 0], atol=0.01)
