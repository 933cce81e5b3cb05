"""The one loop: known transforms found again on any number of maps, an end in every case, and a new residual in a line."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from analytic_scenes import bushes, is_near, random_pose, seen_from
from analytic_scenes import room as lit_room
from numpy.typing import NDArray

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.kernels import linearisation as at
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.linearisation import Floats, Pose, Search, Settings, Sums, Width
from lslam.core.kernels.residuals import Voxels, add_row, nearest, octant_slots
from lslam.registration.alignment import solve, voxel_terms
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import Annealing, Correspondences, Limits, Problem, Term, optimise
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.registration.residuals import RESIDUALS, ResidualKind, find_residual
from lslam.registration.result import RegistrationResult

STEPS = 30


def room(rng: np.random.Generator, n: int, noise: float) -> Floats:
    """Floor and two walls: all six directions are seen."""
    u = rng.uniform(-6, 6, (3, n, 2))
    floor = np.column_stack([u[0], rng.normal(-1.5, noise, n)])
    wall = np.column_stack([u[1, :, 0], rng.normal(6.0, noise, n), u[1, :, 1] / 2 + 1.5])
    side = np.column_stack([rng.normal(6.0, noise, n), u[2, :, 0], u[2, :, 1] / 2 + 1.5])
    return np.concatenate([floor, wall, side])


@pytest.fixture(scope="module")
def target() -> GaussianMap:
    m = GaussianMap(0.8)
    m.insert(room(np.random.default_rng(0), 6000, 0.01).astype(np.float32), np.eye(4))
    return m


def align(
    m: GaussianMap, source: Floats, R: Floats, t: Floats, steps: int = STEPS, weak_share: float = 1e-3,
    farthest: float = np.inf, width: float = 1.0,
) -> RegistrationResult:  # fmt: skip
    matches = Correspondences(len(source))
    terms = voxel_terms(RESIDUALS["plane"], (source, np.zeros((len(source), 6))), [m], matches, 0.03)
    annealing = Annealing(width, steps, 0.1)
    return optimise(Problem(terms, se3.make(R, t), annealing, Limits(weak_share), matches, inlier_distance=farthest))


def test_known_transforms_are_found_again(target: GaussianMap) -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        R_true, t_true = so3.exp(rng.normal(0, 0.5, 3)), rng.normal(0, 1.0, 3)
        source = (room(rng, 400, 0.01) - t_true) @ R_true
        R, t = so3.exp(rng.normal(0, 0.01, 3)) @ R_true, t_true + rng.uniform(-0.15, 0.15, 3)
        found = align(target, source, R, t)
        assert found.converged
        assert len(found.degenerate) == 0
        assert 3 < found.iterations < STEPS
        assert np.linalg.norm(found.T_world_lidar[:3, 3] - t_true) < 0.005
        assert so3.angle(found.T_world_lidar[:3, :3] @ R_true.T) < 0.001
        again = align(target, source, found.T_world_lidar[:3, :3], found.T_world_lidar[:3, 3], steps=1, width=0.1)
        assert np.linalg.norm((again.T_world_lidar - found.T_world_lidar)[:3, 3]) < 1e-3
        assert found.matched > 0.9 * len(source)
        assert found.covariance is not None
        assert np.linalg.eigvalsh(found.covariance).min() > 0
        np.testing.assert_allclose(found.T_world_lidar[:3, :3] @ found.T_world_lidar[:3, :3].T, np.eye(3), atol=1e-14)


def test_it_stops_at_the_iterations_it_was_given(target: GaussianMap) -> None:
    source = room(np.random.default_rng(2), 400, 0.01)
    found = align(target, source, so3.exp(np.array([0.0, 0.0, 0.1])), np.array([0.3, 0.3, 0.0]), steps=2)
    assert (found.iterations, found.converged) == (2, False)


def test_fewer_than_six_matches_move_nothing(target: GaussianMap) -> None:
    source = room(np.random.default_rng(2), 400, 0.01)[:5]
    start = se3.make(np.eye(3), np.array([0.1, 0.0, 0.05]))
    found = align(target, source, start[:3, :3], start[:3, 3])
    assert found.matched < 6
    assert (found.iterations, found.converged) == (1, False)
    np.testing.assert_array_equal(found.T_world_lidar, start)
    assert found.covariance is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_a_pose_that_is_no_pose_ends_at_once(target: GaussianMap, bad: float) -> None:
    found = align(target, room(np.random.default_rng(2), 400, 0.01), np.eye(3), np.array([bad, 0.0, 0.0]))
    assert (found.iterations, found.converged) == (1, False)


def test_no_single_step_leaves_the_reach_of_the_correspondences() -> None:
    # All normals nearly alike: along x the information is tiny and an unguarded step is huge.
    rng = np.random.default_rng(3)
    m = GaussianMap(0.8)
    xy = rng.uniform(-6, 6, (20000, 2))
    m.insert(np.column_stack([xy, 0.002 * xy[:, 0] ** 2 + rng.normal(0, 0.02, 20000)]).astype(np.float32), np.eye(4))
    xy = rng.uniform(-5, 5, (300, 2))
    source = np.column_stack([xy, 0.002 * xy[:, 0] ** 2 + 0.05 * xy[:, 0]])
    found = align(m, source, np.eye(3), np.zeros(3), steps=1, weak_share=0.0)
    assert 0.0 < np.linalg.norm(found.T_world_lidar[:3, 3]) <= 2.0 + 1e-12


def test_a_bound_no_match_is_within_moves_nothing(target: GaussianMap) -> None:
    floor = np.random.default_rng(2).uniform(-4, 4, (400, 3))
    floor[:, 2] = -1.5 + 0.4
    found = align(target, floor, np.eye(3), np.zeros(3), steps=1, farthest=0.3)
    assert found.matched > 300
    assert len(found.degenerate) == 6
    # The covariance of no information at all.
    assert found.covariance is not None
    assert np.linalg.eigvalsh(found.covariance).min() > 1e17
    np.testing.assert_array_equal(found.T_world_lidar, np.eye(4))


def test_a_start_that_is_no_contiguous_array_is_left_alone(target: GaussianMap) -> None:
    source = room(np.random.default_rng(2), 400, 0.01)
    start = se3.make(so3.exp(np.array([0.0, 0.0, 0.01])), np.array([0.05, 0.0, 0.0]))
    turned = np.asfortranarray(start)
    np.testing.assert_array_equal(
        align(target, source, start[:3, :3], start[:3, 3]).T_world_lidar,
        align(target, source, turned[:3, :3], turned[:3, 3]).T_world_lidar,
    )
    np.testing.assert_array_equal(turned, start)


def test_the_facts_are_named() -> None:
    """Two terms that only sum up: every fact of both arrives under its own name."""
    places = [at.INFORMATION, at.SQUARED, at.INLIERS, at.MATCHED, at.LEVER, at.ROBUST]

    def sum_up(points: object, target: object, settings: object, search: object, pose: object, width: object,
               sums: tuple[Floats, ...]) -> None:  # fmt: skip
        sums[0][:] += np.eye(6)
        sums[3][places] += [4.0, 9.0, 20.0, 30.0, 16.0, 1.0]

    term = Term(sum_up, (), (), ())
    facts = optimise(Problem([term, term], np.eye(4), Annealing.once(1.0), Limits(1e-3), Correspondences(0)))
    assert (facts.inliers, facts.matched) == (40, 60)
    assert facts.lever_arm == 2.0
    assert facts.rmse == 3.0


def as_source(points: NDArray[np.float32]) -> PreparedPoints:
    return PreparedPoints(points, points.astype(np.float64), np.zeros((len(points), 6)), len(points))


@pytest.mark.parametrize("residual", list(RESIDUALS))
def test_each_map_serves_what_the_finer_ones_left(residual: str) -> None:
    """Three maps: of floor, of one wall, of the other. Only all three hold the pose."""
    world = room(np.random.default_rng(0), 20000, 0.01)
    thirds = np.array_split(world, 3)
    levels = []
    for k, part in enumerate(thirds):
        level = GaussianMap(0.5 * 2**k)
        level.insert(part.astype(np.float32), np.eye(4))
        levels.append(level)
    rng = np.random.default_rng(1)
    T = random_pose(rng, 0.1, 0.5)
    scan = as_source(seen_from(room(rng, 400, 0.01), T))

    def found(count: int) -> RegistrationResult:
        return solve(
            levels[:count], scan, np.eye(4), Annealing(1.0, 40, decay=0.7), RegistrationConfig(),
            residual=replace(find_residual(residual), non_planar_weight=0.0),
        )  # fmt: skip

    one, two, three = (found(k) for k in (1, 2, 3))
    assert 0 < one.matched < two.matched < three.matched
    assert one.inliers < two.inliers < three.inliers
    # The mean of a voxel of two metres is no place to draw a point to.
    assert residual == "point" or is_near(T, three.T_world_lidar, 0.02, 0.1)


@pytest.mark.parametrize("residual", list(RESIDUALS))
def test_no_point_is_matched_on_two_maps(residual: str) -> None:
    """Bushes among walls: what a non-planar voxel of the fine map serves, the coarse one does not serve again."""
    rng = np.random.default_rng(0)

    def seen() -> NDArray[np.float32]:
        return np.concatenate([room(rng, 2000, 0.01), bushes(rng)]).astype(np.float32)

    levels = [GaussianMap(0.8), GaussianMap(2.4)]
    for level in levels:
        level.insert(seen(), np.eye(4))
    scan = as_source(seen()[::20])
    result = solve(
        levels, scan, np.eye(4), Annealing(0.15, 5), RegistrationConfig(), residual=find_residual(residual)
    )  # fmt: skip
    assert 0 < result.inliers <= result.matched <= result.source_points


@kernel
def linearise_cauchy(points: tuple[Floats, Floats], voxels: Voxels, settings: Settings, search: Search, pose: Pose,
                     width: Width, sums: Sums) -> None:  # fmt: skip
    """Point to plane with the weight of Cauchy, of planes alone."""
    source, _ = points
    planes, keys, table = voxels
    cells, slots, chosen, asked, is_done, distance2 = search
    R, t = pose
    H, _, g, facts = sums
    for i in range(len(source)):
        if is_done[i]:
            continue
        r = R @ source[i]
        x, y, z = r[0] + t[0], r[1] + t[1], r[2] + t[2]
        if octant_slots(x, y, z, i, 1.0 / settings[0], cells, slots, keys, table):
            asked[i, 3] = -1.0
        best, _, _, _ = nearest(x, y, z, i, slots, chosen, asked, planes)
        if best < 0:
            continue
        p = planes[best]
        e = p[3] * (x - p[0]) + p[4] * (y - p[1]) + p[5] * (z - p[2])
        robust = 1.0 / (1.0 + (e / width[0]) ** 2)
        w = robust / (p[6] + settings[1])
        j3, j4, j5 = r[1] * p[5] - r[2] * p[4], r[2] * p[3] - r[0] * p[5], r[0] * p[4] - r[1] * p[3]
        add_row(H, g, w, e, p[3], p[4], p[5], j3, j4, j5)
        is_done[i], distance2[i] = True, e * e
        facts[at.INFORMATION] += w
        facts[at.SQUARED] += robust * e * e
        facts[at.INLIERS] += math.fabs(e) < width[0]
        facts[at.MATCHED] += 1.0
        facts[at.LEVER] += w * (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        facts[at.ROBUST] += robust


def test_a_new_residual_is_a_kernel_and_a_line_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    config = RegistrationConfig(residual="cauchy")
    with pytest.raises(UsageError, match="no residual 'cauchy'"):
        Registration(config)
    monkeypatch.setitem(RESIDUALS, "cauchy", ResidualKind(__name__, "linearise_cauchy"))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        registration = Registration(config)
        registration.register(lit_room(rng).astype(np.float32))
        T = random_pose(rng, 1.0, 3.0)
        result = registration.register(seen_from(lit_room(rng), T))
        assert result.ok
        assert result.converged
        assert is_near(T, result.T_world_lidar, 0.01, 0.05)
