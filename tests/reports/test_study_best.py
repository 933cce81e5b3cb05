"""The best point of each method, and the table of a batch."""

from __future__ import annotations

from dataclasses import replace
from math import nan

import pytest

from lslam.core.types.study import StudyRow
from lslam.reports.study_table import batch_table, best_points, best_table


def row(skip: int, error: float, seed: int = 0, **more: object) -> StudyRow:
    made = StudyRow(
        f"{skip}-{seed}", "study", "open", seed, "icp", parameters={"input.skip_frames": skip}, status="done",
        thesis_rmse=error, metric="thesis_rmse", angular_rmse_deg=1.0, total_time_s=2.0,
    )  # fmt: skip
    return replace(made, **more)  # type: ignore[arg-type]


def test_the_best_point_has_the_least_mean_error_over_its_seeds() -> None:
    (best,) = best_points([row(1, 0.1), row(1, 0.9, 1), row(2, 0.3), row(2, 0.4, 1)])
    assert [r.run for r in best.point] == ["2-0", "2-1"]
    assert best.mean("thesis_rmse") == pytest.approx(0.35)


@pytest.mark.parametrize("status", ["diverged", "failed", "crashed"])
def test_a_point_that_fails_for_one_seed_is_not_the_best(status: str) -> None:
    (best,) = best_points([row(1, 0.1), row(1, 0.1, 1, status=status), row(2, 0.4)])
    assert (best.runs, best.failures, best.point[0].run) == (3, 1, "2-0")


def test_with_and_without_imu_and_beside_stand_apart_in_words() -> None:
    rows = [row(1, 0.1), row(1, 0.2, uses_imu=True), row(0, 0.3, is_beside=True, parameters={})]
    assert best_table(rows)[1:] == [
        ["open", "icp", "1", "0", "skip_frames 1", "0.100", "1.00", "2.00"],
        ["open", "icp+imu", "1", "0", "skip_frames 1", "0.200", "1.00", "2.00"],
        ["open", "icp (beside)", "1", "0", "its own values", "0.300", "1.00", "2.00"],
    ]


def test_without_ground_truth_or_without_a_usable_run_there_is_no_best() -> None:
    for rows in ([row(1, nan)], [row(1, 0.1, status="diverged")]):
        assert best_table(rows)[1][4:] == ["-", "-", "-", "-"]


def test_a_batch_shows_where_a_run_lies_or_why_it_failed() -> None:
    done = row(1, 0.1, ate_se3=0.25, run_s=3.0, scans=7, stages_ms={"a": 1.0, "b": 2.5}, folder="runs/1")
    failed = row(1, nan, status="failed", reason="no scans", run_s=0.5)
    assert batch_table([done, failed])[1:] == [
        ["open", "icp", "done", "7", "0.250", "3.5", "3.0", "runs/1"],
        ["open", "icp", "failed", "0", "-", "-", "0.5", "no scans"],
    ]
