"""Runs with an IMU on distorted scans: gains in accuracy, invalid streams, gaps, and the files of the run."""

from __future__ import annotations

import csv
import dataclasses
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import Standstill, Stub

from lslam.core.config import Config, load_config
from lslam.core.errors import GateError, InputError
from lslam.core.geometry import se3
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import select
from lslam.evaluation.timing import read_timing_rows
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.odometry import create_odometry
from lslam.odometry.frontend.inertial_start import begin_inertial, close_inertial
from lslam.odometry.frontend.register_scans import estimate
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.pipeline.doctor import Findings
from lslam.pipeline.doctor.examine_turns import examine_turns
from lslam.pipeline.run import run
from lslam.pipeline.watch import RunOutcome
from lslam.reports.text import summary
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import SimulatedDrive, simulate

pytestmark = pytest.mark.usefixtures("shared_first_poses")
COUNT = 60


@cache
def walk_drive() -> SimulatedDrive:
    """A hand-held walk, looking about at up to 110 deg/s, rays fired on the way."""
    lidar = dataclasses.replace(LIDARS["vlp16"], columns=300)
    return simulate("walk", lidar=lidar, count=COUNT, imu="icm20948", motion_compensated=False)


@cache
def walk() -> Stub:
    """Its scans in memory."""
    drive = walk_drive()
    return Stub(
        [drive.scan(i) for i in range(COUNT)],
        drive.ground_truth,
        drive.calibration,
        motion_compensated=False,
        imu=drive.imu,
    )


def imu_of(stub: Stub) -> ImuStream:
    assert stub.imu is not None
    return stub.imu


def with_imu(imu: ImuStream | None) -> Stub:
    whole = walk()
    return dataclasses.replace(whole, imu=imu, scans=list(whole.scans), problems=[], reads=[])


def config_of(*settings: str, use: bool = True) -> Config:
    return load_config(None, [f"imu.use={str(use).lower()}", "map.write=false", "report.html=false", *settings], {})


def rmse(results: list[ScanResult]) -> float:
    """Position error, m, both trajectories starting at the same pose, which is that of the first of the results."""
    truth = walk().ground_truth
    assert truth is not None
    found, true = (np.stack([r.T_world_lidar for r in results]), truth.poses[[r.index for r in results]])
    off = (se3.relative(poses[0], poses)[:, :3, 3] for poses in (found, true))
    return float(np.sqrt(np.mean(np.sum(np.subtract(*off) ** 2, axis=1))))


@cache
def runs() -> tuple[RunOutcome, RunOutcome]:
    """Without and with the IMU."""
    without, with_it = (run(with_imu(imu_of(walk())), config_of(use=use)) for use in (False, True))
    return without, with_it


def test_the_imu_gains_accuracy_and_iterations_on_a_walk() -> None:
    without, with_it = (outcome.record.results for outcome in runs())
    assert all(r.status == "ok" for r in with_it)
    assert rmse(with_it) < 0.7 * rmse(without)
    iterations = [float(np.mean([r.iterations for r in results[5:]])) for results in (without, with_it)]
    assert iterations[1] < 0.8 * iterations[0]
    norms = [float(np.median([r.prior_norm for r in results[5:]])) for results in (without, with_it)]
    assert norms[1] < 0.5 * norms[0]
    steady = [r.imu.steady_norm for r in with_it[5:]]
    assert norms[1] < 0.5 * float(np.median([norm for norm in steady if norm is not None]))
    assert len(steady) == len([norm for norm in steady if norm is not None])
    assert all((r.imu.steady_norm, r.imu.gravity) == (None, None) for r in without)
    assert all(r.imu.gravity is not None for r in with_it)


def test_a_method_that_registers_nothing_does_not_pass_for_accurate() -> None:
    """The sentinel must fail the gate that the test above sets."""
    stub = with_imu(imu_of(walk()))
    motion = begin_inertial(stub, config_of("imu.start_s=1.5")).motion
    assert rmse(estimate(stub, Standstill(), motion=motion)) > 5 * rmse(runs()[1].record.results)


@pytest.mark.usefixtures("starts_sought_anew")
def test_results_are_the_same_twice_and_without_the_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    """What constant velocity would have taken is tried on the side: not a bit of the result depends on it."""
    assert sum(r.imu.saved_s is not None for r in runs()[1].record.results) >= 2
    monkeypatch.setattr(InertialMotion, "COMPARISON_INTERVAL_SCANS", 10**6)
    again = run(with_imu(imu_of(walk())), config_of("input.threads=1"))
    np.testing.assert_array_equal(again.trajectory.poses, runs()[1].trajectory.poses)


@pytest.mark.usefixtures("starts_sought_anew")
def test_scans_csv_is_the_same_twice_and_times_are_in_timing_csv(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(InertialMotion, "COMPARISON_INTERVAL_SCANS", 5)
    config = config_of("input.count=24", "imu.start_s=1.5")
    for name in ("first", "second"):
        run(with_imu(imu_of(walk())), config, out=tmp_path / name)
    first, second = ((tmp_path / name / "scans.csv").read_bytes() for name in ("first", "second"))
    assert first == second
    with (tmp_path / "first" / "timing.csv").open(newline="") as stream:
        saved = [row["saved_s"] for row in csv.DictReader(stream)]
    assert 0 < sum(value != "" for value in saved) < len(saved) == 24
    rows = read_timing_rows(tmp_path / "first" / "timing.csv")
    assert "saved_s" not in rows.stages
    np.testing.assert_allclose(sum(rows.stages.values()), rows.total, atol=1e-5)


def test_the_manifest_lists_the_estimates_of_the_imu(tmp_path: Path) -> None:
    outcome = run(with_imu(imu_of(walk())), config_of("report.html=true", "input.count=40"), out=tmp_path / "run")
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    imu = manifest["imu"]
    assert (manifest["status"], imu["used"], imu["is_checked_by_turns"]) == ("done", True, True)
    assert np.abs(np.array(imu["gyro_bias_rad_s"]) - 0.0873).max() < 0.005
    assert imu["prior_error_m"] < imu["constant_velocity_error_m"]
    header, *rows = (tmp_path / "run" / "scans.csv").read_text().splitlines()
    column = header.split(",").index("prior_norm")
    assert float(rows[20].split(",")[column]) == pytest.approx(outcome.record.results[20].prior_norm, abs=1e-5)
    steady = float(rows[20].split(",")[header.split(",").index("steady_norm")])
    assert steady == pytest.approx(outcome.record.results[20].imu.steady_norm, abs=1e-5)
    assert imu["median_prior_norm"] < imu["median_constant_velocity_norm"]
    sample = [r for r in outcome.record.results if r.imu.steady_iterations is not None]
    assert imu["compared_scans"] == len(sample) > 0
    at = header.split(",").index("steady_iterations")
    assert [row.split(",")[at] for row in rows] == [str(r.imu.steady_iterations or "") for r in outcome.record.results]
    assert imu["compared_iterations"] == pytest.approx(np.mean([r.iterations for r in sample]), abs=0.01)
    assert imu["constant_velocity_iterations"] > 1.2 * imu["compared_iterations"]
    assert imu["mean_iterations"] == pytest.approx(
        np.mean([r.iterations for r in outcome.record.results[1:]]), abs=0.01
    )
    world = manifest["frames"]["world"]
    assert "its tilt of" in world, "a walker's sensor is level to within what four seconds tell of gravity"
    assert f"# world: {world}" in (tmp_path / "run" / "trajectory.tum").read_text()
    up = outcome.trajectory.poses[0][2, :3] @ walk_drive().city_poses[0][2, :3]
    assert np.rad2deg(np.arccos(up)) < 2
    first = np.loadtxt(tmp_path / "run" / "trajectory_kitti.txt")[0]
    np.testing.assert_allclose(first, np.eye(4)[:3].ravel(), atol=1e-9, err_msg="KITTI's world is the start")
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Motion prior" in page
    assert "constant velocity, for comparison" in page
    said = f"on {len(sample)} scan" + "s" * (len(sample) != 1)
    assert said in summary(outcome.record, outcome.evaluation)
    assert said in page
    assert "iterations per scan" in summary(outcome.record, outcome.evaluation)


def gyro_by(factor: NDArray[np.float64]) -> ImuStream:
    imu = imu_of(walk())
    return dataclasses.replace(imu, gyro=imu.gyro @ factor)


@pytest.mark.parametrize("kind", ["zeros", "degrees", "axes"])
def test_invalid_imu_streams_are_refused(kind: str) -> None:
    imu = imu_of(walk())
    bad = {
        "zeros": ImuStream(imu.stamps_ns, imu.accel * 0, imu.gyro * 0),
        "degrees": gyro_by(np.rad2deg(np.eye(3))),
        "axes": gyro_by(np.roll(np.eye(3), 1, axis=0)),
    }[kind]
    part = begin_inertial(with_imu(bad), config_of("imu.start_s=3"))
    assert part.motion is None
    assert part.problems[0].startswith("the IMU is refused, the run goes on without it: ")
    assert not close_inertial(part, [])["used"]


def test_refused_means_degraded_and_a_failed_gate_when_strict(tmp_path: Path) -> None:
    stub = with_imu(gyro_by(-np.eye(3)))
    with pytest.raises(GateError, match="the IMU is refused"):
        run(stub, config_of("input.strict=true", "input.count=40"), out=tmp_path / "run")
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert (manifest["status"], manifest["imu"]["used"]) == ("degraded", False)
    poses = read_trajectory(tmp_path / "run" / "trajectory.tum").poses
    np.testing.assert_allclose(poses, runs()[0].trajectory.poses[:40], atol=1e-6)


def silent(begin_ns: int, end_ns: int) -> Stub:
    """The walk without what the IMU said in between."""
    imu = imu_of(walk())
    keep = (imu.stamps_ns < begin_ns) | (imu.stamps_ns > end_ns)
    return with_imu(ImuStream(imu.stamps_ns[keep], imu.accel[keep], imu.gyro[keep]))


def test_a_gap_of_the_imu_is_bridged_reported_and_counted() -> None:
    stub, config = silent(3_000_000_000, 3_250_000_000), config_of()
    part = begin_inertial(stub, config)
    results = estimate(stub, create_odometry(config), motion=part.motion)
    facts = close_inertial(part, results)
    assert facts["used"]
    assert 2 <= facts["scans_in_gaps"] <= 6
    assert any("gaps of the IMU" in problem for problem in part.problems)
    assert rmse(results) < 1.5 * rmse(runs()[1].record.results) + 0.005


@pytest.mark.parametrize("start_s", ["1.5", "5.0"])
def test_an_imu_that_begins_later_is_aligned_where_it_begins(start_s: str, caplog: pytest.LogCaptureFixture) -> None:
    """Two seconds after the first scan: within the time that is registered without it, and beyond."""
    stub = silent(-1, 2_000_000_000)
    config = config_of(f"imu.start_s={start_s}")
    with caplog.at_level("INFO", "lslam"):
        part = begin_inertial(stub, config)
    assert caplog.text.count("the IMU begins 2.0 s after the first scan") == 1
    results = estimate(stub, create_odometry(config), motion=part.motion)
    facts = close_inertial(part, results)
    assert facts["used"]
    assert facts["is_checked_by_turns"]
    assert 17 <= facts["scans_in_gaps"] <= 20
    assert np.abs(np.array(facts["gyro_bias_rad_s"]) - 0.0873).max() < 0.01
    assert all(r.status == "ok" for r in results)
    assert float(np.median([r.prior_norm for r in results[24:]])) < 0.04
    alone = runs()[0].record.results
    # Before, the run without it is deskewed by the scans that follow, and this one by those before.
    assert rmse(results[24:]) < 1.2 * rmse(alone[24:])
    steady = estimate(dataclasses.replace(stub, scans=stub.scans[:4]), create_odometry(config))
    for now, then in zip(results, steady[:3], strict=False):
        np.testing.assert_allclose(now.T_world_lidar, then.T_world_lidar, atol=0.01)


def test_a_hole_in_the_first_seconds_is_no_fault_of_the_imu() -> None:
    """Its turns over the hole are not known, and would fit nothing."""
    part = begin_inertial(silent(500_000_000, 2_500_000_000), config_of())
    assert part.motion is not None
    assert np.abs(part.motion.estimate.gyroscope.bias - 0.0873).max() < 0.01


def test_an_imu_without_samples_at_registered_scans_is_refused() -> None:
    stub = silent(-1, 2_000_000_000)
    stub.scans[10] = walk_drive().scan(10).select(np.arange(9))
    part = begin_inertial(stub, config_of("imu.start_s=1"))
    assert part.motion is None
    assert "it is silent between all 10 scans" in part.problems[0]
    assert "--start" in part.problems[0]


def test_late_stamps_are_found_and_the_imu_still_helps() -> None:
    imu = imu_of(walk())
    stub = with_imu(dataclasses.replace(imu, stamps_ns=imu.stamps_ns + 20_000_000))
    config = config_of()
    part = begin_inertial(stub, config)
    results = estimate(stub, create_odometry(config), motion=part.motion)
    # A millisecond and more is the noise of so short a walk: the prior tells what is left of the lag.
    assert close_inertial(part, results)["time_offset_s"] == pytest.approx(-0.02, abs=0.005)
    late, on_time = (
        float(np.median([r.prior_norm for r in found[1:]])) for found in (results, runs()[1].record.results)
    )
    assert late < 1.5 * on_time
    assert any("stamps moved" in note for note in part.notes)
    assert rmse(results) < 0.2 * rmse(runs()[0].record.results)


@pytest.mark.parametrize("late_s", [0.0, 0.02])
def test_the_doctor_does_not_take_motion_within_sweeps_for_a_time_offset(late_s: float) -> None:
    imu = imu_of(walk())
    findings = Findings()
    facts = examine_turns(with_imu(dataclasses.replace(imu, stamps_ns=imu.stamps_ns + round(1e9 * late_s))), findings)
    assert facts is not None
    assert facts["time_offset_s"] == pytest.approx(-late_s, abs=0.002)
    assert [finding.code for finding in findings] == (["imu-time-offset"] if late_s else [])


def test_scans_that_cannot_be_read_are_bridged_by_the_imu() -> None:
    stub = with_imu(imu_of(walk()))
    for k in range(40, 44):
        stub.scans[k] = "gone"
    off = {}
    for use in (False, True):
        motion = begin_inertial(stub, config_of()).motion if use else None
        results = estimate(select(stub, count=44), create_odometry(Config()), motion=motion)
        truth = stub.ground_truth
        assert truth is not None
        off[use] = float(np.linalg.norm(results[43].T_world_lidar[:3, 3] - truth.poses[43][:3, 3]))
    assert off[True] < 0.05
    assert off[True] < 0.5 * off[False]


def test_a_part_of_a_recording_is_aligned_where_it_begins() -> None:
    part = select(with_imu(imu_of(walk())), start=10, skip_frames=5)
    config = config_of()
    motion = begin_inertial(part, config).motion
    results = estimate(part, create_odometry(config), motion=motion)
    assert all(r.status == "ok" for r in results)
    assert [r.index for r in results][:3] == [10, 15, 20]
    assert max(r.prior_norm for r in results[1:]) < 0.1


def test_a_sequence_without_an_imu_is_missing_input() -> None:
    with pytest.raises(InputError, match="has no IMU"):
        run(with_imu(None), config_of("input.count=5"))


@pytest.mark.parametrize("lost", [[1], [0, 1, 2]])
def test_a_start_with_scans_that_cannot_be_read_is_aligned_all_the_same(lost: list[int]) -> None:
    stub = with_imu(imu_of(walk()))
    for k in lost:
        stub.scans[k] = "gone"
    part = begin_inertial(select(stub, count=30), config_of())
    assert not part.problems
    results = estimate(select(stub, count=30), create_odometry(Config()), motion=part.motion)
    assert [r.index for r in results if r.status != "ok"] == lost
    assert float(np.median([r.prior_norm for r in results[5:]])) < 0.04


def test_a_method_that_predicts_by_itself_is_named() -> None:
    settings = ("odometry.method=kiss-icp", "input.count=12", "imu.start_s=1", "input.strict=true")
    with pytest.raises(GateError, match="predicts by itself"):
        run(with_imu(imu_of(walk())), config_of(*settings))
