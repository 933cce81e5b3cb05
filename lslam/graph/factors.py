"""From plain values to factors of gtsam. Keyframe k has the key k, the floor the key K."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import noise
from lslam.graph.problem import FloorPlane, PoseGraph, PositionFix
from lslam.types.constraint import Constraint, Turn

Floats = NDArray[np.float64]

# The first pose, m and rad, when it is held, and when the fixes hold it; its tilt while up in its world is not known well.
HELD, FREE, TILTING = (1e-4, 1e-4), (1e3, 3.0), 0.2
# A gyroscope says nothing of positions, m.
ANYWHERE = 1e4
# No constraint is known better than this, m and rad: the optimiser's arithmetic.
SMALLEST = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5])


def well_conditioned(covariance: Floats) -> Floats:
    """Symmetric, positive definite (..., 6, 6): no direction is known better than `SMALLEST`."""
    scaled = covariance / np.outer(SMALLEST, SMALLEST)
    values, vectors = np.linalg.eigh(0.5 * (scaled + np.swapaxes(scaled, -1, -2)))
    kept = (vectors * np.maximum(values, 1.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(kept * np.outer(SMALLEST, SMALLEST))


def between(constraint: Constraint, scale: float = 1.0, kernel: Any = None) -> Any:
    """A relation between two keyframes; `scale` multiplies its covariance, `kernel` is an M-estimator of gtsam."""
    import gtsam

    covariance = scale * well_conditioned(constraint.covariance)
    model = gtsam.noiseModel.Gaussian.Covariance(noise.to_body(covariance, constraint.T_a_b))
    return gtsam.BetweenFactorPose3(
        constraint.a, constraint.b, gtsam.Pose3(constraint.T_a_b), _robust(model, kernel)
    )  # fmt: skip


def position(fix: PositionFix, scale: float = 1.0, kernel: Any = None) -> Any:
    """A measured position of the antenna."""
    import gtsam

    model = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(scale) * fix.sigma)
    return gtsam.GPSFactorArm(fix.keyframe, fix.position, fix.arm, _robust(model, kernel))


def fixed_part(graph: PoseGraph, may_tilt: bool = False) -> Any:
    """The factor graph of all that is never doubted; with `may_tilt` the first pose holds but its heading and place."""
    import gtsam

    factors = gtsam.NonlinearFactorGraph()
    sigma_m, sigma_rad = HELD if graph.is_anchored else FREE
    held = np.diag(np.repeat([sigma_m**2, sigma_rad**2], 3))
    if may_tilt:
        held[3:, 3:] += TILTING**2 * (np.eye(3) - np.outer(graph.world_up, graph.world_up))
    start = gtsam.noiseModel.Gaussian.Covariance(noise.to_body(held, graph.poses[0]))
    factors.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(graph.poses[0]), start))
    for constraint in graph.odometry:
        factors.add(between(constraint))
    for up in graph.ups:
        model = gtsam.noiseModel.Isotropic.Sigma(2, up.sigma)
        factors.add(gtsam.AttitudeFactorPose3(up.keyframe, gtsam.Unit3(graph.world_up), model, gtsam.Unit3(up.up)))
    for turn in graph.turns:
        factors.add(_turn(turn))
    for floor in graph.floors:
        factors.add(_floor(floor, len(graph)))
    return factors


def start_values(graph: PoseGraph, poses: Floats) -> Any:
    """Poses as the optimiser takes them, and where the floor is there."""
    import gtsam

    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(k, gtsam.Pose3(pose))
    if graph.floors:
        values.insert(len(poses), gtsam.OrientedPlane3(_floor_in_world(graph.floors, poses)))
    return values


def poses_of(values: Any, count: int) -> Floats:
    """(K, 4, 4) poses of a solution."""
    return np.stack([values.atPose3(k).matrix() for k in range(count)])


def _turn(turn: Turn) -> Any:
    import gtsam

    model = gtsam.noiseModel.Diagonal.Sigmas(np.array([turn.sigma] * 3 + [ANYWHERE] * 3))
    pose = gtsam.Pose3(gtsam.Rot3(turn.R_a_b), np.zeros(3))
    return gtsam.BetweenFactorPose3(turn.a, turn.b, pose, model)


def _floor(floor: FloorPlane, key: int) -> Any:
    import gtsam

    # gtsam's planes are n . p + d = 0 with errors of direction (2) first, then of distance.
    model = gtsam.noiseModel.Diagonal.Sigmas(np.array([floor.sigma_rad, floor.sigma_rad, floor.sigma_m]))
    return gtsam.OrientedPlane3Factor(np.append(floor.normal, floor.offset), model, floor.keyframe, key)


def _floor_in_world(floors: Any, poses: Floats) -> Floats:
    """(4,) the median plane of all that were seen."""
    normals = np.stack([poses[f.keyframe][:3, :3] @ f.normal for f in floors])
    normal = np.median(normals, axis=0)
    normal /= np.linalg.norm(normal)
    offsets = [f.offset - n @ poses[f.keyframe][:3, 3] for f, n in zip(floors, normals, strict=True)]
    return np.append(normal, np.median(offsets))


def _robust(model: Any, kernel: Any) -> Any:
    import gtsam

    return model if kernel is None else gtsam.noiseModel.Robust.Create(kernel, model)
