"""Del Tufo's baseline: results of its NDT and VGICP, and none without walls or points."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from wall_scenes import block, box_at, plain, turned

from lslam.core.geometry import se2
from lslam.core.types.building import Building, Footprint
from lslam.osm.baseline_matcher import align_building, align_scan, flatten_scan, outline_points
from lslam.osm.walls import walls_of

Floats = NDArray[np.float64]

BOXES = [(8, 6, 11, 8), (-21, 7, 12, 9), (10, -19, 9, 10), (-20, -17, 10, 8)]


def village() -> list[Building]:
    return [Building(f"way/{k}", (Footprint(np.array(box_at(*box))),)) for k, box in enumerate(BOXES)]


def scan(seed: int) -> NDArray[np.float32]:
    """Walls that face the origin, the ground, and noise, seen from 1.7 m up."""
    rng = np.random.default_rng(seed)
    walls, _ = walls_of(village())
    along = walls[:, 1] - walls[:, 0]
    faces = walls[along[:, 0] * walls[:, 0, 1] - along[:, 1] * walls[:, 0, 0] > 0]
    cloud = [block([tuple(a), tuple(b)], -1.7, 4.0) for a, b in faces]
    points = np.concatenate([*cloud, plain() - [0, 0, 1.7]])
    return (points + rng.normal(0, 0.02, points.shape)).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_the_scan_finds_its_place_among_all_buildings(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = np.array([30.0, -12.0, rng.uniform(-3, 3)])
    walls = turned(walls_of(village())[0], (truth[0], truth[1], truth[2]))
    found = align_scan(flatten_scan(scan(seed), 60.0), walls, truth + rng.uniform(-1, 1, 3) * [0.8, 0.8, 0.04])
    assert found is not None
    assert np.linalg.norm(found.pose[:2] - truth[:2]) < 0.15
    assert abs(se2.wrap(found.pose[2] - truth[2])) < np.radians(0.6)
    assert found.rmse < 0.5


@pytest.mark.parametrize("building", range(4))
def test_a_building_is_laid_on_what_is_seen_of_it(building: int) -> None:
    seen = flatten_scan(scan(building), 60.0)
    house = village()[building]
    walls, _ = walls_of([house])
    truth = np.append(house.middle, 0.0)
    found = align_building(walls - house.middle, seen, np.add(truth, [0.5, -0.4, 0.03]))
    assert found is not None
    assert np.linalg.norm(found.pose[:2] - truth[:2]) < 0.3
    assert abs(found.pose[2]) < np.radians(2)


def test_what_is_below_the_horizon_is_cut_off_and_the_rest_is_flat_and_thin() -> None:
    flat = flatten_scan(scan(0), 15.0)
    assert flat.shape[1] == 2
    assert np.abs(flat).max() < 15
    assert len(np.unique(np.floor(flat / 0.25), axis=0)) == len(flat)
    walls, _ = walls_of(village())
    gap = [np.abs(flat[:, 0] - x).min() for x in (8.0, -9.0, 10.0, -10.0)]
    assert max(gap) < 0.1
    assert len(flat) < len(outline_points(walls)) * 1.5


def test_no_match_without_points_or_overlap() -> None:
    seen = flatten_scan(scan(0), 60.0)
    walls, _ = walls_of(village())
    assert align_scan(np.zeros((0, 2)), walls, np.zeros(3)) is None
    assert align_scan(seen, np.zeros((0, 2, 2)), np.zeros(3)) is None
    assert align_scan(seen, walls + 500.0, np.zeros(3)) is None
    assert align_building(walls[:4] - [200.0, 0.0], seen, np.zeros(3)) is None
