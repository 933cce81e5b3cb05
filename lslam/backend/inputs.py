"""Inputs of the pose graph beside odometry, loop closures and fixes: up directions and floor planes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lslam.config.backend import GraphConfig
from lslam.graph.problem import FloorPlane, UpDirection
from lslam.keyframes.store import KeyframeStore
from lslam.preprocessing.ground import Z, levelling
from lslam.stopping import checking
from lslam.types.arrays import Floats
from lslam.types.scan_result import ScanResult
from lslam.types.trajectory import Keyframe

# s, correlation time of the errors of the IMU's up direction.
MEMORY_S = 20.0
# Extent of the floor, in cells of half a metre, and its roughness, m.
CELLS, ROUGHNESS = 80, 0.15
# rad; a floor this much steeper than the world's horizon is a ramp or a roof (hdl_graph_slam takes 10 deg).
STEEPEST = np.deg2rad(10.0)
# m; a floor farther from the usual height below the sensor is a roof or a hole (height_clip_range there).
CLIP_M = 1.0
# Largest difference of two measurements of one flat floor, m and rad.
NOISE_M, NOISE_RAD = 0.05, np.deg2rad(0.5)
# Least share of inliers: on hills a half or fewer, on flat streets nearly all.
MOST = 0.8


def up_directions(
    keyframes: Sequence[Keyframe], results: Sequence[ScanResult], config: GraphConfig
) -> list[UpDirection]:
    """One per keyframe with a direction of gravity; those within the correlation time count as one measurement."""
    known = [(k, g) for k in keyframes if (g := results[k.scan].imu.gravity) is not None]
    stamps = np.array([k.stamp_ns for k, _ in known], np.int64)
    half = round(0.5e9 * MEMORY_S)
    alike = np.searchsorted(stamps, stamps + half, side="right") - np.searchsorted(stamps, stamps - half)
    least = np.deg2rad(config.gravity_deg)
    return [
        UpDirection(k.number, -g.direction, float(max(g.sigma, least)), 1 / float(count))
        for (k, g), count in zip(known, alike, strict=True)
    ]


def world_up(ups: Sequence[UpDirection], keyframes: Sequence[Keyframe]) -> Floats | None:
    """(3,) up in the world of odometry, by the first stretch with directions of gravity; None without any."""
    if not ups:
        return None
    begin = keyframes[ups[0].keyframe].stamp_ns
    first = [u for u in ups if keyframes[u.keyframe].stamp_ns <= begin + 1e9 * MEMORY_S]
    turned = np.stack([keyframes[u.keyframe].T_world_lidar[:3, :3] @ u.up for u in first])
    mean = (turned / np.array([[u.sigma**2 / u.share] for u in first])).sum(0)
    return np.asarray(mean / np.linalg.norm(mean))


def floor_planes(store: KeyframeStore, config: GraphConfig, up: Floats = Z, world_up: Floats = Z) -> list[FloorPlane]:
    """The floor plane under each keyframe that is level and as far below as usual.

    up : (3,) unit vector up in the LiDAR frame; world_up : (3,) that in the world of the keyframes
    """
    planes = []
    for keyframe in checking(store.keyframes):
        R, height = levelling(store.points(keyframe.number), ROUGHNESS, CELLS, up)
        normal = R[2]
        if not np.isfinite(height) or world_up @ keyframe.T_world_lidar[:3, :3] @ normal < np.cos(STEEPEST):
            continue
        planes.append(FloorPlane(keyframe.number, normal, -height, float(np.deg2rad(config.floor_deg)), config.floor_m))
    usual = float(np.median([p.offset for p in planes])) if planes else 0.0
    return [p for p in planes if abs(p.offset - usual) <= CLIP_M]


def on_one_plane(
    floors: Sequence[FloorPlane], poses: Floats, distances: Floats, config: GraphConfig
) -> list[FloorPlane]:
    """The floors consistent with the one that has the most support; none where so few are that the ground is not flat.

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
