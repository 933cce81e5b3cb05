"""Faults of an IMU injected into one simulated walk: each is reported, and the run stays on the path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from stub_sequences import Stub

import lslam
from lslam.core.config import load_config
from lslam.core.errors import InputError
from lslam.core.geometry import so3
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

pytestmark = pytest.mark.usefixtures("shared_first_poses")
COUNT = 40
# m, of the ATE: a walk of 4 s.
BOUND = 0.05
QUIET = ("map.write=false", "report.html=false", "loops.use=false", "imu.use=true", "imu.start_s=2")


@cache
def walk() -> Stub:
    lidar = replace(LIDARS["vlp16"], columns=900)
    drive = simulate("walk", lidar=lidar, seed=100, count=COUNT, imu="icm20948-calibrated", motion_compensated=False)
    scans = [drive.scan(i) for i in range(COUNT)]
    return Stub(scans, drive.ground_truth, drive.calibration, motion_compensated=False, imu=drive.imu)


def silent(stub: Stub) -> Stub:
    stamps = stub.imu.stamps_ns
    kept = (stamps < 2_400_000_000) | (stamps > 2_900_000_000)
    imu = replace(stub.imu, stamps_ns=stamps[kept], accel=stub.imu.accel[kept], gyro=stub.imu.gyro[kept])
    return replace(stub, imu=imu)


def not_finite(stub: Stub) -> Stub:
    gyro = stub.imu.gyro.copy()
    gyro[50:400:25] = np.nan
    return replace(stub, imu=replace(stub.imu, gyro=gyro))


def late(stub: Stub) -> Stub:
    return replace(stub, imu=replace(stub.imu, stamps_ns=stub.imu.stamps_ns + 20_000_000))


def turned(stub: Stub) -> Stub:
    T = stub.calibration.T_lidar_imu.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(np.deg2rad(3.0) * np.array([1, -1, 1]) / np.sqrt(3))
    T[:3, 3] += 0.03
    return replace(stub, calibration=replace(stub.calibration, T_lidar_imu=T))


def in_g(stub: Stub) -> Stub:
    return replace(stub, imu=replace(stub.imu, accel=stub.imu.accel / 9.80665))


def in_degrees(stub: Stub) -> Stub:
    return replace(stub, imu=replace(stub.imu, gyro=np.rad2deg(stub.imu.gyro)))


# Units and samples that are no numbers are set right before any method has them.
@pytest.mark.parametrize(
    ("fault", "sentence", "method"),
    [
        (silent, "gaps of the IMU", "icp"), (silent, "gaps of the IMU", "fast-lio2"),
        (late, "IMU stamps moved by -2", "icp"), (late, "IMU stamps moved by -2", "fast-lio2"),
        (turned, "beside that of the scans: correct T_lidar_imu", "icp"),
        (turned, "beside that of the scans: correct T_lidar_imu", "fast-lio2"),
        (not_finite, "samples are not finite", "icp"), (in_g, "is in g, converted", "fast-lio2"),
    ],
)  # fmt: skip
def test_a_fault_is_reported_and_the_run_is_followed(fault: Callable[[Stub], Stub], sentence: str, method: str) -> None:
    outcome = lslam.run(fault(walk()), load_config(None, [f"odometry.method={method}", *QUIET], {}))
    manifest = outcome.record.manifest
    said = [*manifest["imu"]["decisions"], *manifest["problems"]]
    assert any(sentence in text for text in said), said
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    assert error.rmse < BOUND


def test_rates_in_degrees_are_refused_by_name_of_the_unit() -> None:
    with pytest.raises(InputError, match=r"fast-lio2 needs an IMU, and this one is refused: .*deg/s"):
        lslam.run(in_degrees(walk()), load_config(None, ["odometry.method=fast-lio2", *QUIET], {}))
    outcome = lslam.run(in_degrees(walk()), load_config(None, ["odometry.method=icp", *QUIET], {}))
    assert any("deg/s" in problem for problem in outcome.record.manifest["problems"])


@pytest.mark.parametrize("method", ["icp", "fast-lio2"])
def test_the_clock_and_the_mounting_are_estimated_where_that_is_asked_for(method: str) -> None:
    settings = [f"odometry.method={method}", *QUIET, "imu.estimate_offset=true", "imu.estimate_extrinsics=true"]
    imu = lslam.run(late(turned(walk())), load_config(None, settings, {})).record.manifest["imu"]
    assert imu["time_offset_s"] == pytest.approx(-0.02, abs=0.001)
    np.testing.assert_allclose(imu["mounting_deg"], np.array([-3, 3, -3]) / np.sqrt(3), atol=0.3)
