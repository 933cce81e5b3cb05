"""What the pose graph is given of the IMU: readings in the place and axes of the LiDAR."""

from __future__ import annotations

import numpy as np
from imu_drives import GYRO_BIAS, drone, extrinsics_of, stream_of, truth_of
from numpy.typing import NDArray

from lslam.backend.graph.inertial_smoother import InertialSmoother
from lslam.core.config import Config
from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.core.types.scan import Span
from lslam.odometry.inertial.gyroscope import USUAL_NOISE, Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.initialise import FirstPoses, InertialStart, start
from lslam.odometry.inertial.smoothing import SmootherMotion, smoother_noise
from lslam.registration.result import RegistrationResult

IMU_NOISE = smoother_noise(USUAL_NOISE)
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
    motion = SmootherMotion(InertialStart(imu, T_lidar_imu, estimate), Config())
    motion.smoother = InertialSmoother(IMU_NOISE, 10)
    return motion


def test_readings_are_transformed_to_the_lidar() -> None:
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


SURE = np.diag([0.005**2] * 3 + [1e-3**2] * 3)


def stamps() -> NDArray[np.int64]:
    return truth_of(drone())[0]


def poses() -> NDArray[np.float64]:
    return truth_of(drone())[1]


def flying(count: int) -> SmootherMotion:
    """An IMU in flight after so many scans, registered where they were."""
    first = FirstPoses(stamps()[:50], poses()[:50], stamps()[:50], poses()[:50], np.repeat(SURE[None], 50, axis=0))
    begun = start(stream_of(drone()), extrinsics_of(drone()), first, int(stamps()[-1]), ImuConfig())
    motion = SmootherMotion(begun, Config())
    for k in range(count):
        weighed(motion, k)
    return motion


def weighed(motion: SmootherMotion, k: int) -> RegistrationResult:
    """Scan k, registered where it was."""
    stamp = int(stamps()[k])
    prior = motion.sweep(stamp, Span())
    result = motion.fuse(stamp, RegistrationResult(poses()[k], covariance=SURE), prior)
    motion.correct(stamp, result.T_world_lidar, prior, result.is_accepted)
    return result


def test_the_bias_of_the_gyroscope_and_its_sigma_are_both_the_smoothers() -> None:
    """Its other states too, and a graph that begins anew begins with them; readings less its bias are in the axes."""
    motion = flying(30)
    assert isinstance(motion.smoother, InertialSmoother)
    newest, gyroscope = motion.smoother.newest, motion.estimate.gyroscope
    assert newest is not None
    begun = motion._beginning()
    np.testing.assert_allclose(begun.covariance[6:, 6:][3:6, 3:6], newest.covariance[9:12, 9:12])
    np.testing.assert_allclose(begun.covariance[12:15, 12:15], newest.covariance[12:15, 12:15], rtol=2e-2)
    np.testing.assert_allclose(begun.gyro_bias, newest.gyro_bias, rtol=0.05, atol=1e-6)
    summary = motion.estimate.summary
    np.testing.assert_allclose(summary.sigmas[3:6], np.sqrt(np.diag(newest.covariance)[12:15]), rtol=0.05)
    assert np.linalg.eigvalsh(gyroscope.covariance)[0] > 0
    # Of the data sheet, as it stays over three seconds.
    assert (np.abs(summary.values[3:6] - GYRO_BIAS) < 4 * summary.sigmas[3:6]).all()


def unsolvable(motion: SmootherMotion) -> None:
    """Until its graph begins anew."""

    class Unsolvable:
        def update(self, *_: object) -> None:
            raise RuntimeError("Indeterminant linear system detected\nand more")

    assert isinstance(motion.smoother, InertialSmoother)
    motion.smoother._solver = Unsolvable()


def is_followed(motion: SmootherMotion, k: int) -> bool:
    """Whether scans from k on are weighed by a graph again, and are where they were."""
    results = [weighed(motion, k + i) for i in range(3)]
    # The first begins the graph, at the pose of the scan before or its own.
    states = [motion.smoother.state()["steps"].rows, results[-1].T_world_lidar[:3, 3] - poses()[k + 2][:3, 3]]
    return all(r.is_accepted for r in results) and len(states[0]) == 3 and float(np.linalg.norm(states[1])) < 0.02


def test_a_scan_without_a_graph_solution_is_bridged_with_the_covariance_of_the_imu() -> None:
    motion = flying(10)
    unsolvable(motion)
    predicted = motion.sweep(int(stamps()[10]), Span()).pose
    result = weighed(motion, 10)
    assert (result.ok, result.is_rejected, result.converged) == (True, True, False)
    assert result.reason == "the smoother of poses and IMU cannot be solved: Indeterminant linear system detected"
    np.testing.assert_array_equal(result.T_world_lidar, predicted)
    C = result.covariance
    assert C is not None
    off = se3.relative(poses()[9], poses()[10])[:3, 3] - se3.relative(poses()[9], predicted)[:3, 3]
    assert np.linalg.norm(off) < 4 * np.sqrt(np.linalg.eigvalsh(C[:3, :3])[-1])
    twice = flying(10)
    unsolvable(twice)
    stamp = int(stamps()[10])
    surer = RegistrationResult(poses()[10], covariance=1e-4 * SURE)
    np.testing.assert_array_equal(twice.fuse(stamp, surer, twice.sweep(stamp, Span())).covariance, C)
    assert is_followed(motion, 11)


def test_the_graph_restarts_after_a_scan_that_it_cannot_solve() -> None:
    motion = flying(10)
    unsolvable(motion)
    stamp = int(stamps()[10])
    prior = motion.sweep(stamp, Span())
    motion.correct(stamp, prior.pose, prior, has_registration=False)
    newest = motion.smoother.state()["begun"]
    assert newest is not None
    np.testing.assert_allclose(newest.T_world_imu, prior.pose @ extrinsics_of(drone()), atol=1e-9)
    np.testing.assert_array_equal(newest.velocity, motion.estimate.velocity)
    assert is_followed(motion, 11)


def test_a_gap_gives_no_link_and_gaps_alone_give_no_chain() -> None:
    motion = swinging()
    chain = motion.chain([(0, 100_000_000), (1, 900_000_000), (2, 3_000_000_000)], IMU_NOISE)
    assert chain is not None
    assert chain.links[-1].b == 1
    assert motion.chain([(0, 100_000_000), (1, 3_000_000_000)], IMU_NOISE) is None
