"""The integrity monitor in whole runs: injected failures raise alerts without ground truth, good runs raise none."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from lost_odometry import Corruption, Lost, freeze, slip, yaw_ramp
from stub_sequences import SAMPLE, Stub

from lslam.core.config import Config, load_config
from lslam.core.errors import GateError, RunFailedError
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import MotionCheck, ScanResult
from lslam.core.types.sequence import Sequence, select
from lslam.io.readers import open_sequence
from lslam.odometry.integrity.monitor import IntegrityMonitor
from lslam.pipeline import job
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.run import run
from lslam.pipeline.segments import MAX_SENTENCES, raise_alerts, raise_final_alerts
from lslam.pipeline.watch import RunOutcome, Watch
from lslam.reports.text import summary
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

BEGIN = 30


@cache
def drive(scenario: str, count: int = 80, seed: int = 0, lidar: str = "vlp16") -> Sequence:
    """Scans of a scenario, thinned, in memory."""
    simulated = simulate(
        scenario, seed=seed, count=count, lidar=replace(LIDARS[lidar], columns=900 if lidar == "vlp16" else 600)
    )
    return Stub(
        list(simulated), simulated.ground_truth, simulated.calibration, motion_compensated=simulated.motion_compensated
    )


@cache
def registered(scenario: str) -> dict[int, ScanResult]:
    """Of its drive, by the scan's number: what is claimed of the poses changes nothing of how they were found."""
    return {}


def config(*settings: str) -> Config:
    return load_config(None, ["map.write=false", "report.html=false", "loops.use=false", *settings], {})


def ended(sequence: Sequence, *settings: str) -> RunOutcome:
    """The outcome, also of a run that diverges."""
    outcomes: list[RunOutcome] = []
    with suppress(RunFailedError):
        run(sequence, config(*settings), watch=Watch(on_end=outcomes.append))
    return outcomes[0]


def problems(outcome: RunOutcome) -> list[str]:
    return [p for p in outcome.record.manifest["problems"] if "may be lost" in p]


def reordered(sequence: Sequence, order: list[int]) -> Stub:
    """The scans in another order, at the stamps of the right one."""
    assert isinstance(sequence, Stub)
    scans: list[Scan | str] = []
    for k, i in enumerate(order):
        scan = sequence.scan(i)
        scans.append(replace(scan, index=k, stamp_ns=100_000_000 * k))
    return Stub(scans, None, sequence.calibration)


class Holed(Stub):
    """Scans at their own stamps, however many miss between them."""

    @property
    def stamps_ns(self) -> np.ndarray:
        return np.array([scan.stamp_ns for scan in self.scans if isinstance(scan, Scan)], np.int64)


@pytest.mark.parametrize("scenario", ["street", "residential"])
@pytest.mark.parametrize(("corruption", "words"), [(freeze, "m ahead"), (slip, "m ahead"), (yaw_ramp, "deg of yaw")])
def test_poses_that_contradict_the_scans_degrade_the_run(
    scenario: str, corruption: Corruption, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(job, "create_odometry", lambda _: Lost(corruption, BEGIN, known=registered(scenario)))
    outcome = ended(drive(scenario))
    assert outcome.record.manifest["status"] == "degraded"
    assert any(words in problem for problem in problems(outcome))
    lost = np.flatnonzero([r.may_be_elsewhere for r in outcome.record.results])
    assert BEGIN - 5 <= lost[0] <= BEGIN + 10
    assert lost[-1] >= 70
    assert "may be lost" in summary(outcome.record, None)


def test_two_lost_seconds_are_reported_and_fail_a_strict_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(job, "create_odometry", lambda _: Lost(slip, BEGIN, BEGIN + 20, registered("street")))
    with pytest.raises(GateError, match="may be lost"):
        run(drive("street"), config("input.strict=true"), out=tmp_path / "run")
    header, *rows = (tmp_path / "run" / "scans.csv").read_text().splitlines()
    column = header.split(",").index("lost")
    lost = np.flatnonzero([row.split(",")[column] == "1" for row in rows])
    assert BEGIN - 5 <= lost[0] <= BEGIN + 5
    assert BEGIN + 15 <= lost[-1] <= BEGIN + 27
    document = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert document["integrity"]["alerts"] >= 1
    assert document["integrity"]["conclusive"] > 10


@pytest.mark.parametrize("scenario", ["street", "residential"])
def test_four_scans_out_of_order_are_recovered_or_reported(scenario: str) -> None:
    order = list(range(80))
    order[40:44] = [43, 42, 41, 40]
    outcome = ended(reordered(drive(scenario), order))
    assert outcome.record.manifest["status"] in ("degraded", "diverged")
    assert any(r.may_be_elsewhere for r in outcome.record.results[38:46])
    assert any("out of order" in problem for problem in problems(outcome))


def test_scans_swapped_in_pairs_degrade_the_run() -> None:
    order = np.arange(60).reshape(-1, 2)[:, ::-1].ravel().tolist()
    outcome = ended(reordered(drive("street"), order))
    assert outcome.record.manifest["status"] in ("degraded", "diverged")
    assert sum(r.may_be_elsewhere for r in outcome.record.results) > 50


def test_stamps_that_jitter_are_told_as_the_fault_of_the_clock() -> None:
    whole = drive("street")
    late_ns = np.zeros(40, np.int64)
    late_ns[[12, 13, 25]] = 40_000_000, -40_000_000, 45_000_000
    scans = [replace(whole.scan(i), stamp_ns=int(whole.scan(i).stamp_ns + late_ns[i])) for i in range(40)]
    outcome = ended(Holed(scans, None, whole.calibration))
    manifest = outcome.record.manifest
    assert manifest["status"] == "done"
    assert not any(r.may_be_elsewhere for r in outcome.record.results)
    assert [p for p in manifest["problems"] if "the stamps of" in p and "wrong by up to 80 ms" in p]


@pytest.mark.parametrize(("preset", "lost"), [("thesis-icp", 11), ("thesis-loam", 12), ("thesis-loam-map", 1)])
def test_the_settings_of_a_method_that_loses_its_way_do_not_blind_the_monitor(preset: str, lost: int) -> None:
    """Every step that is a metre off is told."""
    sequence = open_sequence(SAMPLE)
    outcome = ended(sequence, f"odometry.preset={preset}")
    assert any("m ahead" in problem for problem in problems(outcome))
    assert sequence.ground_truth is not None
    poses, true = np.stack([r.T_world_lidar for r in outcome.record.results]), sequence.ground_truth.poses[::4]
    off = se3.relative(se3.relative(true[:-1], true[1:]), se3.relative(poses[:-1], poses[1:]))
    is_off = np.linalg.norm(off[:, :3, 3], axis=1) > 1
    assert is_off.sum() >= lost
    assert all(r.may_be_elsewhere for r, is_wrong in zip(outcome.record.results[1:], is_off, strict=True) if is_wrong)


def test_clouds_in_the_frame_of_a_world_are_reported() -> None:
    sequence = open_sequence(SAMPLE)
    assert sequence.ground_truth is not None
    scans = []
    for k, T in enumerate(sequence.ground_truth.poses[:50]):
        scan = sequence.scan(k)
        scans.append(replace(scan, points=(scan.points[:, :3] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)))
    outcome = ended(Stub(scans, None, sequence.calibration, motion_compensated=True))
    (problem,) = problems(outcome)
    assert "the clouds are not in the frame of the sensor" in problem


def test_a_bare_tunnel_is_reported_though_the_method_holds_still() -> None:
    """Rings hold points on points: the method sees no direction that is open."""
    outcome = ended(drive("tunnel", 40), "odometry.method=icp-svd")
    assert outcome.record.manifest["status"] == "degraded"
    (problem,) = problems(outcome)
    assert "nothing confirms the poses" in problem


@pytest.mark.parametrize("lidar", ["vlp16", "hdl64"])
def test_three_missing_seconds_while_moving_degrade_the_run(lidar: str) -> None:
    whole = drive("street", lidar=lidar)
    scans = [whole.scan(i) for i in (*range(20), *range(50, 70))]
    outcome = ended(Holed([replace(scan, index=k) for k, scan in enumerate(scans)], None, whole.calibration))
    assert outcome.record.manifest["status"] in ("degraded", "diverged")
    if outcome.record.manifest["status"] == "degraded":
        assert any(r.may_be_elsewhere for r in outcome.record.results[18:26])


@pytest.mark.parametrize(
    ("scenario", "lidar"),
    [
        ("street", "vlp16"), ("residential", "hdl64"), ("carpark", "vlp16"), ("corridor", "vlp16"),
        ("motorway", "hdl64"), ("urban", "vlp16"), ("climbing", "vlp16"), ("walk", "vlp16"),
    ],
)  # fmt: skip
def test_a_good_drive_raises_no_alert(scenario: str, lidar: str) -> None:
    outcome = ended(drive(scenario, 80, 1, lidar))
    assert problems(outcome) == []
    assert outcome.record.manifest["integrity"]["checks"] >= 14


@pytest.mark.parametrize("more", [0, 1, 3])
def test_the_first_alerts_are_listed_and_the_others_counted(more: int) -> None:
    """One check in six finds the sensor a metre ahead: the scans of each are marked, also of those that are not told."""
    stretches = MAX_SENTENCES + more
    cfg = config()
    monitor = IntegrityMonitor(cfg.preprocess)
    for k in range(6 * stretches):
        found, is_ahead = np.eye(4), k % 6 == 5
        found[0, 3] = is_ahead
        as_claimed = 0.5 if is_ahead else 0.9
        check = MotionCheck(5 * k, 5 * k + 5, 0.5, np.eye(4), found, np.full(6, 1e-3), 0.9, as_claimed, 0.9)
        monitor.checks.append(check)
    count = 30 * stretches + 1
    results = [ScanResult(100 + k, 100_000_000 * k, np.eye(4)) for k in range(count)]
    manifest = Manifest("run", drive("street"), cfg)
    marked = raise_alerts(results, monitor.checks, manifest)
    assert [k for k in range(count) if marked[k].may_be_elsewhere] == [k for k in range(1, count) if (k - 1) % 30 >= 25]
    assert manifest.integrity == {"checks": 6 * stretches, "conclusive": 6 * stretches, "alerts": stretches}
    told = [problem.split(" may be")[0] for problem in manifest.problems[:MAX_SENTENCES]]
    assert told == [f"scans {126 + 30 * k} to {130 + 30 * k}" for k in range(MAX_SENTENCES)]
    said = [f"and {more} more stretches of scans that may be lost: see scans.csv"] if more else []
    assert manifest.problems[MAX_SENTENCES:] == said


@pytest.mark.parametrize("ahead_m", [0.0, 0.02, 1.2])
def test_final_poses_are_held_against_the_same_checks(ahead_m: float) -> None:
    """Odometry agrees with every check; what the graph is given afterwards pulls scans 50 and later ahead."""
    motion = np.eye(4)
    motion[0, 3] = 2.5
    checks = [MotionCheck(5 * k, 5 * k + 5, 0.5, motion, motion, np.full(6, 1e-3), 0.9, 0.9, 0.9) for k in range(20)]
    odometry, final = [], []
    for k in range(101):
        T = np.eye(4)
        T[0, 3] = 0.5 * k
        odometry.append(ScanResult(200 + k, 100_000_000 * k, T))
        T = T.copy()
        T[0, 3] += ahead_m * np.clip((k - 45) / 5, 0, 1)
        final.append(ScanResult(200 + k, 100_000_000 * k, T))
    manifest = Manifest("run", drive("street"), config())
    assert not any(r.may_be_elsewhere for r in raise_alerts(odometry, checks, manifest))
    marked = raise_final_alerts(final, checks, manifest, "the pose graph")
    is_wrong = ahead_m > 1
    assert [k for k in range(101) if marked[k].may_be_elsewhere] == (list(range(46, 51)) if is_wrong else [])
    assert manifest.integrity == {"checks": 20, "conclusive": 20, "alerts": 0, "final_alerts": int(is_wrong)}
    assert manifest.problems == ["after the pose graph, scans 246 to 250 may be lost: beside the scan 0.5 s before, it moved by "
                                 "-1.20 m ahead more than its pose says"] * is_wrong  # fmt: skip


def test_the_sample_raises_no_alert_with_features() -> None:
    """With icp and kiss-icp: tests/cli/test_run.py."""
    outcome = ended(open_sequence(SAMPLE), "odometry.method=loam")
    assert problems(outcome) == []
    assert outcome.record.manifest["integrity"]["conclusive"] > 10


@pytest.mark.parametrize("name", ["kitti_raw_0005", "kitti_raw_0048", "mcd_kth_day_06"])
def test_recordings_raise_no_alert(recordings: Callable[[str], Path], name: str) -> None:
    folder = recordings(name)
    drive_folder = folder / "2011_09_26" / f"2011_09_26_drive_{name[-4:]}_sync" if "kitti" in name else folder / name
    outcome = ended(select(open_sequence(drive_folder), 0, 100))
    assert problems(outcome) == []
