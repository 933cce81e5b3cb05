"""The metrics of two theses, by their own definitions.

Girolimetto: "Confronto di metodi SLAM basati su LiDAR mediante ambiente virtuale", University of Padua 2024.
Del Tufo: "Improved Graph SLAM with OpenStreetMap Priors", Politecnico di Milano 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.outputs import EvalConfig
from lslam.core.geometry import so3
from lslam.core.printable import metres, significant, with_decimals
from lslam.core.types.comparison import Metric, Table
from lslam.evaluation.absolute import align
from lslam.evaluation.metric import (
    NO_ROTATIONS,
    Evaluation,
    MatchedPoses,
    MetricRow,
    TrajectoryMetric,
    percent_of_length,
    two,
)

RPY = ("roll", "pitch", "yaw")
Verdict = Literal["reproduced", "refuted", "undecided"]
# A factor within which two numbers are of one size: other cities, sensors and seeds make as much.
LIKE = 2.0
# As seldom chance alone may put every seed on one side.
CHANCE = 0.05
# Share by which two numbers differ at least, or they are alike: 1 mm of 9 cm in each seed is no gain.
ALIKE = 0.05


@dataclass(frozen=True)
class AxisErrors:
    """Girolimetto's errors, origin alignment: estimate minus ground truth per axis of the ground truth's world.

    thesis_rmse : sqrt(sum |e|^2 / 3N), m, his equation 2.14 divided by sqrt(3); xyz : (N, 3) m; rpy_deg : (N, 3)
    angular : (N,) deg, equation 2.15; the _rmse values are per axis
    """

    alignment: str
    thesis_rmse: float
    rmse: float
    max_error: float
    percent_of_length: float
    xyz_rmse: tuple[float, float, float]
    rpy_rmse_deg: tuple[float, float, float]
    angular_rmse_deg: float
    angular_max_deg: float
    xyz: Floats
    rpy_deg: Floats
    angular: Floats
    recipe: str = "origin alignment; thesis_rmse = sqrt(sum|e|^2 / 3N): compare with the first thesis' tables only"


@dataclass(frozen=True)
class Planar:
    """Del Tufo's errors of SE(2) poses: mean and std of ATE (m), translational (m) and signed rotational RPE (rad).

    spacing : mean ground-truth distance between consecutive poses, m; theirs is about 2 m
    """

    ate_mean: float
    ate_std: float
    rpe_translation_mean: float
    rpe_translation_std: float
    rpe_rotation_mean: float
    rpe_rotation_std: float
    spacing: float
    recipe: str = (
        "SE(2) poses (x, y, yaw), shared start and heading; RPE between consecutive matched poses, rotation signed"
    )


def axis_errors(estimate: Floats, truth: Floats) -> AxisErrors:
    """Girolimetto, equations 2.14 and 2.15: errors per axis of poses (N, 4, 4) brought to the true start."""
    T, _, _ = align(estimate, truth, "origin")
    moved = T @ estimate
    e = moved[:, :3, 3] - truth[:, :3, 3]
    R_est, R_gt = so3.normalise(moved[:, :3, :3]), so3.normalise(truth[:, :3, :3])
    rpy = so3.euler_rpy(R_est) - so3.euler_rpy(R_gt)
    rpy_deg = np.rad2deg((rpy + np.pi) % (2 * np.pi) - np.pi)
    angular = np.rad2deg(so3.angle(R_est @ np.swapaxes(R_gt, -1, -2)))
    rmse = _rms(np.linalg.norm(e, axis=1))
    return AxisErrors(
        alignment="origin",
        thesis_rmse=_rms(e),
        rmse=rmse,
        max_error=float(np.linalg.norm(e, axis=1).max()),
        percent_of_length=percent_of_length(rmse, truth),
        xyz_rmse=(_rms(e[:, 0]), _rms(e[:, 1]), _rms(e[:, 2])),
        rpy_rmse_deg=(_rms(rpy_deg[:, 0]), _rms(rpy_deg[:, 1]), _rms(rpy_deg[:, 2])),
        angular_rmse_deg=_rms(angular),
        angular_max_deg=float(angular.max()),
        xyz=e,
        rpy_deg=rpy_deg,
        angular=angular,
    )


def planar(estimate: Floats, truth: Floats) -> Planar:
    """Del Tufo, equations 4.2 to 4.7: SE(2) errors of poses (N, 4, 4), N >= 2, after a shared start and heading."""
    T, _, _ = align(estimate, truth, "origin")
    p, q = _flatten(T @ estimate), _flatten(truth)
    # The start is shared in the plane too: flattening a tilted start leaves a rest of yaw.
    p = _compose(q[0], _relative(p[0], p))
    ate = np.linalg.norm(_relative(q, p)[:, :2], axis=1)
    delta = _relative(_relative(q[:-1], q[1:]), _relative(p[:-1], p[1:]))
    translation = np.linalg.norm(delta[:, :2], axis=1)
    return Planar(
        ate_mean=float(ate.mean()),
        ate_std=float(ate.std()),
        rpe_translation_mean=float(translation.mean()),
        rpe_translation_std=float(translation.std()),
        rpe_rotation_mean=float(delta[:, 2].mean()),
        rpe_rotation_std=float(delta[:, 2].std()),
        spacing=float(np.linalg.norm(np.diff(q[:, :2], axis=0), axis=1).mean()),
    )


def _flatten(poses: Floats) -> Floats:
    """(N, 3) x, y (m) and yaw (rad) of poses (N, 4, 4)."""
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.column_stack([poses[:, :2, 3], yaw])


def _relative(a: Floats, b: Floats) -> Floats:
    """inv(a) b of SE(2) poses (..., 3)."""
    d = b - a
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    turn = (d[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], turn], axis=-1)


def _compose(a: Floats, b: Floats) -> Floats:
    """SE(2) poses b (N, 3) composed with the pose a (3,) from the left."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.stack([a[0] + c * b[:, 0] - s * b[:, 1], a[1] + s * b[:, 0] + c * b[:, 1], a[2] + b[:, 2]], axis=-1)


def _rms(values: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _more(key: str, unit: str) -> Metric:
    """Metric that only CSV and JSON show."""
    return Metric(key, key, unit, "error", is_main=False)


class Girolimetto(TrajectoryMetric[AxisErrors]):
    """Errors per axis."""

    key, name, word = "thesis1", "thesis1", "thesis"
    columns = (
        ("thesis_rmse", _more("thesis_rmse", "m")),
        ("max_error", _more("thesis_max", "m")),
        ("angular_rmse_deg", _more("thesis_angular", "deg")),
        ("angular_max_deg", _more("thesis_angular_max", "deg")),
    )
    axes = tuple(_more(f"thesis_{axis}", unit) for axes, unit in (("xyz", "m"), (RPY, "deg")) for axis in axes)

    def measure(self, poses: MatchedPoses, config: EvalConfig) -> AxisErrors:
        """Errors per axis after alignment at the first pose; NaN with a note where the truth has no rotations."""
        if not poses.has_rotations:
            nan, three, none = float("nan"), (float("nan"),) * 3, np.full((len(poses.truth), 3), np.nan)
            return AxisErrors(
                "origin", nan, nan, nan, nan, three, three, nan, nan, none, none, none[:, 0], NO_ROTATIONS
            )
        return axis_errors(poses.estimate, poses.truth)

    def comparison_metrics(self, configs: Sequence[EvalConfig]) -> list[Metric]:
        return [*super().comparison_metrics(configs), *self.axes]

    def values(self, document: Any) -> dict[str, float]:
        by_axis = zip(self.axes, (*document["xyz_rmse"], *document["rpy_rmse_deg"]), strict=True)
        return super().values(document) | {axis.key: value for axis, value in by_axis if value is not None}

    def summary(self, e: Evaluation) -> list[tuple[str, str]]:
        return [(self.name, f"{metres(self.of(e).thesis_rmse)} m (thesis_rmse, sqrt(sum|e|²/3N), origin alignment)")]

    def rows(self, es: Sequence[Evaluation]) -> list[MetricRow]:
        """Rows of the scores, one cell per evaluation."""
        scores, below = [self.of(e) for e in es], self.name
        return [
            MetricRow("thesis1 thesis_rmse", "m", [significant(s.thesis_rmse) for s in scores]),
            MetricRow("x / y / z rmse", "m", [_join(s.xyz_rmse) for s in scores], below),
            MetricRow("roll / pitch / yaw rmse", "deg", [_join(s.rpy_rmse_deg) for s in scores], below),
            MetricRow(
                "angular rmse / max", "deg", [two(s, "angular_rmse_deg", "angular_max_deg") for s in scores], below
            ),
        ]

    def tables(self, e: Evaluation) -> list[Table]:
        """Table of the rmse per axis, m and deg."""
        s = self.of(e)
        header = (
            "",
            *(f"{name}, m" for name in ("thesis_rmse", *"xyz")),
            *(f"{name}, deg" for name in (*RPY, "angular")),
        )
        angles = (with_decimals(v, 3) for v in (*s.rpy_rmse_deg, s.angular_rmse_deg))
        row = ("rmse", metres(s.thesis_rmse), *(metres(v) for v in s.xyz_rmse), *angles)
        return [Table("Girolimetto (thesis1): errors per axis", header, (row,), f"{s.recipe}.")]


class DelTufo(TrajectoryMetric[Planar]):
    """Planar errors."""

    key, name, word = "thesis2", "thesis2", "thesis"
    columns = (
        ("ate_mean", _more("planar_ate", "m")),
        ("rpe_translation_mean", _more("planar_rpe", "m")),
    )

    def measure(self, poses: MatchedPoses, config: EvalConfig) -> Planar:
        if not poses.has_rotations:
            nan = float("nan")
            return Planar(nan, nan, nan, nan, nan, nan, nan, NO_ROTATIONS)
        return planar(poses.estimate, poses.truth)

    def summary(self, e: Evaluation) -> list[tuple[str, str]]:
        s = self.of(e)
        return [(self.name, f"ATE {metres(s.ate_mean)} ± {metres(s.ate_std)} m (planar, mean ± std)")]

    def rows(self, es: Sequence[Evaluation]) -> list[MetricRow]:
        """Rows of mean ± standard deviation, one cell per evaluation."""
        scores = [self.of(e) for e in es]

        def row(label: str, unit: str, key: str, below: str = self.name) -> MetricRow:
            cells = [
                f"{significant(getattr(s, f'{key}_mean'))} ± {significant(getattr(s, f'{key}_std'))}" for s in scores
            ]
            return MetricRow(label, unit, cells, below)

        return [
            row("thesis2 planar ATE", "m", "ate", ""),
            row("RPE translation", "m", "rpe_translation"),
            row("RPE rotation, signed", "rad", "rpe_rotation"),
        ]

    def recipes(self, e: Evaluation) -> list[str]:
        spacing = self.of(e).spacing
        return [
            f"{self.name}: {self.of(e).recipe}" + (f"; mean spacing {spacing:.2f} m" if np.isfinite(spacing) else "")
        ]

    def tables(self, e: Evaluation) -> list[Table]:
        """Table of mean and standard deviation of each error."""
        s = self.of(e)
        rows = (
            ("ATE, m", metres(s.ate_mean), metres(s.ate_std)),
            ("RPE translation, m", with_decimals(s.rpe_translation_mean, 5), with_decimals(s.rpe_translation_std, 5)),
            ("RPE rotation, rad", f"{s.rpe_rotation_mean:.3e}", f"{s.rpe_rotation_std:.3e}"),
        )
        recipe = f"{s.recipe}; matched poses are {with_decimals(s.spacing, 2)} m apart."
        return [Table("Del Tufo (thesis2): planar errors", ("", "mean", "std"), rows, recipe)]


def _join(values: Sequence[float]) -> str:
    """Numbers as text with slashes between."""
    return " / ".join(significant(value) for value in values)


@dataclass(frozen=True)
class Judgement:
    """A verdict and why."""

    verdict: Verdict
    why: str


def median_and_worst(values: Sequence[float]) -> tuple[float, float]:
    """Median and worst; a run that failed, inf, is the worst.

    >>> median_and_worst([1.0, 3.0, float("inf"), 2.0])
    (3.0, inf)
    """
    ordered = sorted(values)
    middle = ordered[len(ordered) // 2] if np.isinf(ordered).any() else float(np.median(ordered))
    return middle, ordered[-1]


def difficulty(pairs: Sequence[tuple[float | None, Sequence[float]]]) -> str:
    """How hard our drives were beside those of the thesis: `as hard`, `easier`, `harder` or `partly as hard`.

    Empty where it is unknown. A measure is as hard if the median of our runs is that printed, up to the factor `LIKE`.
    pairs : for each measure, the printed number and those of our runs; all must agree

    >>> difficulty([(2.0, [0.1, 0.2])]), difficulty([(2.0, [1.5]), (9.0, [8.0])]), difficulty([(None, [1.0])])
    ('easier', 'as hard', '')
    >>> difficulty([(2.0, [1.5]), (9.0, [2.0])])
    'partly as hard'
    """
    answers = set()
    for thesis_value, values in pairs:
        if thesis_value is not None and values:
            ratio = median_and_worst(values)[0] / thesis_value
            answers.add("as hard" if 1 / LIKE <= ratio <= LIKE else "easier" if ratio < 1 else "harder")
    return "partly as hard" if len(answers) > 1 else "".join(answers)


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


def judge_number(thesis_value: float, values: Sequence[float], hardness: str = "") -> Judgement:
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
    if low / LIKE <= thesis_value <= high * LIKE:
        return Judgement("reproduced", f"{thesis_value:g} lies among the runs, within a factor of {LIKE:g}")
    side = "smaller" if high < thesis_value else "larger"
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
