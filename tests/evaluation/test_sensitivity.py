"""Studies of known truth: curves, divergence, optimum, elbow, laws; failures are listed and not averaged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from study_rows import rows_of

from lslam.core.config.study import ExpectedFinding
from lslam.core.types.study import StudyRow
from lslam.evaluation.curves import curves_of, divergence, elbow, lost_above, optimum, registration_ms
from lslam.evaluation.sensitivity import evaluate_study

SKIPS = range(1, 21)


def test_curves_are_one_per_method_imu_and_second_parameter_in_order() -> None:
    rows = rows_of([3, 1, 2], at={"preprocess.random_share": 0.1}) + rows_of(
        [1, 2], at={"preprocess.random_share": 0.3}
    )
    rows += rows_of([1, 2], at={"preprocess.random_share": 0.1}, uses_imu=True)
    rows += [replace(rows[0], parameters={}, is_beside=True)]
    curves = curves_of(rows)
    assert [curve.label for curve in curves] == [
        "thesis-icp, random_share 0.1", "thesis-icp, random_share 0.3", "thesis-icp+imu, random_share 0.1",
    ]  # fmt: skip
    assert list(curves[0].values) == [1, 2, 3]
    assert curves[0].quantities["translation"].shape == (3, 3)


def test_registration_is_every_stage_but_those_around_it() -> None:
    row = StudyRow("r", "s", "q", 0, "loam", stages_ms={"read": 1, "prepare": 2, "scan": 4, "map": 8, "keyframe": 16})
    assert registration_ms(row) == 12
    assert np.isnan(registration_ms(replace(row, stages_ms={"read": 1.0})))


def test_run_is_lost_by_its_status_or_by_its_error() -> None:
    rows = rows_of(range(1, 11), error=lambda v: 30.0 if v > 8 else 0.5, diverges=lambda v: v == 5)
    assert lost_above(rows) == pytest.approx(5.0)
    assert lost_above(rows_of([1], error=lambda v: 0.02)) == 2.2
    curve = curves_of(rows)[0]
    assert list(curve.values[curve.loses_most]) == [5, 9, 10]
    assert (curve.quantities["efficiency"][4] == 0).all()
    found = divergence(curve)
    assert (found.last_good, found.first_bad, found.alone) == (8, 9, (5,))


def test_mean_is_of_the_runs_that_were_not_lost_but_a_lost_run_has_no_efficiency() -> None:
    rows = [replace(row, thesis_rmse=40.0) if row.seed == 1 else row for row in rows_of([1, 2, 3])]
    means = evaluate_study(rows)[0].results[0].means
    assert means["translation"].mean == pytest.approx([0.5] * 3)
    assert list(means["total_time"].n) == [2, 2, 2]
    assert list(evaluate_study(rows)[0].results[0].stage_means["register"].n) == [2, 2, 2]
    # Two of three runs have 1 / (0.5 m x 1 deg x 0.05 s), the lost one 0.
    assert means["efficiency"].mean == pytest.approx([40 * 2 / 3] * 3)


def test_divergence_needs_more_than_half_of_the_seeds() -> None:
    rows = rows_of(SKIPS)
    one = [replace(r, status="diverged") if r.parameters["input.skip_frames"] > 7 and r.seed == 0 else r for r in rows]
    two = [replace(r, status="diverged") if r.parameters["input.skip_frames"] > 7 and r.seed < 2 else r for r in rows]
    assert divergence(curves_of(one)[0]).first_bad is None
    assert divergence(curves_of(two)[0]).last_good == 7


def test_divergence_goes_by_most_of_the_values_that_were_run() -> None:
    curve = curves_of(rows_of(range(1, 13), diverges=lambda v: v in (8, 10, 11, 12)))[0]
    found = divergence(curve)
    assert (found.last_good, found.first_bad, found.alone) == (7, 8, ())
    rows = rows_of(range(1, 13), diverges=lambda v: v == 8)
    rows = [replace(r, status="crashed") if r.parameters["input.skip_frames"] > 8 else r for r in rows]
    assert divergence(curves_of(rows)[0]).first_bad == 8


def test_run_that_failed_for_another_reason_says_nothing_about_its_value() -> None:
    rows = [replace(r, status="failed", reason="disk full") if r.seed else r for r in rows_of(SKIPS)]
    result = evaluate_study(rows)[0]
    assert result.results[0].divergence.first_bad is None
    assert list(result.results[0].means["translation"].n) == [1] * 20
    assert {row.reason for row in result.failed} == {"disk full"}
    assert len(result.failed) == 40


def test_optimum_is_flat_over_what_is_at_most_a_tenth_worse() -> None:
    values = np.array([1.0, 2, 3, 4, 5, 6])
    best = optimum(values, np.array([5, 9.2, 10, 9.1, 8.9, 9.5]))
    assert best is not None
    assert (best.value, best.low, best.high) == (3, 2, 4)
    lowest = optimum(values, np.array([5.0, 4.0, 4.2, 6, np.nan, 0]), is_highest_best=False)
    assert lowest is not None
    assert (lowest.value, lowest.low, lowest.high) == (2, 2, 3)
    assert optimum(values, np.full(6, np.nan)) is None


def test_elbow_is_where_the_plateau_begins() -> None:
    values = np.array([0.1, 0.2, 0.3, 0.5, 1.0, 2.0])
    none = np.zeros(6, bool)
    assert elbow(values, np.array([9.0, 1.1, 1.0, 1.0, 0.9, 1.0]), none) == 0.2
    assert elbow(values, np.ones(6), none) == 0.1
    assert elbow(values, np.array([1.0, 1, 1, 1, 1, 5]), none) is None
    lost = np.array([True, False, False, False, False, False])
    assert elbow(values, np.array([np.nan, 1, 1, 1, 1, 1]), lost) == 0.2
    assert elbow(values, np.full(6, np.nan), np.ones(6, bool)) is None
    lost = np.array([False, True, False, False, False, False])
    assert elbow(values, np.array([1, np.nan, 1, 1, 1, 1]), lost) == 0.3


def test_efficiency_of_a_study_peaks_where_error_times_time_is_least() -> None:
    rows = rows_of(
        SKIPS, error=lambda v: 0.2 + 0.01 * (v - 6) ** 2, stages=lambda v: {"register": 50.0 + v}, noise=0.02
    )
    best = evaluate_study(rows)[0].results[0].optimum
    assert best is not None
    assert best.low <= 6 <= best.high
    assert 4 <= best.value <= 8


def test_optimum_is_not_where_one_seed_was_lucky() -> None:
    luck = {0: 0.01, 1: 0.9, 2: 0.9}
    rows = [
        replace(row, thesis_rmse=luck[row.seed]) if row.parameters["input.skip_frames"] == 3 else row
        for row in rows_of([1, 2, 3, 4], error=lambda v: 0.5 if v != 2 else 0.4)
    ]
    best = evaluate_study(rows)[0].results[0].optimum
    assert best is not None
    assert best.value == 2


def test_laws_of_total_time_follow_the_parameter() -> None:
    skip = evaluate_study(rows_of(SKIPS, total=lambda v: 46.82 / v, noise=0.03))[0].results[0]
    assert skip.law is not None
    assert skip.law.kind == "inverse"
    assert abs(skip.law.coefficients[0] - 46.82) <= skip.law.margins[0]
    share = evaluate_study(
        rows_of([i / 10 for i in range(1, 11)], "preprocess.random_share", total=lambda v: 36.81 * v + 0.3373)
    )[0].results[0]
    assert share.law is not None
    assert share.law.text == "T = 36.81 random_share + 0.3373"
    few = evaluate_study(rows_of(range(1, 6), total=lambda v: 46.82 / v))[0].results[0]
    assert few.law is None
    assert few.no_law == "no law from 5 values, 6 are needed"


@pytest.mark.parametrize("is_skip_first", [True, False])
def test_product_law_is_fitted_over_both_parameters_in_either_order(is_skip_first: bool) -> None:
    skip, share = "input.skip_frames", "preprocess.random_share"
    rows = []
    for fixed in (0.1, 0.3, 1.0) if is_skip_first else (1, 2, 4, 8):
        rows += (
            rows_of([1, 2, 4, 8], skip, total=lambda v, ds=fixed: 152.2 * ds / v, at={share: fixed})
            if is_skip_first
            else rows_of([0.1, 0.3, 1.0], share, total=lambda v, sf=fixed: 152.2 * v / sf, at={skip: fixed})
        )
    law = evaluate_study(rows)[0].products["thesis-icp"]
    assert law.text == "T = 152.2 random_share / skip_frames"
    assert law.r2 == pytest.approx(1)


@pytest.mark.parametrize("others", [("grid", "random", "voxel"), (False, True)])
def test_second_parameter_that_is_no_number_makes_no_product(others: tuple[str | bool, ...]) -> None:
    rows = [row for other in others for row in rows_of([1, 2, 4, 8], at={"preprocess.downsample": other})]
    assert evaluate_study(rows)[0].products == {}


def test_words_have_curves_and_no_law() -> None:
    result = evaluate_study(rows_of(["random", "grid"], "preprocess.downsample", error=lambda v: 0.5))[0].results[0]
    assert [result.curve.name_of(v) for v in result.curve.values] == ["random", "grid"]
    assert result.no_law == "preprocess.downsample is not a number"


def test_studies_and_sequences_are_apart_and_runs_beside_are_kept() -> None:
    rows = rows_of([1, 2]) + rows_of([1, 2], sequence="closed")
    rows.append(replace(rows[0], parameters={}, is_beside=True, method="icp"))
    results = evaluate_study(rows)
    assert [(r.study, r.sequence) for r in results] == [("skip", "open"), ("skip", "closed")]
    assert [row.method for row in results[0].beside] == ["icp"]
    assert [row.method for row in results[1].beside] == []
    assert results[0].parameters == ("input.skip_frames",)


def test_parameters_studied_one_at_a_time_are_apart_with_their_findings() -> None:
    rows = rows_of(SKIPS, error=lambda v: 0.5) + rows_of([0.1, 0.2, 0.5], "preprocess.random_share")
    skip = ExpectedFinding(text="it holds", kind="holds_up_to", values=(20,), parameter="input.skip_frames")
    results = evaluate_study(rows, [skip, skip.model_copy(update={"parameter": "preprocess.random_share"})])
    assert [r.parameters for r in results] == [("input.skip_frames",), ("preprocess.random_share",)]
    assert [[v.outcome for v in r.verdicts] for r in results] == [["confirmed"], ["undecided"]]
