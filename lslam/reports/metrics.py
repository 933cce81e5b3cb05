"""The numbers of an evaluation as tables, every table with the recipe of its numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lslam.evaluation.results import ALIGNMENTS

if TYPE_CHECKING:
    from lslam.evaluation.results import Evaluation


@dataclass(frozen=True)
class Table:
    """Rows of texts under a header; the first column is the name. `recipe` says how the numbers came about."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    recipe: str


def metric_tables(evaluation: Evaluation) -> list[Table]:
    """ATE, RPE, KITTI drift and the two theses' forms."""
    tables = [ate_table(evaluation), rpe_table(evaluation), drift_table(evaluation), *thesis_tables(evaluation)]
    return [table for table in tables if table.rows]


def ate_table(evaluation: Evaluation) -> Table:
    """Absolute errors, one row per alignment."""
    rows = []
    for name, error in evaluation.ate.items():
        if not error.available or error.translation is None:
            rows.append((name, error.note or "n/a", *[""] * 8))
            continue
        t = error.translation
        rows.append(
            (
                name,
                *(metres(v) for v in (t.rmse, t.mean, t.median, t.std, t.max)),
                metres(error.horizontal.rmse) if error.horizontal else "",
                metres(error.vertical.rmse) if error.vertical else "",
                f"{error.rotation_deg.rmse:.3f}" if error.rotation_deg else "",
                fixed(error.percent_of_length, 2),
            )
        )
    header = (
        "alignment", "rmse, m", "mean, m", "median, m", "std, m", "max, m", "horizontal rmse, m", "vertical rmse, m",
        "rotation rmse, deg", "rmse, % of length",
    )  # fmt: skip
    alignments = "; ".join(f"{name}: {ALIGNMENTS.get(name, name)}" for name in evaluation.ate)
    recipe = f"{evaluation.matched} of {evaluation.possible} poses matched, path {evaluation.path_length:.1f} m. {alignments}."
    return Table("Absolute trajectory error (ATE)", header, tuple(rows), recipe)


def rpe_table(evaluation: Evaluation) -> Table:
    """Relative errors, one row per pair rule."""
    rows = []
    for error in evaluation.rpe:
        name = error.name
        if error.translation is None or error.rotation_deg is None:
            rows.append((name, str(error.n_pairs), error.note or "n/a", "", "", "", "", ""))
            continue
        t, r = error.translation, error.rotation_deg
        values = (metres(t.rmse), metres(t.mean), metres(t.max), f"{r.rmse:.4f}", f"{r.mean:.4f}", f"{r.max:.4f}")
        rows.append((name, str(error.n_pairs), *values))
    header = (
        "pair rule", "pairs", "translation rmse, m", "mean, m", "max, m", "rotation rmse, deg", "mean, deg", "max, deg",
    )  # fmt: skip
    recipe = (
        "E = inv(inv(Q_i) Q_j) (inv(P_i) P_j) over the pairs of the rule; P estimate, Q ground truth; no alignment."
    )
    return Table("Relative pose error (RPE)", header, tuple(rows), recipe)


def drift_table(evaluation: Evaluation) -> Table:
    """KITTI's drift, all lengths and each length."""
    drift = evaluation.kitti_drift
    recipe = f"{drift.recipe}."
    header = ("segment length", "translation, %", "rotation, deg/100 m", "segments")
    if not drift.available:
        return Table("KITTI drift", header, (("all", drift.note or "n/a", "", "0"),), recipe)
    rows = [("all", f"{drift.translation_percent:.3f}", f"{drift.rotation_deg_per_100m:.4f}", str(drift.segments))]
    for length, (translation, rotation, count) in sorted(drift.by_length.items()):
        if count:
            rows.append((f"{length} m", f"{translation:.3f}", f"{rotation:.4f}", str(count)))
    return Table("KITTI drift", header, tuple(rows), recipe)


def thesis_tables(evaluation: Evaluation) -> list[Table]:
    """The forms in which the two theses behind lslam print their errors."""
    first, second = evaluation.thesis1, evaluation.thesis2
    header = (
        "", "thesis_rmse, m", "x, m", "y, m", "z, m", "roll, deg", "pitch, deg", "yaw, deg", "angular, deg",
    )  # fmt: skip
    angles = (fixed(v, 3) for v in (*first.rpy_rmse_deg, first.angular_rmse_deg))
    row = ("rmse", metres(first.thesis_rmse), *(metres(v) for v in first.xyz_rmse), *angles)
    tables = [Table("thesis1: errors per axis", header, (row,), f"{first.recipe}.")]
    rows = (
        ("ATE, m", metres(second.ate_mean), metres(second.ate_std)),
        ("RPE translation, m", fixed(second.rpe_translation_mean, 5), fixed(second.rpe_translation_std, 5)),
        ("RPE rotation, rad", f"{second.rpe_rotation_mean:.3e}", f"{second.rpe_rotation_std:.3e}"),
    )
    recipe = f"{second.recipe}; matched poses are {second.spacing:.2f} m apart."
    return [*tables, Table("thesis2: planar errors", ("", "mean", "std"), rows, recipe)]


def metres(value: float) -> str:
    """A length with a millimetre's resolution, finer when it is small.

    >>> metres(1.23456), metres(0.00123456), metres(float("nan"))
    ('1.235', '0.0012', 'n/a')
    """
    if not np.isfinite(value):
        return "n/a"
    return f"{value:.3f}" if abs(value) >= 0.01 or value == 0 else f"{value:.4f}"


def counted(number: int, noun: str) -> str:
    """A number with its noun, in the plural unless it is one."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def fixed(value: float, decimals: int) -> str:
    """A number with fixed decimals, `n/a` when it is not finite."""
    return f"{value:.{decimals}f}" if np.isfinite(value) else "n/a"
