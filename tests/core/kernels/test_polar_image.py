"""The polar image against a loop in plain Python, and points that have no place in it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.backend.kernels.bev import polar_image


def by_hand(points: NDArray[np.float32], rings: int, sectors: int, reach: float) -> NDArray[np.float64]:
    image = np.full((rings, sectors), -np.inf)
    for x, y, z in points.astype(float):
        ring = int(math.hypot(x, y) / reach * rings)
        sector = int(math.atan2(y, x) % (2 * math.pi) / (2 * math.pi) * sectors)
        if ring < rings:
            image[ring, sector] = max(image[ring, sector], z)
    return image


def test_polar_image_equals_its_definition() -> None:
    points = np.random.default_rng(0).uniform([-90, -90, -3], [90, 90, 9], (5000, 3)).astype(np.float32)
    assert np.array_equal(polar_image(points, 20, 60, 80.0), by_hand(points, 20, 60, 80.0))


def test_points_without_a_place_are_left_out() -> None:
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1, 1, np.nan], [200, 0, 0], [80, 0, 0]], np.float32)
    assert np.isneginf(polar_image(points, 4, 8, 80.0)).all()
    assert np.isneginf(polar_image(np.zeros((0, 3), np.float32), 4, 8, 80.0)).all()


def test_a_point_just_below_the_x_axis_is_in_the_last_sector() -> None:
    image = polar_image(np.array([[10, -1e-30, 2.0]], np.float32), 4, 8, 80.0)
    assert image[0, 7] == 2.0
    assert np.isfinite(image).sum() == 1
