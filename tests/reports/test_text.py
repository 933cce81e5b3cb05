"""The summary on stdout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lslam.core.config.outputs import EvalConfig
from lslam.core.types.run_record import RunRecord
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.reports.facts import describe, run_facts, stage_matrix
from lslam.reports.html import render_report
from lslam.reports.text import summary

MakeRecord = Callable[..., RunRecord]


def lines(text: str) -> dict[str, str]:
    """First line of each name -> value."""
    found: dict[str, str] = {}
    for line in text.splitlines()[1:]:
        found.setdefault(line[2:14].strip(), line[15:])
    return found


def test_scores_stand_with_their_recipes(make_record: MakeRecord) -> None:
    record = make_record(90)
    assert record.ground_truth is not None
    evaluation = evaluate(record.trajectory, record.ground_truth, EvalConfig(metrics=("thesis",)))
    text = summary(record, evaluation)
    assert "thesis" not in summary(record, replace(evaluation, words=()))
    se3 = evaluation.ate["se3"].translation
    assert se3 is not None
    found = lines(text)
    assert text.startswith("drive, icp\n")
    assert found["status"] == "done"
    assert found["scans"] == "90 of 90 registered"
    assert found["path"].startswith("133.")
    assert found["ATE se3"].startswith(f"{se3.rmse:.3f} m rmse")
    assert "Umeyama" in found["ATE se3"]
    assert "90 of 90 poses" in found["ATE se3"]
    assert f"{evaluation.scores['kitti_drift'].segments} segments" in found["KITTI drift"]
    assert "origin alignment" in found["thesis1"]
    assert "planar" in found["thesis2"]
    assert text.count("pairs, n = ") == 2


def test_times_are_those_of_the_stages(make_record: MakeRecord) -> None:
    found = lines(summary(make_record(100), None))
    assert found["time"] == ("10.5 ms per scan (median), p95 10.9, max 11.0: read 2.0, preprocess 3.0, register 5.5")
    # 100 scans at 10 Hz are 10 s; their stages take 1.0495 s.
    assert found["real time"] == "9.5 times as fast as the sensor; 0 of 100 scans over the limit of 100 ms"


def test_failures_are_named_and_counted(make_record: MakeRecord) -> None:
    bad = {i: ("bridged", f"reason {i}") for i in range(10, 18)} | {3: ("skipped", "")}
    text = summary(make_record(40, bad=bad, problems=["9 scans failed"], manifest={"status": "degraded"}), None)
    assert "31 of 40 registered, 8 bridged, 1 skipped" in text
    assert "scan 3 skipped: reason not given" in text
    assert "scan 13 bridged: reason 13" in text
    assert "reason 17" not in text
    assert "and 4 more: see the report" in text
    assert "9 scans failed" in text


def test_errors_without_truth(make_record: MakeRecord) -> None:
    assert lines(summary(make_record(5, with_truth=False), None))["errors"] == "not stated: no ground truth is known"
    assert "could not be compared" in lines(summary(make_record(5), None))["errors"]


def test_only_files_that_exist_are_named(make_record: MakeRecord) -> None:
    record = make_record(5)
    (record.folder / "map.pcd").touch()
    found = lines(summary(record, None))
    assert found["map"] == str(record.folder / "map.pcd")
    assert "report" not in found


def test_a_run_that_writes_nothing_names_no_file_of_another(
    make_record: MakeRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trajectory.tum").write_text("")
    (tmp_path / "config.toml").write_text("an-other-run = 1")
    monkeypatch.chdir(tmp_path)
    record = make_record(5, folder=None)
    assert "trajectory.tum" not in summary(record, None)
    assert "an-other-run" not in render_report(record, None)


@pytest.mark.parametrize("scans", [0, 1, 2])
def test_very_short_runs(make_record: MakeRecord, scans: int) -> None:
    record = make_record(max(scans, 1))
    if scans == 0:
        record = replace(record, results=[], trajectory=Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))))
    found = lines(summary(record, None))
    assert found["scans"] == f"{scans} of {scans} registered"
    assert found["path"] == f"{1.5 * max(scans - 1, 0):.1f} m in {0.1 * max(scans - 1, 0):.1f} s"
    assert ("real time" in found) == (scans > 0)


def test_status_falls_back_on_what_the_record_shows(make_record: MakeRecord) -> None:
    assert run_facts(make_record(5, manifest={})).status == "done"
    assert run_facts(make_record(5, manifest={}, bad={2: ("bridged", "x")})).status == "degraded"
    facts = run_facts(
        make_record(5, manifest={"status": "failed", "why": "disk full", "problems": ["p"]}, problems=["p"])
    )
    assert (facts.status, facts.reasons) == ("failed", ("p", "disk full"))
    assert not facts.is_flawless


def test_the_time_saved_by_the_imu_is_reported_with_its_sample(make_record: MakeRecord) -> None:
    imu = {
        "used": True, "prior_error_m": 0.01, "constant_velocity_error_m": 0.05, "mean_iterations": 2.2, "compared_scans": 3,
        "compared_iterations": 2.0, "constant_velocity_iterations": 5.3, "saved_ms_per_scan": 4.2,
    }  # fmt: skip

    def said(**changes: object) -> str:
        return summary(make_record(5, manifest={"imu": {**imu, **changes}}), None)

    assert "2.2 iterations per scan; on 3 scans 2.0 of the 5.3 that constant velocity takes" in said()
    assert "4.2 ms per scan saved with the IMU's own work counted" in said()
    assert "1.5 ms per scan lost" in said(saved_ms_per_scan=-1.5)
    assert "compare --imu both" in said(compared_scans=0)


def test_stages_differ_between_scans(make_record: MakeRecord) -> None:
    results = make_record(3).results
    results[1] = replace(results[1], stages={"read": 0.5, "loops": 2.0})
    names, seconds = stage_matrix(results)
    assert names == ["read", "preprocess", "register", "loops"]
    assert seconds[1].tolist() == [0.5, 0.0, 0.0, 2.0]
    assert seconds[2, 3] == 0.0


def test_degenerate_directions_are_named() -> None:
    assert describe(np.array([[0, 0, -1.0, 0, 0, 0], [0, 0.1, 0, 0.9, 0, 0]])) == "along z, about x"


def test_crispness_is_stated_with_and_without_truth(make_record: MakeRecord) -> None:
    from lslam.core.types.run_record import Crispness
    from lslam.reports.evaluations import run_document

    record = make_record(5)
    assert run_document(record, None) is None
    assert "crispness" not in summary(record, None)
    record = replace(record, crispness=Crispness(-4.21, 0.0009, 480, 500, 1000, 0.5, 10))
    assert "map entropy -4.210, planes 0.030" in summary(record, None)
    document = run_document(record, None)
    assert document is not None
    assert "ate" not in document
    assert document["map"]["entropy"] == -4.21
    assert abs(document["map"]["plane_thickness_m"] - 0.03) < 1e-12
    assert "480 neighbourhoods of 0.5 m" in document["map"]["recipe"]
    empty = replace(record, crispness=Crispness(None, None, 0, 0, 0, 0.5, 10))
    assert "crispness" not in summary(empty, None)
