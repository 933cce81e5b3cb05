"""FAST-LIO2: ahead of the loosely coupled IMU on violent motion, no worse elsewhere, and nothing without an IMU."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from stub_sequences import Stub, sample

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import SimulatedDrive, simulate

pytestmark = pytest.mark.usefixtures("shared_first_poses")
QUIET = ("map.write=false", "report.html=false", "loops.use=false", "imu.start_s=1")


def config_of(method: str, *settings: str) -> Config:
    return load_config(None, [f"odometry.method={method}", *QUIET, *settings], {})


@cache
def traced(count: int) -> tuple[list[Scan | str], SimulatedDrive]:
    lidar = replace(LIDARS["vlp16"], columns=900)
    drive = simulate("walk", lidar=lidar, seed=100, count=count, imu="icm20948", motion_compensated=False)
    return list(drive), drive


def walk(count: int) -> Stub:
    scans, drive = traced(count)
    return Stub(scans, drive.ground_truth, drive.calibration, motion_compensated=False, imu=drive.imu)


def ate(sequence: Stub, *settings: str, method: str) -> tuple[float, list[ScanResult]]:
    outcome = lslam.run(sequence, config_of(method, *settings))
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    return error.rmse, outcome.record.results


def test_a_walk_is_followed_as_well_as_by_the_loose_imu_and_far_better_than_without() -> None:
    sequence = walk(50)
    tight, results = ate(sequence, method="fast-lio2")
    loose, _ = ate(sequence, "imu.use=true", method="icp")
    alone, _ = ate(sequence, method="icp")
    assert all(result.status == "ok" for result in results)
    assert tight < 1.2 * loose
    assert tight < 0.5 * alone
    # A sweep is deskewed once, by back propagation.
    assert all("deskew" in result.stages for result in results[1:])
    assert all(result.covariance is not None for result in results)


def test_a_gap_of_the_imu_is_bridged_by_constant_velocity_and_reported() -> None:
    sequence = walk(50)
    assert isinstance(sequence.imu, ImuStream)
    stamps = sequence.imu.stamps_ns
    kept = (stamps < 2_500_000_000) | (stamps > 3_000_000_000)
    imu = ImuStream(stamps[kept], sequence.imu.accel[kept], sequence.imu.gyro[kept])
    outcome = lslam.run(replace(sequence, imu=imu), config_of("fast-lio2"))
    assert outcome.record.manifest["imu"]["scans_in_gaps"] > 3
    assert any("gaps of the IMU" in problem for problem in outcome.record.manifest["problems"])
    assert sum(result.status == "ok" for result in outcome.record.results) == 50


def test_it_asks_for_the_imu_by_itself_and_does_nothing_without_one() -> None:
    assert config_of("fast-lio2").imu.use
    assert not config_of("icp").imu.use
    with pytest.raises(InputError, match="has no IMU: run without --imu, by a method that needs none"):
        lslam.run(sample(5), config_of("fast-lio2"))


def test_a_refused_imu_ends_the_run() -> None:
    sequence = walk(15)
    assert isinstance(sequence.imu, ImuStream)
    no_gravity = replace(sequence.imu, accel=np.zeros_like(sequence.imu.accel))
    with pytest.raises(InputError, match="fast-lio2 needs an IMU, and this one is refused"):
        lslam.run(replace(sequence, imu=no_gravity), config_of("fast-lio2"))


def test_an_imu_that_is_too_slow_for_a_filter_ends_the_run_before_anything_is_registered() -> None:
    """KITTI's raw drives have 10 Hz; loosely coupled it is used, and said to be slow."""
    sequence = replace(walk(15), reads=[])
    assert isinstance(sequence.imu, ImuStream)
    slow = ImuStream(sequence.imu.stamps_ns[::10], sequence.imu.accel[::10], sequence.imu.gyro[::10])
    sequence = replace(sequence, imu=slow, kind="kitti-raw")
    with pytest.raises(InputError, match=r"an IMU of 50 Hz or more, this one has 10\.0 Hz: run a loosely .*`_extract`"):
        lslam.run(sequence, config_of("fast-lio2"))
    assert set(sequence.reads) <= {0}
    notes = lslam.run(sequence, config_of("icp", "imu.use=true")).record.manifest["imu"]["decisions"]
    assert any("10 Hz, which degrades" in note for note in notes)


def test_fast_lio2_resumes_to_the_last_bit(tmp_path: Path) -> None:
    """The states of the filter are part of the checkpoint; see `tests/odometry/frontend/test_resumable_state.py`."""
    from lslam.io.formats.state_files import read_state, write_state
    from lslam.odometry import create_odometry
    from lslam.odometry.frontend.checkpoints import STATE_CLASSES
    from lslam.odometry.frontend.inertial_start import begin_inertial
    from lslam.odometry.frontend.register_scans import read_ahead
    from lslam.odometry.frontend.tracker import Tracker

    sequence, config = walk(16), config_of("fast-lio2")

    def fresh() -> Tracker:
        return Tracker(create_odometry(config), motion=begin_inertial(sequence, config).motion)

    whole, expected = fresh(), []
    loaded = list(read_ahead(sequence, whole.odometry.prepare, 1))
    for scan in loaded:
        expected.append(whole.track(scan).T_world_lidar)
        if len(expected) == 8:
            write_state(tmp_path / "8.npz", whole.state())
    again = fresh()
    again.restore(read_state(tmp_path / "8.npz", STATE_CLASSES))
    np.testing.assert_array_equal([again.track(scan).T_world_lidar for scan in loaded[8:]], expected[8:])
