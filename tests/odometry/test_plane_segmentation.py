"""Planes of a scan: all walls of a room and nothing else, within their covariances."""

from __future__ import annotations

import numpy as np
from analytic_scenes import bushes, pose_at, random_pose, room, seen_from

from lslam.core.geometry import se3
from lslam.odometry.plane_segmentation import PlaneExtractor, boxes_in, to_hesse, transform_planes

# Floor and walls of the room.
WALLS = np.array([[0, 0, -1.7], [10, 0, 0], [-10, 0, 0], [0, 8, 0], [0, -8, 0]], float)


def test_a_room_is_its_floor_and_walls_with_right_covariances() -> None:
    extractor, rng, squares = PlaneExtractor(0.005, 0.0, 0.0), np.random.default_rng(0), []
    for seed in range(8):
        pose = pose_at(tuple(rng.uniform(-1, 1, 3)), 30.0 * seed)
        planes = extractor.extract(seen_from(room(np.random.default_rng(seed), 1500), pose))
        true = transform_planes(WALLS, pose)
        for wall in true:
            nearest = int(np.argmin(np.linalg.norm(planes.cp - wall, axis=1)))
            off = planes.cp[nearest] - wall
            assert np.linalg.norm(off) < 0.05
            squares.append(off @ np.linalg.solve(planes.covariance[nearest], off))
        # Sides of the boxes are all there is beside.
        assert 5 <= len(planes) <= 9
        assert np.abs(planes.rms[:5]).max() < 0.03
    # A few points near corners belong to the other wall.
    assert 0.5 < np.mean(squares) / 3 < 2.0


def test_what_all_points_share_is_added() -> None:
    points = seen_from(room(np.random.default_rng(0), 1500), np.eye(4))
    sure, doubtful = (PlaneExtractor(0.005, common, 0.0).extract(points) for common in (0.0, 0.1))
    n, _ = to_hesse(sure.cp)
    grown = np.einsum("ki,kij,kj->k", n, doubtful.covariance - sure.covariance, n)
    np.testing.assert_allclose(grown, 0.01, rtol=1e-6)


def test_bushes_are_no_planes_and_an_empty_scan_has_none() -> None:
    extractor = PlaneExtractor(0.03)
    scan = seen_from(bushes(np.random.default_rng(0)), np.eye(4))
    assert sum(extractor.extract(scan).counts) < 0.1 * len(scan)
    assert len(extractor.extract(np.zeros((0, 3), np.float32))) == 0


def test_a_scan_does_not_depend_on_the_ones_before() -> None:
    rng = np.random.default_rng(1)
    first, second = (seen_from(room(rng, 1500), random_pose(rng, 1, 20)) for _ in range(2))
    used, fresh = PlaneExtractor(0.03), PlaneExtractor(0.03)
    used.extract(first)
    np.testing.assert_array_equal(used.extract(second).cp, fresh.extract(second).cp)


def test_boxes_hold_what_they_held_from_anywhere() -> None:
    planes = PlaneExtractor(0.03).extract(seen_from(room(np.random.default_rng(0), 1500), np.eye(4)))
    T = random_pose(np.random.default_rng(0), 5, 180)
    lows, highs = boxes_in(planes, T)
    for corner in (planes.lows, planes.highs, planes.means):
        moved = se3.apply(T, corner)
        assert ((moved > lows - 0.5) & (moved < highs + 0.5)).all()
