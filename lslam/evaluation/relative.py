"""RPE: error of the motion between two poses against the true motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.config.outputs import EvalConfig
from lslam.core.geometry import se3, so3
from lslam.core.printable import metres
from lslam.core.types.comparison import Metric, Table
from lslam.evaluation import parse_delta
from lslam.evaluation.metric import (
    NO_ROTATIONS,
    Document,
    Evaluation,
    MatchedPoses,
    MetricRow,
    RelativeError,
    TrajectoryMetric,
    cells_of,
    describe,
    statistics_document,
    two,
)

Pairs = NDArray[np.int64]
TOLERANCE = 0.1  # of the distance, for pairs that must be as far apart as asked

RULES = {
    ("scan", "consecutive"): "each pose with the one `delta` later, end to end",
    ("scan", "all"): "every pose with the one `delta` later, overlapping",
    ("m", "consecutive"): "end to end, a pair ends where the estimate has travelled `delta` or more",
    ("m", "all"): "every pose with the later one whose distance along the estimate is nearest `delta`, within 10 %",
    ("s", "consecutive"): "end to end, each with the later pose whose stamp is nearest `delta` later, within 10 %",
    ("s", "all"): "every pose with the later one whose stamp is nearest `delta` later, within 10 %",
}


def by_index(count: int, delta: int, all_pairs: bool) -> Pairs:
    """Pairs (M, 2) of poses `delta` indices apart."""
    starts = np.arange(0, max(count - delta, 0), 1 if all_pairs else delta, dtype=np.int64)
    return np.stack([starts, starts + delta], axis=1)


def by_path(positions: Floats, delta: float, all_pairs: bool) -> Pairs:
    """Pairs (M, 2) of poses `delta` metres of path apart, `positions` (N, 3) of the estimate."""
    if all_pairs:
        steps = np.linalg.norm(positions[:-1] - positions[1:], axis=1)
        return _nearest(np.concatenate([[0.0], np.cumsum(steps)]), delta)
    ends, travelled = [0], 0.0
    for i in range(1, len(positions)):
        # One norm at a time and a sum that restarts: the last bit decides pairs on evenly spaced poses.
        travelled += float(np.linalg.norm(positions[i] - positions[i - 1]))
        if travelled >= delta:
            ends.append(i)
            travelled = 0.0
    return np.stack([ends[:-1], ends[1:]], axis=1).astype(np.int64)


def by_time(seconds: Floats, delta: float, all_pairs: bool) -> Pairs:
    """Pairs (M, 2) of poses `delta` seconds apart, `seconds` (N,) increasing."""
    every = _nearest(seconds, delta)
    if all_pairs:
        return every
    end_of = dict(every.tolist())
    pairs, i = [], 0
    while i < len(seconds):
        if i in end_of:
            pairs.append((i, end_of[i]))
        i = end_of.get(i, i + 1)
    return np.array(pairs, np.int64).reshape(-1, 2)


def _nearest(along: Floats, delta: float) -> Pairs:
    """Pairs (i, j): every i with the first j > i whose `along[j] - along[i]` is nearest to `delta`; dropped if over 10 % off."""
    tolerance = delta * TOLERANCE
    slack = 1e-9 * max(abs(float(along[-1])), delta, 1.0)
    low = np.searchsorted(along, along + (delta - tolerance - slack), side="left")
    high = np.searchsorted(along, along + (delta + tolerance + slack), side="right")
    pairs = []
    for i in range(len(along) - 1):
        first = max(int(low[i]), i + 1)
        if first >= high[i]:
            continue
        off = np.abs(along[first : high[i]] - along[i] - delta)
        best = int(np.argmin(off))
        if off[best] <= tolerance:
            pairs.append((i, first + best))
    return np.array(pairs, np.int64).reshape(-1, 2)


def relative_error(estimate: Floats, truth: Floats, seconds: Floats | None, recipe: str) -> RelativeError:
    """RPE of matched poses (N, 4, 4) for one `recipe`; `seconds` (N,) or None when nothing is known about time.

    Agrees with evo's RPE on scans and metres; pairs come from the estimate, as there.
    """
    delta, unit, rule = parse_delta(recipe)
    sentence = RULES[unit, rule].replace("`delta`", f"{delta:g} {unit}")
    if unit == "s" and seconds is None:
        return RelativeError(delta, unit, rule, 0, None, None, "n/a (no stamps)", sentence)
    pairs = _pairs(estimate, seconds, delta, unit, rule == "all")
    if len(pairs) == 0:
        return RelativeError(delta, unit, rule, 0, None, None, f"n/a (no poses {delta:g} {unit} apart)", sentence)
    E = error_transforms(estimate, truth, pairs)
    translation = np.linalg.norm(E[:, :3, 3], axis=1)
    angle = np.rad2deg(so3.angle(so3.normalise(E[:, :3, :3])))
    return RelativeError(
        delta,
        unit,
        rule,
        len(pairs),
        describe(translation),
        describe(angle),
        "",
        sentence,
        pair_ends=pairs[:, 1],
        translation_errors=translation,
        rotation_errors_deg=angle,
    )


def _without_rotations(recipe: str) -> RelativeError:
    """Unavailable error at one distance, for positions alone: RPE compares motions in the body frame."""
    delta, unit, rule = parse_delta(recipe)
    sentence = RULES[unit, rule].replace("`delta`", f"{delta:g} {unit}")
    return RelativeError(delta, unit, rule, 0, None, None, NO_ROTATIONS, sentence)


def error_transforms(estimate: Floats, truth: Floats, pairs: Longs) -> Floats:
    """E (M, 4, 4) = inv(inv(Q_i) Q_j) (inv(P_i) P_j) of `pairs` (M, 2); P estimate, Q truth, (N, 4, 4)."""
    i, j = pairs[:, 0], pairs[:, 1]
    return se3.relative(se3.relative(truth[i], truth[j]), se3.relative(estimate[i], estimate[j]))


def _pairs(poses: Floats, seconds: Floats | None, delta: float, unit: str, all_pairs: bool) -> Longs:
    """Pairs (K, 2) of pose indices that are `delta` apart, in the `unit` "scan", "m" or "s".

    all_pairs : one from every pose, overlapping; otherwise each begins where the last one ended. seconds : (N,), for "s" alone
    """
    if unit == "scan":
        return by_index(len(poses), int(delta), all_pairs)
    if unit == "m":
        return by_path(poses[:, :3, 3], delta, all_pairs)
    assert seconds is not None
    return by_time(seconds, delta, all_pairs)


class RelativePoseError(TrajectoryMetric[list[RelativeError]]):
    """RPE at each distance of `eval.delta`."""

    key, name, gate_option = "rpe", "RPE", "rpe"

    def measure(self, poses: MatchedPoses, config: EvalConfig) -> list[RelativeError]:
        if not poses.has_rotations:
            return [_without_rotations(text) for text in config.delta]
        return [relative_error(poses.estimate, poses.truth, poses.seconds, delta) for delta in config.delta]

    def document(self, score: list[RelativeError]) -> list[Document]:
        return [_document(error) for error in score]

    def summary(self, e: Evaluation) -> list[tuple[str, str]]:
        return [(self.name, _sentence(error)) for error in self.of(e)]

    def rows(self, es: Sequence[Evaluation]) -> list[MetricRow]:
        return [row for k in range(len(self.of(es[0]))) for row in _rows([self.of(e)[k] for e in es])]

    def recipes(self, e: Evaluation) -> list[str]:
        return [f"RPE {error.name}: {error.rule}, no alignment" for error in self.of(e)]

    def tables(self, e: Evaluation) -> list[Table]:
        """Table of the errors, one row per pair rule."""
        rows = []
        for error in self.of(e):
            if error.translation is None or error.rotation_deg is None:
                rows.append((error.name, str(error.n_pairs), error.note or "n/a", "", "", "", "", ""))
                continue
            t, r = error.translation, error.rotation_deg
            values = (metres(t.rmse), metres(t.mean), metres(t.max), f"{r.rmse:.4f}", f"{r.mean:.4f}", f"{r.max:.4f}")
            rows.append((error.name, str(error.n_pairs), *values))
        errors = (("translation", "m"), ("rotation", "deg"))
        columns = ((f"{what} rmse, {unit}", f"mean, {unit}", f"max, {unit}") for what, unit in errors)
        header = ("pair rule", "pairs", *chain.from_iterable(columns))
        recipe = (
            "E = inv(inv(Q_i) Q_j) (inv(P_i) P_j) over the pairs of the rule; P estimate, Q ground truth; no alignment."
        )
        return [Table("Relative pose error (RPE)", header, tuple(rows), recipe)]

    def gate_value(self, e: Evaluation) -> tuple[str, float | None, str]:
        first = self.of(e)[0]
        return f"RPE {first.name} rmse", first.translation.rmse if first.translation else None, "m"

    def comparison_metrics(self, configs: Sequence[EvalConfig]) -> list[Metric]:
        """Translation rmse of each pair rule of `configs` as main metric, rotation rmse as a further one."""
        deltas = list(dict.fromkeys(parse_delta(text) for config in configs for text in config.delta))
        metrics = []
        for delta, unit, pairs in deltas:
            recipe = f"{delta:g} {unit}, {pairs} pairs, no alignment; rmse of the translation"
            metrics.append(Metric(rpe_key(delta, unit, pairs), f"RPE {delta:g} {unit}", "m", "error", recipe))
        rotations = [f"{rpe_key(*delta)}.rotation" for delta in deltas]
        return metrics + [Metric(key, key, "deg", "error", is_main=False) for key in rotations]

    def values(self, document: Any) -> dict[str, float]:
        """Rmse of translation, m, and rotation, deg, by metric key, of the rules that have pairs."""
        values = {}
        for error in document:
            if error["n_pairs"]:
                key = rpe_key(error["delta"], error["unit"], error["pairs"])
                values[key], values[f"{key}.rotation"] = error["translation"]["rmse"], error["rotation_deg"]["rmse"]
        return values


def rpe_key(delta: float, unit: str, pairs: str) -> str:
    """Key of an RPE among the values of a run.

    >>> rpe_key(10.0, "m", "all")
    'rpe.10m.all'
    """
    return f"rpe.{delta:g}{unit}.{pairs}"


def _document(error: RelativeError) -> Document:
    """JSON document of the error; statistics that are missing are None."""
    return {
        "recipe": error.recipe,
        "delta": error.delta,
        "unit": error.unit,
        "pairs": error.pairs,
        "n_pairs": error.n_pairs,
        "note": error.note,
        "translation": statistics_document(error.translation),
        "rotation_deg": statistics_document(error.rotation_deg),
    }


def _sentence(error: RelativeError) -> str:
    """Error in words: rmse of translation and rotation, pair rule, number of pairs; the note if there are none."""
    if error.translation is None or error.rotation_deg is None:
        return f"{error.name}: {error.note or 'n/a'}"
    return f"{metres(error.translation.rmse)} m, {error.rotation_deg.rmse:.4f} deg rmse ({error.name}, n = {error.n_pairs})"


def _rows(errors: list[RelativeError]) -> list[MetricRow]:
    """Rows of a pair rule's errors, one cell per evaluation; only the first where none has pairs."""
    under = f"RPE {errors[0].name}"

    def cells(pick: Callable[[RelativeError], str]) -> list[str]:
        return cells_of(errors, lambda e: e.n_pairs > 0, pick)

    rows = [
        MetricRow(f"{under}: rmse / mean", "m", cells(lambda e: two(e.translation, "rmse", "mean"))),
        MetricRow("rotation rmse / mean", "deg", cells(lambda e: two(e.rotation_deg, "rmse", "mean")), under),
        MetricRow("pairs", "", [str(e.n_pairs) for e in errors], under),
    ]
    return rows if any(e.n_pairs for e in errors) else rows[:1]
