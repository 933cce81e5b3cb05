"""Occupancy by rays: against plain Python, and on scenes that change."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import ConfigError
from lslam.core.geometry import se3, so3
from lslam.maps.floor_plan import FREE, OCCUPIED, UNKNOWN, floor_plan
from lslam.maps.occupancy import OccupancyGrid, OccupancyMapper
from lslam.pipeline.map_files import write_occupancy

# OctoMap's (Hornung et al. 2013): a hit is 0.7, a miss 0.4, clamped to 0.12 and 0.97; hundredths of log-odds, the clamps rounded.
HIT, MISS = (round(100 * np.log(p / (1 - p))) for p in (0.7, 0.4))
LOW, HIGH = -200, 350
Cell = tuple[int, ...]


def crossed(start: NDArray[np.float64], end: NDArray[np.float64]) -> set[Cell]:
    """Cells of a beam by its crossings of all cell borders, sorted along it: no stepping."""
    cuts = [0.0, 1.0]
    for a, b in zip(start, end, strict=True):
        low, high = sorted((a, b))
        cuts += [(border - a) / (b - a) for border in range(int(np.ceil(low)), int(np.floor(high)) + 1) if b != a]
    cuts.sort()
    middles = [(s + t) / 2 for s, t in pairwise(cuts) if t - s > 1e-9]
    return {tuple(np.floor(start + m * (end - start)).astype(int).tolist()) for m in middles}


def test_equals_plain_python() -> None:
    rng = np.random.default_rng(1)
    mapper, odds = OccupancyMapper(0.5, 1.0, 6.0), {}
    for k in range(6):
        T = se3.make(so3.exp(rng.normal(0, 0.5, 3)), rng.uniform(-2, 2, 3))
        points = rng.normal(0, 3.5, (150, 3)).astype(np.float32)
        points[:2] = [[np.nan] * 3, [0.0] * 3]
        mapper.add(points, T)
        hits, misses = set[Cell](), set[Cell]()
        start, done = T[:3, 3] / 0.5, set[Cell]()
        ranges = np.linalg.norm(points.astype(float), axis=1)
        for far in (False, True):
            for p, r in zip(points.astype(float), ranges, strict=True):
                if not r >= 1.0 or (r > 6.0) != far:
                    continue
                end = se3.apply(T, (p * min(1.0, 6.0 / r))[None])[0] / 0.5
                cell = tuple(np.floor(end).astype(int).tolist())
                (misses if far else hits).add(cell)
                # One beam per end cell is cast.
                if cell not in done:
                    done.add(cell)
                    misses |= crossed(start, end)
        for cell in hits | misses:
            odds[cell] = min(max(odds.get(cell, 0) + (HIT if cell in hits else MISS), LOW), HIGH)
        assert k == mapper.scans - 1
    grid = mapper.result()
    found = {tuple(c): int(v) for c, v in zip(grid.cells.tolist(), grid.log_odds, strict=True)}
    assert found == odds
    assert len(found) > 500
    assert min(odds.values()) == LOW
    assert max(odds.values()) > 0


def test_what_went_to_disk_is_put_together_in_order(tmp_path: Path) -> None:
    """A cell's history is cut anywhere: clamped sums must not notice."""
    rng = np.random.default_rng(2)
    near, far = OccupancyMapper(0.4, 0.5, 10.0), OccupancyMapper(0.4, 0.5, 10.0, most=2000, spool=tmp_path)
    for k in range(30):
        cloud = rng.normal([0, 3 if k % 7 < 4 else -3, 0], 2, (300, 3))
        T = se3.make(np.eye(3), np.array([0.1 * k, 0, 0]))
        near.add(cloud.astype(np.float32), T)
        far.add(cloud.astype(np.float32), T)
    assert list(tmp_path.iterdir()), "nothing was spilled"
    a, b = near.result(), far.result()
    assert a.cells.tobytes() == b.cells.tobytes()
    assert a.log_odds.tobytes() == b.log_odds.tobytes()


def street(with_car: bool) -> NDArray[np.float32]:
    """A wall 10 m to the left and, in front of it, the side of a car, seen from the origin 1.7 m above the ground."""
    x, z = np.meshgrid(np.linspace(-8, 8, 161), np.linspace(-1.6, 2, 37))
    wall = np.stack([x, np.full_like(x, 10.0), z], -1).reshape(-1, 3)
    if not with_car:
        return wall.astype(np.float32)
    shadow = (np.abs(wall[:, 0] * 0.5) < 2) & (wall[:, 2] * 0.5 < -0.2)
    return np.concatenate([wall[~shadow], wall[shadow] * 0.5]).astype(np.float32)


@pytest.mark.parametrize("scans", [20, 100])
def test_the_cells_of_a_car_that_left_end_free(scans: int) -> None:
    """However long it stood there."""
    mapper = OccupancyMapper(0.4, 1.0, 40.0)
    for _ in range(scans):
        mapper.add(street(True), np.eye(4))
    for _ in range(20):
        mapper.add(street(False), np.eye(4))
    grid = mapper.result()
    car = (np.abs(grid.centres[:, 0]) < 1.8) & (np.abs(grid.centres[:, 1] - 5.0) < 0.4) & (grid.centres[:, 2] < -0.3)
    assert car.sum() > 20
    assert not grid.is_occupied[car].any()
    wall = np.abs(grid.centres[:, 1] - 10.2) < 0.1
    assert grid.is_occupied[wall].mean() == 1.0
    assert (grid.centres[:, 1] < 10.4).all(), "what lies behind the wall is unknown"


def test_a_car_that_came_is_occupied_and_hides_the_wall() -> None:
    mapper = OccupancyMapper(0.4, 1.0, 40.0)
    for with_car in [False] * 30 + [True] * 10:
        mapper.add(street(with_car), np.eye(4))
    grid = mapper.result()
    car = (np.abs(grid.centres[:, 0]) < 1.8) & (np.abs(grid.centres[:, 1] - 5.0) < 0.21) & (grid.centres[:, 2] < -0.4)
    assert grid.is_occupied[car].mean() > 0.9


def test_broken_scans_poses_and_settings() -> None:
    mapper = OccupancyMapper()
    mapper.add(np.zeros((0, 3), np.float32), np.eye(4))
    mapper.add(np.full((3, 3), np.nan, np.float32), np.eye(4))
    mapper.add(np.ones((3, 3), np.float32) * 5, np.full((4, 4), np.nan))
    grid = mapper.result()
    assert len(grid) == 0
    assert floor_plan(grid).image.tolist() == [[UNKNOWN]]
    for settings in ({"voxel": 0.0}, {"range_min": 5.0, "range_max": 5.0}, {"range_max": np.inf}):
        with pytest.raises(ConfigError, match="occupancy_voxel"):
            OccupancyMapper(**settings)


def test_a_floor_plan_shows_walls_ways_and_what_nobody_saw() -> None:
    """A floor that climbs, a wall on it, a roof above it, and a bridge nobody saw beneath."""
    cells, odds = [], []
    for x in range(40):
        for y in range(20):
            ground = x // 10
            cells.append((x, y, ground))
            odds.append(100)
            if y == 5:
                cells += [(x, y, ground + k) for k in range(1, 8)]
                odds += [100] * 7
            elif y > 10:
                cells += [(x, y, ground + k) for k in range(1, 4)] + [(x, y, ground + 8)]
                odds += [-100] * 3 + [100]
    cells += [(x, 30, 12) for x in range(40)]
    odds += [100] * 40
    cells += [(3, 3, 1)]  # the ground on the border of two cells
    odds += [100]
    plan = floor_plan(OccupancyGrid(np.array(cells, np.int32), np.array(odds, np.int16), 0.4))
    picture = plan.image[::-1]
    assert picture.shape == (31, 40)
    assert (picture[5] == OCCUPIED).all()
    assert (picture[[0, 3, 8, 15]] == FREE).all()
    assert (picture[22:30] == UNKNOWN).all()
    assert (plan.x, plan.y, plan.resolution) == (0.0, 0.0, 0.4)
    assert "origin: [0, 0, 0.0]" in plan.yaml("a.png")


def test_files_hold_every_cell(tmp_path: Path) -> None:
    from matplotlib.image import imread

    from lslam.io.formats.point_files import read_points

    mapper = OccupancyMapper(0.4, 1.0, 40.0)
    mapper.add(street(True), np.eye(4))
    grid = mapper.result()
    write_occupancy(tmp_path, grid, "here")
    with np.load(tmp_path / "occupancy.npz") as stored:
        assert np.array_equal(stored["cells"], grid.cells)
        assert np.array_equal(stored["log_odds"], grid.log_odds)
        assert float(stored["voxel"]) == 0.4
    np.testing.assert_allclose(read_points(tmp_path / "occupancy.ply").points, grid.centres, atol=1e-5)
    plan = floor_plan(grid)
    assert np.array_equal(np.rint(imread(tmp_path / "floor_plan.png") * 255).astype(int), plan.image)
    assert f"resolution: {plan.resolution:g}" in (tmp_path / "floor_plan.yaml").read_text()
