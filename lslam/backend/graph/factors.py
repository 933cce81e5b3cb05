"""From plain values to factors of gtsam.

Of K keyframes k has the key k, the floor the key K, the map the key K + 1; correlated noise of fixes has keys from `FIX_NOISE`.
The IMU enters by preintegrated factors between keyframes, with a velocity and biases at each (Shan et al. 2020): keyframe k has
its velocity at the key `SPEED_KEY` + k and its biases at `BIAS_KEY` + k.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from lslam.backend.graph.fix_noise import GaussMarkovNoise
from lslam.backend.graph.problem import FloorPlane, PlanarPrior, PoseGraph, PositionFix
from lslam.core.arrays import Floats
from lslam.core.geometry import noise, se2, se3, so3
from lslam.core.types.constraint import Constraint, Turn
from lslam.core.types.imu import GRAVITY, InertialChain, InertialStep, SmootherNoise

# Sigmas of the prior on the first pose, m and rad, when anchored and when the fixes anchor it, where its tilt has one of its
# own (`PoseGraph.tilt_sigma`); of its tilt before up is known.
HELD, FREE, TILTING = (1e-4, 1e-4), (1e3, 3.0), 0.2
# m, sigma of the positions that a gyroscope does not observe.
ANYWHERE = 1e4
# x, y and yaw among the six of a pose, translation first.
PLANAR = [0, 1, 5]
# Roll and pitch, likewise.
TILT = [3, 4]
# First key of the correlated noise of fixes, beyond all others.
FIX_NOISE = 1 << 40
# Correlation times after which an error is independent.
CORRELATION_TIMES = 20.0
# Least sigmas of a constraint, m and rad, for the optimiser's arithmetic.
SMALLEST = np.array([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5])


def regularise(covariance: Floats) -> Floats:
    """Symmetric, positive definite (..., 6, 6): no sigma is below `SMALLEST`."""
    scaled = covariance / np.outer(SMALLEST, SMALLEST)
    values, vectors = np.linalg.eigh(0.5 * (scaled + np.swapaxes(scaled, -1, -2)))
    lifted = (vectors * np.maximum(values, 1.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(lifted * np.outer(SMALLEST, SMALLEST))


def between(constraint: Constraint, scale: float = 1.0, kernel: Any = None) -> Any:
    """gtsam's factor of a measured pose between two keyframes.

    scale : factor on its covariance; kernel : M-estimator of gtsam, None: not robust
    """
    return between_makers([constraint])[0](scale, kernel)


def between_all(constraints: Sequence[Constraint]) -> list[Any]:
    """gtsam's factors of measured poses, as `between` for each constraint."""
    return [make(1.0, None) for make in between_makers(constraints)]


def between_makers(constraints: Sequence[Constraint]) -> list[Callable[[float, Any], Any]]:
    """For each constraint a function of scale and robust kernel that makes its factor; one linear algebra call serves all."""
    import gtsam

    if not constraints:
        return []
    poses = np.stack([c.T_a_b for c in constraints])
    bodies = noise.to_body(regularise(np.stack([c.covariance for c in constraints])), poses)

    def make(c: Constraint, pose: Any, body: Floats, scale: float, kernel: Any) -> Any:
        model = gtsam.noiseModel.Gaussian.Covariance(scale * body)
        return gtsam.BetweenFactorPose3(c.a, c.b, pose, _robust(model, kernel))

    return [partial(make, c, gtsam.Pose3(c.T_a_b), body) for c, body in zip(constraints, bodies, strict=True)]


def position(fix: PositionFix, scale: float = 1.0, kernel: Any = None) -> Any:
    """Factor of a measured antenna position: scale : on its covariance; kernel : of gtsam, None: not robust."""
    import gtsam

    model = _robust(gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(scale) * fix.sigma), kernel)
    if fix.share:
        return _between_keyframes(fix, model)
    if fix.instant is None:
        return gtsam.GPSFactorArm(fix.keyframe, fix.position, fix.arm, model)
    key, arm = FIX_NOISE + fix.instant, fix.arm
    across = so3.hat(arm)

    def error(_: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
        pose = values.atPose3(fix.keyframe)
        R = pose.rotation().matrix()
        if jacobians is not None:
            jacobians[0] = np.hstack([-R @ across, R])
            jacobians[1] = np.eye(3)
        return np.asarray(pose.translation() + R @ arm + values.atPoint3(key) - fix.position)

    return gtsam.CustomFactor(model, [fix.keyframe, key], error)


def _between_keyframes(fix: PositionFix, model: Any) -> Any:
    """Factor of an antenna position between two keyframes, interpolated linearly between theirs by `fix.share`."""
    import gtsam

    ends = ((fix.keyframe, fix.arm, 1.0 - fix.share), (fix.keyframe + 1, fix.next_arm, fix.share))

    def error(_: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
        off = -fix.position
        for i, (key, arm, weight) in enumerate(ends):
            pose = values.atPose3(key)
            R = pose.rotation().matrix()
            off = off + weight * (pose.translation() + R @ arm)
            if jacobians is not None:
                jacobians[i] = weight * np.hstack([-R @ so3.hat(arm), R])
        return np.asarray(off)

    return gtsam.CustomFactor(model, [key for key, _, _ in ends], error)


def planar(prior: PlanarPrior, pose: Floats, key: int, scale: float = 1.0, kernel: Any = None) -> Any:
    """A planar prior on a keyframe in the map `key`: height, roll, pitch and directions that walls do not observe stay free.

    pose : (4, 4) of the keyframe now, at whose height and tilt the error is linearised; scale : on the covariance
    """
    import gtsam

    T = _seen_from_above(prior.pose, pose)
    information = np.zeros((6, 6))
    information[np.ix_(PLANAR, PLANAR)] = prior.information * (prior.share / scale)
    values, axes = np.linalg.eigh(noise.to_body(information, T))
    # Rows of the square root, one per observed direction: an unobserved one has no information at all.
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * axes.T
    model = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
    return gtsam.BetweenFactorPose3(key, prior.keyframe, gtsam.Pose3(T), _robust(model, kernel))


def _seen_from_above(planar: Floats, pose: Floats) -> Floats:
    """(4, 4) at x, y and yaw of `planar` (3,), with the height and the tilt of `pose` (4, 4)."""
    turn = se2.to_se3(np.array([0.0, 0.0, planar[2] - se2.of_se3(pose)[2]]))[:3, :3]
    return se3.make(turn @ pose[:3, :3], np.array([*planar[:2], pose[2, 3]]))


def map_key(graph: PoseGraph) -> int:
    """Key of the variable for the map's frame in gtsam's values."""
    return len(graph) + 1


def fixed_part(graph: PoseGraph, may_tilt: bool = False, with_lidar: bool = True) -> Any:
    """All factors that are no outlier candidates, binding ones included.

    may_tilt : a wide prior on roll and pitch of the first pose
    with_lidar : include odometry and binding loop closures
    """
    import gtsam

    factors = gtsam.NonlinearFactorGraph()
    factors.add(_start(graph, may_tilt))
    for factor in _relative(graph, with_lidar):
        factors.add(factor)
    for fix in graph.fixes:
        if fix.is_binding:
            factors.add(position(fix))
    for up in graph.free_ups:
        model = gtsam.noiseModel.Isotropic.Sigma(2, up.sigma / np.sqrt(up.share))
        factors.add(gtsam.AttitudeFactorPose3(up.keyframe, gtsam.Unit3(graph.world_up), model, gtsam.Unit3(up.up)))
    for turn in graph.turns:
        factors.add(_turn(turn))
    for floor in graph.floors:
        factors.add(_floor(floor, len(graph)))
    if graph.fix_noise is not None:
        _add_fix_noise(factors, graph.fix_noise)
    if graph.map_priors:
        shift = gtsam.noiseModel.Diagonal.Sigmas(
            np.array([HELD[1]] * 3 + [max(graph.shift_sigma, HELD[0])] * 2 + [HELD[0]])
        )
        factors.add(gtsam.PriorFactorPose3(map_key(graph), gtsam.Pose3(), shift))
    return factors


def _relative(graph: PoseGraph, with_lidar: bool) -> list[Any]:
    """Factors between keyframes: odometry and binding loop closures if `with_lidar`, and the IMU."""
    by_lidar = [*graph.odometry, *(loop for loop in graph.loops if loop.is_binding)] if with_lidar else []
    imu = [] if graph.inertial is None else inertial_factors(graph.inertial, graph.world_up)
    return [*between_all(by_lidar), *imu]


def _start(graph: PoseGraph, may_tilt: bool) -> Any:
    """Prior on the first pose, tight if the graph is anchored, wide if fixes define its frame; may_tilt : wide in tilt."""
    import gtsam

    sigma_m, sigma_rad = HELD if graph.is_anchored else FREE
    prior = np.diag(np.repeat([sigma_m**2, sigma_rad**2], 3))
    if not graph.is_anchored:
        prior[TILT, TILT] = graph.tilt_sigma**2
    if graph.start_sigma is not None:
        prior[PLANAR, PLANAR] = graph.start_sigma**2
    if may_tilt:
        prior[3:, 3:] += TILTING**2 * (np.eye(3) - np.outer(graph.world_up, graph.world_up))
    first = graph.poses[0] if graph.start is None else _seen_from_above(graph.start, graph.poses[0])
    start = gtsam.noiseModel.Gaussian.Covariance(noise.to_body(prior, first))
    return gtsam.PriorFactorPose3(0, gtsam.Pose3(first), start)


def start_values(graph: PoseGraph, poses: Floats) -> Any:
    """Initial values of all variables of the graph, for `poses` (K, 4, 4) of the keyframes."""
    import gtsam

    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(k, gtsam.Pose3(pose))
    if graph.floors:
        values.insert(len(poses), gtsam.OrientedPlane3(_floor_in_world(graph.floors, poses)))
    if graph.map_priors:
        values.insert(map_key(graph), gtsam.Pose3())
    if graph.inertial is not None:
        insert_inertial(values, graph.inertial, poses)
    if graph.fix_noise is not None:
        for i in range(len(graph.fix_noise.seconds)):
            values.insert(FIX_NOISE + i, np.zeros(3))
    return values


def poses_of(values: Any, count: int) -> Floats:
    """(K, 4, 4) poses of a solution."""
    return np.stack([values.atPose3(k).matrix() for k in range(count)])


def _turn(turn: Turn) -> Any:
    """gtsam's factor of a measured rotation between two keyframes; the translation stays free."""
    import gtsam

    model = gtsam.noiseModel.Diagonal.Sigmas(np.array([turn.sigma] * 3 + [ANYWHERE] * 3))
    pose = gtsam.Pose3(gtsam.Rot3(turn.R_a_b), np.zeros(3))
    return gtsam.BetweenFactorPose3(turn.a, turn.b, pose, model)


def _floor(floor: FloorPlane, key: int) -> Any:
    """gtsam's factor of the floor seen from a keyframe; key : of the floor plane, common to all."""
    import gtsam

    # gtsam's planes are n . p + d = 0 with errors of direction (2) first, then of distance.
    model = gtsam.noiseModel.Diagonal.Sigmas(np.array([floor.sigma_rad, floor.sigma_rad, floor.sigma_m]))
    return gtsam.OrientedPlane3Factor(np.append(floor.normal, floor.offset), model, floor.keyframe, key)


def _add_fix_noise(factors: Any, fix_noise: GaussMarkovNoise) -> None:
    """Add the factors of a stationary first-order Gauss-Markov process.

    (b - p a)^2 = p (b - a)^2 + (1 - p) b^2 - p (1 - p) a^2: between factors of instants a and b, and a prior on each.
    """
    import gtsam

    steps = np.minimum(np.diff(fix_noise.seconds) / fix_noise.memory, CORRELATION_TIMES)
    memory, driven = np.exp(-steps), -np.expm1(-2 * steps)
    own = np.append(1.0, 1 / (1 + memory))
    own[:-1] -= memory / (1 + memory)
    for i, weight in enumerate(own.tolist()):
        model = gtsam.noiseModel.Diagonal.Sigmas(fix_noise.sigma / np.sqrt(weight))
        factors.add(gtsam.PriorFactorPoint3(FIX_NOISE + i, np.zeros(3), model))
    for i, ratio in enumerate((driven / memory).tolist()):
        model = gtsam.noiseModel.Diagonal.Sigmas(fix_noise.sigma * np.sqrt(ratio))
        factors.add(gtsam.BetweenFactorPoint3(FIX_NOISE + i, FIX_NOISE + i + 1, np.zeros(3), model))


def _floor_in_world(floors: Any, poses: Floats) -> Floats:
    """(4,) median of the floor planes in the world: normal and offset."""
    normals = np.stack([poses[f.keyframe][:3, :3] @ f.normal for f in floors])
    normal = np.median(normals, axis=0)
    normal /= np.linalg.norm(normal)
    offsets = [f.offset - n @ poses[f.keyframe][:3, 3] for f, n in zip(floors, normals, strict=True)]
    return np.append(normal, np.median(offsets))


def _robust(model: Any, kernel: Any) -> Any:
    """The noise model with a robust kernel; itself without one."""
    import gtsam

    return model if kernel is None else gtsam.noiseModel.Robust.Create(kernel, model)


# m2 per s, of the integration itself: none but rounding.
INTEGRATION = 1e-10


def preintegrate(
    step: InertialStep, accel_bias: Floats, gyro_bias: Floats, gravity: Floats, imu_noise: SmootherNoise
) -> Any:
    """gtsam's `PreintegratedCombinedMeasurements` of the readings, linear in the biases (3,) about the given ones.

    gravity : (3,) m/s2, world
    """
    import gtsam

    one = np.eye(3)
    params = gtsam.PreintegrationCombinedParams(gravity)
    params.setAccelerometerCovariance((imu_noise.force**2 + step.clipping) * one)
    params.setGyroscopeCovariance(step.rate_noise)
    params.setIntegrationCovariance(INTEGRATION * one)
    params.setBiasAccCovariance(imu_noise.accel_walk**2 * one)
    params.setBiasOmegaCovariance(imu_noise.gyro_walk**2 * one)
    measured = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(accel_bias, gyro_bias))
    for accel, rate, seconds in zip(step.accel, step.rates, step.seconds.tolist(), strict=True):
        measured.integrateMeasurement(accel, rate, seconds)
    return measured


SPEED_KEY, BIAS_KEY = 1 << 41, 1 << 42
# m/s2 and rad/s, one sigma about the biases at the run's end, where a chain begins: a consumer device's wander in hours.
FORCE_BIAS, RATE_BIAS = 0.1, 0.003


def keyframe_of(key: int) -> int:
    """Number of the keyframe that a key belongs to: of its pose, velocity or biases. Other keys are returned unchanged."""
    return key - next((first for first in (BIAS_KEY, SPEED_KEY) if key >= first), 0)


def inertial_factors(chain: InertialChain, world_up: Floats) -> list[Any]:
    """The factors of all links; world_up : (3,) unit, in the world of the graph."""
    import gtsam

    factors: list[Any] = []
    gravity = -GRAVITY * world_up
    bias = gtsam.imuBias.ConstantBias(chain.accel_bias, chain.gyro_bias)
    about = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([FORCE_BIAS, RATE_BIAS], 3))
    before = -1
    for link in chain.links:
        if link.a != before:
            factors.append(gtsam.PriorFactorConstantBias(BIAS_KEY + link.a, bias, about))
        before = link.b
        measured = preintegrate(link.step, chain.accel_bias, chain.gyro_bias, gravity, chain.noise)
        a, b = link.a, link.b
        names = (a, SPEED_KEY + a, b, SPEED_KEY + b, BIAS_KEY + a, BIAS_KEY + b)
        factors.append(gtsam.CombinedImuFactor(*names, measured))
    return factors


def insert_inertial(values: Any, chain: InertialChain, poses: Floats) -> None:
    """Insert initial velocities (mean between keyframes, m/s) and biases (those of the run's end) of the chain into `values`."""
    import gtsam

    bias = gtsam.imuBias.ConstantBias(chain.accel_bias, chain.gyro_bias)
    for link in chain.links:
        speed = (poses[link.b, :3, 3] - poses[link.a, :3, 3]) / float(link.step.seconds.sum())
        for k in (link.a, link.b):
            if not values.exists(SPEED_KEY + k):
                values.insert(SPEED_KEY + k, speed)
                values.insert(BIAS_KEY + k, bias)
