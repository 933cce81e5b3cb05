"""The vertical: the world of a run levelled, and up directions and floor planes for its pose graph.

Levelling turns all poses by one rotation, up becomes z, origin and heading stay the first scan's: relative motions, aligned
errors and the map's shape do not change.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence as Many
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from lslam.backend.graph.problem import FloorPlane, UpDirection
from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.config.backend import GraphConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.stopping import checking
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Keyframe
from lslam.registration.preprocessing.ground import GROUND_TOLERANCE_M, NEAR_Z, Z, levelling, up_of

log = logging.getLogger("lslam")

ORIGIN = "LiDAR at the first scan"
# The ground under the sensor and the floor of a keyframe: so many cells of half a metre to each side.
CELLS = 80
# Sigmas below which a tilt is insignificant: most sensors are mounted level, and a bias looks like a tilt before the first bends.
SIGNIFICANT = 2.0


@dataclass(frozen=True)
class Level:
    """Rotation R (3, 3) from a world to a level one; world : description for files; problem : source that failed."""

    R: Floats
    world: str
    problem: str = ""

    @property
    def is_turned(self) -> bool:
        """Whether the rotation is not the identity."""
        return not np.array_equal(self.R, np.eye(3))


def find_level(sequence: Sequence, results: list[ScanResult], config: Config) -> Level:
    """The level that `input.level` configures: by gravity from an IMU, by the ground under the first scan, or none.

    Its `problem` says why a configured level is unavailable. A tilt within the sigma of gravity is not corrected.
    """
    mode = config.input.level
    if mode == "auto":
        mode = "gravity" if config.imu.use else "none"
    if mode == "none":
        return Level(np.eye(3), f"{ORIGIN}, not levelled")
    sigma = 0.0
    if mode == "gravity":
        up, sigma = _up_by_gravity(results)
        what, why = "gravity", "no scan has a direction of gravity: it takes --imu, and an IMU that is not refused"
    else:
        up = _up_by_ground(sequence, results, config)
        what, why = "the ground under the first scan", "no ground plane is seen there"
    if up is None:
        problem = "" if config.input.level == "auto" else f"input.level = {mode}: {why}; the world is not levelled"
        return Level(np.eye(3), f"{ORIGIN}, not levelled", problem)
    R = so3.least_rotation(up, Z) if up[2] > NEAR_Z else so3.level_frame(up)
    tilt, sigma_deg = np.rad2deg(float(so3.angle(R))), np.rad2deg(sigma)
    if tilt < SIGNIFICANT * sigma_deg:
        return Level(
            np.eye(3),
            f"{ORIGIN}, not levelled: its tilt of {tilt:.2f} deg is none to {what}, known to {sigma_deg:.2f} deg",
        )
    log.info("the world is levelled by %s: turned by %.2f deg", what, tilt)
    return Level(R, f"{ORIGIN}, levelled by {what} (turned by {tilt:.2f} deg)")


def level_results(results: list[ScanResult], level: Level) -> list[ScanResult]:
    """The results in the level world: poses, covariances and degenerate directions are rotated."""
    if not level.is_turned:
        return results
    T = se3.make(level.R, np.zeros(3))
    return [r.in_world(T) for r in results]


def _up_by_gravity(results: list[ScanResult]) -> tuple[Floats | None, float]:
    """Up (3,) in the run's world and its sigma, rad: the mean over the run, weighted by sigmas; None without gravity.

    Bias and tilt become observable only in bends. The sigma is that of the best measurement, since errors are correlated.
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
    """Up (3,) in the run's world: the normal of the ground plane under the first registered scan; None without a plane."""
    for number, result in enumerate(results):
        if result.status != "ok" or result.frame:
            continue
        with suppress(InputError):
            R, height = levelling(sequence.scan(number).points, GROUND_TOLERANCE_M, CELLS, up_of(config.preprocess))
            return np.asarray(result.T_world_lidar[:3, :3] @ R[2]) if np.isfinite(height) else None
    return None


# s, correlation time of the errors of the IMU's up direction.
MEMORY_S = 20.0
ROUGHNESS = 0.15  # m, of the floor
# rad; a floor this much steeper than the world's horizon is a ramp or a roof (hdl_graph_slam takes 10 deg).
STEEPEST_RAD = np.deg2rad(10.0)
# m; a floor farther from the usual height below the sensor is a roof or a hole (height_clip_range there).
CLIP_M = 1.0
# Largest difference of two measurements of one flat floor, m and rad.
NOISE_M, NOISE_RAD = 0.05, np.deg2rad(0.5)
# Least share of inliers: on hills a half or fewer, on flat streets nearly all.
MOST = 0.8


def up_directions(keyframes: Many[Keyframe], results: Many[ScanResult], config: GraphConfig) -> list[UpDirection]:
    """Measured up directions, one per keyframe that has gravity; those within the correlation time share one measurement."""
    gravities = [(k, g) for k in keyframes if (g := results[k.scan].imu.gravity) is not None]
    stamps = np.array([k.stamp_ns for k, _ in gravities], np.int64)
    half = round(0.5e9 * MEMORY_S)
    alike = np.searchsorted(stamps, stamps + half, side="right") - np.searchsorted(stamps, stamps - half)
    least = np.deg2rad(config.gravity_deg)
    return [
        UpDirection(k.number, -g.direction, float(max(g.sigma, least)), 1 / float(count))
        for (k, g), count in zip(gravities, alike, strict=True)
    ]


def world_up(ups: Many[UpDirection], keyframes: Many[Keyframe]) -> Floats | None:
    """(3,) up in the world of odometry, by the first stretch with directions of gravity; None without any."""
    if not ups:
        return None
    begin = keyframes[ups[0].keyframe].stamp_ns
    first = [u for u in ups if keyframes[u.keyframe].stamp_ns <= begin + 1e9 * MEMORY_S]
    turned = np.stack([keyframes[u.keyframe].T_world_lidar[:3, :3] @ u.up for u in first])
    mean = (turned / np.array([[u.sigma**2 / u.share] for u in first])).sum(0)
    return np.asarray(mean / np.linalg.norm(mean))


def floor_planes(store: KeyframeStore, config: GraphConfig, up: Floats = Z, world_up: Floats = Z) -> list[FloorPlane]:
    """The floor plane under each keyframe, where it is level and its distance is close to the median.

    up : (3,) unit vector up in the LiDAR frame; world_up : (3,) that in the world of the keyframes
    """
    planes = []
    for keyframe in checking(store.keyframes):
        R, height = levelling(store.points(keyframe.number), ROUGHNESS, CELLS, up)
        normal = R[2]
        if not np.isfinite(height) or world_up @ keyframe.T_world_lidar[:3, :3] @ normal < np.cos(STEEPEST_RAD):
            continue
        planes.append(FloorPlane(keyframe.number, normal, -height, float(np.deg2rad(config.floor_deg)), config.floor_m))
    usual = float(np.median([p.offset for p in planes])) if planes else 0.0
    return [p for p in planes if abs(p.offset - usual) <= CLIP_M]


def on_one_plane(floors: Many[FloorPlane], poses: Floats, distances: Floats, config: GraphConfig) -> list[FloorPlane]:
    """The floors that agree with the one of largest support, up to odometry's drift; none where too few agree: no flat ground.

    poses : (K, 4, 4) of the keyframes by odometry, with the drift of `config`; distances : (K,) m travelled
    """
    if not floors:
        return []
    of = np.array([floor.keyframe for floor in floors])
    normals = np.einsum("fij,fj->fi", poses[of, :3, :3], np.stack([floor.normal for floor in floors]))
    feet = poses[of, :3, 3] - np.array([[floor.offset] for floor in floors]) * normals
    way = np.abs(distances[of, None] - distances[None, of])
    turn = np.deg2rad(config.drift_deg_per_100m) / 100 * way
    between = feet[None, :] - feet[:, None]
    rise = np.abs(np.einsum("fi,fgi->fg", normals, between))
    bend = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    slack = NOISE_M + 0.01 * config.drift_percent * way + turn * np.linalg.norm(between, axis=-1)
    agrees = (bend <= NOISE_RAD + turn) & (np.maximum(rise, rise.T) <= slack)
    inliers = agrees[agrees.sum(1).argmax()]
    if inliers.sum() < MOST * len(floors):
        return []
    return [floor for floor, is_right in zip(floors, inliers, strict=True) if is_right]
