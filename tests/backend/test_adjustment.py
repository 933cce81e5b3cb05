"""Plane adjustment: its equations against a dense oracle, and poses that come back to where they were."""

from __future__ import annotations

import numpy as np
import pytest
from rooms import in_room, walk

from lslam.backend.adjustment import SweptPoints, adjust, find_planes
from lslam.backend.graph.marginals import PosePrior
from lslam.backend.kernels import plane_adjustment
from lslam.core.arrays import Floats
from lslam.core.geometry import se3, so3


def ate(poses: Floats, truth: Floats) -> float:
    T, _, _ = se3.umeyama(poses[:, :3, 3], truth[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum((se3.apply(T, poses[:, :3, 3]) - truth[:, :3, 3]) ** 2, axis=1))))


def test_the_reduced_equations_are_those_of_all_points_with_the_plane_eliminated() -> None:
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(3, 3))
    sightings, each = [(0, 0.3), (1, 0.0), (1, 0.6), (2, 0.0)], 7
    points = [np.column_stack([rng.normal(size=(each, 2)), 0.03 * rng.normal(size=each)]) for _ in sightings]
    cells = np.repeat(np.arange(4), each)
    numbers, means, covariances = plane_adjustment.sums(cells, 4, np.concatenate(points))
    assert (numbers == each).all()
    starts, at = np.array([0, 4]), np.array([k for k, _ in sightings])
    shares = np.array([share for _, share in sightings])
    floor = 1e-4
    seen = starts, at, shares, means
    H, beside, g, *of_planes = plane_adjustment.equations(*seen, covariances, origins, floor)

    everything = np.concatenate(points)
    middle = everything.mean(axis=0)
    values, axes = np.linalg.eigh(np.cov(everything.T, bias=True))
    n = axes[:, 0]
    weight = 1.0 / (values[0] + floor) / each
    J, K, r = np.zeros((4 * each, 18)), np.zeros((4 * each, 3)), (everything - middle) @ n
    for i, p in enumerate(everything):
        k, share = sightings[i // each]
        for node, part in ((k, 1.0 - share), (k + 1, share)):
            if part:
                J[i, 6 * node : 6 * node + 3] += part * n
                J[i, 6 * node + 3 : 6 * node + 6] += part * np.cross(p - origins[node], n)
        K[i] = [1.0, (p - middle) @ axes[:, 1], (p - middle) @ axes[:, 2]]
    project = np.eye(len(r)) - K @ np.linalg.solve(K.T @ K, K.T)
    whole, right = weight * J.T @ project @ J, weight * J.T @ project @ r
    stiffness = np.array([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0.5, 0.0, 0.5, 0.0, 0.0, 2.0]])
    steps = np.array([[[1, -1, 0], [-1, 1, 0], [0, 0, 0]], [[0, 0, 0], [0, 1, -1], [0, -1, 1]]])
    chain = sum(np.kron(step, np.diag(stiff)) for step, stiff in zip(steps, stiffness, strict=True))
    x, out = rng.normal(size=(3, 6)), np.empty((3, 6))
    plane_adjustment.product(x, H, beside, *seen, origins, *of_planes, stiffness, out)
    np.testing.assert_allclose(out.ravel(), (whole + chain) @ x.ravel(), rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(g.ravel(), right, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_poses_that_drifted_come_back(seed: int) -> None:
    """A steady drift of 1 % and noise of 3 mm: no scan is registered anew, planes alone say where they are."""
    rng, truth = np.random.default_rng(seed), walk(60)
    points, scans = in_room(truth, 400, rng)
    way = np.arange(60)[:, None]
    drifted = truth.copy()
    drifted[:, :3, :3] = so3.exp(0.0006 * way * [0.2, -0.3, 1.0]) @ truth[:, :3, :3]
    drifted[:, :3, 3] += 0.0015 * way * [1.0, -1.0, 0.5] + 0.003 * rng.normal(size=(60, 3))
    world = np.einsum("nij,nj->ni", drifted[scans, :3, :3], points) + drifted[scans, :3, 3]
    swept = SweptPoints(world, scans, np.zeros(len(world)))
    found = adjust(drifted, swept, np.ones(len(world), bool))
    assert ate(found.poses, truth) < min(0.005, 0.2 * ate(drifted, truth))


@pytest.mark.parametrize("seed", range(3))
def test_what_is_known_of_some_poses_gives_the_place(seed: int) -> None:
    """Of every sixth pose the position is known to 5 mm: the run drifts, and comes back to its place without alignment."""
    rng, truth = np.random.default_rng(seed), walk(60)
    points, scans = in_room(truth, 400, rng)
    way = np.arange(60)[:, None]
    drifted = truth.copy()
    drifted[:, :3, 3] += 0.2 * np.array([1.0, -1.0, 0.5]) + 0.0015 * way * [1.0, -1.0, 0.5]
    world = np.einsum("nij,nj->ni", drifted[scans, :3, :3], points) + drifted[scans, :3, 3]
    swept, known = SweptPoints(world, scans, np.zeros(len(world))), np.arange(0, 60, 6)
    information = np.diag([0.005**-2] * 3 + [0.0] * 3)
    surveyed = truth[known].copy()
    surveyed[:, :3, 3] += 0.005 * rng.normal(size=(len(known), 3))
    prior = PosePrior(surveyed, lambda x: x @ information, np.tile(information, (len(known), 1, 1)))
    found = adjust(drifted, swept, np.ones(len(world), bool), prior, known)
    away = np.linalg.norm(found.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert away.max() < 0.015


@pytest.mark.parametrize("seed", range(3))
def test_two_drives_of_one_room_come_together(seed: int) -> None:
    """Each drifts on its own way, and the second lies 5 cm off: no motion joins it to the first, planes that both saw do."""
    rng, one = np.random.default_rng(seed), walk(40)
    truth = np.concatenate([one, one[::-1]])
    points, scans = in_room(truth, 400, rng)
    drifted, way = truth.copy(), np.tile(np.arange(40), 2)[:, None]
    drifted[:, :3, 3] += 0.0015 * way * np.repeat([[1.0, -1.0, 0.5], [-1.0, 1.0, 0.5]], 40, axis=0)
    drifted[40:, :3, 3] += [0.03, 0.04, 0.0]
    swept = [
        SweptPoints(world, at, 0.0 * at)
        for half in (scans < 40, scans >= 40)
        for world, at in [
            (
                np.einsum("nij,nj->ni", drifted[scans, :3, :3], points)[half] + drifted[scans, :3, 3][half],
                scans[half] % 40,
            )
        ]
    ]
    firsts = np.array([0, 40])
    cloud = SweptPoints.chain(swept, firsts)
    np.testing.assert_array_equal(cloud.poses, scans)
    again, mask = SweptPoints.chain(swept, firsts), np.ones(len(scans), bool)
    refined = adjust(drifted, cloud, mask, firsts=firsts)
    assert ate(refined.poses, truth) < 0.005
    # As one drive, the step from the end of the first to the begin of the second would have to stay as it is.
    assert ate(adjust(drifted, again, mask).poses, truth) > 2.0 * ate(refined.poses, truth)


def test_points_move_with_the_poses_round_the_instant_they_were_measured() -> None:
    swept = SweptPoints.at_times(
        np.array([[1.0, 0, 0]] * 5), np.array([-0.1, 0.0, 0.05, 0.1, 0.3]), np.array([0.0, 0.1])
    )
    np.testing.assert_array_equal(swept.poses, [0, 0, 0, 1, 1])
    np.testing.assert_allclose(swept.shares, [0.0, 0.0, 0.5, 0.0, 0.0])
    corrections = np.zeros((2, 6))
    corrections[1] = [0.2, 0, 0, 0, 0, np.pi / 2]
    swept.move(np.stack([np.eye(4), np.eye(4)]), corrections)
    moved = swept.points
    np.testing.assert_allclose(moved[[0, 3]], [[1, 0, 0], [0.2, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(moved[2], [0.6, 0.5, 0], atol=1e-12)


def test_knots_keep_the_place_of_every_point() -> None:
    swept = SweptPoints(np.zeros((4, 3)), np.array([0, 3, 10, 12]), np.array([0.5, 0.0, 0.5, 0.0]))
    on = swept.on_knots(np.array([0, 10, 12]))
    np.testing.assert_array_equal(on.poses, [0, 0, 1, 2])
    np.testing.assert_allclose(on.shares, [0.05, 0.3, 0.25, 0.0])


def test_what_is_no_plane_is_none() -> None:
    """A wall is one plane from many scans; a bush is none, nor what three scans saw, nor a pole."""
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.random((200, 1)) * 0.01, rng.random((200, 2)) * 1.9])
    bush = rng.random((200, 3)) * 0.4 + [10, 10, 10]
    pole = np.column_stack([0.01 * rng.normal(size=(200, 2)) + 20.5, rng.random(200)])
    scans = np.arange(200) // 25
    order = np.argsort(np.tile(scans, 3), kind="stable")
    planes = find_planes(np.concatenate([wall, bush, pole])[order], np.tile(scans, 3)[order], 0.005)
    assert (planes[order < 200] == 0).all()
    assert (planes[order >= 200] == -1).all()
    assert (find_planes(wall, scans // 3, 0.005) == -1).all()


def test_without_planes_nothing_moves() -> None:
    rng, poses = np.random.default_rng(2), walk(12)
    swept = SweptPoints(rng.random((600, 3)) * 30, np.repeat(np.arange(12), 50), np.zeros(600))
    found = adjust(poses, swept, np.ones(600, bool))
    np.testing.assert_array_equal(found.poses, poses)
    assert found.rounds == 0
