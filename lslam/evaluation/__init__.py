"""Accuracy of trajectories; here, the names of metrics, checked before heavy imports."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from lslam.core.errors import UsageError, nearest

ALIGNMENTS = {
    "none": "estimate as it is",
    "origin": "first pose on the first true pose",
    "se3": "least squares over positions (Umeyama), rotation and translation",
    "sim3": "least squares over positions (Umeyama), rotation, translation and scale",
    "posyaw": "least squares over positions, translation and rotation about the vertical",
}
# Of `eval.metrics`: those by which the metrics of `METRICS` go that are not always shown.
WORDS = ("thesis",)
UNIT_NAMES = {"scan": "scan", "scans": "scan", "m": "m", "s": "s", "": "scan"}


def check_words(words: Sequence[str]) -> None:
    """Raise UsageError for a word of `eval.metrics` that names no metric."""
    for word in words:
        if word not in WORDS:
            raise UsageError(f"no metrics {word!r}; {nearest(word, WORDS)}")


def parse_delta(text: str) -> tuple[float, str, str]:
    """Distance, unit (scan, m, s) and pair rule of a recipe like `10m/all` or `1scan`.

    Without a rule, scans are compared consecutively, metres and seconds over all pairs. Raises UsageError.
    """
    match = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*(?:/\s*(consecutive|all))?\s*", text)
    unit = UNIT_NAMES.get(match.group(2)) if match else None
    try:
        value = float(match.group(1)) if match else 0.0
    except ValueError:
        value = 0.0
    if match is None or unit is None or not value > 0 or not math.isfinite(value):
        raise UsageError(
            f"RPE distance {text!r}: expected a number, scan|m|s and /consecutive or /all, for example 10m/all"
        )
    if unit == "scan" and value != int(value):
        raise UsageError(f"RPE distance {text!r}: scans are counted in whole numbers")
    return value, unit, match.group(3) or ("consecutive" if unit == "scan" else "all")
