"""Evaluation of a sensitivity study: means over seeds, divergence, optimum, laws and verdicts (Girolimetto, section 5.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from lslam.core.arrays import Bools, Floats
from lslam.core.config.study import ExpectedFinding
from lslam.core.types.study import (
    Curve,
    CurveResult,
    FindingVerdict,
    Interval,
    Judged,
    Law,
    LawKind,
    Outcome,
    StudyResult,
    StudyRow,
)
from lslam.evaluation import verdicts
from lslam.evaluation.curves import (
    FEWEST,
    contrast,
    curves_of,
    divergence,
    fit_law,
    law_over,
    lost_above,
    median_over_seeds,
    optimum,
    over_seeds,
    valid_runs,
)

_OF_TIME = ("time_per_scan", "total_time")
_LAWS = ("linear", "inverse", "product")
_OF_ERROR = ("diverges_beyond", "holds_up_to", "elbow_at", "good_from")
_OF_WORDS = ("matters_little", "acts_only_on")
SKIP = "input.skip_frames"
EFFICIENCIES = ("efficiency", "total_efficiency")
# Sign that the change is expected to have.
OF_IMU = {"imu_lowers": -1.0, "imu_flattens": -1.0, "imu_steepens": 1.0}


def judge_trend(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict on a rise or fall: of each seed, the median over the upper half of the values against that over the lower half.

    Confirmed if larger, or smaller, by a tenth and by more than the scatter over seeds; refuted if it is no more than that.
    """
    table = valid_runs(result.curve, finding.of)
    half = len(table) // 2
    if np.isfinite(table).any(1).sum() < verdicts.FEWEST_VALUES:
        return "undecided", f"fewer than {verdicts.FEWEST_VALUES} values have a result"
    lower, upper = (median_over_seeds(part.T) for part in (table[:half], table[-half:]))
    first, second = (upper, lower) if finding.kind == "rises" else (lower, upper)
    ratio = contrast(first, second)
    said = f"{finding.of.replace('_', ' ')} of the upper half of the values is {_ratio(upper, lower)} times that of the lower"
    if ratio.is_more:
        return "confirmed", said
    return ("refuted" if ratio.is_no_more else "undecided"), said


def judge_imu(finding: ExpectedFinding, result: CurveResult, others: Sequence[CurveResult]) -> Judged:
    """Verdict on a run with the IMU against the same without: level or slope, seed by seed, over values that both have.

    Confirmed if the difference is of the expected sign by more than the scatter over seeds; refuted if of the other.
    """
    curve = result.curve
    same = [o for o in others if (o.curve.method, o.curve.at, o.curve.uses_imu) == (curve.method, curve.at, False)]
    if not same or not np.array_equal(same[0].curve.values, curve.values) or same[0].curve.seeds != curve.seeds:
        return "undecided", "the same was not run without the IMU"
    with_imu, without = (valid_runs(each.curve, finding.of) for each in (result, same[0]))
    mask = np.isfinite(with_imu) & np.isfinite(without) & (with_imu > 0) & (without > 0)
    seeds = np.flatnonzero(mask.sum(0) >= verdicts.FEWEST_VALUES)
    name = finding.of.replace("_", " ")
    if len(seeds) < 2:
        return "undecided", f"{name}: fewer than 2 seeds have {verdicts.FEWEST_VALUES} values with and without the IMU"
    if finding.kind == "imu_lowers":
        ratios = [float(np.median(with_imu[mask[:, s], s] / without[mask[:, s], s])) for s in seeds]
        changes, said = np.log(ratios), f"{name} with the IMU is {np.median(ratios):.2f} times that without"
    else:
        slopes = np.array([[_slope(curve.values, t[:, s], mask[:, s]) for t in (with_imu, without)] for s in seeds])
        changes = slopes[:, 0] - slopes[:, 1]
        middle = np.median(slopes, axis=0)
        said = f"{name} goes by {middle[0]:.3g} with and {middle[1]:.3g} without the IMU for each unit"
    signed = OF_IMU[finding.kind] * changes
    mean, std = float(signed.mean()), float(signed.std(ddof=1))
    if mean - std > 0:
        return "confirmed", said
    return ("refuted", said) if mean + std < 0 else ("undecided", f"{said}, by less than the seeds scatter")


def _ratio(upper: Floats, lower: Floats) -> str:
    """Median over the seeds of `upper` over `lower`, as text."""
    mask = np.isfinite(upper) & np.isfinite(lower) & (lower > 0)
    return f"{np.median(upper[mask] / lower[mask]):.2f}" if mask.any() else "unknown"


def _slope(values: Floats, numbers: Floats, mask: Bools) -> float:
    """Slope of a line through the numbers over the values that `mask` selects."""
    return float(np.polyfit(values[mask], numbers[mask], 1)[0])


_JUDGES: dict[str, Callable[[ExpectedFinding, CurveResult], Judged]] = {
    "diverges_beyond": verdicts.judge_diverges_beyond,
    "holds_up_to": verdicts.judge_holds_up_to,
    "best_between": verdicts.judge_best_between,
    "largest_between": verdicts.judge_largest_between,
    "elbow_at": verdicts.judge_elbow_at,
    "good_from": verdicts.judge_good_from,
    "matters_little": verdicts.judge_matters_little,
    "linear": verdicts.judge_law,
    "inverse": verdicts.judge_law,
    "acts_only_on": verdicts.judge_acts_only_on,
    "rises": judge_trend,
    "falls": judge_trend,
}


def judge(finding: ExpectedFinding, results: Sequence[CurveResult], products: Mapping[str, Law]) -> FindingVerdict:
    """Verdict over all curves that the finding applies to; undecided if they disagree."""
    is_of_imu = finding.kind in OF_IMU
    mine = [
        result for result in results if _speaks_of(finding, result) and not (is_of_imu and not result.curve.uses_imu)
    ]
    if not mine:
        return FindingVerdict(finding.text, "undecided", "no run of that kind was made", finding.source)
    if not any(result.curve.ran.any() for result in mine):
        return FindingVerdict(finding.text, "undecided", "no run of that kind came to an end", finding.source)
    if finding.kind == "product":
        judged = {
            result.curve.series: verdicts.judge_product(finding, products.get(result.curve.series), result)
            for result in mine
        }
    else:
        judged = {result.curve.label: _judge_one(finding, result, results) for result in mine}
    outcomes = {outcome for outcome, _ in judged.values()}
    outcome: Outcome = outcomes.pop() if len(outcomes) == 1 else "undecided"
    told = [f"{name}: {said}" if len(judged) > 1 else said for name, (_, said) in judged.items()]
    if _is_of_time(finding) and not all(result.curve.is_timed_alone for result in mine):
        outcome = "undecided"
        told.append("runs shared the machine, so times cannot be compared")
    return FindingVerdict(finding.text, outcome, "; ".join(told), finding.source)


def _judge_one(finding: ExpectedFinding, result: CurveResult, results: Sequence[CurveResult]) -> Judged:
    """Outcome and reason of a finding on one curve; undecided without usable runs, or where one seed shows no scatter."""
    curve = result.curve
    if curve.words and finding.kind not in _OF_WORDS:
        return "undecided", f"{curve.parameter} is not a number"
    if not curve.ran.any():
        return "undecided", "no run came to an end"
    if not _is_of_time(finding) and not _has_errors(curve):
        return "undecided", "no run has an error: there is no ground truth, or they are too short"
    if finding.kind in OF_IMU:
        return judge_imu(finding, result, results)
    outcome, said = _JUDGES[finding.kind](finding, result)
    # The values of a law are many, and their scatter about it shows with one seed too.
    if outcome == "confirmed" and finding.kind not in _LAWS and curve.ran.any(0).sum() < 2:
        return "undecided", f"{said}, but one seed shows no scatter"
    return outcome, said


def _has_errors(curve: Curve) -> bool:
    """Whether runs were scored. Without scores it is unknown whether a run is lost."""
    are_scored = np.isfinite(curve.quantities["translation"]).any()
    return bool(are_scored or curve.losses[curve.ran].all())


def _is_of_time(finding: ExpectedFinding) -> bool:
    """Whether a finding is about time, so that it needs comparable timings."""
    return finding.kind in (*_LAWS, "acts_only_on") or (finding.kind not in _OF_ERROR and finding.of in _OF_TIME)


def _speaks_of(finding: ExpectedFinding, result: CurveResult) -> bool:
    """True when the finding concerns the curve's method, IMU and other parameters."""
    curve = result.curve
    return (
        finding.method in ("", curve.method)
        and finding.imu in (None, curve.uses_imu)
        and all(dict(curve.at).get(key) == value for key, value in finding.at.items())
    )


def evaluate_study(rows: Sequence[StudyRow], findings: Sequence[ExpectedFinding] = ()) -> list[StudyResult]:
    """One result per study, sequence and parameter, in the order of `rows`; reference runs beside the study belong to all."""
    groups: dict[tuple[str, str, str], list[StudyRow]] = {}
    for row in rows:
        if not row.is_beside:
            groups.setdefault((row.study, row.sequence, next(iter(row.parameters), "")), []).append(row)
    out = []
    for (study, sequence, parameter), group in groups.items():
        beside = [row for row in rows if row.is_beside and (row.study, row.sequence) == (study, sequence)]
        mine = [finding for finding in findings if finding.parameter in ("", parameter)]
        out.append(_evaluate(group, beside, mine))
    return out


def _evaluate(rows: Sequence[StudyRow], beside: Sequence[StudyRow], findings: Sequence[ExpectedFinding]) -> StudyResult:
    """Evaluate the runs of one sequence; `beside` are those outside the grid. Unusable runs of both are in `failed`."""
    limit = lost_above(rows)
    results = tuple(_result(curve) for curve in curves_of(rows, limit))
    products = _products(results)
    return StudyResult(
        study=rows[0].study,
        sequence=rows[0].sequence,
        parameters=tuple(dict.fromkeys(name for row in rows for name in row.parameters)),
        results=results,
        products=products,
        verdicts=tuple(judge(finding, results, products) for finding in findings),
        beside=tuple(row for row in beside if row.is_usable),
        failed=tuple(row for row in (*rows, *beside) if not row.is_usable),
        lost_above=limit,
        metric=rows[0].metric,
    )


def _result(curve: Curve) -> CurveResult:
    """Means and medians over seeds of a curve, with divergence, optimal value of the parameter, and law of total time."""
    tables = {
        name: table if name in EFFICIENCIES else valid_runs(curve, name) for name, table in curve.quantities.items()
    }
    means = {name: over_seeds(table) for name, table in tables.items()}
    medians = {name: median_over_seeds(table) for name, table in tables.items()}
    law, no_law = _law_of(curve, means["total_time"])
    return CurveResult(
        curve=curve,
        means=means,
        medians=medians,
        stage_means={name: over_seeds(np.where(curve.losses, np.nan, table)) for name, table in curve.stages.items()},
        divergence=divergence(curve),
        optimum=optimum(curve.values, medians["efficiency"]),
        law=law,
        no_law=no_law,
    )


def _law_of(curve: Curve, times: Interval) -> tuple[Law | None, str]:
    """The law of total time: inverse over skipped scans, a line over any other number."""
    if curve.words:
        return None, f"{curve.parameter} is not a number"
    kind: LawKind = "inverse" if curve.parameter == SKIP else "linear"
    law = law_over(kind, curve, times)
    return law, "" if law else f"no law from {int((times.n > 0).sum())} values, {FEWEST} are needed"


def _products(results: Sequence[CurveResult]) -> dict[str, Law]:
    """Laws a y / x by series, of studies of skipped scans (x) and another number (y)."""
    groups: dict[str, list[tuple[Floats, ...]]] = {}
    names: tuple[str, ...] = ()
    for result in results:
        curve = result.curve
        if len(curve.at) != 1 or curve.words or SKIP not in (curve.parameter, curve.at[0][0]):
            continue
        key, other = curve.at[0]
        if isinstance(other, (bool, str)):
            continue
        over, second = result.means["total_time"], np.full(len(curve.values), float(other))
        is_skip = curve.parameter == SKIP
        names = (SKIP, key) if is_skip else (SKIP, curve.parameter)
        points = np.stack([curve.values, second] if is_skip else [second, curve.values], 1)
        groups.setdefault(curve.series, []).append((points, over.mean, over.n.astype(np.float64), over.std))
    laws = {}
    for series, parts in groups.items():
        points, times, runs, scatter = (np.concatenate(column) for column in zip(*parts, strict=True))
        laws[series] = fit_law("product", names, points, times, runs, scatter=scatter)
    return {series: law for series, law in laws.items() if law is not None}
