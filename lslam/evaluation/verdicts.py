"""Findings judged by the results of a study: confirmed, refuted or undecided, with the numbers that say so."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from lslam.config.finding import Finding
from lslam.evaluation.curves import NOT_REGISTRATION
from lslam.evaluation.landmarks import Rise, elbow, optimum, rise_below
from lslam.evaluation.laws import FEWEST, fit_law
from lslam.types.sensitivity import CurveResult, Floats, Law, LawKind, Optimum, Outcome, Verdict

R2 = 0.95
OWN_SHARE = 0.8  # of the change of all stages, for a parameter that acts on one of them
LEAST_CHANGE = 0.1  # of registration's time: below it nothing was acted on
UNITS = {"translation": "m", "angular": "deg", "time_per_scan": "ms", "total_time": "s"}
BELOW: dict[Rise, str] = {
    "worse": "it is worse by more than the seeds scatter", "as good": "it is as good",
    "unknown": "too few runs say whether it rises",
}  # fmt: skip
_OF_TIME = ("time_per_scan", "total_time")
_LAWS: tuple[LawKind, ...] = ("linear", "inverse", "product")
_OF_WORDS = ("matters_little", "acts_only_on")

Judged = tuple[Outcome, str]


def judge(finding: Finding, results: Sequence[CurveResult], products: Mapping[str, Law]) -> Verdict:
    """The verdict over all curves that the finding speaks of: where they disagree it is undecided."""
    mine = [result for result in results if _speaks_of(finding, result)]
    if not mine:
        return Verdict(finding.text, "undecided", "no run of that kind was made", finding.source)
    mine = [result for result in mine if result.curve.ran.any()]
    if not mine:
        return Verdict(finding.text, "undecided", "no run of that kind came to an end", finding.source)
    if finding.kind == "product":
        judged = {result.curve.series: _law(finding, result, products.get(result.curve.series)) for result in mine}
    else:
        judged = {result.curve.label: _judge_one(finding, result) for result in mine}
    outcomes = {outcome for outcome, _ in judged.values()}
    outcome: Outcome = outcomes.pop() if len(outcomes) == 1 else "undecided"
    told = [f"{name}: {said}" if len(judged) > 1 else said for name, (_, said) in judged.items()]
    is_of_time = finding.kind in (*_LAWS, "acts_only_on") or finding.of in _OF_TIME
    if is_of_time and not all(result.curve.is_timed_alone for result in mine):
        outcome = "undecided"
        told.append("runs shared the machine, so times cannot be compared")
    return Verdict(finding.text, outcome, "; ".join(told), finding.source)


def _judge_one(finding: Finding, result: CurveResult) -> Judged:
    if result.curve.words and finding.kind not in _OF_WORDS:
        return "undecided", f"{result.curve.parameter} is not a number"
    return _JUDGES[finding.kind](finding, result)


def _speaks_of(finding: Finding, result: CurveResult) -> bool:
    curve = result.curve
    return (
        finding.method in ("", curve.method)
        and finding.imu in (None, curve.uses_imu)
        and all(dict(curve.at).get(key) == value for key, value in finding.at.items())
    )


def _diverges_beyond(finding: Finding, result: CurveResult) -> Judged:
    """Confirmed when the last value that works is the expected one or a neighbour of it."""
    values, found = _run_values(result), result.divergence
    expected = finding.values[0]
    if found.first_bad is None:
        outcome: Outcome = "refuted" if values[-1] > expected else "undecided"
        lost = _lost(result, values[-1])
        said = "it holds" if lost else "nothing diverges"
        return outcome, f"{said} up to {values[-1]:g}, the largest value{lost}"
    if found.last_good is None:
        return "refuted", f"everything diverges, from {found.first_bad:g} on"
    is_near = abs(_place(values, found.last_good) - _place(values, expected)) <= 1
    return (
        "confirmed" if is_near else "refuted",
        f"{found.last_good:g} is the last value that works{_lost(result, found.last_good)}",
    )


def _holds_up_to(finding: Finding, result: CurveResult) -> Judged:
    values, found = _run_values(result), result.divergence
    expected = finding.values[0]
    if found.first_bad is not None and found.first_bad <= expected:
        below = -np.inf if found.last_good is None else found.last_good
        return "refuted", f"it diverges from {found.first_bad:g} on{_lost(result, below)}"
    if values[-1] < expected:
        return "undecided", f"{values[-1]:g} is the largest value that was run"
    lost = _lost(result, expected)
    if any(value <= expected for value in found.alone):
        return "undecided", f"nothing diverges for good{lost}"
    return "confirmed", f"{'it holds' if lost else 'nothing diverges'} up to {expected:g}{lost}"


def _between(finding: Finding, result: CurveResult, *, is_highest: bool) -> Judged:
    """Confirmed when the extreme lies between and most seeds agree, refuted when nothing as good lies there."""
    low, high = finding.values
    medians = np.where(result.curve.is_lost, np.nan, result.medians[finding.of])
    best = optimum(result.curve.values, medians, is_highest_best=is_highest)
    word = "largest" if finding.kind == "largest_between" else "best"
    if best is None or np.isfinite(medians).sum() < 3:
        return "undecided", "fewer than 3 values have a result"
    flat = (
        f"within 10 % from {best.low:g} to {best.high:g}" if best.low < best.high else "no value beside it within 10 %"
    )
    said = f"{finding.of.replace('_', ' ')} is {word} at {best.value:g} ({flat})"
    ran = _run_values(result)
    if low <= best.value <= high and ((ran[0] > low or ran[-1] < high) or (ran[0] >= low and ran[-1] <= high)):
        return "undecided", f"{said}, but only values from {ran[0]:g} to {ran[-1]:g} were run"
    if low <= best.value <= high:
        own = _best_by_seed(finding, result, is_highest)
        agree = sum(seed.low <= high and seed.high >= low for seed in own)
        if 2 * agree > len(own):
            return "confirmed", said
        return "undecided", f"{said}, but so in {agree} of {len(own)} seeds only"
    return "refuted" if best.high < low or best.low > high else "undecided", said


def _best_by_seed(finding: Finding, result: CurveResult, is_highest: bool) -> list[Optimum]:
    """Where each seed alone is best, of seeds that have any result."""
    table = np.where(result.curve.lost, np.nan, result.curve.quantities[finding.of])
    found = [optimum(result.curve.values, column, is_highest_best=is_highest) for column in table.T]
    return [best for best in found if best is not None]


def _elbow_at(finding: Finding, result: CurveResult) -> Judged:
    """Confirmed when the error comes to its plateau at the expected value or a neighbour of it."""
    values, expected = _run_values(result), finding.values[0]
    found = _elbow(result)
    if found is None:
        return "refuted", "the error comes to no plateau"
    if found == values[0]:
        outcome: Outcome = "undecided" if expected <= values[0] else "refuted"
        return outcome, f"there is no elbow: {found:g}, the smallest value, is as good as the others"
    said = f"the error is on its plateau from {found:g} on"
    if abs(_place(values, found) - _place(values, expected)) > 1:
        return "refuted", said
    below = rise_below(result.curve, found)
    return "confirmed" if below == "worse" else "undecided", f"{said}; below {BELOW[below]}"


def _good_from(finding: Finding, result: CurveResult) -> Judged:
    """Confirmed when the error has come to its plateau there and a value below is worse, refuted when these are as good."""
    found = _elbow(result)
    if found is None:
        return "refuted", "the error comes to no plateau"
    values, expected = _run_values(result), finding.values[0]
    if not values[0] <= expected <= values[-1]:
        return "undecided", f"values from {values[0]:g} to {values[-1]:g} were run"
    said = f"the error is on its plateau from {found:g} on"
    if found > expected:
        return "refuted", said
    below = rise_below(result.curve, expected)
    outcomes: dict[Rise, Outcome] = {"worse": "confirmed", "as good": "refuted", "unknown": "undecided"}
    return outcomes[below], f"{said}; below {expected:g} {BELOW[below]}"


def _matters_little(finding: Finding, result: CurveResult) -> Judged:
    medians = result.medians[finding.of]
    known = medians[np.isfinite(medians) & (medians > 0)]
    if len(known) < 3:
        return "undecided", "fewer than 3 values have a result"
    ratio = float(known.max() / known.min())
    name, unit = finding.of.replace("_", " "), UNITS.get(finding.of, "")
    said = f"{name} goes from {known.min():.3g} to {known.max():.3g} {unit}".rstrip() + f", a factor of {ratio:.2f}"
    if result.curve.is_lost.any():
        return "refuted", f"{said}, and it diverges at {_list(result.curve.values[result.curve.is_lost])}"
    return "confirmed" if ratio < finding.values[0] else "refuted", said


def _law_of(finding: Finding, result: CurveResult) -> Judged:
    law = result.law
    if law is None or law.kind != finding.kind:
        assert finding.kind in ("linear", "inverse")
        times = result.means["total_time"]
        law = fit_law(finding.kind, (result.curve.parameter,), result.curve.values, times.mean, times.n.astype(float))
    return _law(finding, result, law)


def _law(finding: Finding, result: CurveResult, law: Law | None) -> Judged:
    if law is None:
        return "undecided", f"no law is fitted to fewer than {FEWEST} values"
    least = finding.values[0] if finding.values else R2
    outcome: Outcome = "confirmed" if law.r2 >= least else "refuted"
    worst = 100 * float(np.abs(law.residuals).max())
    return outcome, f"{law.text} s with R2 {law.r2:.3f}, off by {worst:.0f} % at most"


def _acts_only_on(finding: Finding, result: CurveResult) -> Judged:
    """Confirmed when the named stages make up at least 80 % of the change, stage by stage, of registration."""
    timed = {
        name: m.mean[m.n > 0] for name, m in result.stage_means.items() if m.n.any() and name not in NOT_REGISTRATION
    }
    change = {name: float(np.ptp(means)) for name, means in timed.items()}
    if not any(name in change for name in finding.stages):
        return "undecided", f"no stage {', '.join(finding.stages)} was timed"
    whole, own = sum(change.values()), sum(change.get(name, 0.0) for name in finding.stages)
    level = sum(float(means.mean()) for means in timed.values())
    if not level or whole < LEAST_CHANGE * level:
        return "undecided", f"registration changes by {whole:.2g} of {level:.3g} ms only"
    said = ", ".join(f"{name} by {ms:.3g}" for name, ms in sorted(change.items(), key=lambda item: -item[1])[:3])
    outcome: Outcome = "confirmed" if own >= OWN_SHARE * whole else "refuted"
    return outcome, f"{' and '.join(finding.stages)}: {100 * own / whole:.0f} % of the change ({said} ms)"


def _elbow(result: CurveResult) -> float | None:
    return elbow(result.curve.values, result.medians["translation"], result.curve.is_lost)


def _run_values(result: CurveResult) -> Floats:
    """Values at which some run says anything."""
    return result.curve.values[result.curve.ran.any(1)]


def _place(values: Floats, value: float) -> int:
    """Index of the nearest value."""
    return int(np.argmin(np.abs(values - value)))


def _lost(result: CurveResult, last: float) -> str:
    """How many runs are lost at values up to `last`, which for most seeds work."""
    curve = result.curve
    at = curve.lost.any(1) & (curve.values <= last)
    lost, ran = int(curve.lost[at].sum()), int(curve.ran[at].sum())
    return (
        f", though {lost} of {ran} runs at {_list(curve.values[at])} {'is' if lost == 1 else 'are'} lost"
        if lost
        else ""
    )


def _list(values: Sequence[float] | Floats) -> str:
    return ", ".join(f"{value:g}" for value in values)


_JUDGES: dict[str, Callable[[Finding, CurveResult], Judged]] = {
    "diverges_beyond": _diverges_beyond,
    "holds_up_to": _holds_up_to,
    "best_between": lambda f, r: _between(f, r, is_highest=f.of.endswith("efficiency")),
    "largest_between": lambda f, r: _between(f, r, is_highest=True),
    "elbow_at": _elbow_at,
    "good_from": _good_from,
    "matters_little": _matters_little,
    "linear": _law_of,
    "inverse": _law_of,
    "acts_only_on": _acts_only_on,
}
