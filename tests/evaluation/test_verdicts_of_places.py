"""Verdicts on studies whose divergence, best value and plateau are known: each turns when the data do."""

from __future__ import annotations

import math
from dataclasses import replace
from math import nan
from typing import Any

import pytest
from study_rows import by_seed, outcome, rows_of, verdict

SKIPS = range(1, 21)
DISTANCES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
GRID = (0.1, 0.3, 0.5, 0.8, 1.0, 1.5, 2.0, 3.0, 5.0)


def test_divergence() -> None:
    at_8 = rows_of(SKIPS, diverges=lambda v: v > 7)
    assert outcome(at_8, "diverges_beyond", 7) == "confirmed"
    assert outcome(at_8, "diverges_beyond", 7.5) == "confirmed"
    assert {outcome(at_8, "diverges_beyond", v) for v in (6, 8)} == {"undecided"}, "a step beside it"
    assert outcome(at_8, "diverges_beyond", 50) == "refuted"
    at_20 = rows_of(SKIPS, diverges=lambda v: v > 19)
    assert outcome(at_20, "diverges_beyond", 50) == "refuted", "no value is taken for the nearest that was run"
    assert outcome(rows_of(SKIPS, diverges=lambda v: v > 1), "diverges_beyond", 0.1) == "refuted", "1 works"
    assert outcome(rows_of(SKIPS, diverges=lambda v: True), "diverges_beyond", 0.1) == "undecided", "nothing works"
    assert outcome(rows_of(range(1, 11), diverges=lambda v: v in (3, 8, 9, 10)), "diverges_beyond", 7) == "undecided"
    assert outcome(at_8, "diverges_beyond", 9) == "refuted"
    assert outcome(rows_of(SKIPS), "diverges_beyond", 7) == "refuted"
    assert outcome(rows_of(range(1, 7)), "diverges_beyond", 7) == "undecided"
    assert "everything diverges" in verdict(rows_of(SKIPS, diverges=lambda v: True), "diverges_beyond", 7).numbers


def test_holding_up() -> None:
    assert outcome(rows_of(SKIPS), "holds_up_to", 20) == "confirmed"
    assert outcome(rows_of(SKIPS, diverges=lambda v: v > 17), "holds_up_to", 20) == "refuted"
    assert outcome(rows_of(SKIPS, diverges=lambda v: v > 17), "holds_up_to", 15) == "confirmed"
    assert outcome(rows_of(range(1, 10)), "holds_up_to", 20) == "undecided"
    assert outcome(rows_of((1, 10, 30), diverges=lambda v: v > 10), "holds_up_to", 20) == "undecided", "a gap"
    assert outcome(rows_of(SKIPS, diverges=lambda v: True), "holds_up_to", 0.5) == "undecided", "nothing holds"
    once = verdict(rows_of(SKIPS, diverges=lambda v: v == 5), "holds_up_to", 20)
    assert once.outcome == "undecided"
    assert once.numbers == "nothing diverges for good, though 3 of 3 runs at 5 are lost"


def test_runs_lost_where_most_seeds_succeed_are_counted() -> None:
    rows = rows_of(SKIPS)
    one = [replace(r, status="diverged") if r.seed == 1 and r.parameters["input.skip_frames"] > 18 else r for r in rows]
    at_20 = verdict(one, "holds_up_to", 20)
    assert (at_20.outcome, at_20.numbers) == ("confirmed", "it holds up to 20, though 2 of 6 runs at 19, 20 are lost")
    assert verdict(one, "holds_up_to", 18).numbers == "nothing diverges up to 18"
    beyond = verdict(one, "diverges_beyond", 7).numbers
    assert beyond == "it holds up to 20, the largest value, though 2 of 6 runs at 19, 20 are lost"
    rows = rows_of(SKIPS, diverges=lambda v: v > 12)
    some = [
        replace(r, status="diverged") if r.seed == 2 and r.parameters["input.skip_frames"] == 9 else r for r in rows
    ]
    assert (
        verdict(some, "diverges_beyond", 7).numbers
        == "12 is the last value that works, though 1 of 3 runs at 9 is lost"
    )
    assert verdict(some, "holds_up_to", 20).numbers == "it diverges from 13 on, though 1 of 3 runs at 9 is lost"
    none = rows_of(SKIPS, diverges=lambda v: True)
    assert verdict(none, "holds_up_to", 20).numbers == "it diverges from 1 on"


@pytest.mark.parametrize("kind", ["diverges_beyond", "holds_up_to", "good_from"])
@pytest.mark.parametrize(
    "failed",
    [{"status": "failed", "reason": "disk full", "stages_ms": {}}, {"reason": "not scored", "thesis_rmse": nan}],
)
def test_value_whose_runs_all_failed_or_have_no_error_is_not_one_that_was_run(
    kind: str, failed: dict[str, Any]
) -> None:
    """They came to 12 scans at most, so nothing is known at 13 and from there on."""
    rows = [replace(r, **failed) if r.parameters["input.skip_frames"] > 12 else r for r in rows_of(SKIPS)]
    found = verdict(rows, kind, 13)
    assert found.outcome == "undecided"
    assert "12" in found.numbers


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
    assert "best at 1.5" in found.numbers
    assert f"in {agree} of 3 seeds only" in found.numbers


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


def test_a_range_needs_values_beside_it() -> None:
    falling = rows_of((1.0, 1.5, 2.0), "loam.grid_step", error=lambda v: 1 / v)
    assert outcome(falling, "best_between", 1, 2) == "undecided"
    assert outcome(falling, "best_between", 1.5, 3) == "undecided", "nothing was run above"
    assert outcome(falling, "best_between", 1.5, 2) == "confirmed", "the range ends where the values do"
    assert outcome(falling, "largest_between", 0.5, 1.5, of="translation") == "undecided"


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
    assert outcome(at_02, "elbow_at", 0.3) == "undecided", "a step beside it"
    assert outcome(at_02, "elbow_at", 0.5) == "refuted"
    at_15 = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v >= 1 else 1.9, noise=0.02)
    assert outcome(at_15, "elbow_at", 0.7) == "undecided", "a step beside it, on the other side"
    later = verdict(at_15, "elbow_at", 0.5)
    assert (later.outcome, "below" in later.numbers) == ("refuted", False)
    assert outcome(at_15, "elbow_at", 100) == "undecided", "no value is taken for the nearest that was run"
    flat = rows_of(DISTANCES, "imu.inlier_distance")
    assert outcome(flat, "elbow_at", 0.2) == "refuted"
    assert outcome(flat, "elbow_at", 0.1) == "undecided"
    unsteady = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v < 1.5 else 2)
    assert {outcome(unsteady, "elbow_at", 0.2), outcome(unsteady, "good_from", 0.2)} == {"refuted"}


def test_elbow_is_not_moved_by_one_unlucky_seed() -> None:
    rows = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v >= 0.2 else 1.9)
    unlucky = [
        replace(r, thesis_rmse=2.0) if r.seed == 1 and r.parameters["imu.inlier_distance"] == 1 else r for r in rows
    ]
    assert outcome(unlucky, "good_from", 0.2) == "confirmed"


def test_a_bound_needs_values_below_it_that_are_worse() -> None:
    """That errors rise only below a share of 0.2 is not shown by a plateau that begins at the smallest value run."""
    flat = rows_of(DISTANCES, "imu.inlier_distance", noise=0.02)
    found = verdict(flat, "good_from", 0.3)
    assert (found.outcome, "below 0.3 it is as good" in found.numbers) == ("refuted", True)
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
    assert outcome(unlucky, "good_from", 0.3) == "undecided"


def test_a_range_in_which_no_value_was_run_is_undecided() -> None:
    rows = rows_of(GRID, "loam.grid_step", error=lambda v: 0.2 + v)
    assert outcome(rows, "best_between", 3.5, 4.5, of="translation") == "undecided"
    assert outcome(rows, "best_between", 2.5, 4.5, of="translation") == "refuted"


def test_a_range_whose_runs_are_all_lost_is_not_the_best_one() -> None:
    rows = rows_of(GRID, "loam.grid_step", error=lambda v: 0.2 + 0.1 * v, diverges=lambda v: 1 <= v <= 2)
    assert outcome(rows, "best_between", 1, 2, of="translation") == "refuted"
    assert outcome(rows, "largest_between", 3, 5, of="translation") == "refuted", "lost runs have the largest error"
    assert outcome(rows, "largest_between", 3, 5, of="total_time") == "undecided", "and nobody knows their time"


def test_a_flat_curve_has_no_best_range() -> None:
    flat = verdict(rows_of(GRID, "loam.grid_step", noise=0.01), "best_between", 1, 2, of="translation")
    assert flat.outcome == "refuted"
    assert "all values outside are as good" in flat.numbers
    half = rows_of(GRID, "loam.grid_step", error=lambda v: 1.0 if v < 1 else 0.5 + 0.001 * v, noise=0.001)
    found = verdict(half, "best_between", 1, 2, of="translation")
    assert found.outcome == "undecided"
    assert "on one side no value is worse" in found.numbers


def test_a_plateau_that_one_seed_leaves_decides_nothing() -> None:
    rows = rows_of(DISTANCES, "imu.inlier_distance", error=lambda v: 0.5 if v >= 0.2 else 1.9, noise=0.02)
    steep = by_seed(rows, lambda v, s: {"thesis_rmse": (0.3, 0.9, 0.9)[s]} if v == 1.5 else {})
    assert {outcome(steep, kind, 0.2) for kind in ("good_from", "elbow_at")} == {"undecided"}


def test_a_value_outside_that_seeds_call_better_but_their_median_does_not_leaves_it_undecided() -> None:
    at_08 = [math.exp(log) for log in (-0.25, -0.25, 0.01, -0.09, -0.09)]
    rows = by_seed(
        rows_of(GRID, "loam.grid_step", seeds=range(5)),
        lambda v, s: {"thesis_rmse": (1 + s) * (at_08[s] if v == 0.8 else 1.0 if 1 <= v <= 1.5 else 2.0)},
    )
    found = verdict(rows, "best_between", 1, 2, of="translation")
    assert found.outcome == "undecided"
    assert found.numbers.startswith("translation is best at 1 ")
