"""Findings that name a value of the parameter: where a curve diverges, is best, or comes to its plateau."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from lslam.config.study import ExpectedFinding
from lslam.evaluation.curves import Rise, contrast, divergence, elbow, optimum, plateau, rise_at, rise_below
from lslam.types.study import Curve, CurveResult, Floats, Judged, Optimum, Outcome

BELOW: dict[Rise, str] = {
    "worse": "it is worse by more than the seeds scatter", "as good": "it is as good",
    "unknown": "too few runs, or too scattered ones, say whether it rises",
}  # fmt: skip
Ranking = Literal["worse", "as good", "better", "unknown"]


def judge_diverges_beyond(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Confirmed where the last value that works is the expected one, undecided one value beside it, refuted elsewhere."""
    return _as_most_seeds(lambda curve: _diverges_beyond(curve, finding.values[0]), result.curve)


def judge_holds_up_to(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Confirmed where the expected value, or a larger one, works and none below is lost; refuted where it diverges before."""
    return _as_most_seeds(lambda curve: _holds_up_to(curve, finding.values[0]), result.curve)


def _as_most_seeds(says: Callable[[Curve], Judged], curve: Curve) -> Judged:
    """What all runs say together, if most seeds say it by themselves."""
    outcome, said = says(curve)
    if outcome == "undecided":
        return outcome, said
    scored = [int(seed) for seed in np.flatnonzero(curve.scored.any(0))]
    agree = sum(says(curve.of_seed(seed))[0] == outcome for seed in scored)
    if 2 * agree > len(scored):
        return outcome, said
    return "undecided", f"{said}, but so in {agree} of {len(scored)} seeds only"


def _diverges_beyond(curve: Curve, expected: float) -> Judged:
    values, found = _scored_values(curve), divergence(curve)
    if found.first_bad is not None and found.last_good is None:
        outcome: Outcome = "undecided" if expected < values[0] else "refuted"
        return outcome, f"everything diverges, from {found.first_bad:g} on"
    last = float(values[-1]) if found.last_good is None else found.last_good
    lost = _lost(curve, last)
    place = int(np.flatnonzero(values == last)[0])
    # Luck of a few runs moves a divergence by a step.
    is_near = values[max(place - 1, 0)] <= expected <= values[min(place + 1, len(values) - 1)]
    if found.first_bad is None:
        said = f"{'it holds' if lost else 'nothing diverges'} up to {last:g}, the largest value{lost}"
        return "undecided" if is_near or expected > last else "refuted", said
    said = f"{last:g} is the last value that works{lost}"
    if last <= expected < found.first_bad:
        return "undecided" if found.alone else "confirmed", said
    return "undecided" if is_near else "refuted", said


def _holds_up_to(curve: Curve, expected: float) -> Judged:
    values, found = _scored_values(curve), divergence(curve)
    if found.first_bad is not None and found.first_bad <= expected:
        below = -np.inf if found.last_good is None else found.last_good
        return "refuted", f"it diverges from {found.first_bad:g} on{_lost(curve, below)}"
    last = values[-1] if found.first_bad is None else found.last_good
    if values[-1] < expected:
        return "undecided", f"{values[-1]:g} is the largest value that was run"
    if values[0] > expected or last is None:
        return "undecided", f"{values[0]:g} is the smallest value that was run"
    if last < expected:
        return "undecided", f"{last:g} works, {found.first_bad:g} does not, and nothing was run between"
    lost = _lost(curve, expected)
    if any(value <= expected for value in found.alone):
        return "undecided", f"nothing diverges for good{lost}"
    return "confirmed", f"{'it holds' if lost else 'nothing diverges'} up to {expected:g}{lost}"


def judge_best_between(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """As `_between`, of the highest efficiency, the smallest error or the shortest time."""
    return _between(finding, result, is_highest=finding.of.endswith("efficiency"))


def judge_largest_between(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """As `_between`, of the largest number whatever it is."""
    return _between(finding, result, is_highest=True)


def _between(finding: ExpectedFinding, result: CurveResult, *, is_highest: bool) -> Judged:
    """Confirmed when the extreme lies between, on each side some value is worse, and most seeds agree.

    Refuted when the extreme lies outside and beats the best one between, or all values outside are as good as that.
    """
    low, high = finding.values
    curve = result.curve
    medians = np.where(curve.is_lost, np.nan, result.medians[finding.of])
    best = optimum(curve.values, medians, is_highest_best=is_highest)
    if best is None or np.isfinite(medians).sum() < 3:
        return "undecided", "fewer than 3 values have a result"
    flat = (
        f"within 10 % from {best.low:g} to {best.high:g}" if best.low < best.high else "no value beside it within 10 %"
    )
    word = "largest" if finding.kind == "largest_between" else "best"
    said = f"{finding.of.replace('_', ' ')} is {word} at {best.value:g} ({flat})"
    known = np.isfinite(medians) | curve.is_lost
    is_inside = (curve.values >= low) & (curve.values <= high)
    inside = optimum(curve.values[is_inside], medians[is_inside], is_highest_best=is_highest)
    if not (known & is_inside).any():
        return "undecided", f"{said}, but no value from {low:g} to {high:g} was run"
    if inside is None:
        return "refuted", f"{said}, and it diverges from {low:g} to {high:g}"
    base = int(np.flatnonzero(curve.values == inside.value)[0])
    rankings = {int(k): _ranking(finding, curve, int(k), base, is_highest) for k in np.flatnonzero(known & ~is_inside)}
    # Of many values some are better by luck, the best of all is so least.
    if any(how == "better" and (curve.is_lost[k] or curve.values[k] == best.value) for k, how in rankings.items()):
        return "refuted", said
    sides = [{how for k, how in rankings.items() if side[k]} for side in (curve.values < low, curve.values > high)]
    outside = sides[0] | sides[1]
    if outside == {"as good"}:
        return "refuted", f"{said}, and all values outside are as good as {inside.value:g}"
    ran = curve.values[known]
    if (ran[0] > low or ran[-1] < high) or not outside:
        return "undecided", f"{said}, but only values from {ran[0]:g} to {ran[-1]:g} were run"
    if not low <= best.value <= high or "better" in outside:
        return "undecided", f"{said}, by less than the seeds scatter"
    own = _best_by_seed(finding, result, is_highest)
    agree = sum(seed.low <= high and seed.high >= low for seed in own)
    if 2 * agree <= len(own):
        return "undecided", f"{said}, but so in {agree} of {len(own)} seeds only"
    if any(side and "worse" not in side for side in sides):
        return "undecided", f"{said}, but on one side no value is worse by more than the seeds scatter"
    return "confirmed", said


def _ranking(finding: ExpectedFinding, curve: Curve, other: int, base: int, is_highest: bool) -> Ranking:
    """How the value at index `other` stands against that at `base`."""
    if curve.is_lost[other]:
        if finding.kind == "best_between" or finding.of.endswith("efficiency"):
            return "worse"
        # Of lost runs the errors are the largest there are; their times say nothing.
        return "better" if finding.of in ("translation", "angular") else "unknown"
    table = np.where(curve.lost, np.nan, curve.quantities[finding.of])
    ours, theirs = (table[base], table[other]) if is_highest else (table[other], table[base])
    lead, lag = contrast(ours, theirs), contrast(theirs, ours)
    if lead.is_more:
        return "worse"
    if lag.is_more:
        return "better"
    return "as good" if lead.is_no_more and lag.is_no_more else "unknown"


def _best_by_seed(finding: ExpectedFinding, result: CurveResult, is_highest: bool) -> list[Optimum]:
    """Where each seed alone is best, of seeds that have any result."""
    table = np.where(result.curve.lost, np.nan, result.curve.quantities[finding.of])
    found = [optimum(result.curve.values, column, is_highest_best=is_highest) for column in table.T]
    return [best for best in found if best is not None]


def judge_elbow_at(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Confirmed where the error comes to its plateau at the expected value and is worse just below it.

    Undecided one value beside it; refuted where it comes there later, or is as good just below.
    """
    curve, expected = result.curve, finding.values[0]
    values = _scored_values(curve)
    if not values[0] <= expected <= values[-1]:
        return "undecided", f"values from {values[0]:g} to {values[-1]:g} were run"
    found = _elbow(result)
    place = int(np.searchsorted(values, expected))
    if found is None or _place(values, found) > place + 1:
        return _plateau_is_later(result, expected, found)
    if found == values[0]:
        said = f"there is no elbow: {found:g}, the smallest value, is as good as the others"
        return _only_if_as_good(_rise_before(curve, values, place)), said
    said = f"the error is on its plateau from {found:g} on"
    rise = _rise_before(curve, values, _place(values, found))
    if found == values[place]:
        return "confirmed" if rise == "worse" else "undecided", f"{said}; below {BELOW[rise]}"
    if abs(_place(values, found) - place) == 1:
        return "undecided", f"{said}, one value beside {expected:g}"
    return _only_if_as_good(_rise_before(curve, values, place)), said


def judge_good_from(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Confirmed when the error has come to its plateau there and a value below is worse, refuted when these are as good."""
    curve, expected = result.curve, finding.values[0]
    values = _scored_values(curve)
    if not values[0] <= expected <= values[-1]:
        return "undecided", f"values from {values[0]:g} to {values[-1]:g} were run"
    found = _elbow(result)
    if found is None or found > expected:
        return _plateau_is_later(result, expected, found)
    below = rise_below(curve, expected)
    outcomes: dict[Rise, Outcome] = {"worse": "confirmed", "as good": "refuted", "unknown": "undecided"}
    return outcomes[below], f"the error is on its plateau from {expected:g} on; below {expected:g} {BELOW[below]}"


def _plateau_is_later(result: CurveResult, expected: float, found: float | None) -> Judged:
    """Refuted, if a value from the expected one to the plateau is worse than it by more than the seeds scatter."""
    curve = result.curve
    values = _scored_values(curve)
    level = plateau(curve, float(values[len(values) // 2]))
    said = "the error comes to no plateau" if found is None else f"the error is on its plateau from {found:g} on"
    before = np.flatnonzero((curve.values >= expected) & (curve.values < (np.inf if found is None else found)))
    if any(rise_at(curve, int(index), level) == "worse" for index in before):
        return "refuted", said
    return "undecided", f"{said}, but before it no error is worse by more than the seeds scatter"


def _rise_before(curve: Curve, values: Floats, place: int) -> Rise:
    """Whether the error just below the value at `place` is worse than from there on."""
    if place == 0:
        return "unknown"
    return rise_at(curve, _place(curve.values, float(values[place - 1])), plateau(curve, float(values[place])))


def _only_if_as_good(rise: Rise) -> Outcome:
    return "refuted" if rise == "as good" else "undecided"


def _elbow(result: CurveResult) -> float | None:
    return elbow(result.curve.values, result.medians["translation"], result.curve.is_lost)


def _scored_values(curve: Curve) -> Floats:
    """Values at which some run says whether they work."""
    return curve.values[curve.scored.any(1)]


def _place(values: Floats, value: float) -> int:
    """Index of a value that is there."""
    return int(np.flatnonzero(values == value)[0])


def _lost(curve: Curve, last: float) -> str:
    """How many runs are lost at values up to `last`, which for most seeds work."""
    at = curve.lost.any(1) & (curve.values <= last)
    lost, ran = int(curve.lost[at].sum()), int(curve.scored[at].sum())
    listed = ", ".join(f"{value:g}" for value in curve.values[at])
    return f", though {lost} of {ran} runs at {listed} {'is' if lost == 1 else 'are'} lost" if lost else ""
