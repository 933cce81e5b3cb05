"""Findings judged by the results of a study: confirmed, refuted or undecided, with the numbers that say so.

A finding is confirmed by evidence on both sides of what it states, and by two seeds at least; what differs by less than the
seeds scatter decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from lslam.config.finding import ExpectedFinding
from lslam.evaluation.verdicts_of_amounts import judge_acts_only_on, judge_law, judge_matters_little, judge_product
from lslam.evaluation.verdicts_of_places import (
    judge_best_between,
    judge_diverges_beyond,
    judge_elbow_at,
    judge_good_from,
    judge_holds_up_to,
    judge_largest_between,
)
from lslam.types.study import Curve, CurveResult, FindingVerdict, Judged, Law, Outcome

_OF_TIME = ("time_per_scan", "total_time")
_LAWS = ("linear", "inverse", "product")
_OF_ERROR = ("diverges_beyond", "holds_up_to", "elbow_at", "good_from")
_OF_WORDS = ("matters_little", "acts_only_on")


def judge(finding: ExpectedFinding, results: Sequence[CurveResult], products: Mapping[str, Law]) -> FindingVerdict:
    """The verdict over all curves that the finding speaks of: where they disagree it is undecided."""
    mine = [result for result in results if _speaks_of(finding, result)]
    if not mine:
        return FindingVerdict(finding.text, "undecided", "no run of that kind was made", finding.source)
    if not any(result.curve.ran.any() for result in mine):
        return FindingVerdict(finding.text, "undecided", "no run of that kind came to an end", finding.source)
    if finding.kind == "product":
        judged = {
            result.curve.series: judge_product(finding, products.get(result.curve.series), result) for result in mine
        }
    else:
        judged = {result.curve.label: _judge_one(finding, result) for result in mine}
    outcomes = {outcome for outcome, _ in judged.values()}
    outcome: Outcome = outcomes.pop() if len(outcomes) == 1 else "undecided"
    told = [f"{name}: {said}" if len(judged) > 1 else said for name, (_, said) in judged.items()]
    if _is_of_time(finding) and not all(result.curve.is_timed_alone for result in mine):
        outcome = "undecided"
        told.append("runs shared the machine, so times cannot be compared")
    return FindingVerdict(finding.text, outcome, "; ".join(told), finding.source)


def _judge_one(finding: ExpectedFinding, result: CurveResult) -> Judged:
    curve = result.curve
    if curve.words and finding.kind not in _OF_WORDS:
        return "undecided", f"{curve.parameter} is not a number"
    if not curve.ran.any():
        return "undecided", "no run came to an end"
    if not _is_of_time(finding) and not _has_errors(curve):
        return "undecided", "no run has an error: there is no ground truth, or they are too short"
    outcome, said = _JUDGES[finding.kind](finding, result)
    # The values of a law are many, and their scatter about it shows with one seed too.
    if outcome == "confirmed" and finding.kind not in _LAWS and curve.ran.any(0).sum() < 2:
        return "undecided", f"{said}, but one seed shows no scatter"
    return outcome, said


def _has_errors(curve: Curve) -> bool:
    """Whether runs were scored; where none was, a run that is not lost says nothing either."""
    are_scored = np.isfinite(curve.quantities["translation"]).any()
    return bool(are_scored or curve.lost[curve.ran].all())


def _is_of_time(finding: ExpectedFinding) -> bool:
    return finding.kind in (*_LAWS, "acts_only_on") or (finding.kind not in _OF_ERROR and finding.of in _OF_TIME)


def _speaks_of(finding: ExpectedFinding, result: CurveResult) -> bool:
    curve = result.curve
    return (
        finding.method in ("", curve.method)
        and finding.imu in (None, curve.uses_imu)
        and all(dict(curve.at).get(key) == value for key, value in finding.at.items())
    )


_JUDGES: dict[str, Callable[[ExpectedFinding, CurveResult], Judged]] = {
    "diverges_beyond": judge_diverges_beyond,
    "holds_up_to": judge_holds_up_to,
    "best_between": judge_best_between,
    "largest_between": judge_largest_between,
    "elbow_at": judge_elbow_at,
    "good_from": judge_good_from,
    "matters_little": judge_matters_little,
    "linear": judge_law,
    "inverse": judge_law,
    "acts_only_on": judge_acts_only_on,
}
