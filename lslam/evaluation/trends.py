"""Verdicts on trends over the studied parameter, and on what the IMU makes of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lslam.core.config.study import ExpectedFinding
from lslam.core.types.arrays import Bools, Floats
from lslam.core.types.study import CurveResult, Judged
from lslam.evaluation.curves import contrast
from lslam.evaluation.verdicts import FEWEST_VALUES

# Sign that the change is expected to have.
OF_IMU = {"imu_lowers": -1.0, "imu_flattens": -1.0, "imu_steepens": 1.0}


def judge_trend(finding: ExpectedFinding, result: CurveResult) -> Judged:
    """Verdict on a rise or fall: of each seed, the median over the upper half of the values against that over the lower half.

    Confirmed if larger, or smaller, by a tenth and by more than the scatter over seeds; refuted if it is no more than that.
    """
    table = _kept(finding, result)
    half = len(table) // 2
    if np.isfinite(table).any(1).sum() < FEWEST_VALUES:
        return "undecided", f"fewer than {FEWEST_VALUES} values have a result"
    lower, upper = (_medians(part) for part in (table[:half], table[-half:]))
    first, second = (upper, lower) if finding.kind == "rises" else (lower, upper)
    found = contrast(first, second)
    said = f"{finding.of.replace('_', ' ')} of the upper half of the values is {_ratio(upper, lower)} times that of the lower"
    if found.is_more:
        return "confirmed", said
    return ("refuted" if found.is_no_more else "undecided"), said


def judge_imu(finding: ExpectedFinding, result: CurveResult, others: Sequence[CurveResult]) -> Judged:
    """Verdict on a run with the IMU against the same without: level or slope, seed by seed, over values that both have.

    Confirmed if the difference is of the expected sign by more than the scatter over seeds; refuted if of the other.
    """
    curve = result.curve
    same = [o for o in others if (o.curve.method, o.curve.at, o.curve.uses_imu) == (curve.method, curve.at, False)]
    if not same or not np.array_equal(same[0].curve.values, curve.values) or same[0].curve.seeds != curve.seeds:
        return "undecided", "the same was not run without the IMU"
    with_imu, without = (_kept(finding, each) for each in (result, same[0]))
    known = np.isfinite(with_imu) & np.isfinite(without) & (with_imu > 0) & (without > 0)
    seeds = np.flatnonzero(known.sum(0) >= FEWEST_VALUES)
    name = finding.of.replace("_", " ")
    if len(seeds) < 2:
        return "undecided", f"{name}: fewer than 2 seeds have {FEWEST_VALUES} values with and without the IMU"
    if finding.kind == "imu_lowers":
        ratios = [float(np.median(with_imu[known[:, s], s] / without[known[:, s], s])) for s in seeds]
        changes, said = np.log(ratios), f"{name} with the IMU is {np.median(ratios):.2f} times that without"
    else:
        slopes = np.array([[_slope(curve.values, t[:, s], known[:, s]) for t in (with_imu, without)] for s in seeds])
        changes = slopes[:, 0] - slopes[:, 1]
        middle = np.median(slopes, axis=0)
        said = f"{name} goes by {middle[0]:.3g} with and {middle[1]:.3g} without the IMU for each unit"
    signed = OF_IMU[finding.kind] * changes
    mean, std = float(signed.mean()), float(signed.std(ddof=1))
    if mean - std > 0:
        return "confirmed", said
    return ("refuted", said) if mean + std < 0 else ("undecided", f"{said}, by less than the seeds scatter")


def _kept(finding: ExpectedFinding, result: CurveResult) -> Floats:
    """(V, S) of the runs that were not lost, nan for the others."""
    curve = result.curve
    return np.where(curve.losses, np.nan, curve.quantities[finding.of])


def _medians(part: Floats) -> Floats:
    """(S,) median over the values of each seed, nan where it has none."""
    out = np.full(part.shape[1], np.nan)
    known = np.isfinite(part).any(0)
    out[known] = np.nanmedian(part[:, known], axis=0)
    return out


def _ratio(upper: Floats, lower: Floats) -> str:
    known = np.isfinite(upper) & np.isfinite(lower) & (lower > 0)
    return f"{np.median(upper[known] / lower[known]):.2f}" if known.any() else "unknown"


def _slope(values: Floats, numbers: Floats, known: Bools) -> float:
    return float(np.polyfit(values[known], numbers[known], 1)[0])
