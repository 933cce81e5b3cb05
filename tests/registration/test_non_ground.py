"""Non-ground points: which they are, and how many agree at a pose."""

from __future__ import annotations

import numpy as np
from analytic_scenes import pose_at
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3
from lslam.registration.policies import NEAR_M, NonGroundPoints, ground_under, high_points, on_ground
from lslam.registration.preprocessing.prepare import PreparedPoints

Floats = NDArray[np.float64]
Points = NDArray[np.float32]


def street(rng: np.random.Generator, x: float) -> NDArray[np.float32]:
    """Flat ground and irregular poles as seen from (x, 0, 1.7)."""
    ground = np.column_stack([rng.uniform(-30, 30, (4000, 2)), np.zeros(4000)])
    poles = np.random.default_rng(9).uniform(-25, 25, (40, 2)).repeat(20, axis=0)
    standing = np.column_stack([poles, np.tile(np.linspace(1.6, 4.0, 20), 40)])
    return (np.concatenate([ground, standing]) - [x, 0, 1.7]).astype(np.float32)


def non_ground_of(points: Points, pose: Floats) -> NonGroundPoints:
    return NonGroundPoints([(points, pose)], PreprocessConfig())


def seen_in(points: Points) -> PreparedPoints:
    prepared = PreparedPoints(points, points.astype(np.float64), np.zeros((len(points), 6)), len(points))
    return high_points(prepared, ground_under(prepared, PreprocessConfig()))


def test_the_share_is_that_of_points_with_a_neighbour_and_leaves_the_ground_out() -> None:
    rng = np.random.default_rng(0)
    first = non_ground_of(street(rng, 0.0), pose_at((5.0, 0.0, 0.0), 30.0))
    seen = seen_in(street(rng, 2.0))
    assert len(seen.source) == 800
    tree = cKDTree(se3.apply(pose_at((5.0, 0.0, 0.0), 30.0), street(rng, 0.0)[4000:].astype(float)))
    true = pose_at((5.0, 0.0, 0.0), 30.0) @ pose_at((2.0, 0.0, 0.0))
    for off in np.arange(0.0, 6.0, 0.75):
        pose = true @ pose_at((off, 0.1, 0.0))
        away, _ = tree.query(se3.apply(pose, seen.source))
        # Cells stand for their points: their mean lies up to half a cell from any of them.
        assert (away < NEAR_M / 2).mean() - 0.02 <= first.share(seen, pose) <= (away < 1.5 * NEAR_M).mean() + 0.02
    assert first.share(seen, true) == 1.0
    assert first.share(seen, true) > 1.06 * first.share(seen, true @ pose_at((1.0, 0.0, 0.0)))


def test_points_as_low_as_crash_barriers_are_left_out() -> None:
    """Barriers lie along the road everywhere: the sensor's own rings match on them best where nothing moved."""
    points = street(np.random.default_rng(1), 0.0)
    along = np.arange(-20, 20, 0.1)
    barrier = np.column_stack([along, np.full_like(along, 5.0), np.full_like(along, 0.8 - 1.7)]).astype(np.float32)
    points = np.concatenate([points, barrier])
    asked = seen_in(points)
    assert len(asked.source) == 800
    # What was seen of it earlier is kept: posts end at the height of barriers.
    low = PreparedPoints(barrier, barrier.astype(np.float64), np.zeros((len(barrier), 6)), len(barrier))
    assert non_ground_of(points, np.eye(4)).share(low, np.eye(4)) == 1.0


def test_bare_ground_has_no_share() -> None:
    ground = street(np.random.default_rng(1), 0.0)[:4000]
    assert non_ground_of(ground, np.eye(4)).share(seen_in(ground), np.eye(4)) == 0.0


def test_ground_and_non_ground_points_are_complementary() -> None:
    points = street(np.random.default_rng(1), 0.0)
    seen = PreparedPoints(points, points.astype(np.float64), np.arange(len(points))[:, None] * np.ones(6), len(points))
    ground = on_ground(seen, ground_under(seen, PreprocessConfig()))
    np.testing.assert_array_equal(ground.source, points[:4000].astype(np.float64))
    np.testing.assert_array_equal(ground.scatter, seen.scatter[:4000])
