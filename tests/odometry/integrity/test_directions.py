"""Directions that a sensor sees: of a sensor that stands among what moves, and of clouds that are not its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.odometry.integrity.pair_registration import empty_share, filled_directions

Floats = NDArray[np.float64]


def seen(walls_m: float, at: Floats, noise: int = 0) -> NDArray[np.float32]:
    """Points of 32 rings, 1.8 m above the ground at a place (2,), in a square of walls 6 m high, up to 35 m away."""
    e, a = np.meshgrid(np.deg2rad(np.linspace(-25, 15, 32)), np.deg2rad(np.arange(0.1, 360, 0.4)), indexing="ij")
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    to_walls = np.min((walls_m * np.sign(d[:, :2]) - at) / d[:, :2], axis=1)
    to_ground = np.where(d[:, 2] < 0, -1.8 / np.minimum(d[:, 2], -1e-9), np.inf)
    r = np.minimum(to_walls, to_ground)
    points = d * (r + np.random.default_rng(noise).normal(0, 0.02, len(r)))[:, None]
    return points[(points[:, 2] < 4.2) & (r < 35)].astype(np.float32)


def test_a_sensor_that_stands_goes_on_seeing_where_it_saw() -> None:
    before = filled_directions(seen(30.0, np.zeros(2)))
    assert len(before) > 400
    assert empty_share(before, filled_directions(seen(30.0, np.zeros(2), noise=1))) < 0.02
    # Walls that go away, or come near, empty the sky alone.
    for walls_m in (10.0, 34.0):
        assert empty_share(before, filled_directions(seen(walls_m, np.zeros(2)))) < 0.02


def test_clouds_that_stay_while_their_sensor_moves_on_empty_the_directions_round_their_origin() -> None:
    before = filled_directions(seen(30.0, np.zeros(2)))
    place = np.array([20.0, 5.0])
    moved = seen(30.0, place) + np.array([*place, 0.0], np.float32)
    assert empty_share(before, filled_directions(moved)) > 0.25


def test_points_that_are_no_numbers_fill_no_direction() -> None:
    points = seen(30.0, np.zeros(2))
    broken = np.concatenate([points, np.full((50, 3), np.nan, np.float32), np.zeros((50, 3), np.float32)])
    np.testing.assert_array_equal(filled_directions(broken[: len(points)]), filled_directions(points))
    assert len(filled_directions(broken[len(points) :])) == 0
    assert empty_share(np.zeros(0, np.int64), filled_directions(points)) == 0.0
