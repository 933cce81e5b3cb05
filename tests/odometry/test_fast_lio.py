"""FAST-LIO: features and the filter's prior are one estimate, as two measurements are, and a walk is followed by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import Stub, sample
from test_feature_target import scan_of_room

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.motion_prior import MotionPrior
from lslam.odometry import create_odometry
from lslam.odometry.fast_lio import FastLio
from lslam.registration.result import RegistrationResult
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

pytestmark = pytest.mark.usefixtures("shared_first_poses")
Floats = NDArray[np.float64]
QUIET = ("map.write=false", "report.html=false", "loops.use=false", "odometry.integrity=false", "imu.start_s=1")
TRUE = se3.make(so3.exp(np.array([0.0, 0.0, 0.02])), np.array([0.3, 0.1, 0.0]))


def config_of(method: str, *settings: str) -> Config:
    return load_config(None, [f"odometry.method={method}", *QUIET, *settings], {})


def on_map(prior: Floats, covariance: Floats | None) -> RegistrationResult:
    """The scan seen from `TRUE`, registered on a map of three others with a prior of this pose and covariance."""
    method = create_odometry(config_of("fast-lio"))
    assert isinstance(method, FastLio)
    for seed in range(3):
        scan, at = scan_of_room(np.eye(4), seed), MotionPrior.at_once(np.eye(4))
        method.update(scan, at, method.register(scan, method.prepare(scan), at))
    scan = scan_of_room(TRUE, 9)
    return method.register(scan, method.prepare(scan), replace(MotionPrior.at_once(prior), covariance=covariance))


def test_features_and_prior_are_one_estimate_as_two_measurements_of_a_pose_are() -> None:
    alone = on_map(TRUE, None)
    assert alone.ok
    assert alone.covariance is not None
    prior = se3.make(alone.T_world_lidar[:3, :3], alone.T_world_lidar[:3, 3] + [0.004, 0.0, 0.0])
    together = on_map(prior, alone.covariance)
    assert together.covariance is not None
    # As sure of it as the features are: half the covariance, and half of the way to it.
    np.testing.assert_allclose(together.covariance, alone.covariance / 2, rtol=0.1, atol=2e-9)
    moved = together.T_world_lidar[:3, 3] - alone.T_world_lidar[:3, 3]
    np.testing.assert_allclose(moved, [0.002, 0.0, 0.0], atol=4e-4)
    # Much surer of it, or not at all.
    held = on_map(prior, 1e-6 * alone.covariance)
    np.testing.assert_allclose(held.T_world_lidar, prior, atol=1e-6)
    free = on_map(prior, 1e6 * alone.covariance)
    np.testing.assert_allclose(free.T_world_lidar, alone.T_world_lidar, atol=1e-4)


def test_a_walk_is_followed_as_closely_as_by_the_same_features_on_a_loose_imu() -> None:
    drive = simulate(
        "walk", lidar=replace(LIDARS["vlp16"], columns=900), seed=100, count=24, imu="icm20948",
        motion_compensated=False,
    )  # fmt: skip
    walk = Stub(list(drive), drive.ground_truth, drive.calibration, motion_compensated=False, imu=drive.imu)

    def rmse(config: Config) -> float:
        outcome = lslam.run(walk, config)
        assert all(result.status == "ok" for result in outcome.record.results)
        assert outcome.evaluation is not None
        error = outcome.evaluation.ate["se3"].translation
        assert error is not None
        return error.rmse

    assert rmse(config_of("fast-lio")) < 1.2 * rmse(config_of("floam", "imu.use=true"))


def test_it_asks_for_the_imu_by_itself_and_does_nothing_without_one() -> None:
    assert config_of("fast-lio").imu.use
    with pytest.raises(InputError, match="has no IMU: run without --imu, by a method that needs none"):
        lslam.run(sample(5), config_of("fast-lio"))
