"""Runs compared with what a thesis prints: number by number, and one system against another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Verdict = Literal["reproduced", "refuted", "undecided"]
# A factor within which two numbers are of one size: other cities, sensors and seeds make as much.
LIKE = 2.0
# As seldom chance alone may put every seed on one side.
CHANCE = 0.05
# Share by which two numbers differ at least, or they are alike: 1 mm of 9 cm in each seed is no gain.
ALIKE = 0.05


@dataclass(frozen=True)
class Judgement:
    """A verdict and why."""

    verdict: Verdict
    why: str


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Median and worst; a run that failed, inf, is the worst.

    >>> spread([1.0, 3.0, float("inf"), 2.0])
    (3.0, inf)
    """
    ordered = sorted(values)
    middle = ordered[len(ordered) // 2] if np.isinf(ordered).any() else float(np.median(ordered))
    return middle, ordered[-1]


def difficulty(pairs: Sequence[tuple[float | None, Sequence[float]]]) -> str:
    """How hard ours was beside theirs: `as hard`, `easier`, `harder` or `partly as hard`; empty where nobody knows.

    pairs : of each measure of it, the printed number and those of our runs; all must say the same

    >>> difficulty([(2.0, [0.1, 0.2])]), difficulty([(2.0, [1.5]), (9.0, [8.0])]), difficulty([(None, [1.0])])
    ('easier', 'as hard', '')
    >>> difficulty([(2.0, [1.5]), (9.0, [2.0])])
    'partly as hard'
    """
    found = set()
    for printed, values in pairs:
        if printed is not None and values:
            ratio = spread(values)[0] / printed
            found.add("as hard" if 1 / LIKE <= ratio <= LIKE else "easier" if ratio < 1 else "harder")
    return "partly as hard" if len(found) > 1 else "".join(found)


def judge_time(values: Sequence[float], limit: float | None) -> Judgement:
    """Whether each run has kept up with the recording, as each that is printed has; s per scan, and those from scan to scan.

    >>> judge_time([0.1, 0.2], 0.4).verdict, judge_time([0.1, 0.5], 0.4).verdict, judge_time([0.1], None).verdict
    ('reproduced', 'undecided', 'undecided')
    """
    if limit is None or not values or max(values) == np.inf:
        return Judgement("undecided", "no time, or no limit")
    slow = sum(value > limit for value in values)
    said = f"{slow} of {len(values)} runs" if slow else f"none of {len(values)} runs"
    verdict: Verdict = "undecided" if slow else "reproduced"
    return Judgement(verdict, f"{said} took longer than the {limit:g} s from scan to scan; another machine")


def judge_number(printed: float, values: Sequence[float], hardness: str = "") -> Judgement:
    """Whether ours is of the printed size. It is refuted only where all runs are off to one side, of what was as hard.

    >>> judge_number(0.8, [0.5, 0.9]).verdict, judge_number(0.8, [0.1, 0.2], "as hard").verdict
    ('reproduced', 'refuted')
    >>> judge_number(0.8, [0.1, 0.2], "easier").why
    'all 2 runs are smaller by more than 2 times, of what was easier'
    """
    failed = sum(map(np.isinf, values))
    if failed or not values:
        return Judgement("undecided", f"{failed} of {len(values)} runs failed")
    low, high = min(values), max(values)
    if low / LIKE <= printed <= high * LIKE:
        return Judgement("reproduced", f"{printed:g} lies among the runs, within a factor of {LIKE:g}")
    side = "smaller" if high < printed else "larger"
    text = f"all {len(values)} runs are {side} by more than {LIKE:g} times"
    if hardness == "as hard":
        return Judgement("refuted", f"{text}, of what was as hard")
    return Judgement(
        "undecided", f"{text}, of what was {hardness}" if hardness else f"{text}; how hard it was nobody knows"
    )


def judge_order(is_smaller: bool, pairs: Sequence[tuple[float, float]]) -> Judgement:
    """Whether the first of each pair, of one seed, is smaller (or larger) than the second, as it is stated.

    Decided where every seed says the same, so many of them do not by chance, and by more than ALIKE.

    >>> judge_order(True, [(1, 2)] * 5).verdict, judge_order(False, [(1, 2)] * 5).verdict, judge_order(True, [(1, 2)] * 4).verdict
    ('reproduced', 'refuted', 'undecided')
    """
    unequal = [(a, b) for a, b in pairs if a != b]
    if not unequal:
        return Judgement("undecided", "no pair of runs")
    agree = sum((a < b) == is_smaller for a, b in unequal)
    finite = [a / b for a, b in unequal if np.isfinite([a, b]).all() and b > 0]
    ratio = f"; median ratio {np.median(finite):.2f}" if finite else ""
    text = f"so in {agree} of {len(pairs)} seeds{ratio}"
    is_certain = agree in (0, len(pairs)) and len(unequal) == len(pairs) and 0.5 ** len(pairs) < CHANCE
    if not is_certain:
        return Judgement("undecided", text)
    if finite and abs(np.median(finite) - 1) < ALIKE:
        return Judgement("undecided", f"{text}, which is alike")
    return Judgement("reproduced" if agree else "refuted", text)
