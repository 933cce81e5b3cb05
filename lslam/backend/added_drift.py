"""`debug.drift`: drift added to odometry on purpose.

Positions drift along a direction fixed in the world, heading and horizon turn steadily. A scale error is not modelled: a loop
closure does not observe it.

The pose graph estimates and corrects a steady rate of drift from loop closures (`graph.loop_drift`); its covariances, which
allow for a random walk beside it, are conservative then (NEES per degree of freedom 0.1 to 1.1). With `debug.drift_memory` the
rate is a Gauss-Markov process, and a random walk has no rate: one loop closure at the end removes less than half of either.
Errors recorded from real odometry can be added, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.backend import DebugConfig
from lslam.core.errors import InputError
from lslam.core.geometry import noise, se3, so3
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe
from lslam.evaluation.associate import associate
from lslam.evaluation.frames import main_axis
from lslam.io.formats.trajectory_files import read_trajectory

# x ahead, y to the left, z up, of axes with x to the right, y down, z ahead.
CAMERA_TO_LIDAR = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def with_drift(results: Sequence[ScanResult], config: DebugConfig, tilt_deg_per_100m: float = 0.0) -> list[ScanResult]:
    """The results with the drift of `debug.drift` added to their poses; covariances are rotated with them, and not enlarged.

    tilt_deg_per_100m : added drift of roll and pitch, in place of `drift_deg_per_100m`, which is of the heading
    """
    poses = np.stack([r.T_world_lidar for r in results])
    steps = se3.relative(poses[:-1], poses[1:])
    way = np.linalg.norm(steps[:, :3, 3], axis=1)
    if config.drift_recording is not None:
        errors = errors_over(way, *recorded_errors(*config.drift_recording))
        astray = [poses[0]]
        for step, error in zip(steps, errors, strict=True):
            astray.append(se3.normalise(astray[-1] @ step @ error))
        return _move(results, np.stack(astray))
    directions, sides = _courses(way, config)
    # The horizon sinks towards the direction.
    across = np.stack([-directions[:, 1], directions[:, 0]], axis=1)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    degrees = np.column_stack([tilt_deg_per_100m * across, config.drift_deg_per_100m * sides])
    turns = so3.exp(np.deg2rad(degrees) / 100 * way[:, None])
    shifts = 0.01 * config.drift_percent * way[:, None] * directions
    drifted = [poses[0]]
    for step, turn, shift in zip(steps, turns, shifts, strict=True):
        pose = drifted[-1] @ step
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += shift
        drifted.append(se3.normalise(pose))
    return _move(results, np.stack(drifted))


def _courses(way: Floats, config: DebugConfig) -> tuple[Floats, Floats]:
    """Direction (N, 3) of the position drift and sign (N,) of the heading drift of each step, random, of unit size (rms).

    way : (N,) m, length of the steps
    """
    rng = np.random.default_rng(config.drift_seed)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    side = float(rng.choice([-1.0, 1.0]))
    if config.drift_kind == "random-walk":
        scale = np.sqrt(100.0 / np.maximum(way, 1e-9)) * (way > 0)
        walk = scale[:, None] * rng.normal(size=(len(way), 4))
        return walk[:, :3] * np.sqrt(1 / 3), walk[:, 3]
    if config.drift_memory is None:
        return np.tile(direction, (len(way), 1)), np.full(len(way), side)
    kept = np.exp(-way / config.drift_memory)
    course = np.append(direction, side)
    size = np.append(np.full(3, np.sqrt(1 / 3)), 1.0)
    courses = np.empty((len(way), 4))
    for i, share in enumerate(kept):
        course = share * course + np.sqrt(1.0 - share**2) * size * rng.normal(size=4)
        courses[i] = course
    return courses[:, :3], courses[:, 3]


def recorded_errors(estimate: str, truth: str) -> tuple[Floats, Floats]:
    """Distance travelled (K,), m, in a recorded run, and its accumulated odometry error there, (K, 6) twists in LiDAR axes.

    Raises InputError when a file cannot be read, the two do not belong together, or nothing moves.
    """
    matches = associate(read_trajectory(estimate), read_trajectory(truth))
    real, recorded = (se3.relative(poses[:-1], poses[1:]) for poses in (matches.truth, matches.estimate))
    way = np.linalg.norm(real[:, :3, 3], axis=1)
    if way.sum() <= 0:
        raise InputError(f"{truth} does not move: it has no errors over the way")
    twists = se3.log(se3.relative(real, recorded))
    if main_axis(matches.truth) in ("+z", "-z"):  # as cameras advance
        twists = (twists.reshape(-1, 2, 3) @ CAMERA_TO_LIDAR.T).reshape(-1, 6)
    zero = np.zeros((1, 6))
    return np.append(0.0, np.cumsum(way)), np.concatenate([zero, np.cumsum(twists, axis=0)])


def errors_over(way: Floats, nodes: Floats, errors: Floats) -> Floats:
    """Pose errors (N, 4, 4) of steps of `way` (N,) m; `errors` (K, 6), accumulated at `nodes` (K,) m, repeat periodically."""
    ends = np.append(0.0, np.cumsum(way))
    rounds, at = np.divmod(ends, nodes[-1])
    # Places where the sensor stood have one way and several errors: the last one counts.
    last = np.append(np.diff(nodes) > 0, True)
    summed = np.column_stack([np.interp(at, nodes[last], column[last]) for column in errors.T])
    return np.asarray(se3.exp(np.diff(summed + rounds[:, None] * errors[-1], axis=0)))


def moved_keyframes(keyframes: Sequence[Keyframe], results: Sequence[ScanResult]) -> list[Keyframe]:
    """The keyframes at the poses and covariances of their scans in `results`."""
    return [
        replace(k, T_world_lidar=results[k.scan].T_world_lidar, covariance=results[k.scan].covariance)
        for k in keyframes
    ]


def describe(config: DebugConfig) -> str:
    """Sentence about the added drift, for the manifest and the log."""
    if config.drift_recording is not None:
        estimate, truth = config.drift_recording
        return f"debug.drift: odometry was made to err as {estimate} does against {truth}; this run is an experiment"
    lasting = "steadily" if config.drift_memory is None else f"anew after some {config.drift_memory:g} m"
    if config.drift_kind == "random-walk":
        lasting = "in the root mean square after 100 m of a random walk"
    return (
        f"debug.drift: odometry was made to drift by {config.drift_percent:g} % of the way and "
        f"{config.drift_deg_per_100m:g} deg/100 m, {lasting} "
        f"(seed {config.drift_seed}); this run is an experiment"
    )


def _move(results: Sequence[ScanResult], poses: Floats) -> list[ScanResult]:
    """The results at other `poses` (N, 4, 4), their covariances rotated with the poses."""
    turns = so3.normalise(poses[:, :3, :3] @ np.stack([r.T_world_lidar[:3, :3].T for r in results]))

    def rotate(covariance: Floats | None, R: Floats) -> Floats | None:
        return None if covariance is None else noise.rotate(covariance, R)

    return [
        replace(
            result,
            T_world_lidar=pose,
            covariance=rotate(result.covariance, R),
            registration_covariance=rotate(result.registration_covariance, R),
            points_covariance=rotate(result.points_covariance, R),
        )
        for result, pose, R in zip(results, poses, turns, strict=True)
    ]
