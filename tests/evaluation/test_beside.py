"""Verdicts about numbers that a thesis prints, and about which of two systems does better."""

from __future__ import annotations

from math import inf

import pytest

from lslam.evaluation.thesis import difficulty, judge_number, judge_order, judge_time, median_and_worst


@pytest.mark.parametrize(
    ("found", "hardness", "verdict"),
    [
        ([0.5, 1.1], "easier", "reproduced"),
        ([1.9, 2.5], "harder", "reproduced"),
        ([0.1, 0.49], "as hard", "refuted"),
        ([2.1, 9.0], "as hard", "refuted"),
        ([0.1, 0.49], "easier", "undecided"),
        ([0.1, 0.49], "", "undecided"),
        ([0.1, 0.49], "partly as hard", "undecided"),
        ([0.9, inf], "as hard", "undecided"),
        ([inf, inf], "as hard", "undecided"),
        ([], "as hard", "undecided"),
    ],
)
def test_a_number_of_one_is_judged_by_all_runs_and_refuted_at_equal_hardness_only(
    found: list[float], hardness: str, verdict: str
) -> None:
    assert judge_number(1.0, found, hardness).verdict == verdict


@pytest.mark.parametrize(
    ("pairs", "verdict"),
    [
        ([(1.0, 2.0)] * 5, "reproduced"),
        ([(2.0, 1.0)] * 5, "refuted"),
        ([(1.0, 2.0)] * 4, "undecided"),
        ([(1.0, 2.0)] * 9 + [(2.0, 1.0)], "undecided"),
        ([(1.0, inf)] * 5, "reproduced"),
        ([(1.0, 2.0)] * 5 + [(1.0, 1.0)], "undecided"),
        ([(inf, inf)] * 5, "undecided"),
        ([(1.0, 1.02)] * 9, "undecided"),
        ([(1.0, 1.1)] * 5, "reproduced"),
        ([], "undecided"),
    ],
)
def test_an_order_is_decided_where_all_seeds_say_the_same_and_chance_does_not(
    pairs: list[tuple[float, float]], verdict: str
) -> None:
    assert judge_order(True, pairs).verdict == verdict
    turned = {"reproduced": "refuted", "refuted": "reproduced"}.get(verdict, verdict)
    assert judge_order(False, pairs).verdict == turned


def test_hardness_and_the_worst() -> None:
    assert [difficulty([(1.0, [value])]) for value in (0.4, 0.6, 1.9, 2.1, inf)] == [
        "easier", "as hard", "as hard", "harder", "harder",
    ]  # fmt: skip
    assert difficulty([(1.0, [1.0]), (8.0, [9.0])]) == "as hard"
    assert difficulty([(1.0, [1.0]), (8.0, [2.0])]) == "partly as hard"
    assert difficulty([(None, [1.0]), (8.0, [2.0])]) == "easier"
    assert difficulty([(1.0, []), (None, [2.0])]) == ""
    assert median_and_worst([0.3, 0.1, 0.2, 0.4]) == (0.25, 0.4)
    assert median_and_worst([0.3, inf]) == (inf, inf)


@pytest.mark.parametrize(
    ("times", "limit", "verdict"),
    [
        ([0.1, 0.4], 0.4, "reproduced"),
        ([0.1, 0.41], 0.4, "undecided"),
        ([0.1, inf], 0.4, "undecided"),
        ([], 0.4, "undecided"),
        ([0.1], None, "undecided"),
    ],
)
def test_time_is_judged_by_the_limit_and_never_refuted(times: list[float], limit: float | None, verdict: str) -> None:
    assert judge_time(times, limit).verdict == verdict
