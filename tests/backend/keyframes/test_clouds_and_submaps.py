"""What is kept of a scan, and several of them in one frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lslam.backend.keyframes.store import KeyframeStore, neighbours, submap
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.trajectory import Keyframe
from lslam.odometry.frontend.keyframing import GRAIN, keyframe_cloud

AT_ONCE = MotionPrior.at_once(np.eye(4))


def centroids(points: NDArray[np.float32], voxel: float) -> NDArray[np.float64]:
    """The reference: voxels by sorting, sums in double."""
    _, member = np.unique(np.floor(points.astype(np.float64) / voxel), axis=0, return_inverse=True)
    sums = np.stack([np.bincount(member.ravel(), points[:, axis]) for axis in range(3)], axis=1)
    return sums / np.bincount(member.ravel())[:, None]


def test_one_centroid_per_voxel_and_what_is_no_measurement_stays_out() -> None:
    rng = np.random.default_rng(0)
    good = rng.uniform(-20, 20, (3000, 3)).astype(np.float32)
    good = good[np.linalg.norm(good, axis=1) > 1.0]
    bad = np.array([[0, 0, 0], [np.nan] * 3, [0.1, 0.1, 0], [500, 0, 0], [np.inf, 0, 0], [5, 5, 5]], np.float32)
    preprocess = PreprocessConfig(ego_box=(4.9, 5.1, 4.9, 5.1, 4.9, 5.1), remove_ground=True)
    found = keyframe_cloud(Scan(np.concatenate([bad, good]), 0, 0), AT_ONCE, preprocess)
    expected = centroids(good, 0.3)
    assert found.dtype == np.float32
    assert len(found) == len(expected)
    for one, other in ((found, expected), (expected, found)):
        assert cKDTree(one).query(other)[0].max() < GRAIN
    np.testing.assert_array_equal(found / GRAIN, np.round(found / GRAIN))


def test_a_wall_seen_while_turning_is_straight_again() -> None:
    """A wall at x = 10, swept in 0.1 s by a sensor that drives at 10 m/s and turns at 90 deg/s."""
    knots = np.linspace(0, 0.1, 33)
    motion = MotionPrior(knots, se3.exp(knots[:, None] * np.array([10.0, 0, 0, 0, 0, np.pi / 2])))
    times = np.linspace(0, 0.1, 2000)
    wall = np.stack([np.full(2000, 10.0), np.linspace(-8, 8, 2000), np.linspace(0, 3, 2000)], axis=1)
    poses = se3.exp(times[:, None] * np.array([10.0, 0, 0, 0, 0, np.pi / 2]))
    seen = np.einsum("nij,nj->ni", se3.inverse(poses)[:, :3, :3], wall - poses[:, :3, 3]).astype(np.float32)
    scan = Scan(seen, 0, 0, times=times.astype(np.float32))
    straight = keyframe_cloud(scan, motion, PreprocessConfig())
    assert np.abs(straight[:, 0] - 10.0).max() < 0.005
    off = keyframe_cloud(scan, motion, PreprocessConfig(deskew=False))
    assert np.abs(off[:, 0] - 10.0).max() > 0.5


def test_neighbours_stay_within_the_run() -> None:
    for count in (1, 2, 5, 9):
        for size in (1, 2, 5):
            for number in range(count):
                found = neighbours(count, number, size)
                assert number in found
                assert len(found) <= size
                assert found.start >= 0
                assert found.stop <= count
    assert len(neighbours(9, 4, 4)) == 4


def test_a_submap_lies_in_the_frame_of_its_keyframe() -> None:
    """The same posts seen from five places come to lie on top of each other."""
    rng = np.random.default_rng(1)
    world = rng.uniform(-30, 30, (400, 3))
    poses = se3.exp(rng.normal(size=(5, 6)) * np.array([5, 5, 1, 0.1, 0.1, 2.0]))
    store = KeyframeStore()
    for k, pose in enumerate(poses):
        store.add(Keyframe(k, k, k, np.eye(4)), se3.apply(se3.inverse(pose), world).astype(np.float32))
    found = submap(store, poses, 2, 5)
    assert found.shape == (2000, 3)
    np.testing.assert_allclose(found, np.tile(se3.apply(se3.inverse(poses[2]), world), (5, 1)), atol=1e-4)
    assert 400 <= len(submap(store, poses, 2, 5, voxel=0.1)) < 600
    np.testing.assert_array_equal(submap(store, poses, 0, 1), store.points(0))
    in_the_world = submap(store, poses, 2, 5, T_world_frame=np.eye(4))
    np.testing.assert_allclose(in_the_world, np.tile(world, (5, 1)), atol=1e-4)
