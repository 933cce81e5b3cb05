"""LIO-mapping: as good as the loosely coupled IMU, a map of scans that left the window, and nothing without an IMU."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from stub_sequences import Stub, sample
from warmed_kernels import recorded

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError, UsageError
from lslam.core.kernels import linalg
from lslam.core.types.imu import ImuStream
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry import create_odometry
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.inertial_start import begin_inertial
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.inertial.window import WINDOW_SCANS, WindowMotion
from lslam.odometry.lio_mapping import LioMapping
from lslam.pipeline.check import check_config
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

pytestmark = pytest.mark.usefixtures("shared_first_poses")
QUIET = ("map.write=false", "report.html=false", "loops.use=false", "imu.start_s=1")


def config_of(method: str, *settings: str) -> Config:
    return load_config(None, [f"odometry.method={method}", *QUIET, *settings], {})


def windowed() -> Config:
    return config_of("lio-mapping")


@cache
def walk(count: int = 40) -> Stub:
    lidar = replace(LIDARS["vlp16"], columns=900)
    drive = simulate("walk", lidar=lidar, seed=100, count=count, imu="icm20948", motion_compensated=False)
    return Stub(
        [drive.scan(i) for i in range(count)], drive.ground_truth, drive.calibration, motion_compensated=False,
        imu=drive.imu,
    )  # fmt: skip


def tracker_of(sequence: Stub, config: Config) -> tuple[Tracker, LioMapping, WindowMotion]:
    odometry, motion = create_odometry(config), begin_inertial(sequence, config).motion
    assert isinstance(odometry, LioMapping)
    assert isinstance(motion, WindowMotion)
    return Tracker(odometry, motion=motion), odometry, motion


def ate(sequence: Stub, config: Config) -> float:
    outcome = lslam.run(sequence, config)
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    assert all(result.status == "ok" for result in outcome.record.results)
    assert all(result.covariance is not None for result in outcome.record.results)
    return error.rmse


def test_a_walk_is_followed_as_well_as_by_the_loose_imu() -> None:
    tight, loose = ate(walk(), windowed()), ate(walk(), config_of("icp", "imu.use=true"))
    assert tight < 1.2 * loose


def test_the_map_is_of_scans_that_left_the_window_and_a_run_goes_on_where_it_was(tmp_path: Path) -> None:
    sequence, config = replace(walk(), scans=walk().scans[:18]), windowed()
    tracker, odometry, motion = tracker_of(sequence, config)
    loaded = list(read_ahead(sequence, odometry.prepare, 1))
    expected = []
    for k, scan in enumerate(loaded):
        expected.append(tracker.track(scan).T_world_lidar)
        assert motion.window is not None
        stamps = [m.stamp_ns for m in motion.window.moments]
        assert stamps == [one.stamp_ns for one in loaded[max(0, k + 1 - WINDOW_SCANS) : k + 1]]
        # All scans but the first have equations, and each is in the map or waits for it.
        assert all(m.equations is not None for m in motion.window.moments if m.stamp_ns != loaded[0].stamp_ns)
        assert odometry.registration.history.inserted + len(odometry.pending) == k + 1
        assert all(np.array_equal(T, motion.poses()[stamp]) for stamp, _, T, _ in odometry.pending)
        if k == 11:
            write_state(tmp_path / "12.npz", tracker.state())
    # One more waits in the window than enters the map while it fills.
    assert len(odometry.pending) == WINDOW_SCANS - 1
    again, _, _ = tracker_of(sequence, config)
    again.restore(read_state(tmp_path / "12.npz", STATE_CLASSES))
    np.testing.assert_array_equal([again.track(scan).T_world_lidar for scan in loaded[12:]], expected[12:])


def test_a_scan_that_is_missing_stays_in_the_window_without_equations() -> None:
    sequence, config = replace(walk(), scans=walk().scans[:14]), windowed()
    tracker, odometry, motion = tracker_of(sequence, config)
    loaded = list(read_ahead(sequence, odometry.prepare, 1))
    loaded[11] = ScanInput(11, loaded[11].stamp_ns, error="gone")
    results = [tracker.track(scan) for scan in loaded]
    assert [r.status for r in results[10:]] == ["ok", "skipped", "ok", "ok"]
    assert motion.window is not None
    assert [m.equations is None for m in motion.window.moments] == [k == 11 for k in range(14 - WINDOW_SCANS, 14)]
    truth = walk().ground_truth
    assert truth is not None
    found, real = results[11].T_world_lidar, np.linalg.solve(truth.poses[0], truth.poses[11])
    assert np.linalg.norm(found[:3, 3] - real[:3, 3]) < 0.05


def test_a_gap_of_the_imu_is_bridged_by_constant_velocity_and_reported() -> None:
    sequence = walk()
    assert isinstance(sequence.imu, ImuStream)
    stamps = sequence.imu.stamps_ns
    kept = (stamps < 1_500_000_000) | (stamps > 2_000_000_000)
    imu = ImuStream(stamps[kept], sequence.imu.accel[kept], sequence.imu.gyro[kept])
    outcome = lslam.run(replace(sequence, imu=imu), windowed())
    assert outcome.record.manifest["imu"]["scans_in_gaps"] > 3
    assert any("gaps of the IMU" in problem for problem in outcome.record.manifest["problems"])
    assert sum(result.status == "ok" for result in outcome.record.results) == 40


def test_it_does_nothing_without_an_imu() -> None:
    assert windowed().imu.use
    with pytest.raises(InputError, match="has no IMU: run without --imu, by a method that needs none"):
        lslam.run(sample(5), windowed())
    with pytest.raises(UsageError, match="of the loosely coupled IMU, lio-mapping weighs points and IMU together"):
        check_config(config_of("lio-mapping", "imu.velocity=integrated"))


def test_warming_up_compiles_what_the_window_is_solved_with(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = replace(walk(), scans=walk().scans[:8])
    one, method, _ = tracker_of(sequence, windowed())
    calls = recorded(monkeypatch, linalg, "inverse", "complement", "solve")
    method.warm_up()
    warm = set(calls)
    assert len(method.registration.map) == 0
    for loaded in read_ahead(sequence, method.prepare, 1):
        one.track(loaded)
    assert {name for name, _ in calls} == {"inverse", "complement", "solve"}
    assert calls == warm
