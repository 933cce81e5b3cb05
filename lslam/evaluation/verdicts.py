"""Verdicts on expected findings of a study: about effects and laws, and about places on a curve."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from typing import Literal

import numpy as np

from lslam.core.arrays import Bools, Floats
from lslam.core.config.study import ExpectedFinding
from lslam.core.types.study import Curve, CurveResult, Judged, Law, Optimum, Outcome
from lslam.evaluation.curves import (
    FEWEST,
    NOT_REGISTRATION,
    Rise,
    contrast,
    divergence,
    elbow,
    law_over,
    optimum,
    over_seeds,
    plateau,
    rise_at,
    rise_below,
    rival,
    valid_runs,
)

R2 = 0.95
OWN_SHARE = 0.8  # of the change of all stages, for a parameter that acts on one of them
LEAST_TIME_SHARE = 0.1  # of registration's time: below it nothing was acted on
FEWEST_VALUES = 3
UNITS = {"translation": "m", "angular": "deg", "time_per_scan": "ms", "total_time": "s"}
_EQUAL = 1e-9  # R2 of laws that fit alike


def judge_matters_little(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict on a small effect: confirmed if largest over smallest is below a factor, refuted if above, scatter included.

    Refuted as well where most runs of some value are lost; a value without result, or numbers that do not vary at all,
    leave it undecided.
    """
    curve, medians = result.curve, result.medians[finding.of]
    known = np.isfinite(medians) & (medians > 0)
    if known.sum() < FEWEST_VALUES:
        return "undecided", f"fewer than {FEWEST_VALUES} values have a result"
    table = valid_runs(curve, finding.of)
    top, bottom = (int(pick(np.where(known, medians, np.nan))) for pick in (np.nanargmax, np.nanargmin))
    largest, smallest = medians[top], medians[bottom]
    name, unit = finding.of.replace("_", " "), UNITS.get(finding.of, "")
    said = f"{name} goes from {smallest:.3g} to {largest:.3g} {unit}".rstrip()
    said += f", a factor of {largest / smallest:.2f}"
    lost = curve.loses_most
    if lost.any():
        outcome: Outcome = "refuted" if (curve.losses.sum(1)[lost] > 1).any() else "undecided"
        return outcome, f"{said}, and it diverges at {_value_list(curve, lost)}"
    least, pairs = finding.values[0], permutations(table[known], 2)
    if contrast(table[top], table[bottom]).exceeds(least):
        return "refuted", said
    if not all(contrast(one, other).stays_below(least) for one, other in pairs):
        return "undecided", f"{said}, which seeds that are too few or too scattered do not tell from {least:g}"
    if not known.all():
        return "undecided", f"{said}, but nothing is known at {_value_list(curve, ~known)}"
    if not np.ptp(np.nan_to_num(table), axis=0).any():
        return "undecided", f"{said}: it is the same to the last digit at every value, so the parameter was not in use"
    return "confirmed", said


def judge_law(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict, as by `_law`, on the total time over the studied parameter."""
    law = result.law
    if law is None or law.kind != finding.kind:
        assert finding.kind in ("linear", "inverse")
        law = law_over(finding.kind, result.curve, result.means["total_time"])
    return _law(finding, law)


def judge_product(finding: ExpectedFinding, law: Law | None, result: CurveResult) -> Judged:
    """Verdict, as by `_law`, on the total time over both studied parameters."""
    if result.curve.words:
        return "undecided", f"{result.curve.parameter} is not a number"
    return _law(finding, law)


def _law(finding: ExpectedFinding, law: Law | None) -> Judged:
    """Verdict on a law: confirmed if it explains enough and best; refuted if another does, or off by more than the scatter."""
    if law is None:
        return "undecided", f"no law is fitted to fewer than {FEWEST} values"
    least = finding.values[0] if finding.values else R2
    worst = 100 * float(np.abs(law.residuals).max())
    said = f"{law.text} s with R2 {law.r2:.3f}, off by {worst:.0f} % at most"
    other, r2 = rival(law)
    if law.r2 >= least:
        if r2 > law.r2 - _EQUAL:
            said = f"{said}, but {other} fits as well, with R2 {r2:.3f}: too few values, or too near each other"
            return "undecided", said
        return "confirmed", said
    if r2 >= least:
        return "refuted", f"{said}; {other} has R2 {r2:.3f}"
    misfit, scatter = _rms((law.times - law.law_times) / law.times), _rms(law.scatter / law.times)
    if misfit > scatter:
        return "refuted", said
    return "undecided", f"{said}, which is no more than runs at one value scatter, as far as that is known"


def _rms(values: Floats) -> float:
    """Root mean square; infinite if no value is known, since unknown scatter may be of any size."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("inf")


def judge_acts_only_on(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict on stages: confirmed if the named ones make up 80 % of the change of registration time, for most seeds too."""
    curve = result.curve
    change, level = _changes(curve)
    if not any(name in curve.stages for name in finding.stages):
        return "undecided", f"no stage {', '.join(finding.stages)} was timed"
    if level is None:
        return "undecided", f"fewer than {FEWEST_VALUES} values were timed"
    whole = sum(change.values())
    if not level or whole < LEAST_TIME_SHARE * level:
        return "undecided", f"registration changes by {whole:.2g} of {level:.3g} ms only"
    said = ", ".join(f"{name} by {ms:.3g}" for name, ms in sorted(change.items(), key=lambda item: -item[1])[:3])
    share = _own_share(finding, change)
    said = f"{' and '.join(finding.stages)}: {100 * share:.0f} % of the change ({said} ms)"
    alone = [_changes(curve.of_seed(seed))[0] for seed in range(len(curve.seeds))]
    shares = [_own_share(finding, own) for own in alone if sum(own.values()) > 0]
    agree = sum((own >= OWN_SHARE) == (share >= OWN_SHARE) for own in shares)
    if 2 * agree <= len(shares):
        return "undecided", f"{said}, but so in {agree} of {len(shares)} seeds only"
    return "confirmed" if share >= OWN_SHARE else "refuted", said


def _changes(curve: Curve) -> tuple[dict[str, float], float | None]:
    """Change of each registration stage's mean over the values, ms, and of their sum.

    A stage that a timed run lacks counts as 0. Empty, and None, where fewer than 3 values were timed.
    """
    tables = {
        n: np.where(curve.losses, np.nan, table) for n, table in curve.stages.items() if n not in NOT_REGISTRATION
    }
    if not tables:
        return {}, None
    timed = np.any([np.isfinite(table) for table in tables.values()], axis=0)
    values = timed.any(1)
    if values.sum() < FEWEST_VALUES:
        return {}, None
    means = {
        name: over_seeds(np.where(timed, np.nan_to_num(table), np.nan)).mean[values] for name, table in tables.items()
    }
    level = float(np.sum([mean.mean() for mean in means.values()]))
    return {name: float(np.ptp(mean)) for name, mean in means.items()}, level


def _own_share(finding: ExpectedFinding, change: dict[str, float]) -> float:
    """Share of the change of all stages that the stages of the finding have."""
    return sum(change.get(name, 0.0) for name in finding.stages) / sum(change.values())


def _value_list(curve: Curve, which: Bools) -> str:
    """Values of the curve that `which` selects, as text."""
    return ", ".join(curve.name_of(value) for value in curve.values[which])


BELOW: dict[Rise, str] = {
    "worse": "it is worse by more than the seeds scatter",
    "as good": "it is as good",
    "unknown": "too few runs, or too scattered ones, say whether it rises",
}
Ranking = Literal["worse", "as good", "better", "unknown"]


def judge_diverges_beyond(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict: confirmed if the last working value is the expected one, undecided one value beside it, else refuted."""
    return _as_most_seeds(lambda curve: _diverges_beyond(curve, finding.values[0]), result.curve)


def judge_holds_up_to(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict: confirmed if the expected or a larger value works and none below is lost; refuted if it diverges earlier."""
    return _as_most_seeds(lambda curve: _holds_up_to(curve, finding.values[0]), result.curve)


def _as_most_seeds(says: Callable[[Curve], Judged], curve: Curve) -> Judged:
    """Verdict on all runs, if most seeds by themselves give the same; else undecided."""
    outcome, said = says(curve)
    if outcome == "undecided":
        return outcome, said
    scored = [int(seed) for seed in np.flatnonzero(curve.with_score.any(0))]
    agree = sum(says(curve.of_seed(seed))[0] == outcome for seed in scored)
    if 2 * agree > len(scored):
        return outcome, said
    return "undecided", f"{said}, but so in {agree} of {len(scored)} seeds only"


def _diverges_beyond(curve: Curve, target: float) -> Judged:
    """Judge that the method diverges just beyond `target`; undecided where that lies within a step of the last good value."""
    values, divergent = _scored_values(curve), divergence(curve)
    if divergent.first_bad is not None and divergent.last_good is None:
        outcome: Outcome = "undecided" if target < values[0] else "refuted"
        return outcome, f"everything diverges, from {divergent.first_bad:g} on"
    last = float(values[-1]) if divergent.last_good is None else divergent.last_good
    lost = _loss_remark(curve, last)
    place = int(np.flatnonzero(values == last)[0])
    # Luck of a few runs moves a divergence by a step.
    is_near = values[max(place - 1, 0)] <= target <= values[min(place + 1, len(values) - 1)]
    if divergent.first_bad is None:
        said = f"{'it holds' if lost else 'nothing diverges'} up to {last:g}, the largest value{lost}"
        return "undecided" if is_near or target > last else "refuted", said
    said = f"{last:g} is the last value that works{lost}"
    if last <= target < divergent.first_bad:
        return "undecided" if divergent.alone else "confirmed", said
    return "undecided" if is_near else "refuted", said


def _holds_up_to(curve: Curve, target: float) -> Judged:
    """Judge that no value up to `target` diverges; undecided where no run is as large."""
    values, divergent = _scored_values(curve), divergence(curve)
    if divergent.first_bad is not None and divergent.first_bad <= target:
        below = -np.inf if divergent.last_good is None else divergent.last_good
        return "refuted", f"it diverges from {divergent.first_bad:g} on{_loss_remark(curve, below)}"
    last = values[-1] if divergent.first_bad is None else divergent.last_good
    if values[-1] < target:
        return "undecided", f"{values[-1]:g} is the largest value that was run"
    if values[0] > target or last is None:
        return "undecided", f"{values[0]:g} is the smallest value that was run"
    if last < target:
        return "undecided", f"{last:g} works, {divergent.first_bad:g} does not, and nothing was run between"
    lost = _loss_remark(curve, target)
    if any(value <= target for value in divergent.alone):
        return "undecided", f"nothing diverges for good{lost}"
    return "confirmed", f"{'it holds' if lost else 'nothing diverges'} up to {target:g}{lost}"


def judge_best_between(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict, as by `_between`, on the highest efficiency, the smallest error or the shortest time."""
    return _between(finding, result, is_highest=finding.of.endswith("efficiency"))


def judge_largest_between(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict, as by `_between`, on the largest value of any number."""
    return _between(finding, result, is_highest=True)


def _between(finding: ExpectedFinding, result: CurveResult, *, is_highest: bool) -> Judged:
    """Verdict: confirmed if the extreme lies between, some value is worse on each side, and most seeds agree.

    Refuted when the extreme lies outside and beats the best one between, or all values outside are as good as that.
    """
    low, high = finding.values
    curve = result.curve
    medians = np.where(curve.loses_most, np.nan, result.medians[finding.of])
    best = optimum(curve.values, medians, is_highest_best=is_highest)
    if best is None or np.isfinite(medians).sum() < 3:
        return "undecided", "fewer than 3 values have a result"
    flat = (
        f"within 10 % from {best.low:g} to {best.high:g}" if best.low < best.high else "no value beside it within 10 %"
    )
    word = "largest" if finding.kind == "largest_between" else "best"
    said = f"{finding.of.replace('_', ' ')} is {word} at {best.value:g} ({flat})"
    known = np.isfinite(medians) | curve.loses_most
    is_inside = (curve.values >= low) & (curve.values <= high)
    inside = optimum(curve.values[is_inside], medians[is_inside], is_highest_best=is_highest)
    if not (known & is_inside).any():
        return "undecided", f"{said}, but no value from {low:g} to {high:g} was run"
    if inside is None:
        return "refuted", f"{said}, and it diverges from {low:g} to {high:g}"
    base = int(np.flatnonzero(curve.values == inside.value)[0])
    rankings = {int(k): _ranking(finding, curve, int(k), base, is_highest) for k in np.flatnonzero(known & ~is_inside)}
    # Of many values some are better by luck, the best of all is so least.
    if any(how == "better" and (curve.loses_most[k] or curve.values[k] == best.value) for k, how in rankings.items()):
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
    """Ranking of the value at index `other` against that at `base`; is_highest : larger is better."""
    if curve.loses_most[other]:
        if finding.kind == "best_between" or finding.of.endswith("efficiency"):
            return "worse"
        # Of lost runs the errors are the largest there are; their times say nothing.
        return "better" if finding.of in ("translation", "angular") else "unknown"
    table = valid_runs(curve, finding.of)
    ours, theirs = (table[base], table[other]) if is_highest else (table[other], table[base])
    lead, lag = contrast(ours, theirs), contrast(theirs, ours)
    if lead.is_more:
        return "worse"
    if lag.is_more:
        return "better"
    return "as good" if lead.is_no_more and lag.is_no_more else "unknown"


def _best_by_seed(finding: ExpectedFinding, result: CurveResult, is_highest: bool) -> list[Optimum]:
    """Best value of each seed alone, for seeds that have any result."""
    table = valid_runs(result.curve, finding.of)
    optima = [optimum(result.curve.values, column, is_highest_best=is_highest) for column in table.T]
    return [best for best in optima if best is not None]


def judge_elbow_at(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict: confirmed if the error reaches its plateau at the expected value and is worse just below.

    Undecided one value beside it; refuted if it reaches the plateau later, or is as good just below.
    """
    curve, target = result.curve, finding.values[0]
    values = _scored_values(curve)
    if not values[0] <= target <= values[-1]:
        return "undecided", f"values from {values[0]:g} to {values[-1]:g} were run"
    start = _elbow(result)
    place = int(np.searchsorted(values, target))
    if start is None or _place(values, start) > place + 1:
        return _plateau_is_later(result, target, start)
    if start == values[0]:
        said = f"there is no elbow: {start:g}, the smallest value, is as good as the others"
        return _only_if_as_good(_rise_before(curve, values, place)), said
    said = f"the error is on its plateau from {start:g} on"
    rise = _rise_before(curve, values, _place(values, start))
    if start == values[place]:
        return "confirmed" if rise == "worse" else "undecided", f"{said}; below {BELOW[rise]}"
    if abs(_place(values, start) - place) == 1:
        return "undecided", f"{said}, one value beside {target:g}"
    return _only_if_as_good(_rise_before(curve, values, place)), said


def judge_good_from(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict: confirmed if the error is on its plateau there and some value below is worse, refuted if these are as good."""
    curve, target = result.curve, finding.values[0]
    values = _scored_values(curve)
    if not values[0] <= target <= values[-1]:
        return "undecided", f"values from {values[0]:g} to {values[-1]:g} were run"
    start = _elbow(result)
    if start is None or start > target:
        return _plateau_is_later(result, target, start)
    below = rise_below(curve, target)
    outcomes: dict[Rise, Outcome] = {"worse": "confirmed", "as good": "refuted", "unknown": "undecided"}
    return outcomes[below], f"the error is on its plateau from {target:g} on; below {target:g} {BELOW[below]}"


def _plateau_is_later(result: CurveResult, target: float, start: float | None) -> Judged:
    """Refuted if a value from the expected one to the plateau is worse by more than the scatter over seeds, else undecided."""
    curve = result.curve
    values = _scored_values(curve)
    level = plateau(curve, float(values[len(values) // 2]))
    said = "the error comes to no plateau" if start is None else f"the error is on its plateau from {start:g} on"
    before = np.flatnonzero((curve.values >= target) & (curve.values < (np.inf if start is None else start)))
    if any(rise_at(curve, int(index), level) == "worse" for index in before):
        return "refuted", said
    return "undecided", f"{said}, but before it no error is worse by more than the seeds scatter"


def _rise_before(curve: Curve, values: Floats, place: int) -> Rise:
    """Whether the error just below the value at `place` is worse than from there on."""
    if place == 0:
        return "unknown"
    return rise_at(curve, _place(curve.values, float(values[place - 1])), plateau(curve, float(values[place])))


def _only_if_as_good(rise: Rise) -> Outcome:
    """`refuted` if lower values are as good, else `undecided`."""
    return "refuted" if rise == "as good" else "undecided"


def _elbow(result: CurveResult) -> float | None:
    """Value from which the median error of a curve is on its plateau; None without one."""
    return elbow(result.curve.values, result.medians["translation"], result.curve.loses_most)


def _scored_values(curve: Curve) -> Floats:
    """Values with at least one scored run."""
    return curve.values[curve.with_score.any(1)]


def _place(values: Floats, value: float) -> int:
    """Index of a value that is among `values`."""
    return int(np.flatnonzero(values == value)[0])


def _loss_remark(curve: Curve, last: float) -> str:
    """Remark on the number of lost runs at values up to `last`, which work for most seeds; empty if none is lost."""
    at = curve.losses.any(1) & (curve.values <= last)
    lost, ran = int(curve.losses[at].sum()), int(curve.with_score[at].sum())
    listed = ", ".join(f"{value:g}" for value in curve.values[at])
    return f", though {lost} of {ran} runs at {listed} {'is' if lost == 1 else 'are'} lost" if lost else ""
