"""The whole recipe in one process: what it writes, how it ends, and that nothing fails silently."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stub_sequences import Standstill, Stub, noise, sample, with_points

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import GateError, InputError, InterruptedRunError, OutputError, RunFailedError, UsageError
from lslam.core.types.scan import Scan
from lslam.evaluation.evaluate import Evaluation
from lslam.pipeline import job
from lslam.pipeline.watch import RunOutcome, Watch

ONLY_MAP = {"schema", "version", "lslam", "estimate", "map"}  # of evaluation.json without ground truth
ALL = {
    "trajectory.tum", "trajectory_kitti.txt", "covariances.npz", "map.ply", "map.json", "timing.csv", "scans.csv",
    "trajectory_odometry.tum", "loops.csv",
    "manifest.json", "config.toml", "log.txt", "evaluation.json", "report.html", "keyframes",
}  # fmt: skip
# A run whose odometry is lost, or that somebody ended, goes no further.
BACK_END = {"trajectory_odometry.tum", "loops.csv"}
# Each scan is decided as it comes: none is registered again on the map of those that follow.
AT_ONCE = "registration.start_scans=1"
Usage = namedtuple("Usage", "total used free")


def names(folder: Path) -> set[str]:
    return {p.name for p in folder.iterdir()}


def manifest(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return document


def config(*settings: str) -> Config:
    return load_config(settings=settings, environ={})


def passes_gate(evaluation: Evaluation | None, alignment: str = "se3", limit: float = 0.1) -> bool:
    """The accuracy gate of these tests; a score that cannot be stated does not pass."""
    assert evaluation is not None
    error = evaluation.ate[alignment].translation
    return error is not None and error.rmse < limit


class Stopper:
    """Asks to stop after a number of steps of one stage, and remembers how the run ended."""

    def __init__(self, stage: str, steps: int) -> None:
        self.stage, self.steps, self.now = stage, steps, ""
        self.outcomes: list[RunOutcome] = []

    @property
    def watch(self) -> Watch:
        return Watch(self._start, self._step, self.outcomes.append, lambda: self.steps <= 0)

    def _start(self, stage: str, total: int) -> None:
        self.now = stage

    def _step(self) -> None:
        self.steps -= self.now == self.stage


def test_a_good_run_writes_everything_and_ends_done(tmp_path: Path) -> None:
    outcome = lslam.run(sample(15), out=tmp_path / "out")
    assert names(tmp_path / "out") == ALL
    facts = manifest(tmp_path / "out")
    assert (facts["status"], facts["problems"]) == ("done", [])
    assert facts["counts"] == {
        "scans": 15,
        "ok": 15,
        "bridged": 0,
        "skipped": 0,
        "standing": 0,
        "degenerate": 0,
        "fallback": 0,
    }
    assert facts["sequence"]["decisions"] == ["a note of the reader"]
    assert facts["frames"]["trajectory_kitti.txt"].startswith("camera 0")
    assert outcome.record.manifest == facts, "`run --json` prints what the file says"
    assert facts["timings"]["report_s"] > 0
    assert len(outcome.trajectory) == 15
    log = (tmp_path / "out" / "log.txt").read_text()
    assert "a note of the reader" in log
    assert "method icp" in log


def test_python_without_a_folder_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = lslam.run(sample(15))
    assert names(tmp_path) == set()
    assert passes_gate(outcome.evaluation)


def test_the_identity_sentinel_fails_the_gate_that_icp_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    good = lslam.run(sample(40))
    monkeypatch.setattr(job, "create_odometry", lambda config: Standstill())
    still = lslam.run(sample(40))
    for alignment in ("se3", "origin"):
        assert passes_gate(good.evaluation, alignment)
        assert not passes_gate(still.evaluation, alignment, 1.0)


@pytest.mark.parametrize(
    ("spoil", "status", "reason"),
    [
        (lambda s: s.scans.__setitem__(5, "velodyne/000005.bin: 1001 bytes are not whole points"), "skipped", "000005"),
        (lambda s: s.scans.__setitem__(5, Scan(np.zeros((0, 3), np.float32), 500_000_000, 5)), "skipped", "no points"),
        (lambda s: s.scans.__setitem__(5, Scan(noise(1), 500_000_000, 5)), "bridged", ""),
    ],
)
def test_one_bad_scan_degrades_the_run_and_is_counted(
    tmp_path: Path, spoil: Callable[[Stub], None], status: str, reason: str
) -> None:
    stub = sample(15)
    spoil(stub)
    out = tmp_path / "out"
    lslam.run(stub, out=out)
    facts = manifest(out)
    assert facts["status"] == "degraded"
    assert facts["counts"][status] == 1
    assert facts["counts"]["ok"] == 14
    assert "1 of 15 scans" in facts["problems"][0]
    assert "scan 5" in facts["problems"][0]
    assert reason in facts["problems"][0]
    assert names(out) == ALL
    assert f"scan 5 {status}" in (out / "log.txt").read_text()
    row = (out / "scans.csv").read_text().splitlines()[6].split(",")
    assert (row[0], row[2]) == ("5", status)
    assert len((out / "trajectory_kitti.txt").read_text().splitlines()) == 15
    with np.load(out / "covariances.npz") as file:
        assert np.isfinite(file["covariances"]).all()
        trace = np.trace(file["covariances"][:, :3, :3], axis1=1, axis2=2)
    assert trace[5] > 10 * trace[4], "a pose nobody measured is doubtful"
    with pytest.raises(GateError, match="--strict"):
        lslam.run(stub, config("input.strict=true"), out=tmp_path / "strict")
    assert names(tmp_path / "strict") == ALL


def test_nothing_but_empty_scans_is_bad_input_and_no_result(tmp_path: Path) -> None:
    stub = Stub([Scan(np.zeros((0, 3), np.float32), i * 100_000_000, i) for i in range(4)])
    with pytest.raises(InputError, match=r"none of 4 scans can be used.*no points"):
        lslam.run(stub, out=tmp_path / "out")
    assert manifest(tmp_path / "out")["status"] == "failed"
    assert names(tmp_path / "out") == {"manifest.json", "config.toml", "log.txt"}


def test_a_diverged_run_is_written_up_to_its_last_scan(tmp_path: Path) -> None:
    stub = sample(40)
    for i in range(10, 40):
        stub = with_points(stub, i, noise(i, 2000))
    stopper = Stopper("nothing", 1)
    with pytest.raises(RunFailedError, match=r"the first is scan 10"):
        lslam.run(stub, config(), out=tmp_path / "out", watch=stopper.watch)
    assert manifest(tmp_path / "out")["status"] == "diverged"
    assert len((tmp_path / "out" / "trajectory_kitti.txt").read_text().splitlines()) == 40
    assert names(tmp_path / "out") == ALL - BACK_END
    assert len(stopper.outcomes) == 1, "whoever watches still gets what there is"


@pytest.mark.parametrize("stage", ["odometry", "map"])
def test_an_interrupted_run_writes_what_was_done(tmp_path: Path, stage: str) -> None:
    stopper = Stopper(stage, 6)
    out = tmp_path / "out"
    with pytest.raises(InterruptedRunError, match="interrupted"):
        lslam.run(sample(15), config(AT_ONCE), out=out, watch=stopper.watch)
    facts = manifest(out)
    assert facts["status"] == "interrupted"
    missing = {"map.ply", "map.json"} | (BACK_END if stage == "odometry" else set())
    assert names(out) == ALL - missing | {"checkpoint"}
    assert len((out / "trajectory_kitti.txt").read_text().splitlines()) == (6 if stage == "odometry" else 15)
    assert stopper.outcomes


def test_a_second_signal_ends_at_once_and_still_says_so(tmp_path: Path) -> None:
    def hurry(index: int) -> None:
        if index == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lslam.run(replace(sample(15), on_read=hurry), config("input.threads=1", AT_ONCE), out=tmp_path / "out")
    assert manifest(tmp_path / "out")["status"] == "interrupted"
    assert names(tmp_path / "out") - {"checkpoint"} == {"manifest.json", "config.toml", "log.txt", "keyframes"}


def test_a_disk_that_will_not_hold_the_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub = sample(10)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9, 1000))
    with pytest.raises(OutputError, match="MB left"):
        lslam.run(stub, out=tmp_path / "early")
    assert stub.reads == [], "found out before the work, not after"
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9, 600_000))
    with pytest.raises(OutputError, match="the map needs about"):
        lslam.run(sample(10), config("map.voxel=0.05"), out=tmp_path / "late")
    facts = manifest(tmp_path / "late")
    assert facts["status"] == "failed"
    assert "the map needs about" in facts["why"]
    assert {"trajectory.tum", "evaluation.json"} <= names(tmp_path / "late")
    assert not {"map.ply", "map.ply.part"} & names(tmp_path / "late")


def test_a_mistake_of_a_method_is_in_the_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken(Standstill):
        def register(self, scan: Scan, prepared: None, prior: object) -> Any:
            raise ZeroDivisionError

    monkeypatch.setattr(job, "create_odometry", lambda config: Broken())
    with pytest.raises(ZeroDivisionError):
        lslam.run(sample(5), out=tmp_path / "out")
    facts = manifest(tmp_path / "out")
    assert (facts["status"], facts["why"]) == ("failed", "ZeroDivisionError")


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_poses_than_a_score_needs(tmp_path: Path, count: int) -> None:
    outcome = lslam.run(sample(count), out=tmp_path / "out")
    assert outcome.evaluation is None
    facts = manifest(tmp_path / "out")
    assert facts["status"] == "degraded"
    assert "not scored" in facts["problems"][0]
    assert f"{count} poses" in facts["problems"][0]
    assert facts["problems"][0].endswith(facts["unscored"])
    assert names(tmp_path / "out") == ALL
    assert set(json.loads((tmp_path / "out" / "evaluation.json").read_text())) == ONLY_MAP
    assert "not scored" in (tmp_path / "out" / "report.html").read_text()


def test_truth_that_shares_no_time_leaves_the_run_done_without_a_score(tmp_path: Path) -> None:
    stub = sample(10)
    assert stub.ground_truth is not None
    late = replace(stub.ground_truth, stamps_ns=stub.ground_truth.stamps_ns + 10**12)
    outcome = lslam.run(stub, out=tmp_path / "out", ground_truth=late)
    assert outcome.evaluation is None
    assert "1000.000" in manifest(tmp_path / "out")["problems"][0], "both time ranges are named"
    assert set(json.loads((tmp_path / "out" / "evaluation.json").read_text())) == ONLY_MAP


def test_values_are_checked_before_any_scan_is_read(tmp_path: Path) -> None:
    stub = sample(5)
    for setting, way_out in (("odometry.method=ipc", "did you mean 'icp'"), ("eval.delta=['5furlong']", "10m/all")):
        with pytest.raises(UsageError, match=way_out):
            lslam.run(stub, config(setting), out=tmp_path / "out")
    assert stub.reads == []
    assert not (tmp_path / "out").exists()


def test_no_tr_means_lidar_poses_and_the_manifest_says_so(tmp_path: Path) -> None:
    stub = sample(5)
    lslam.run(replace(stub, calibration=replace(stub.calibration, T_cam0_lidar=None)), out=tmp_path / "out")
    assert manifest(tmp_path / "out")["frames"]["trajectory_kitti.txt"] == "LiDAR (no Tr is known)"
    first, last = np.loadtxt(tmp_path / "out" / "trajectory_kitti.txt")[[0, -1]]
    np.testing.assert_allclose(first, np.eye(4)[:3].ravel(), atol=1e-9)
    assert last[3] > 2, "the LiDAR drives along its x"


def test_unknown_motion_within_scans_is_said_loudly(tmp_path: Path) -> None:
    for compensated, words in ((None, "not known"), (False, "is not")):
        out = tmp_path / str(compensated)
        lslam.run(replace(sample(4), motion_compensated=compensated), out=out)
        assert words in manifest(out)["frames"]["deskew"]
        assert "WARNING no deskew" in (out / "log.txt").read_text()


def test_switched_off_outputs_are_not_written(tmp_path: Path) -> None:
    lslam.run(sample(5), config("map.write=false", "report.html=false"), out=tmp_path / "out")
    assert names(tmp_path / "out") == ALL - {"map.ply", "map.json", "report.html"}
    lslam.run(sample(5), config("map.format=pcd"), out=tmp_path / "pcd")
    assert "map.pcd" in names(tmp_path / "pcd")


@pytest.mark.usefixtures("starts_sought_anew")
def test_threads_and_repetition_change_no_byte(tmp_path: Path) -> None:
    stub = with_points(sample(25), 12, noise(3))
    seen: list[dict[str, bytes]] = []
    for threads in (1, 2, 4, 2):
        out = tmp_path / f"run{len(seen)}"
        lslam.run(stub, config(f"input.threads={threads}"), out=out)
        files = ("trajectory.tum", "trajectory_kitti.txt", "covariances.npz", "map.ply", "evaluation.json")
        seen.append({name: (out / name).read_bytes() for name in files})
    for other in seen[1:]:
        for name, data in seen[0].items():
            assert other[name] == data, f"{name} depends on the threads or the repetition"
