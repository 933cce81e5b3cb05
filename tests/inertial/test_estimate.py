"""The filter's model of how errors travel, against finite differences of the integration itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lslam.geometry import so3
from lslam.inertial.estimate import ImuEstimate, _propagate
from lslam.inertial.gyroscope import Gyroscope
from lslam.types.imu import ImuStream


@pytest.mark.parametrize("direction", range(9))
def test_errors_travel_as_the_covariance_says(direction: int) -> None:
    """Velocity, gravity, accelerometer bias: displacement and velocity after a turn of 0.3 s change by the same column."""
    stamps = np.arange(0, 300_000_001, 10_000_000)
    rng = np.random.default_rng(5)
    imu = ImuStream(stamps, rng.normal(0, 4, (31, 3)), rng.normal(1.0, 0.3, (31, 3)))
    R = so3.exp(np.array([0.3, -0.5, 1.1]))
    nothing = np.zeros((9, 9))
    state = ImuEstimate(
        np.array([3.0, -1, 0.2]), np.array([0.1, 0.2, -9.8]), np.zeros(3), Gyroscope(np.zeros(3)), nothing
    )
    error = np.zeros(9)
    error[direction] = 0.1
    wrong = dataclasses.replace(
        state, velocity=state.velocity + error[:3], gravity=state.gravity + error[3:6], accel_bias=error[6:]
    )
    doubtful = dataclasses.replace(state, covariance=np.outer(error, error))
    ends = stamps[[0, -1]]
    x, P = _propagate(state, state.over(imu, ends), R)
    x_wrong, _ = _propagate(wrong, wrong.over(imu, ends), R)
    _, P_doubtful = _propagate(doubtful, doubtful.over(imu, ends), R)
    moved = x_wrong - x
    assert np.linalg.norm(moved) > 0.05
    np.testing.assert_allclose(P_doubtful - P, np.outer(moved, moved), atol=1e-9)
