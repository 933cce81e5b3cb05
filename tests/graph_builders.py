"""Pose graphs with known truth: laps on a hilly figure of eight, odometry with noise, loops where laps meet."""

from __future__ import annotations

import numpy as np

from lslam.backend.graph.problem import PoseGraph
from lslam.core.geometry import se3, so3
from lslam.core.types.constraint import Constraint

STEP_SIGMAS = np.array([0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3])
LOOP_SIGMAS = np.array([0.03, 0.03, 0.03, 2e-3, 2e-3, 2e-3])


def truth(count: int, laps: int, radius: float = 60.0) -> np.ndarray:
    """(K, 4, 4) poses looking ahead; the first is the identity."""
    phase = np.linspace(0, 2 * np.pi * laps, count)
    p = np.column_stack([radius * np.sin(phase), radius * np.sin(phase) * np.cos(phase), 3 * np.sin(2 * phase)])
    ahead = np.gradient(p, axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    pitch = -np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
    poses = se3.make(so3.from_euler_rpy(np.column_stack([0 * yaw, pitch, yaw])), p)
    return se3.inverse(poses[0]) @ poses


def measured(T: np.ndarray, sigmas: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """T disturbed as t' = t + d[:3], R' = exp(d[3:]) R."""
    d = sigmas * rng.standard_normal((*T.shape[:-2], 6))
    return se3.make(so3.exp(d[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + d[..., :3])


def graph_of(
    poses: np.ndarray, loops: int, wrong: int, rng: np.random.Generator, laps: int, believed: float = 1.0
) -> PoseGraph:
    """A graph whose initial poses are odometry's; the last `wrong` of `loops` are random nonsense near their ends.

    believed : what odometry's covariance is multiplied by, below 1 when it thinks too well of itself
    """
    count = len(poses)
    steps = measured(se3.relative(poses[:-1], poses[1:]), STEP_SIGMAS, rng)
    chain = [np.eye(4)]
    for step in steps:
        chain.append(se3.normalise(chain[-1] @ step))
    covariance = believed * np.diag(STEP_SIGMAS**2)
    odometry = [Constraint(k, k + 1, steps[k], covariance, "odometry") for k in range(count - 1)]
    lap = (count - 1) // laps
    a = rng.integers(0, count - lap, loops)
    b = np.minimum(a + lap * rng.integers(1, laps, loops) + rng.integers(-2, 3, loops), count - 1)
    b = np.where(b <= a, a + lap, b)
    T = measured(se3.relative(poses[a], poses[b]), LOOP_SIGMAS, rng)
    T[loops - wrong :] = measured(np.eye(4), np.array([6.0, 6.0, 1.0, 0.05, 0.05, 1.0]), rng) @ T[loops - wrong :]
    for i in range(loops - wrong, loops):
        T[i] = measured(T[i], np.array([6.0, 6.0, 1.0, 0.05, 0.05, 1.0]), rng)
    closed = [
        Constraint(int(i), int(j), T[n], np.diag(LOOP_SIGMAS**2)) for n, (i, j) in enumerate(zip(a, b, strict=True))
    ]
    return PoseGraph(np.stack(chain), odometry, closed)


def ate(poses: np.ndarray, real: np.ndarray) -> float:
    """Rmse of positions, m; both start at the same pose."""
    return float(np.sqrt(((poses[:, :3, 3] - real[:, :3, 3]) ** 2).sum(1).mean()))
