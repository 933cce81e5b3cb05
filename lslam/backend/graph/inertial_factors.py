"""A pose graph's IMU: preintegrated factors between keyframes, with a velocity and biases at each (Shan et al. 2020).

Keyframe k has its velocity at the key `SPEED_KEY` + k and its biases at `BIAS_KEY` + k.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lslam.core.types.arrays import Floats
from lslam.core.types.imu import GRAVITY, InertialChain, InertialStep, SmootherNoise

# m2 per s, of the integration itself: none but rounding.
INTEGRATION = 1e-10


def preintegrated(
    step: InertialStep, accel_bias: Floats, gyro_bias: Floats, gravity: Floats, imu_noise: SmootherNoise
) -> Any:
    """`PreintegratedCombinedMeasurements` of the readings, linear in the biases (3,) about these; gravity (3,) in the world."""
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
    """The keyframe whose pose, velocity or biases have this key; any other key as it is."""
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
        measured = preintegrated(link.step, chain.accel_bias, chain.gyro_bias, gravity, chain.noise)
        a, b = link.a, link.b
        names = (a, SPEED_KEY + a, b, SPEED_KEY + b, BIAS_KEY + a, BIAS_KEY + b)
        factors.append(gtsam.CombinedImuFactor(*names, measured))
    return factors


def insert_inertial(values: Any, chain: InertialChain, poses: Floats) -> None:
    """Start values: the velocity over the way to the next keyframe, and the biases of the run's end."""
    import gtsam

    bias = gtsam.imuBias.ConstantBias(chain.accel_bias, chain.gyro_bias)
    for link in chain.links:
        speed = (poses[link.b, :3, 3] - poses[link.a, :3, 3]) / float(link.step.seconds.sum())
        for k in (link.a, link.b):
            if not values.exists(SPEED_KEY + k):
                values.insert(SPEED_KEY + k, speed)
                values.insert(BIAS_KEY + k, bias)
