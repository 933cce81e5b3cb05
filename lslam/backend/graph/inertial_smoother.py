"""Registered poses and preintegrated IMU measurements in one factor graph, smoothed by iSAM2 (LIO-SAM, Shan et al. 2020).

State k has the keys 4 k to 4 k + 3: pose, velocity and biases; gravity has the key `GRAVITY_KEY`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lslam.backend.graph.factors import preintegrate, regularise
from lslam.core.arrays import Floats
from lslam.core.errors import GraphError
from lslam.core.geometry import noise, se3
from lslam.core.types.imu import InertialState, InertialStep, SmootherNoise
from lslam.core.types.state import State, Stateful
from lslam.io.formats.state_files import Records

GRAVITY_KEY = 1 << 40
# Pose, velocity, biases and gravity among the 18 of a state.
POSE, SPEED, BIASES, DOWN = slice(0, 6), slice(6, 9), slice(9, 15), slice(15, 18)


class InertialSmoother(Stateful):
    """The newest state after each step, from all steps since the graph began; it begins anew after `reset` of them.

    A new graph begins with the joint marginal of the newest state as its prior, as in the paper's implementation, which takes
    that of each variable by itself.
    """

    def __init__(self, imu_noise: SmootherNoise, reset: int) -> None:
        self._noise, self._reset = imu_noise, reset
        self._begun: InertialState | None = None
        self._steps: list[InertialStep] = []
        self._solver: Any = None
        self.newest: InertialState | None = None

    def begin(self, state: InertialState) -> None:
        """Discard all steps and begin a new graph with `state` as the prior of its first state."""
        import gtsam

        self._begun, self._steps, self.newest = state, [], state
        params = gtsam.ISAM2Params()
        # As in the paper's implementation.
        params.setRelinearizeThreshold(0.1)
        params.relinearizeSkip = 1
        params.setFactorization("QR")
        self._solver = gtsam.ISAM2(params)
        factors, values = gtsam.NonlinearFactorGraph(), _values(0, state)
        values.insert(GRAVITY_KEY, state.gravity)
        factors.add(_prior(state))
        self._solver.update(factors, values)

    def add(self, step: InertialStep) -> InertialState:
        """The state at the end of `step`. Raises GraphError when the graph cannot be solved."""
        if len(self._steps) >= self._reset:
            assert self.newest is not None
            self.begin(self._next_prior(self.newest))
        return self._take(step)

    def withdraw(self) -> None:
        """Undo the newest step, the others replayed."""
        assert self._begun is not None
        steps = self._steps[:-1]
        self.begin(self._begun)
        for step in steps:
            self._take(step)

    def state(self) -> State:
        """The steps of the graph so far, for a checkpoint."""
        return {"begun": self._begun, "steps": Records(list(self._steps))}

    def restore(self, state: State) -> None:
        """Continue from a saved `state`: the same steps in the same order give the same bytes."""
        self._solver = self._begun = self.newest = None
        self._steps = []
        if state["begun"] is not None:
            self.begin(state["begun"])
            for step in state["steps"].rows if isinstance(state["steps"], Records) else state["steps"]:
                self._take(step)

    def _take(self, step: InertialStep) -> InertialState:
        """Add one step to the graph and return the newest state; raises GraphError when iSAM2 fails."""
        import gtsam

        before = self.newest
        assert before is not None
        k = len(self._steps)
        increments = preintegrate(step, before.accel_bias, before.gyro_bias, before.gravity, self._noise)
        names = (4 * k, 4 * k + 1, 4 * k + 4, 4 * k + 5, 4 * k + 2, 4 * k + 6)
        factors = gtsam.NonlinearFactorGraph()
        factors.add(gtsam.CombinedImuFactorWithGravityVector(*names, GRAVITY_KEY, increments))
        T, velocity = _predict(before, increments)
        if step.T_world_imu is not None and step.covariance is not None:
            body = noise.to_body(regularise(step.covariance), step.T_world_imu)
            model = gtsam.noiseModel.Gaussian.Covariance(body)
            factors.add(gtsam.PriorFactorPose3(4 * k + 4, gtsam.Pose3(step.T_world_imu), model))
        values = gtsam.Values()
        values.insert(4 * k + 4, gtsam.Pose3(T))
        values.insert(4 * k + 5, velocity)
        values.insert(4 * k + 6, gtsam.imuBias.ConstantBias(before.accel_bias, before.gyro_bias))
        self._steps.append(step)
        try:
            self._solver.update(factors, values)
            self.newest = self._estimate(k + 1)
        except RuntimeError as failure:
            message = str(failure).strip() or "nothing is said why"
            raise GraphError(f"the smoother of poses and IMU cannot be solved: {message.splitlines()[0]}") from None
        return self.newest

    def _estimate(self, k: int) -> InertialState:
        """State number `k` of the solver with its joint covariance, in the axes of `InertialState`."""
        solver, pose, speed, bias = self._solver, 4 * k, 4 * k + 1, 4 * k + 2
        T = se3.normalise(solver.calculateEstimatePose3(pose).matrix())
        biases = solver.calculateEstimateConstantBias(bias)
        joint = solver.jointMarginalCovariance([pose, speed, bias, GRAVITY_KEY]).fullMatrix()
        J = _into_house(T)
        covariance = J @ joint @ J.T
        return InertialState(
            T,
            solver.calculateEstimatePoint3(speed),
            biases.accelerometer(),
            biases.gyroscope(),
            solver.calculateEstimatePoint3(GRAVITY_KEY),
            0.5 * (covariance + covariance.T),
        )

    def _next_prior(self, state: InertialState) -> InertialState:
        """The newest state as prior of the next graph, with the random walk of gravity's direction over this graph added.

        Gravity turns in the map's world as that drifts.
        """
        seconds = sum(float(step.seconds.sum()) for step in self._steps)
        covariance = state.covariance.copy()
        along = state.gravity / np.linalg.norm(state.gravity)
        covariance[DOWN, DOWN] += self._noise.gravity_walk**2 * seconds * (np.eye(3) - np.outer(along, along))
        return replace(state, covariance=covariance)


def _values(k: int, state: InertialState) -> Any:
    """gtsam values of state number `k`: pose, velocity and biases."""
    import gtsam

    values = gtsam.Values()
    values.insert(4 * k, gtsam.Pose3(state.T_world_imu))
    values.insert(4 * k + 1, state.velocity)
    values.insert(4 * k + 2, gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias))
    return values


def _predict(before: InertialState, increments: Any) -> tuple[Floats, Floats]:
    """Pose (4, 4) and velocity (3,) at the end of what was `increments`, by the mean of the state before."""
    import gtsam

    start = gtsam.NavState(gtsam.Pose3(before.T_world_imu), before.velocity)
    state = increments.predict(start, gtsam.imuBias.ConstantBias(before.accel_bias, before.gyro_bias))
    return se3.normalise(state.pose().matrix()), state.velocity()


def _prior(state: InertialState) -> Any:
    """Joint prior on the first state, whose parts are correlated: gravity with the accelerometer's bias above all."""
    import gtsam

    J = _into_house(state.T_world_imu).T
    model = gtsam.noiseModel.Gaussian.Covariance(J @ state.covariance @ J.T)
    origin = gtsam.Pose3(state.T_world_imu)
    bias = gtsam.imuBias.ConstantBias(state.accel_bias, state.gyro_bias)

    def error(_: Any, values: Any, jacobians: list[Floats] | None) -> Floats:
        if jacobians is not None:
            for i, part in enumerate((POSE, SPEED, BIASES, DOWN)):
                jacobians[i] = np.eye(18)[:, part]
        return np.concatenate(
            [
                origin.localCoordinates(values.atPose3(0)),
                values.atPoint3(1) - state.velocity,
                bias.localCoordinates(values.atConstantBias(2)),
                values.atPoint3(GRAVITY_KEY) - state.gravity,
            ]
        )

    return gtsam.CustomFactor(model, [0, 1, 2, GRAVITY_KEY], error)


def _into_house(T: Floats) -> Floats:
    """(18, 18) from gtsam's order and axes of a state at the pose `T` (4, 4) into those of `InertialState`; orthogonal."""
    J = np.eye(18)
    J[POSE, POSE] = noise.into_body(T).T
    return J
