"""Simulated and recorded drives, prepared once per session, and the scores that judge a trajectory."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.sequence import Sequence
from lslam.evaluation.absolute import absolute_error
from lslam.evaluation.relative import by_path, error_transforms
from lslam.odometry.uncertainty import PoseUncertainty
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
    """Scans ready for registration and the true poses (N, 4, 4), the first of them the identity."""

    points: list[PreparedPoints]
    truth: Floats

    @cached_property
    def results(self) -> list[RegistrationResult]:
        """Of all scans in the default configuration, registered once however many tests judge them."""
        return registered(self.points)


@cache
def drive(
    scenario: str, seed: int, count: int, every: int = 1, lidar: str | None = None, speed: float | None = None,
    compensated: bool | None = None,
) -> Drive:  # fmt: skip
    """`count` scans, each `every`-th of the simulated ones; with `speed` it starts at full speed."""
    simulated = simulate(
        scenario, seed=seed, lidar=lidar, count=every * (count - 1) + 1, speed=speed, start_speed=speed,
        motion_compensated=compensated,
    )  # fmt: skip
    assert simulated.ground_truth is not None
    return Drive(prepared(simulated, range(0, len(simulated), every)), simulated.ground_truth.poses[::every])


def prepared(sequence: Sequence, indices: Iterable[int]) -> list[PreparedPoints]:
    """Scans of a sequence with the default preprocessing."""
    return [prepare_points(sequence.scan(i).points, PreprocessConfig(), i) for i in indices]


def registered(points: Iterable[PreparedPoints]) -> list[RegistrationResult]:
    """All scans, one after the other, in the default configuration."""
    registration = Registration()
    return [registration.align(p) for p in points]


def poses_of(results: list[RegistrationResult]) -> Floats:
    return np.stack([r.T_world_lidar for r in results])


def standing(truth: Floats) -> Floats:
    """What an odometry that always says `nothing moved` would answer."""
    return np.tile(np.eye(4), (len(truth), 1, 1))


def coasting(truth: Floats) -> Floats:
    """What constant velocity without any registration would answer, even with the first motion exactly right."""
    step = se3.log(se3.relative(truth[0], truth[1]))
    return se3.exp(np.arange(len(truth))[:, None] * step)


def ate(estimate: Floats, truth: Floats) -> float:
    """ATE rmse, m, se3 alignment; infinite where that is not determined."""
    translation = absolute_error(estimate, truth, "se3").translation
    return np.inf if translation is None else translation.rmse


def rotation_rpe(estimate: Floats, truth: Floats, along: Floats) -> float:
    """Rotation RPE rmse, deg, over all pairs 10 m apart on the path `along` (N, 4, 4); infinite without pairs."""
    pairs = by_path(along[:, :3, 3], 10.0, True)
    if len(pairs) == 0:
        return np.inf
    angles = so3.angle(so3.normalise(error_transforms(estimate, truth, pairs)[:, :3, :3]))
    return float(np.rad2deg(np.sqrt(np.mean(angles**2))))


def final_yaw_deg(poses: Floats) -> float:
    """Heading of the last pose seen from the first, deg."""
    return float(np.rad2deg(so3.euler_rpy(se3.relative(poses[0], poses[-1])[:3, :3])[2]))


def nees_per_dof(results: list[RegistrationResult], truth: Floats) -> Floats:
    """e^T inv(C) e / 6 of every pose but the first, world axes, both trajectories starting at the identity."""
    uncertainty = PoseUncertainty()
    out = []
    for k, (result, T) in enumerate(zip(results, truth, strict=True)):
        C = uncertainty.add(result)
        assert C is not None
        R = result.T_world_lidar[:3, :3] @ T[:3, :3].T
        e = np.concatenate([result.T_world_lidar[:3, 3] - T[:3, 3], so3.log(R)])
        if k:
            out.append(float(e @ np.linalg.solve(C, e)) / 6)
    return np.array(out)
