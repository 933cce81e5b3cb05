"""A pose graph with its IMU: drift in tilt is corrected, covariances are consistent, and gaps give no links."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from graph_builders import ate, measured
from numpy.typing import NDArray

from lslam.backend.graph.factors import fixed_part
from lslam.backend.graph.inertial_smoother import InertialSmoother
from lslam.backend.graph.odometry_constraints import odometry_constraints
from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PoseGraph, PositionFix, UpDirection
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.types.constraint import Constraint
from lslam.core.types.imu import InertialChain, InertialLink, InertialState, InertialStep, SmootherNoise
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe

Floats = NDArray[np.float64]

COUNT, HZ, G = 40, 50, 9.80665
# A second from keyframe to keyframe; odometry is poor at turns, so that the IMU has something to say.
SIGMAS = np.array([0.02, 0.02, 0.02, 2e-3, 2e-3, 2e-3])
FORCE, RATE = 0.05, 2e-4
NOISE = SmootherNoise(FORCE, 2e-3, 2e-5, 5e-3)
BIAS = np.array([0.05, -0.05, 0.08]), np.array([1e-3, -2e-3, 1e-3])


def curve(t: Floats) -> tuple[Floats, Floats, Floats]:
    """Positions, accelerations and rotations on a figure of eight that climbs and rolls."""
    p = np.stack([30 * np.sin(0.1 * t), 15 * np.sin(0.2 * t), np.sin(0.2 * t)], -1)
    v = np.stack([3 * np.cos(0.1 * t), 3 * np.cos(0.2 * t), 0.2 * np.cos(0.2 * t)], -1)
    a = np.stack([-0.3 * np.sin(0.1 * t), -0.6 * np.sin(0.2 * t), -0.04 * np.sin(0.2 * t)], -1)
    yaw = np.unwrap(np.arctan2(v[..., 1], v[..., 0]))
    pitch = -np.arctan2(v[..., 2], np.hypot(v[..., 0], v[..., 1]))
    return p, a, so3.from_euler_rpy(np.stack([0.05 * np.sin(0.3 * t), pitch, yaw], -1))


def link(k: int, rng: np.random.Generator) -> InertialLink:
    at = k + np.arange(HZ + 1) / HZ
    R = curve(at)[2]
    rates = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) * HZ
    _, a, middle = curve(at[:-1] + 0.5 / HZ)
    forces = np.einsum("nji,nj->ni", middle, a + np.array([0.0, 0.0, G]))
    forces = forces + BIAS[0] + FORCE * np.sqrt(HZ) * rng.standard_normal(forces.shape)
    rates = rates + BIAS[1] + RATE * np.sqrt(HZ) * rng.standard_normal(rates.shape)
    return InertialLink(k, k + 1, InertialStep(np.full(HZ, 1 / HZ), forces, rates, RATE**2 * np.eye(3)))


def graph_and_truth(seed: int) -> tuple[PoseGraph, Floats]:
    rng = np.random.default_rng(seed)
    p, _, R = curve(np.arange(COUNT, dtype=float))
    poses = se3.make(R, p)
    real = se3.inverse(poses[0]) @ poses
    steps = measured(se3.relative(real[:-1], real[1:]), SIGMAS, rng)
    begun = [np.eye(4)]
    for step in steps:
        begun.append(se3.normalise(begun[-1] @ step))
    odometry = [Constraint(k, k + 1, T, np.diag(SIGMAS**2), "odometry") for k, T in enumerate(steps)]
    chain = InertialChain([link(k, rng) for k in range(COUNT - 1)], BIAS[0] + 0.01, BIAS[1] + 1e-4, NOISE)
    return PoseGraph(np.stack(begun), odometry, world_up=R[0].T @ [0, 0, 1], inertial=chain), real


def fixes_of(real: Floats) -> list[PositionFix]:
    rng = np.random.default_rng(7)
    return [
        PositionFix(k, real[k, :3, 3] + 0.5 * rng.normal(size=3), np.full(3, 0.5), np.zeros(3))
        for k in range(0, COUNT, 3)
    ]


def turned(poses: Floats, real: Floats) -> float:
    """rad, rms."""
    return float(np.linalg.norm(so3.log(poses[:, :3, :3] @ np.swapaxes(real[:, :3, :3], -1, -2))))


def nees(poses: Floats, covariances: Floats, real: Floats) -> float:
    e = poses[1:, :3, 3] - real[1:, :3, 3]
    return float(np.mean(np.einsum("ki,ki->k", e, np.linalg.solve(covariances[1:, :3, :3], e[..., None])[..., 0])) / 3)


def test_the_imu_halves_the_tilt_error_with_consistent_covariances() -> None:
    ratios, consistency = [], []
    for seed in range(3):
        graph, real = graph_and_truth(seed)
        held = optimise(graph, GraphConfig())
        alone = optimise(replace(graph, inertial=None), GraphConfig())
        ratios.append(turned(held.poses, real) / turned(alone.poses, real))
        consistency.append(nees(held.poses, held.covariances, real))
    assert np.median(ratios) < 0.5
    assert 0.3 < np.mean(consistency) < 2.0


@pytest.mark.parametrize("settings", [{}, {"optimizer": "isam2"}])
def test_fixes_and_imu_together_are_better_than_fixes_alone(settings: dict[str, object]) -> None:
    graph, real = graph_and_truth(0)
    config = GraphConfig.model_validate(settings)
    free = replace(graph, fixes=fixes_of(real), is_anchored=False)
    held = optimise(free, config)
    assert held.fix_inliers.all()
    alone = optimise(replace(free, inertial=None), config)
    assert ate(held.poses, real) < ate(alone.poses, real)
    assert turned(held.poses, real) < 0.8 * turned(alone.poses, real)


@pytest.mark.parametrize("optimizer", ["lm", "isam2"])
def test_a_gap_of_the_imu_leaves_odometry_alone_there(optimizer: Literal["lm", "isam2"]) -> None:
    graph, real = graph_and_truth(1)
    assert graph.inertial is not None
    config = GraphConfig(optimizer=optimizer)
    # The second gap is at the begin, beyond the first keyframes that are taken in together.
    for gap in (range(15, 19), range(12)):
        kept = [one for one in graph.inertial.links if one.a not in gap]
        held = optimise(replace(graph, inertial=replace(graph.inertial, links=kept)), config)
        assert ate(held.poses, real) < ate(optimise(replace(graph, inertial=None), config).poses, real)
    until = graph.inertial.until(10)
    assert until is not None
    assert len(until.links) == 9
    assert graph.inertial.until(1) is None


def tilting(seed: int) -> tuple[PoseGraph, Floats]:
    """Odometry that sinks its front by a quarter of a degree a step, with gravity felt at each keyframe."""
    graph, real = graph_and_truth(seed)
    bend = se3.make(so3.exp(np.array([0.0, 0.004, 0.0])), np.zeros(3))
    steps = [replace(c, T_a_b=c.T_a_b @ bend) for c in graph.odometry]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(se3.normalise(poses[-1] @ step.T_a_b))
    ups = [UpDirection(k, T[:3, :3].T @ graph.world_up, 0.005) for k, T in enumerate(real)]
    return replace(graph, poses=np.stack(poses), odometry=steps, ups=ups), real


def test_gravity_levels_a_graph_without_imu_links_or_with_one() -> None:
    graph, real = tilting(2)
    assert graph.inertial is not None
    alone = optimise(replace(graph, inertial=None), GraphConfig())
    assert turned(alone.poses, real) < 0.5 * turned(graph.poses, real)
    for links in ([], graph.inertial.links[20:21]):
        held = optimise(replace(graph, inertial=replace(graph.inertial, links=links)), GraphConfig())
        assert turned(held.poses, real) < 1.1 * turned(alone.poses, real)
        assert ate(held.poses, real) < 1.1 * ate(alone.poses, real)


def test_gravity_is_counted_once() -> None:
    graph, _ = tilting(2)
    assert graph.inertial is not None
    late = replace(graph.inertial, links=graph.inertial.links[30:])
    for chain, levelled_by_ups in ((graph.inertial, []), (late, list(range(30)))):
        held = replace(graph, inertial=chain)
        assert [up.keyframe for up in held.free_ups] == levelled_by_ups
        without = fixed_part(replace(held, ups=())).size()
        assert fixed_part(held).size() - without == len(levelled_by_ups)


def smoothed(seed: int) -> tuple[PoseGraph, list[Keyframe], list[ScanResult], Floats]:
    """A graph, and its keyframes by odometry whose smoother has the same IMU, each registered on the one before."""
    graph, real = graph_and_truth(seed)
    assert graph.inertial is not None
    rng = np.random.default_rng(100 + seed)
    chain, known = graph.inertial, np.repeat([1e-8, 1e-8, 0.01, 4e-4, 1e-6, 2.5e-3], 3)
    speed = curve(np.zeros(1))[2][0].T @ [3.0, 3.0, 0.2] + 0.05 * rng.normal(size=3)
    smoother = InertialSmoother(NOISE, 100)
    smoother.begin(
        InertialState(np.eye(4), speed, chain.accel_bias, chain.gyro_bias, -G * graph.world_up, np.diag(known))
    )
    pose, own, nothing = np.eye(4), np.diag(SIGMAS**2), np.zeros((6, 6))
    results = [ScanResult(0, 0, pose, covariance=nothing, registration_covariance=nothing, points_covariance=nothing)]
    for k, (link, true) in enumerate(zip(chain.links, se3.relative(real[:-1], real[1:]), strict=True), 1):
        registered = pose @ measured(true[None], SIGMAS, rng)[0]
        turned_own = noise.rotate(own, pose[:3, :3])
        found = smoother.add(replace(link.step, T_world_imu=registered, covariance=turned_own))
        step, before = found.T_world_imu[:3, 3] - pose[:3, 3], results[-1]
        assert before.covariance is not None
        assert before.points_covariance is not None
        pose = found.T_world_imu
        results.append(
            ScanResult(
                k, 1_000_000_000 * k, pose, registration_covariance=nothing,
                covariance=noise.transport(before.covariance, step) + found.covariance[:6, :6],
                points_covariance=noise.transport(before.points_covariance, step) + turned_own,
            )
        )  # fmt: skip
    keyframes = [Keyframe(r.index, r.index, r.stamp_ns, r.T_world_lidar, r.covariance, 1.0 * r.index) for r in results]
    return replace(graph, poses=np.stack([r.T_world_lidar for r in results])), keyframes, results, real


def turning_nees(poses: Floats, covariances: Floats, real: Floats) -> float:
    e = so3.log(poses[1:, :3, :3] @ np.swapaxes(real[1:, :3, :3], -1, -2))
    return float(np.mean(np.einsum("ki,ki->k", e, np.linalg.solve(covariances[1:, 3:, 3:], e[..., None])[..., 0])) / 3)


def test_tightly_coupled_odometry_enters_with_the_information_of_its_points() -> None:
    """The smoother's own covariances would count the IMU twice: a NEES of 4."""
    twice, once = [], []
    for seed in range(4):
        graph, keyframes, results, real = smoothed(seed)
        for told, consistency in ((results, twice), ([r.by_points for r in results], once)):
            odometry = odometry_constraints(keyframes, told, GraphConfig())
            held = optimise(replace(graph, odometry=odometry), GraphConfig())
            consistency.append(turning_nees(held.poses, held.covariances, real))
    assert 0.3 < np.mean(once) < 2.0
    assert np.mean(twice) > 2 * np.mean(once)
