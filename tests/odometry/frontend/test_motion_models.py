"""Every tightly coupled method has a motion model of its own, and no other method has."""

from __future__ import annotations

import re
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from lslam.core.config import Config, load_config
from lslam.core.config.odometry import FIXED_DEVICE, TIGHTLY_COUPLED
from lslam.core.geometry import so3
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.odometry import METHODS
from lslam.odometry.frontend.inertial_start import motion_of, mounting_problem
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.gyroscope import AXES_SIGMA, Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.initialise import InertialStart
from lslam.pipeline.check import check_config


def test_tightly_coupled_methods_are_those_with_a_motion_model_of_their_own() -> None:
    own = {name for name, (module, _) in METHODS.items() if hasattr(import_module(module), "create_motion")}
    assert own == set(TIGHTLY_COUPLED)
    kinds = {name: type(turned_motion(config_of(f"odometry.method={name}"))) for name in (*TIGHTLY_COUPLED, "icp")}
    assert kinds.pop("icp") is InertialMotion
    assert InertialMotion not in kinds.values()


def config_of(*settings: str) -> Config:
    return load_config(None, ["imu.use=true", *settings], {})


def turned_motion(config: Config) -> InertialMotion:
    """Of a device that was found to be turned by 3 deg, to a tenth of one."""
    none, count = np.zeros(3), 20
    imu = ImuStream(np.arange(count) * 10_000_000, np.tile([0.0, 0.0, GRAVITY], (count, 1)), np.zeros((count, 3)))
    prior = Gyroscope.of_bias(none, 1e-4)
    gyroscope = replace(prior, axes=so3.exp(np.array([np.deg2rad(3.0), 0.0, 0.0])), covariance=1e-6 * np.eye(12))
    estimate = ImuEstimate(none, np.array([0, 0, -GRAVITY]), none, gyroscope, 1e-4 * np.eye(9))
    return motion_of(InertialStart(imu, np.eye(4), estimate, 0.0, True, True, [], []), config)


@pytest.mark.parametrize(
    "settings",
    [
        *((f"odometry.method={name}",) for name in ("icp", *TIGHTLY_COUPLED)),
        *(("odometry.method=icp", f"imu.velocity={rule}") for rule in ("along-x", "integrated")),
    ],
)
def test_what_is_advised_against_a_turned_imu_is_taken(settings: tuple[str, ...]) -> None:
    said = mounting_problem(turned_motion(config_of(*settings)))
    assert "3.0 deg (sigma 0.1) beside that of the scans: correct T_lidar_imu, or" in said
    advised = [f"odometry.method={name}" for name in re.findall(r"--method (\S+)", said)]
    advised += re.findall(r"--set (\S+)", said)
    config = config_of(*settings, *advised)
    check_config(config)
    assert config.imu.estimate_extrinsics


def test_turns_about_one_axis_do_not_blame_the_mounting() -> None:
    motion = turned_motion(config_of("odometry.method=fast-lio2"))
    axes, sigma = np.eye(3), np.full((3, 3), AXES_SIGMA)
    axes[0, 2], sigma[:, 2] = np.deg2rad(2.5), 1e-3
    covariance = np.diag(np.concatenate([np.full(3, 1e-8), sigma.ravel() ** 2]))
    askew = replace(motion.estimate.gyroscope, axes=axes, covariance=covariance)
    motion.estimate = replace(motion.estimate, gyroscope=askew)
    assert "2.5 deg (sigma 0.1) beside that of the scans: the gyroscope's axes are askew or T_lidar_imu is turned" in (
        mounting_problem(motion)
    )
    # No axes are askew by eight degrees.
    axes[0, 2] = np.deg2rad(8.0)
    assert "correct T_lidar_imu" in mounting_problem(motion)


def test_methods_without_states_for_the_device_are_those_whose_motion_models_have_none() -> None:
    fixed = [name for name in TIGHTLY_COUPLED if not turned_motion(config_of(f"odometry.method={name}")).HAS_DEVICE]
    assert set(fixed) == set(FIXED_DEVICE)
