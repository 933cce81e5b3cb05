"""Readings of an IMU between two instants as one measurement of gtsam."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.types.imu import InertialStep, SmootherNoise

Floats = NDArray[np.float64]

# m2 per s, of the integration itself: none but rounding.
INTEGRATION = 1e-10


def preintegrated(
    step: InertialStep, accel_bias: Floats, gyro_bias: Floats, gravity: Floats, imu_noise: SmootherNoise
) -> Any:
    """`PreintegratedCombinedMeasurements` of the readings, linear in the biases (3,) about these; gravity (3,) in the world."""
    import gtsam

    one = np.eye(3)
    params = gtsam.PreintegrationCombinedParams(gravity)
    params.setAccelerometerCovariance((imu_noise.force**2 + step.hidden) * one)
    params.setGyroscopeCovariance(step.rate_noise)
    params.setIntegrationCovariance(INTEGRATION * one)
    params.setBiasAccCovariance(imu_noise.accel_walk**2 * one)
    params.setBiasOmegaCovariance(imu_noise.gyro_walk**2 * one)
    felt = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(accel_bias, gyro_bias))
    for accel, rate, seconds in zip(step.accel, step.rates, step.seconds.tolist(), strict=True):
        felt.integrateMeasurement(accel, rate, seconds)
    return felt
