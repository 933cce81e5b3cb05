"""Deskewing against the transform of every single point, and what is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan, Span
from lslam.registration.preprocessing.deskew import SWEEP_KNOTS, deskew, deskew_points
from lslam.registration.preprocessing.prepare import prepare_points

# 15 m/s and 150 deg/s, as a 0.1 s sweep sees them.
TWIST = np.array([1.5, 0.05, -0.02, 0.03, -0.02, np.deg2rad(15.0)])


def sweep(knots: int, twist: NDArray[np.float64] = TWIST, begin: float = 0.0) -> MotionPrior:
    times = begin + np.linspace(0.0, 0.1, knots)
    pose = se3.exp(np.array([30.0, -20.0, 1.0, 0.1, 0.2, 2.0]))
    return MotionPrior(times, pose @ se3.exp(times[:, None] / 0.1 * twist))


def cloud(n: int = 3000) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(0)
    return rng.uniform(-60, 60, (n, 3)).astype(np.float32), rng.uniform(0, 0.1, n).astype(np.float32)


@pytest.mark.parametrize("begin", [0.0, -0.05, -0.037, -0.1])
@pytest.mark.parametrize("knots", [2, 11, SWEEP_KNOTS])
def test_every_point_is_carried_by_the_pose_at_its_time(knots: int, begin: float) -> None:
    """To the stamp: where the sweep begins, in its middle, elsewhere, at its end."""
    points, times = cloud()
    times += np.float32(begin)
    moved = deskew_points(points, times, sweep(knots, begin=begin))
    T_stamp_point = se3.exp(times[:, None].astype(float) / 0.1 * TWIST)
    expected = np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], points.astype(float)) + T_stamp_point[:, :3, 3]
    # Between two knots translation runs straight and not along the screw.
    np.testing.assert_allclose(moved, expected, atol=0.06 if knots == 2 else 2e-3)
    assert np.linalg.norm(moved - points, axis=1).max() > 5.0 * max(-begin, 0.1 + begin) / 0.1


def test_what_has_no_times_or_no_motion_is_left_alone() -> None:
    points, times = cloud(100)
    assert deskew_points(points, None, sweep(2)) is points
    assert deskew_points(points, times, sweep(1)) is points
    prepared = prepare_points(points, PreprocessConfig())
    assert deskew(prepared, sweep(5)) is prepared


@pytest.mark.parametrize("begin", [0.0, -0.05])
def test_points_without_a_finite_time_are_unchanged_and_do_not_affect_others(begin: float) -> None:
    points, times = cloud(100)
    good = deskew_points(points, times, sweep(SWEEP_KNOTS, begin=begin))
    times[7] = np.nan
    assert Scan(points, 0, 0, None, times).span == Span(0.0, float(np.nanmax(times)))
    moved = deskew_points(points, times, sweep(SWEEP_KNOTS, begin=begin))
    np.testing.assert_allclose(moved[7], points[7], atol=1e-5)
    np.testing.assert_array_equal(np.delete(moved, 7, 0), np.delete(good, 7, 0))


def test_times_after_the_sweep_continue_its_motion() -> None:
    points = np.zeros((1, 3), np.float32)
    straight = sweep(2, np.array([1.0, 0, 0, 0, 0, 0]))
    moved = deskew_points(points, np.array([0.12], np.float32), straight)
    np.testing.assert_allclose(moved, [[1.2, 0, 0]], atol=1e-5)


def test_centroids_are_deskewed_as_well_as_their_points() -> None:
    """A wall seen by a passing sensor: centroids deskewed by their mean time lie on it."""
    rng = np.random.default_rng(1)
    times = np.sort(rng.uniform(0, 0.1, 40_000)).astype(np.float32)
    twist = np.array([1.5, 0, 0, 0, 0, np.deg2rad(6.0)])
    azimuth = -np.pi * times / 0.1
    wall = np.column_stack([10 * np.cos(azimuth), np.full(len(times), -5.0), rng.uniform(-1, 3, len(times))])
    seen = se3.inverse(se3.exp(times[:, None].astype(float) / 0.1 * twist))
    raw = np.einsum("nij,nj->ni", seen[:, :3, :3], wall) + seen[:, :3, 3]
    prior = MotionPrior(np.linspace(0, 0.1, SWEEP_KNOTS), se3.exp(np.linspace(0, 1, SWEEP_KNOTS)[:, None] * twist))
    prepared = prepare_points(raw, PreprocessConfig(), times=times)
    assert np.abs(prepared.source[:, 1] + 5).max() > 0.3
    straight = deskew(prepared, prior)
    for points in (straight.map_points, straight.source):
        assert np.abs(points[:, 1] + 5).max() < 0.005
