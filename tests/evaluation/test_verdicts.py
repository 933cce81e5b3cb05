"""Verdicts on studies of known truth: each turns when the data does, and says undecided where the data says nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from study_rows import rows_of

from lslam.config.finding import Finding
from lslam.evaluation.sensitivity import evaluate_study
from lslam.types.sensitivity import Verdict
from lslam.types.study import StudyRow

SKIPS = range(1, 21)
DISTANCES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
GRID = (0.1, 0.3, 0.5, 0.8, 1.0, 1.5, 2.0, 3.0, 5.0)


def verdict(rows: list[StudyRow], kind: str, *values: float, **more: Any) -> Verdict:
    finding = Finding.model_validate({"text": "So it is.", "kind": kind, "values": values, **more})
    return evaluate_study(rows, [finding])[0].verdicts[0]


def outcome(rows: list[StudyRow], kind: str, *values: float, **more: Any) -> str:
    return verdict(rows, kind, *values, **more).outcome


def test_divergence() -> None:
    at_8 = rows_of(SKIPS, diverges=lambda v: v > 7)
    assert outcome(at_8, "diverges_beyond", 7) == "confirmed"
    assert outcome(at_8, "diverges_beyond", 8) == "confirmed", "a neighbour"
    assert outcome(at_8, "diverges_beyond", 9) == "refuted"
    assert outcome(rows_of(SKIPS), "diverges_beyond", 7) == "refuted"
    assert outcome(rows_of(range(1, 7)), "diverges_beyond", 7) == "undecided"
    assert "everything diverges" in verdict(rows_of(SKIPS, diverges=lambda v: True), "diverges_beyond", 7).measured


def test_holding_up() -> None:
    assert outcome(rows_of(SKIPS), "holds_up_to", 20) == "confirmed"
    assert outcome(rows_of(SKIPS, diverges=lambda v: v > 17), "holds_up_to", 20) == "refuted"
    assert outcome(rows_of(SKIPS, diverges=lambda v: v > 17), "holds_up_to", 15) == "confirmed"
    assert outcome(rows_of(range(1, 10)), "holds_up_to", 20) == "undecided"
    once = verdict(rows_of(SKIPS, diverges=lambda v: v == 5), "holds_up_to", 20)
    assert once.outcome == "undecided"
    assert once.measured == "nothing diverges for good, though 3 of 3 runs at 5 are lost"


def test_runs_lost_where_most_seeds_hold_are_told() -> None:
    rows = rows_of(SKIPS)
    one = [replace(r, status="diverged") if r.seed == 1 and r.parameters["input.skip_frames"] > 18 else r for r in rows]
    at_20 = verdict(one, "holds_up_to", 20)
    assert (at_20.outcome, at_20.measured) == ("confirmed", "it holds up to 20, though 2 of 6 runs at 19, 20 are lost")
    assert verdict(one, "holds_up_to", 18).measured == "nothing diverges up to 18"
    beyond = verdict(one, "diverges_beyond", 7).measured
    assert beyond == "it holds up to 20, the largest value, though 2 of 6 runs at 19, 20 are lost"
    rows = rows_of(SKIPS, diverges=lambda v: v > 12)
    some = [
        replace(r, status="diverged") if r.seed == 2 and r.parameters["input.skip_frames"] == 9 else r for r in rows
    ]
    assert (
        verdict(some, "diverges_beyond", 7).measured
        == "12 is the last value that works, though 1 of 3 runs at 9 is lost"
    )
    assert verdict(some, "holds_up_to", 20).measured == "it diverges from 13 on, though 1 of 3 runs at 9 is lost"
    none = rows_of(SKIPS, diverges=lambda v: True)
    assert verdict(none, "holds_up_to", 20).measured == "it diverges from 1 on"


@pytest.mark.parametrize("kind", ["diverges_beyond", "holds_up_to", "good_from"])
def test_value_whose_runs_all_failed_is_not_one_that_was_run(kind: str) -> None:
    """They came to 12 scans at most, so nothing is known at 13 and from there on."""
    failed = {"status": "failed", "reason": "disk full", "stages_ms": {}}
    rows = [replace(r, **failed) if r.parameters["input.skip_frames"] > 12 else r for r in rows_of(SKIPS)]
    found = verdict(rows, kind, 13)
    assert found.outcome == "undecided"
    assert "12" in found.measured


@pytest.mark.parametrize(
    ("kind", "values"), [("diverges_beyond", [1]), ("best_between", [0, 1]), ("good_from", [0]), ("linear", [])]
)
def test_words_are_no_places_on_an_axis(kind: str, values: list[float]) -> None:
    words = rows_of(["a", "b", "c", "d", "e", "f", "g"], "preprocess.downsample", error=lambda v: 0.5)
    found = verdict(words, kind, *values)
    assert found.outcome == "undecided"
    assert found.measured == "preprocess.downsample is not a number"
    assert outcome(words, "matters_little", 1.5, of="translation") == "confirmed"


def test_best_value() -> None:
    valley = rows_of(GRID, "loam.grid_step", error=lambda v: 0.2 + (v - 1.5) ** 2)
    assert outcome(valley, "best_between", 1, 2) == "confirmed"
    assert outcome(valley, "best_between", 3, 5) == "refuted"
    assert outcome(valley, "best_between", 1, 2, of="translation") == "confirmed"
    nearly = rows_of(GRID, "loam.grid_step", error=lambda v: 0.2 if v == 0.8 else 0.21 if 1 <= v <= 2 else 0.9)
    assert outcome(nearly, "best_between", 1, 2) == "undecided"
    assert outcome(rows_of((1, 2)), "best_between", 1, 2) == "undecided"


def test_best_value_of_one_lucky_seed_changes_nothing() -> None:
    rows = rows_of(GRID, "loam.grid_step", error=lambda v: 1 / (1 + v))
    lucky = [replace(r, thesis_rmse=0.01) if r.seed == 0 and r.parameters["loam.grid_step"] == 1 else r for r in rows]
    assert outcome(rows, "best_between", 1, 2) == outcome(lucky, "best_between", 1, 2) == "refuted"


@pytest.mark.parametrize(("first", "agree"), [(0.1, 0), (1.5, 1)])
def test_best_value_that_is_best_in_few_seeds_is_not_confirmed(first: float, agree: int) -> None:
    # 1.5 is the second best of two seeds at least, and each seed has another best.
    best = {0: first, 1: 3.0, 2: 5.0}
    rows = [
        replace(r, thesis_rmse=0.1 if v == best[r.seed] else 0.2 if v == 1.5 else 1.0)
        for r in rows_of(GRID, "loam.grid_step")
        for v in r.parameters.values()
    ]
    found = verdict(rows, "best_between", 1, 2)
    assert found.outcome == "undecided"
    assert "best at 1.5" in found.measured
    assert f"in {agree} of 3 seeds only" in found.measured


def test_best_value_is_not_where_most_runs_are_lost() -> None:
    valley = rows_of(GRID, "loam.grid_step", error=lambda v: 0.2 + (v - 1.5) ** 2, total=lambda v: 1 + (v - 1.5) ** 2)
    lucky = [
        replace(r, thesis_rmse=0.01 if r.seed == 2 else 80.0) if r.parameters["loam.grid_step"] == 5 else r
        for r in valley
    ]
    assert outcome(lucky, "best_between", 1, 2, of="translation") == "confirmed"
    fast = [
        replace(r, thesis_rmse=80.0, total_time_s=0.1) if r.parameters["loam.grid_step"] == 5 else r for r in valley
    ]
    assert outcome(fast, "best_between", 1, 2, of="total_time") == "confirmed"


def test_elbow_is_not_moved_by_one_unlucky_seed() -> None:
    rows = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v >= 0.2 else 1.9)
    unlucky = [
        replace(r, thesis_rmse=2.0) if r.seed == 1 and r.parameters["imu.inlier_distance"] == 1 else r for r in rows
    ]
    assert outcome(unlucky, "good_from", 0.2) == "confirmed"


def test_largest_value() -> None:
    rising = rows_of([0.2, 0.4, 0.6, 0.8, 1.0], "icp.ratio", total=lambda v: 10 * v)
    assert outcome(rising, "largest_between", 1, 1, of="total_time") == "confirmed"
    falling = rows_of([0.2, 0.4, 0.6, 0.8, 1.0], "icp.ratio", total=lambda v: 10 / v)
    assert outcome(falling, "largest_between", 1, 1, of="total_time") == "refuted"


def test_elbow() -> None:
    at_02 = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v >= 0.2 else 1.9, noise=0.02)
    assert outcome(at_02, "elbow_at", 0.2) == "confirmed"
    assert outcome(at_02, "elbow_at", 1.0) == "refuted"
    assert outcome(at_02, "good_from", 0.5) == "confirmed"
    assert outcome(at_02, "good_from", 0.1) == "refuted"
    assert outcome(at_02, "good_from", 0.05) == "undecided"
    flat = rows_of(DISTANCES, "imu.inlier_distance")
    assert outcome(flat, "elbow_at", 0.2) == "refuted"
    assert outcome(flat, "elbow_at", 0.1) == "undecided"
    unsteady = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v < 1.5 else 2)
    assert {outcome(unsteady, "elbow_at", 0.2), outcome(unsteady, "good_from", 0.2)} == {"refuted"}


def test_a_bound_needs_values_below_it_that_are_worse() -> None:
    """That errors rise only below a share of 0.2 is not shown by a plateau that begins at the smallest value run."""
    flat = rows_of(DISTANCES, "imu.inlier_distance", noise=0.02)
    found = verdict(flat, "good_from", 0.3)
    assert (found.outcome, "below 0.3 it is as good" in found.measured) == ("refuted", True)
    assert outcome(flat, "good_from", 0.1) == "undecided", "nothing was run below"
    rises = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v >= 0.3 else 0.7, noise=0.02)
    assert outcome(rises, "good_from", 0.3) == "confirmed"
    assert outcome([r for r in rises if r.seed == 0], "good_from", 0.3) == "undecided", "one seed has no scatter"
    lost = rows_of(DISTANCES, "imu.inlier_distance", diverges=lambda v: v < 0.2)
    assert outcome(lost, "good_from", 0.2) == "confirmed"
    # One seed of three is worse below, by so much that the mean is too.
    unlucky = [
        replace(r, thesis_rmse=1.0) if r.seed == 0 and r.parameters["imu.inlier_distance"] < 0.3 else r for r in flat
    ]
    assert outcome(unlucky, "good_from", 0.3) == "refuted"


def test_a_range_needs_values_beside_it() -> None:
    falling = rows_of((1.0, 1.5, 2.0), "loam.grid_step", error=lambda v: 1 / v)
    assert outcome(falling, "best_between", 1, 2) == "undecided"
    assert outcome(falling, "best_between", 1.5, 3) == "undecided", "nothing was run above"
    assert outcome(falling, "best_between", 1.5, 2) == "confirmed", "the range ends where the values do"
    assert outcome(falling, "largest_between", 0.5, 1.5, of="translation") == "undecided"


def test_little_influence() -> None:
    flat = rows_of(SKIPS, error=lambda v: 0.5 + 0.005 * v)
    assert outcome(flat, "matters_little", 1.5, of="translation") == "confirmed"
    assert outcome(rows_of(SKIPS, error=lambda v: 0.1 * v), "matters_little", 1.5, of="translation") == "refuted"
    lost = verdict(rows_of(SKIPS, diverges=lambda v: v == 5), "matters_little", 1.5, of="translation")
    assert lost.outcome == "refuted"
    assert "diverges at 5" in lost.measured
    assert outcome(rows_of([1, 2]), "matters_little", 1.5) == "undecided"


def test_laws() -> None:
    hyperbola = rows_of(SKIPS, total=lambda v: 46.82 / v, noise=0.02)
    line = rows_of(SKIPS, total=lambda v: 5 + 2 * v, noise=0.02)
    assert outcome(hyperbola, "inverse") == "confirmed"
    assert outcome(hyperbola, "linear") == "refuted"
    assert outcome(line, "inverse") == "refuted"
    assert outcome(line, "linear") == "confirmed"
    assert outcome(hyperbola[:15], "inverse") == "undecided"
    assert "R2 1.000" in verdict(rows_of(SKIPS, total=lambda v: 46.82 / v), "inverse", 0.99).measured


def test_product_law() -> None:
    rows, sums = [], []
    for share in (0.1, 0.5, 1.0):
        more: dict[str, Any] = {"at": {"preprocess.random_share": share}, "noise": 0.02}
        rows += rows_of([1, 2, 4], total=lambda v, ds=share: 152 * ds / v, **more)
        sums += rows_of([1, 2, 4], total=lambda v, ds=share: 5 + ds + v, **more)
    assert outcome(rows, "product") == "confirmed"
    assert outcome(sums, "product") == "refuted"
    assert outcome(rows[:9], "product") == "undecided"


def test_stage_that_a_parameter_acts_on() -> None:
    on_scan = rows_of(GRID, "loam.grid_step", stages=lambda v: {"scan": 50 / v, "map": 20.0, "keyframe": 90 / v})
    on_both = rows_of(GRID, "loam.grid_step", stages=lambda v: {"scan": 50 / v, "map": 50 / v})
    assert outcome(on_scan, "acts_only_on", stages=["scan"]) == "confirmed"
    assert outcome(on_scan, "acts_only_on", stages=["scan", "recover"]) == "confirmed"
    assert outcome(on_scan, "acts_only_on", stages=["map"]) == "refuted"
    assert outcome(on_both, "acts_only_on", stages=["scan"]) == "refuted"
    assert outcome(rows_of(GRID, "loam.grid_step"), "acts_only_on", stages=["register"]) == "undecided"
    hardly = rows_of(GRID, "loam.grid_step", stages=lambda v: {"scan": 50 + v, "map": 20.0})
    assert outcome(hardly, "acts_only_on", stages=["scan"]) == "undecided"
    assert "no stage maps was timed" in verdict(on_scan, "acts_only_on", stages=["maps"]).measured


def test_times_of_runs_that_shared_the_machine_decide_nothing() -> None:
    rows = rows_of(SKIPS, total=lambda v: 46.82 / v, is_timing_comparable=False)
    found = verdict(rows, "inverse")
    assert found.outcome == "undecided"
    assert "shared the machine" in found.measured
    assert outcome(rows, "matters_little", 1.5, of="translation") == "confirmed"
    flat = rows_of(SKIPS, is_timing_comparable=False)
    assert outcome(flat, "matters_little", 1.5, of="total_time") == "undecided"
    alone = rows_of(SKIPS, total=lambda v: 46.82 / v)
    failed = replace(alone[0], seed=3, status="failed", is_timing_comparable=False)
    assert outcome([*alone, failed], "inverse") == "confirmed"


def test_curves_that_disagree_leave_it_undecided_unless_the_finding_names_one() -> None:
    rows = rows_of(SKIPS, diverges=lambda v: v > 7) + rows_of(SKIPS, uses_imu=True)
    both = verdict(rows, "holds_up_to", 20)
    assert both.outcome == "undecided"
    assert both.sentence == (
        "undecided: So it is; here thesis-icp: it diverges from 8 on; thesis-icp+imu: nothing diverges up to 20"
    )
    assert outcome(rows, "holds_up_to", 20, imu=True) == "confirmed"
    assert outcome(rows, "holds_up_to", 20, imu=False) == "refuted"
    assert outcome(rows, "holds_up_to", 20, method="loam") == "undecided"


def test_finding_at_a_value_of_the_other_parameter() -> None:
    near = rows_of(DISTANCES, "imu.inlier_distance", at={"input.skip_frames": 4}, error=lambda v: 0.5 + 2 * (v < 0.2))
    far = rows_of(DISTANCES, "imu.inlier_distance", at={"input.skip_frames": 20}, error=lambda v: 0.5 + 2 * (v < 1))
    assert outcome(near + far, "elbow_at", 1.0, at={"input.skip_frames": 20}) == "confirmed"
    assert outcome(near + far, "elbow_at", 1.0, at={"input.skip_frames": 4}) == "refuted"


@pytest.mark.parametrize("kind", ["diverges_beyond", "holds_up_to", "good_from"])
def test_study_without_a_usable_run_decides_nothing(kind: str) -> None:
    rows = [replace(row, status="failed", reason="no data", stages_ms={}) for row in rows_of(SKIPS)]
    assert outcome(rows, kind, 5) == "undecided"
