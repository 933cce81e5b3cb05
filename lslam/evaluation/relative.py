"""RPE: how far the motion between two poses is from the true motion."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.evaluation import pairs as pair_rules
from lslam.evaluation.results import RelativeError
from lslam.evaluation.statistics import describe
from lslam.geometry import se3, so3

Floats = NDArray[np.float64]
UNIT_NAMES = {"scan": "scan", "scans": "scan", "m": "m", "s": "s", "": "scan"}


def parse_delta(text: str) -> tuple[float, str, str]:
    """Distance, unit (scan, m, s) and pair rule of a recipe like `10m/all` or `1scan`.

    Without a rule, scans are compared consecutively, metres and seconds over all pairs. Raises UsageError.
    """
    found = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*(?:/\s*(consecutive|all))?\s*", text)
    unit = UNIT_NAMES.get(found.group(2)) if found else None
    try:
        value = float(found.group(1)) if found else 0.0
    except ValueError:
        value = 0.0
    if found is None or unit is None or not value > 0 or not np.isfinite(value):
        raise UsageError(
            f"RPE distance {text!r}: expected a number, scan|m|s and /consecutive or /all, for example 10m/all"
        )
    if unit == "scan" and value != int(value):
        raise UsageError(f"RPE distance {text!r}: scans are counted in whole numbers")
    return value, unit, found.group(3) or ("consecutive" if unit == "scan" else "all")


def relative_error(estimate: Floats, truth: Floats, seconds: Floats | None, recipe: str) -> RelativeError:
    """RPE of matched poses (N, 4, 4) for one `recipe`; `seconds` (N,) or None when nothing is known about time.

    Agrees with evo's RPE on scans and metres; pairs come from the estimate, as there.
    """
    delta, unit, rule = parse_delta(recipe)
    sentence = pair_rules.RULES[unit, rule].replace("`delta`", f"{delta:g} {unit}")
    if unit == "s" and seconds is None:
        return RelativeError(delta, unit, rule, 0, None, None, "n/a (no stamps)", sentence)
    pairs = _pairs(estimate, seconds, delta, unit, rule == "all")
    if len(pairs) == 0:
        return RelativeError(delta, unit, rule, 0, None, None, f"n/a (no poses {delta:g} {unit} apart)", sentence)
    E = error_transforms(estimate, truth, pairs)
    translation = np.linalg.norm(E[:, :3, 3], axis=1)
    angle = np.rad2deg(so3.angle(so3.normalise(E[:, :3, :3])))
    return RelativeError(
        delta, unit, rule, len(pairs), describe(translation), describe(angle), "", sentence,
        pair_ends=pairs[:, 1], translation_errors=translation, rotation_errors_deg=angle,
    )  # fmt: skip


def error_transforms(estimate: Floats, truth: Floats, pairs: NDArray[np.int64]) -> Floats:
    """E (M, 4, 4) = inv(inv(Q_i) Q_j) (inv(P_i) P_j) of `pairs` (M, 2); P estimate, Q truth, (N, 4, 4)."""
    i, j = pairs[:, 0], pairs[:, 1]
    return se3.relative(se3.relative(truth[i], truth[j]), se3.relative(estimate[i], estimate[j]))


def _pairs(poses: Floats, seconds: Floats | None, delta: float, unit: str, all_pairs: bool) -> NDArray[np.int64]:
    if unit == "scan":
        return pair_rules.by_index(len(poses), int(delta), all_pairs)
    if unit == "m":
        return pair_rules.by_path(poses[:, :3, 3], delta, all_pairs)
    assert seconds is not None
    return pair_rules.by_time(seconds, delta, all_pairs)
