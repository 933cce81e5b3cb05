"""Ground removal against scenes whose ground is known, sloped, tilted and dirty ones; laws of the kernel by NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import so3
from lslam.core.kernels import ground
from lslam.registration.preprocessing.ground import above_ground
from lslam.registration.preprocessing.prepare import gate_points, prepare_points

Points = NDArray[np.float32]


def place(grade: float = 0.0, height: float = 1.8, seed: int = 0) -> tuple[Points, NDArray[np.bool_]]:
    """Rings on ground that rises by `grade` along x, two house fronts, eight cars; and which points are ground."""
    rng = np.random.default_rng(seed)
    r = np.repeat(np.geomspace(4, 50, 40), 300)
    a = rng.uniform(-np.pi, np.pi, len(r))
    floor = np.column_stack([r * np.cos(a), r * np.sin(a), np.zeros(len(r))])
    floor = floor[np.abs(floor[:, 1]) < 12]
    fronts = np.column_stack([rng.uniform(-50, 50, 6000), rng.choice([-12.0, 12.0], 6000), rng.uniform(0.3, 9, 6000)])
    corners = rng.uniform([-40, -8], [40, 8], (8, 2))
    cars = np.concatenate([np.append(c, 0.5) + rng.uniform(0, [4, 1.8, 1.0], (150, 3)) for c in corners])
    points = np.concatenate([floor, fronts, cars])
    points[:, 2] += grade * points[:, 0] - height + rng.normal(0, 0.02, len(points))
    is_ground = np.arange(len(points)) < len(floor)
    return points.astype(np.float32), is_ground


def scores(points: Points, is_ground: NDArray[np.bool_]) -> tuple[float, float]:
    """Share of the ground that is taken out, and of the rest that stays."""
    stays = np.zeros(len(points), bool)
    stays[above_ground(points)] = True
    return float((~stays[is_ground]).mean()), float(stays[~is_ground].mean())


@pytest.mark.parametrize("grade", [0.0, 0.1, -0.25])
@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (20.0, 0.0), (-12.0, 15.0)])
@pytest.mark.parametrize("height", [1.8, 12.0])
def test_ground_goes_and_the_rest_stays_on_slopes_and_under_a_tilted_sensor(
    grade: float, tilt_deg: tuple[float, float], height: float
) -> None:
    points, is_ground = place(grade, height)
    R = so3.from_euler_rpy(np.deg2rad([*tilt_deg, 30.0]))
    gone, stayed = scores((points @ R).astype(np.float32), is_ground)
    assert gone > 0.97
    assert stayed > 0.97


def test_a_hill_within_the_slope_is_ground_and_a_steep_one_is_not() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-30, 30, (20_000, 2))
    for steepness, is_kept in ((0.15, False), (0.6, True)):
        z = np.maximum(xy[:, 0] - 5, 0) * steepness - 2
        points = np.column_stack([xy, z]).astype(np.float32)
        kept = points[above_ground(points)]
        assert (len(kept) > 3000) == is_kept
        if not is_kept:
            assert len(kept) < 0.01 * len(points)


def test_reflections_from_under_the_road_do_not_lift_it() -> None:
    points, is_ground = place()
    rng = np.random.default_rng(1)
    lone = rng.uniform([-30, -10, -9], [30, 10, -3], (40, 3))
    puddle = np.array([8.0, 2.0, -2.9]) + rng.uniform(-0.5, 0.5, (60, 3)) * [1, 1, 0.1]
    dirty = np.concatenate([points, lone, puddle]).astype(np.float32)
    gone, stayed = scores(dirty, np.append(is_ground, np.ones(100, bool)))
    assert gone > 0.95
    assert stayed > 0.97


def test_a_roof_seen_from_above_is_no_ground() -> None:
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform(-40, 40, (15_000, 2)), rng.normal(-20, 0.02, 15_000)])
    floor = floor[~((np.abs(floor[:, 0] - 15) < 8) & (np.abs(floor[:, 1]) < 8))]
    roof = np.column_stack([rng.uniform([7, -8], [23, 8], (3000, 2)), rng.normal(-12, 0.02, 3000)])
    points = np.concatenate([floor, roof]).astype(np.float32)
    assert scores(points, np.arange(len(points)) < len(floor)) == (1.0, 1.0)


def test_the_envelope_is_the_lowest_cone_over_supported_cells() -> None:
    rng = np.random.default_rng(3)
    height = np.where(rng.random((24, 24)) < 0.4, rng.normal(0, 0.1, (24, 24)), ground.NO_HEIGHT)
    height[4, 5] = -9.0
    top = ground.envelope(height, 0.1, 0.25)
    i, j = np.indices(height.shape)
    expected = np.full_like(height, ground.NO_HEIGHT)
    for a, b in zip(*np.nonzero(height < ground.NO_HEIGHT), strict=True):
        near = height[max(a - 2, 0) : a + 3, max(b - 2, 0) : b + 3]
        others = near[near < ground.NO_HEIGHT]
        low = (others < height[a, b] + 0.25 + 0.2).sum() - 1
        if low < 1 or 4 * low < len(others) - 1:
            continue
        far, short = np.maximum(abs(i - a), abs(j - b)), np.minimum(abs(i - a), abs(j - b))
        expected = np.minimum(expected, height[a, b] + 0.1 * (far - short + np.sqrt(2) * short))
    np.testing.assert_allclose(top, expected, atol=1e-12)
    assert top.min() > -1


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_scans_of_a_few_points(n: int) -> None:
    points = np.array([[5, 0, -1], [6, 1, -1], [5, 2, -1], [9, 9, 4], [9, 8, -1]], np.float32)[:n]
    kept = above_ground(points)
    assert set(kept.tolist()) <= set(range(n))
    assert (np.diff(kept) > 0).all()


def test_without_a_plane_nothing_is_levelled() -> None:
    wall = np.random.default_rng(0).uniform([10, -9, -2], [10.01, 9, 9], (4000, 3)).astype(np.float32)
    kept = above_ground(wall)
    assert 0.9 < len(kept) / len(wall) < 1.0


def test_the_option_reaches_every_methods_points_and_is_off_by_default() -> None:
    points, _ = place()
    config = PreprocessConfig(remove_ground=True)
    expected = set(above_ground(points).tolist())
    in_range = set(gate_points(points, PreprocessConfig()).tolist())
    assert set(gate_points(points, config).tolist()) == expected & in_range
    assert len(in_range) > 0.9 * len(points)
    assert prepare_points(points, config).in_range < 0.7 * prepare_points(points, PreprocessConfig()).in_range
