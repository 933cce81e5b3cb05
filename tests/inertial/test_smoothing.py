"""What the pose graph is given of the IMU: readings in the place and axes of the LiDAR."""

from __future__ import annotations

import numpy as np

from lslam.config.imu import ImuConfig
from lslam.frontend.motion_models import smoother_noise
from lslam.geometry import se3, so3
from lslam.graph.inertial_smoother import InertialSmoother
from lslam.inertial.gyroscope import Gyroscope
from lslam.inertial.imu_estimate import GRAVITY, ImuEstimate
from lslam.inertial.imu_noise import USUAL
from lslam.inertial.smoothing import SmootherMotion
from lslam.types.imu import ImuStream

IMU_NOISE = smoother_noise(USUAL)
LEVER = np.array([0.4, -0.3, 0.2])
FORCE_BIAS, RATE_BIAS = np.array([0.1, 0.2, -0.3]), np.array([0.02, -0.01, 0.03])


def swinging() -> SmootherMotion:
    """A LiDAR that turns about itself and stays where it is, with an IMU aside, askew and biased."""
    t = np.arange(0, 2, 0.005)
    rate = np.stack([0 * t, 0 * t, 1.5 * np.cos(3 * t)], 1)
    turning = np.stack([0 * t, 0 * t, -4.5 * np.sin(3 * t)], 1)
    felt = np.array([0, 0, GRAVITY]) + np.cross(turning, LEVER) + np.cross(rate, np.cross(rate, LEVER))
    T_lidar_imu = se3.make(so3.exp(np.array([0.3, -0.5, 1.2])), LEVER)
    R = T_lidar_imu[:3, :3]
    imu = ImuStream(np.round(1e9 * t).astype(np.int64), felt @ R + FORCE_BIAS, rate @ R + RATE_BIAS)
    gyroscope = Gyroscope.of_bias(RATE_BIAS, 1e-4)
    estimate = ImuEstimate(np.zeros(3), np.array([0, 0, -GRAVITY]), FORCE_BIAS, gyroscope, 1e-4 * np.eye(9))
    return SmootherMotion(imu, T_lidar_imu, estimate, ImuConfig(), InertialSmoother(IMU_NOISE, 10))


def test_readings_are_carried_to_the_lidar() -> None:
    motion = swinging()
    chain = motion.chain([(0, 100_000_000), (1, 900_000_000), (2, 1_700_000_000)], IMU_NOISE)
    assert chain is not None
    assert [(link.a, link.b) for link in chain.links] == [(0, 1), (1, 2)]
    for link in chain.links:
        assert abs(link.step.seconds.sum() - 0.8) < 1e-9
        forces = link.step.accel - chain.accel_bias
        # The IMU itself feels up to 2.3 m/s2 more.
        np.testing.assert_allclose(forces, np.tile([0, 0, GRAVITY], (len(forces), 1)), atol=0.05)
        rates = link.step.rates - chain.gyro_bias
        np.testing.assert_allclose(rates[:, :2], 0, atol=1e-3)
        assert np.ptp(rates[:, 2]) > 1


def test_silence_is_no_link_and_nothing_else_no_chain() -> None:
    motion = swinging()
    chain = motion.chain([(0, 100_000_000), (1, 900_000_000), (2, 3_000_000_000)], IMU_NOISE)
    assert chain is not None
    assert chain.links[-1].b == 1
    assert motion.chain([(0, 100_000_000), (1, 3_000_000_000)], IMU_NOISE) is None
