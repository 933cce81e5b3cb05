"""ATE: position and rotation errors of the aligned estimate against ground truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import UsageError, nearest
from lslam.core.geometry import se3, so3
from lslam.core.printable import metres, significant, with_decimals
from lslam.core.types.comparison import Metric, Table
from lslam.evaluation import ALIGNMENTS
from lslam.evaluation.metric import (
    NO_ROTATIONS,
    AbsoluteError,
    Document,
    Evaluation,
    MatchedPoses,
    MetricRow,
    TrajectoryMetric,
    cells_of,
    describe,
    percent_of_length,
    statistics_document,
    two,
)


def absolute_error(estimate: Floats, truth: Floats, alignment: str, has_rotations: bool = True) -> AbsoluteError:
    """ATE of matched poses (N, 4, 4), N >= 1, under `alignment`; z of the ground truth's world is up.

    Agrees with evo's APE (translation part, rotation angle) for none, origin, se3 and sim3. Without rotations there is no
    alignment by the first pose, and no angle. Raises UsageError for an unknown alignment.
    """
    T, scale, note = align(estimate, truth, alignment)
    if alignment == "origin" and not has_rotations:
        note = NO_ROTATIONS
    if note:
        empty = np.zeros((0, 3))
        return AbsoluteError(
            alignment, False, note, None, None, None, None, float("nan"), T, scale, empty, np.zeros(0), empty
        )
    positions = scale * estimate[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    errors = positions - truth[:, :3, 3]
    turned = np.swapaxes(T[:3, :3] @ estimate[:, :3, :3], -1, -2) @ truth[:, :3, :3]
    # Printed matrices are rotations to six digits only; the angle of the nearest rotation is what is meant.
    angles = np.rad2deg(so3.angle(so3.normalise(turned))) if has_rotations else np.full(len(errors), np.nan)
    translation = describe(np.linalg.norm(errors, axis=1))
    return AbsoluteError(
        alignment=alignment,
        available=True,
        note="",
        translation=translation,
        rotation_deg=describe(angles) if has_rotations else None,
        horizontal=describe(np.linalg.norm(errors[:, :2], axis=1)),
        vertical=describe(np.abs(errors[:, 2])),
        percent_of_length=percent_of_length(translation.rmse, truth) if translation else float("nan"),
        T_gt_est=T,
        scale=scale,
        errors=errors,
        rotation_errors_deg=angles,
        aligned_positions=positions,
    )


def align(estimate: Floats, truth: Floats, alignment: str) -> tuple[Floats, float, str]:
    """Alignment as transform (4, 4) and scale, and a note if it is not determined; UsageError for an unknown name."""
    if alignment not in ALIGNMENTS:
        raise UsageError(f"no alignment {alignment!r}; {nearest(alignment, ALIGNMENTS)}")
    p, q = estimate[:, :3, 3], truth[:, :3, 3]
    if alignment == "none":
        return np.eye(4), 1.0, ""
    if alignment == "origin":
        return np.asarray(truth[0] @ se3.inverse(estimate[0])), 1.0, ""
    if len(p) < 3:
        return np.eye(4), 1.0, f"n/a ({len(p)} poses)"
    if alignment == "posyaw":
        return _position_and_yaw(p, q)
    T, scale, is_determined = se3.umeyama(p, q, with_scale=alignment == "sim3")
    return (T, scale, "") if is_determined else (np.eye(4), 1.0, "n/a (collinear)")


def _position_and_yaw(p: Floats, q: Floats) -> tuple[Floats, float, str]:
    """Alignment by position and yaw, the four unknowns that gravity leaves open (Zhang and Scaramuzza 2018, section IV)."""
    a, b = p - p.mean(0), q - q.mean(0)
    sine = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    cosine = float(np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    if np.hypot(sine, cosine) <= 1e-12 * max(float(np.sum(b * b)), 1e-12):
        return np.eye(4), 1.0, "n/a (no horizontal motion)"
    R = so3.exp(np.array([0.0, 0.0, np.arctan2(sine, cosine)]))
    return se3.make(R, q.mean(0) - R @ p.mean(0)), 1.0, ""


class AbsoluteTrajectoryError(TrajectoryMetric[dict[str, AbsoluteError]]):
    """ATE under each alignment of `eval.align`."""

    key, name, gate_option = "ate", "ATE", "ate"

    def measure(self, poses: MatchedPoses, config: EvalConfig) -> dict[str, AbsoluteError]:
        return {name: absolute_error(poses.estimate, poses.truth, name, poses.has_rotations) for name in config.align}

    def document(self, score: dict[str, AbsoluteError]) -> Document:
        return {name: _document(error) for name, error in score.items()}

    def summary(self, e: Evaluation) -> list[tuple[str, str]]:
        return [(f"ATE {name}", _sentence(error, e)) for name, error in self.of(e).items()]

    def rows(self, es: Sequence[Evaluation]) -> list[MetricRow]:
        return [row for name in self.of(es[0]) for row in _rows(name, [self.of(e)[name] for e in es])]

    def recipes(self, e: Evaluation) -> list[str]:
        errors = self.of(e).items()
        return [f"ATE {error.recipe if error.available else f'{name}: {error.note}'}" for name, error in errors]

    def tables(self, e: Evaluation) -> list[Table]:
        """Table of the errors, one row per alignment."""
        rows = []
        for name, error in self.of(e).items():
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
                    with_decimals(error.percent_of_length, 2),
                )
            )
        lengths = (
            f"{what}, m" for what in ("rmse", "mean", "median", "std", "max", "horizontal rmse", "vertical rmse")
        )
        header = ("alignment", *lengths, "rotation rmse, deg", "rmse, % of length")
        alignments = "; ".join(f"{name}: {ALIGNMENTS.get(name, name)}" for name in self.of(e))
        recipe = f"{e.matched} of {e.possible} poses matched, path {e.path_length:.1f} m. {alignments}."
        return [Table("Absolute trajectory error (ATE)", header, tuple(rows), recipe)]

    def cards(self, e: Evaluation) -> list[tuple[str, str, str]]:
        return [
            (metres(error.translation.rmse), "m", f"ATE rmse, {name}")
            for name, error in self.of(e).items()
            if error.available and error.translation is not None
        ]

    def gate_value(self, e: Evaluation) -> tuple[str, float | None, str]:
        for error in self.of(e).values():
            if error.translation:
                return f"ATE {error.alignment} rmse", error.translation.rmse, "m"
        return "ATE", None, "m"

    def comparison_metrics(self, configs: Sequence[EvalConfig]) -> list[Metric]:
        """Rmse of each alignment of `configs` as main metric, its largest error and rotation as further ones."""
        names = list(dict.fromkeys(name for config in configs for name in config.align))
        main = [
            Metric(f"ate.{name}", f"ATE {name}", "m", "error", f"alignment {name}: {ALIGNMENTS[name]}; rmse over poses")
            for name in names
        ]
        more = [(f"ate.{name}.{what}", unit) for name in names for what, unit in (("max", "m"), ("rotation", "deg"))]
        return main + [Metric(key, key, unit, "error", is_main=False) for key, unit in more]

    def values(self, document: Document) -> dict[str, float]:
        """Rmse, m, largest error, m, and rotation rmse, deg, by metric key, of the alignments that are available."""
        values = {}
        for name, error in document.items():
            if error["available"]:
                values[f"ate.{name}"] = error["rmse"]
                values[f"ate.{name}.max"] = error["max"]
                values[f"ate.{name}.rotation"] = error["rotation_deg"]["rmse"]
        return {key: value for key, value in values.items() if value is not None}


def _document(error: AbsoluteError) -> Document:
    """JSON document of the error; statistics that are missing are None."""
    return {
        "recipe": error.recipe,
        "available": error.available,
        "note": error.note,
        "unit": "m",
        **statistics_document(error.translation),
        "rotation_deg": statistics_document(error.rotation_deg),
        "horizontal": statistics_document(error.horizontal),
        "vertical": statistics_document(error.vertical),
        "percent_of_length": error.percent_of_length,
        "T_gt_est": error.T_gt_est.tolist(),
        "scale": error.scale,
    }


def _sentence(error: AbsoluteError, e: Evaluation) -> str:
    """Error in words: rmse, maximum, share of the length and alignment; the note where it is not available."""
    if not error.available or error.translation is None:
        return error.note or "n/a"
    rotation = f", {error.rotation_deg.rmse:.3f} deg" if error.rotation_deg else ""
    return (
        f"{metres(error.translation.rmse)} m rmse{rotation}, max {metres(error.translation.max)} m, "
        f"{with_decimals(error.percent_of_length, 2)} % of length ({ALIGNMENTS.get(error.alignment, error.alignment)}; "
        f"{e.matched} of {e.possible} poses)"
    )


def _rows(name: str, errors: list[AbsoluteError]) -> list[MetricRow]:
    """Rows of an alignment's errors, one cell per evaluation; only the first where none is available."""
    under = f"ATE {name}"

    def row(label: str, unit: str, pick: Callable[[AbsoluteError], str], under: str = under) -> MetricRow:
        return MetricRow(label, unit, cells_of(errors, lambda e: e.available, pick), under)

    def rmse(error: AbsoluteError, what: str) -> str:
        values = getattr(error, what)
        return "n/a" if values is None else significant(values.rmse)

    rows = [
        row(f"{under} rmse", "m", lambda e: rmse(e, "translation"), ""),
        row("mean / median", "m", lambda e: two(e.translation, "mean", "median")),
        row("std / max", "m", lambda e: two(e.translation, "std", "max")),
        row("horizontal / vertical rmse", "m", lambda e: f"{rmse(e, 'horizontal')} / {rmse(e, 'vertical')}"),
        row("rotation rmse / max", "deg", lambda e: two(e.rotation_deg, "rmse", "max")),
        row("rmse of path length", "%", lambda e: significant(e.percent_of_length)),
    ]
    if name == "sim3":
        rows.append(row("scale", "", lambda e: f"{e.scale:.6f}"))
    return rows if any(e.available for e in errors) else rows[:1]
