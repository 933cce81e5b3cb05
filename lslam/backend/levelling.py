"""Levelling of a run's world: up becomes z, origin and heading stay the first scan's.

All poses are turned by one rotation, so relative motions, aligned errors and the map's shape do not change.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from lslam.config import Config
from lslam.errors import InputError
from lslam.geometry import se3, so3
from lslam.kernels import jit
from lslam.machine import one_at_a_time
from lslam.preprocessing.ground import levelling, up_of
from lslam.preprocessing.up import NEAR_Z
from lslam.types.arrays import Floats
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence

log = logging.getLogger("lslam")

ORIGIN = "LiDAR at the first scan"
UP = np.array([0.0, 0.0, 1.0])
# The ground under the sensor: so many cells of half a metre to each side.
CELLS = 80
# Sigmas below which a tilt is insignificant: most sensors are mounted level, and a bias looks like a tilt before the first bends.
SIGNIFICANT = 2.0


@dataclass(frozen=True)
class Level:
    """The rotation that levels a world, and its source.

    R : (3, 3) from the world before; world : description for files; problem : what was asked for and failed
    """

    R: Floats
    world: str
    problem: str = ""

    @property
    def is_turned(self) -> bool:
        """Whether the rotation is not the identity."""
        return not np.array_equal(self.R, np.eye(3))


def find_level(sequence: Sequence, results: list[ScanResult], config: Config) -> Level:
    """The level that `input.level` asks for: by gravity from an IMU, by the ground under the first scan, or none."""
    wanted = config.input.level
    if wanted == "auto":
        wanted = "gravity" if config.imu.use else "none"
    if wanted == "none":
        return Level(np.eye(3), f"{ORIGIN}, not levelled")
    sigma = 0.0
    if wanted == "gravity":
        up, sigma = _up_by_gravity(results)
        what, why = "gravity", "no scan has a direction of gravity: it takes --imu, and an IMU that is not refused"
    else:
        up = _up_by_ground(sequence, results, config)
        what, why = "the ground under the first scan", "no ground plane is seen there"
    if up is None:
        problem = "" if config.input.level == "auto" else f"input.level = {wanted}: {why}; the world is not levelled"
        return Level(np.eye(3), f"{ORIGIN}, not levelled", problem)
    R = so3.least_rotation(up, UP) if up[2] > NEAR_Z else so3.level_frame(up)
    tilt, known = np.rad2deg(float(so3.angle(R))), np.rad2deg(sigma)
    if tilt < SIGNIFICANT * known:
        return Level(
            np.eye(3), f"{ORIGIN}, not levelled: its tilt of {tilt:.2f} deg is none to {what}, known to {known:.2f} deg"
        )
    log.info("the world is levelled by %s: turned by %.2f deg", what, tilt)
    return Level(R, f"{ORIGIN}, levelled by {what} (turned by {tilt:.2f} deg)")


def level_results(results: list[ScanResult], level: Level) -> list[ScanResult]:
    """The results in the level world: poses, covariances and degenerate directions are rotated."""
    if not level.is_turned:
        return results
    T = se3.make(level.R, np.zeros(3))
    B = np.kron(np.eye(2), level.R)

    def turned(covariance: Floats | None) -> Floats | None:
        return None if covariance is None else np.asarray(B @ covariance @ B.T)

    return [
        replace(
            r,
            T_world_lidar=se3.normalise(T @ r.T_world_lidar),
            covariance=turned(r.covariance),
            registration_covariance=turned(r.registration_covariance),
            points_covariance=turned(r.points_covariance),
            degenerate=r.degenerate @ B.T,
        )
        for r in results
    ]


def _up_by_gravity(results: list[ScanResult]) -> tuple[Floats | None, float]:
    """Mean over the run weighted by sigmas: bias and tilt become observable only in bends.

    Its sigma, rad, is that of the best measurement, since their errors are correlated.
    """
    up = np.zeros(3)
    results = [r for r in results if not r.frame]
    for r in results:
        if r.imu.gravity is not None:
            up -= r.T_world_lidar[:3, :3] @ r.imu.gravity.direction / r.imu.gravity.sigma**2
    norm = float(np.linalg.norm(up))
    sigmas = [r.imu.gravity.sigma for r in results if r.imu.gravity is not None]
    return (up / norm, min(sigmas)) if norm > 0 else (None, 0.0)


def _up_by_ground(sequence: Sequence, results: list[ScanResult], config: Config) -> Floats | None:
    """The dominant plane below the first scan that was registered."""
    for number, result in enumerate(results):
        if result.status != "ok" or result.frame:
            continue
        with suppress(InputError), jit.announced(log), one_at_a_time(jit.lock_file(), "compiles kernels"):
            tolerance, up = config.preprocess.ground_tolerance, up_of(config.preprocess)
            R, height = levelling(sequence.scan(number).points, tolerance, CELLS, up)
            return np.asarray(result.T_world_lidar[:3, :3] @ R[2]) if np.isfinite(height) else None
    return None
