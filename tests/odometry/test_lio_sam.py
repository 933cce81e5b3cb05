"""LIO-SAM: as good as the loose IMU on its features and on all points, with states; nothing without an IMU."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stub_sequences import Stub, sample

import lslam
from lslam.backend.graph.factors import regularise
from lslam.backend.graph.odometry_constraints import odometry_constraints
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.optimise import run_back_end
from lslam.backend.outcome import BackEnd
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry import create_odometry
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.inertial_start import begin_inertial
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.tracker import Tracker
from lslam.odometry.lio_sam import LioSam, LioSamOfPoints
from lslam.pipeline import back_end_pass
from lslam.simulation.imu import IMUS
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate
from lslam.simulation.sensors import GnssModel

pytestmark = pytest.mark.usefixtures("shared_first_poses")
QUIET = ("map.write=false", "report.html=false", "loops.use=false", "odometry.integrity=false", "imu.start_s=1")
COUNT = 24


def config_of(*settings: str) -> Config:
    return load_config(None, [*QUIET, *settings], {})


TIGHT = "odometry.method=lio-sam"
POINTS = "lio_sam.features=points"


@cache
def walk(seed: int = 100) -> Stub:
    lidar = replace(LIDARS["vlp16"], columns=900)
    receiver = GnssModel(rate_hz=10.0, white=0.02, slow=0.0)
    drive = simulate(
        "walk", lidar=lidar, seed=seed, count=COUNT, imu="icm20948", gnss=receiver, motion_compensated=False
    )
    return Stub(
        [drive.scan(i) for i in range(COUNT)], drive.ground_truth, drive.calibration, motion_compensated=False,
        imu=drive.imu, gnss=drive.gnss,
    )  # fmt: skip


def ate(sequence: Stub, *settings: str) -> tuple[float, list[ScanResult]]:
    outcome = lslam.run(sequence, config_of(*settings))
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    return error.rmse, outcome.record.results


def test_a_walk_is_followed_as_closely_as_by_the_same_features_on_a_loose_imu_and_the_states_are_estimated() -> None:
    tight, results = ate(walk(), TIGHT)
    loose, _ = ate(walk(), "odometry.method=floam", "imu.use=true")
    assert all(result.status == "ok" for result in results)
    assert tight < 1.2 * loose
    assert all(result.covariance is not None and not result.posed_by for result in results)
    last = results[-1].imu.state
    assert last is not None
    # Of the data sheet: 5 deg/s on each axis.
    np.testing.assert_allclose(last.values[3:6], IMUS["icm20948"].gyro.bias, atol=3e-3)
    assert (last.sigmas[3:6] < 3e-3).all()
    assert np.linalg.norm(last.values[6:9]) == pytest.approx(9.81, abs=0.05)


def test_all_points_may_take_the_place_of_features() -> None:
    assert isinstance(create_odometry(config_of(TIGHT)), LioSam)
    assert isinstance(create_odometry(config_of(TIGHT, POINTS)), LioSamOfPoints)
    ratios = []
    for seed in (100, 101, 102):
        tight, results = ate(walk(seed), TIGHT, POINTS)
        assert all(result.status == "ok" for result in results)
        ratios.append(tight / ate(walk(seed), "imu.use=true")[0])
    # Of seeds 0 to 2 at most 0.61; of one walk half a millimetre in two is chance.
    assert np.median(ratios) < 1.2


def test_a_gap_of_the_imu_is_bridged_by_constant_velocity_and_reported() -> None:
    assert isinstance(walk().imu, ImuStream)
    stamps = walk().imu.stamps_ns
    kept = (stamps < 1_300_000_000) | (stamps > 1_800_000_000)
    imu = ImuStream(stamps[kept], walk().imu.accel[kept], walk().imu.gyro[kept])
    outcome = lslam.run(replace(walk(), imu=imu), config_of(TIGHT, POINTS))
    assert outcome.record.manifest["imu"]["scans_in_gaps"] > 3
    assert any("gaps of the IMU" in problem for problem in outcome.record.manifest["problems"])
    assert sum(result.status == "ok" for result in outcome.record.results) == COUNT


def test_it_asks_for_the_imu_by_itself_and_does_nothing_without_one() -> None:
    assert config_of(TIGHT).imu.use
    with pytest.raises(InputError, match="has no IMU: run without --imu, by a method that needs none"):
        lslam.run(sample(5), config_of(TIGHT))


def test_a_refused_imu_ends_the_run() -> None:
    assert isinstance(walk().imu, ImuStream)
    no_gravity = replace(walk().imu, accel=np.zeros_like(walk().imu.accel))
    with pytest.raises(InputError, match="lio-sam needs an IMU, and this one is refused"):
        lslam.run(replace(walk(), imu=no_gravity), config_of(TIGHT))


def test_a_run_goes_on_where_it_was_and_carries_a_scan_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a reset of the graph, and a scan of which too little is left to register."""
    monkeypatch.setattr("lslam.odometry.inertial.smoothing.RESET_SCANS", 5)
    config = config_of(TIGHT, POINTS)
    scans = [walk().scan(i) for i in range(16)]
    scans[10] = scans[10].select(np.arange(3))
    sequence = replace(walk(), scans=scans)

    def fresh() -> Tracker:
        return Tracker(create_odometry(config), motion=begin_inertial(sequence, config).motion)

    whole, expected = fresh(), []
    loaded = list(read_ahead(sequence, whole.odometry.prepare, 1))
    for scan in loaded:
        expected.append(whole.track(scan))
        if len(expected) in (8, 12):
            write_state(tmp_path / f"{len(expected)}.npz", whole.state())
    assert [result.status for result in expected].count("bridged") == 1
    for k in (8, 12):
        again = fresh()
        again.restore(read_state(tmp_path / f"{k}.npz", STATE_CLASSES))
        for scan, one in zip(loaded[k:], expected[k:], strict=True):
            other = again.track(scan)
            np.testing.assert_array_equal(other.T_world_lidar, one.T_world_lidar)
            np.testing.assert_array_equal(other.covariance, one.covariance)
            np.testing.assert_array_equal(other.points_covariance, one.points_covariance)


def test_the_pose_graph_has_the_imu_beside_odometry_that_weighs_as_much_as_its_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[tuple[list[Keyframe], list[ScanResult], BackEnd]] = []

    def watched(sequence: Any, results: list[ScanResult], store: KeyframeStore, *more: Any) -> BackEnd:
        seen.append((list(store.keyframes), results, run_back_end(sequence, results, store, *more)))
        return seen[0][2]

    monkeypatch.setattr(back_end_pass, "run_back_end", watched)
    outcome = lslam.run(walk(), config_of(TIGHT, "gnss.mode=graph", "keyframes.distance=0.2"))
    facts = outcome.record.manifest["graph"]
    assert facts["keyframes"] > 5
    assert facts["imu_factors"] == facts["keyframes"] - 1
    assert facts["gravity_factors"] == 0
    assert facts["fixes"] > 10
    (keyframes, results, done), config = seen[0], config_of(TIGHT).graph
    by_points = odometry_constraints(keyframes, [result.by_points for result in results], config)
    by_smoother = odometry_constraints(keyframes, results, config)
    for held, one in zip(done.constraints, by_points, strict=True):
        np.testing.assert_allclose(held.covariance, regularise(one.covariance), rtol=1e-9, atol=1e-15)
    # Of rotation, where the IMU is what is known better.
    grown = [sum(np.trace(c.covariance[3:, 3:]) for c in steps) for steps in (by_points, by_smoother)]
    assert grown[0] > 1.2 * grown[1]
