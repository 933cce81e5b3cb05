"""Findings about how much: a parameter that matters little, laws of time, and the stages it acts on."""

from __future__ import annotations

from itertools import permutations

import numpy as np

from lslam.config.study import ExpectedFinding
from lslam.evaluation.curves import NOT_REGISTRATION, contrast, over_seeds
from lslam.evaluation.laws import FEWEST, law_over, rival
from lslam.types.study import Bools, Curve, CurveResult, Floats, Judged, Law, Outcome

R2 = 0.95
OWN_SHARE = 0.8  # of the change of all stages, for a parameter that acts on one of them
LEAST_CHANGE = 0.1  # of registration's time: below it nothing was acted on
FEWEST_VALUES = 3
UNITS = {"translation": "m", "angular": "deg", "time_per_scan": "ms", "total_time": "s"}
_EQUAL = 1e-9  # R2 of laws that fit alike


def judge_matters_little(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Confirmed where the largest is less than so many times the smallest, refuted where it is more, scatter included.

    Refuted as well where most runs of some value are lost; a value without result, or numbers that do not vary at all,
    leave it undecided.
    """
    curve, medians = result.curve, result.medians[finding.of]
    known = np.isfinite(medians) & (medians > 0)
    if known.sum() < FEWEST_VALUES:
        return "undecided", f"fewer than {FEWEST_VALUES} values have a result"
    table = np.where(curve.lost, np.nan, curve.quantities[finding.of])
    top, bottom = (int(pick(np.where(known, medians, np.nan))) for pick in (np.nanargmax, np.nanargmin))
    largest, smallest = medians[top], medians[bottom]
    name, unit = finding.of.replace("_", " "), UNITS.get(finding.of, "")
    said = f"{name} goes from {smallest:.3g} to {largest:.3g} {unit}".rstrip()
    said += f", a factor of {largest / smallest:.2f}"
    lost = curve.is_lost
    if lost.any():
        outcome: Outcome = "refuted" if (curve.lost.sum(1)[lost] > 1).any() else "undecided"
        return outcome, f"{said}, and it diverges at {_listed(curve, lost)}"
    least, pairs = finding.values[0], permutations(table[known], 2)
    if contrast(table[top], table[bottom]).exceeds(least):
        return "refuted", said
    if not all(contrast(one, other).stays_below(least) for one, other in pairs):
        return "undecided", f"{said}, which seeds that are too few or too scattered do not tell from {least:g}"
    if not known.all():
        return "undecided", f"{said}, but nothing is known at {_listed(curve, ~known)}"
    if not np.ptp(np.nan_to_num(table), axis=0).any():
        return "undecided", f"{said}: it is the same to the last digit at every value, so the parameter was not in use"
    return "confirmed", said


def judge_law(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """As `_law`, of the total time over the studied parameter."""
    law = result.law
    if law is None or law.kind != finding.kind:
        assert finding.kind in ("linear", "inverse")
        law = law_over(finding.kind, result.curve, result.means["total_time"])
    return _law(finding, law)


def judge_product(finding: ExpectedFinding, law: Law | None, result: CurveResult) -> Judged:
    """As `_law`, of the total time over both studied parameters."""
    if result.curve.words:
        return "undecided", f"{result.curve.parameter} is not a number"
    return _law(finding, law)


def _law(finding: ExpectedFinding, law: Law | None) -> Judged:
    """Confirmed where it explains enough and nothing else does better; refuted where something else explains enough, or it is
    off by more than the seeds scatter.
    """
    if law is None:
        return "undecided", f"no law is fitted to fewer than {FEWEST} values"
    least = finding.values[0] if finding.values else R2
    worst = 100 * float(np.abs(law.residuals).max())
    said = f"{law.text} s with R2 {law.r2:.3f}, off by {worst:.0f} % at most"
    other, r2 = rival(law)
    if law.r2 >= least:
        if r2 > law.r2 - _EQUAL:
            return (
                "undecided",
                f"{said}, but {other} fits as well, with R2 {r2:.3f}: too few values, or too near each other",
            )
        return "confirmed", said
    if r2 >= least:
        return "refuted", f"{said}; {other} has R2 {r2:.3f}"
    misfit, scatter = _rms((law.observed - law.fitted) / law.observed), _rms(law.scatter / law.observed)
    if misfit > scatter:
        return "refuted", said
    return "undecided", f"{said}, which is no more than runs at one value scatter, as far as that is known"


def _rms(values: Floats) -> float:
    """Infinite where none is known: what scatters by an unknown amount may scatter by any."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("inf")


def judge_acts_only_on(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Confirmed when the named stages make up at least 80 % of the change, stage by stage, of registration, refuted when less;
    in most seeds by themselves too.
    """
    curve = result.curve
    change, level = _changes(curve)
    if not any(name in curve.stages for name in finding.stages):
        return "undecided", f"no stage {', '.join(finding.stages)} was timed"
    if level is None:
        return "undecided", f"fewer than {FEWEST_VALUES} values were timed"
    whole = sum(change.values())
    if not level or whole < LEAST_CHANGE * level:
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
    """By how many ms the mean of each stage of registration changes over the values, and what all take together.

    A stage that a timed run did not pass took no time. Nothing, and None, where fewer than 3 values were timed.
    """
    tables = {
        name: np.where(curve.lost, np.nan, table)
        for name, table in curve.stages.items()
        if name not in NOT_REGISTRATION
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
    return {name: float(np.ptp(mean)) for name, mean in means.items()}, float(
        np.sum([m.mean() for m in means.values()])
    )


def _own_share(finding: ExpectedFinding, change: dict[str, float]) -> float:
    return sum(change.get(name, 0.0) for name in finding.stages) / sum(change.values())


def _listed(curve: Curve, which: Bools) -> str:
    return ", ".join(curve.name_of(value) for value in curve.values[which])
