"""KITTI's odometry metric, by the formula of its development kit (Geiger, Lenz, Urtasun 2012)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.outputs import EvalConfig
from lslam.core.printable import count_of, significant
from lslam.core.types.comparison import Metric, Table
from lslam.evaluation.metric import NO_ROTATIONS, Document, Evaluation, MatchedPoses, MetricRow, TrajectoryMetric

LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)
START_EVERY = 10


@dataclass(frozen=True)
class KittiDrift:
    """KITTI's mean drift over all segments of 100..800 m; by_length : m -> (translation %, rotation deg/100 m, segments)."""

    available: bool
    note: str
    translation_percent: float
    rotation_deg_per_100m: float
    segments: int
    by_length: dict[int, tuple[float, float, int]]
    recipe: str = "KITTI devkit: 100..800 m of ground truth, a start every 10 scans, mean over segments, no alignment"


def kitti_drift(estimate: Floats, truth: Floats) -> KittiDrift:
    """Drift of matched poses (N, 4, 4), consecutive scans, in % and deg/100 m; not available under 100 m.

    The kit's general inverse and arc cosine of the trace are kept: on poses printed with six digits they differ from
    the transpose and the logarithm, and published numbers are the kit's.
    """
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    firsts = np.arange(0, len(truth), START_EVERY)
    by_length: dict[int, tuple[float, float, int]] = {}
    every: list[Floats] = []
    for length in LENGTHS:
        lasts = np.searchsorted(distance, distance[firsts] + length, side="right")
        inside = lasts < len(truth)
        if not inside.any():
            continue
        errors = _segment_errors(estimate, truth, firsts[inside], lasts[inside]) / length
        by_length[length] = (
            float(100 * errors[:, 0].mean()),
            float(np.rad2deg(errors[:, 1].mean()) * 100),
            len(errors),
        )
        every.append(errors)
    if not every:
        nan = float("nan")
        return KittiDrift(False, f"n/a (no segment of 100 m: the path is {distance[-1]:.0f} m)", nan, nan, 0, {})
    mean = np.concatenate(every).mean(axis=0)
    return KittiDrift(
        True, "", float(100 * mean[0]), float(np.rad2deg(mean[1]) * 100), sum(len(e) for e in every), by_length
    )


def _segment_errors(estimate: Floats, truth: Floats, first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
    """(M, 2) translation m and rotation rad of inv(estimated motion) @ true motion, from pose `first` to pose `last` (M,).

    estimate, truth : (N, 4, 4) matched poses
    """
    true_motion = np.linalg.inv(truth[first]) @ truth[last]
    motion = np.linalg.inv(estimate[first]) @ estimate[last]
    E = np.linalg.inv(motion) @ true_motion
    cosine = 0.5 * (np.trace(E[:, :3, :3], axis1=1, axis2=2) - 1.0)
    return np.stack([np.linalg.norm(E[:, :3, 3], axis=1), np.arccos(np.clip(cosine, -1.0, 1.0))], axis=1)


class KittiOdometry(TrajectoryMetric[KittiDrift]):
    """Drift over segments of 100 to 800 m."""

    key, name, gate_option = "kitti_drift", "KITTI drift", "drift"
    columns = (
        (
            "translation_percent",
            Metric("drift", "drift", "%", "error", "KITTI: 100 to 800 m of ground truth, mean over segments"),
        ),
        (
            "rotation_deg_per_100m",
            Metric("drift.rotation", "drift.rotation", "deg/100m", "error", is_main=False),
        ),
    )

    def measure(self, poses: MatchedPoses, config: EvalConfig) -> KittiDrift:
        if not poses.has_rotations:
            return KittiDrift(False, NO_ROTATIONS, float("nan"), float("nan"), 0, {})
        return kitti_drift(poses.estimate, poses.truth)

    def document(self, score: KittiDrift) -> Document:
        names = ("translation_percent", "rotation_deg_per_100m", "segments")
        lengths = {str(length): dict(zip(names, values, strict=True)) for length, values in score.by_length.items()}
        whole = asdict(score)
        return {"recipe": whole.pop("recipe"), **whole, "by_length": lengths}

    def summary(self, e: Evaluation) -> list[tuple[str, str]]:
        """Mean drift in words; the note where it is not available."""
        drift = self.of(e)
        text = (
            f"{drift.translation_percent:.3f} %, {drift.rotation_deg_per_100m:.4f} deg/100 m "
            f"({count_of(drift.segments, 'segment')} of 100 to 800 m)"
        )
        return [(self.name, text if drift.available else drift.note or "n/a")]

    def rows(self, es: Sequence[Evaluation]) -> list[MetricRow]:
        drifts = [self.of(e) for e in es]
        return [
            MetricRow(self.name, "%", [significant(d.translation_percent) for d in drifts]),
            MetricRow("rotation", "deg/100m", [significant(d.rotation_deg_per_100m) for d in drifts], self.name),
        ]

    def recipes(self, e: Evaluation) -> list[str]:
        drift = self.of(e)
        return [f"drift: {drift.recipe}; {count_of(drift.segments, 'segment') if drift.available else drift.note}"]

    def tables(self, e: Evaluation) -> list[Table]:
        """Table of the drift: mean, and one row per segment length."""
        drift = self.of(e)
        header = ("segment length", "translation, %", "rotation, deg/100 m", "segments")
        rows = [("all", f"{drift.translation_percent:.3f}", f"{drift.rotation_deg_per_100m:.4f}", str(drift.segments))]
        for length, (translation, rotation, count) in sorted(drift.by_length.items()):
            rows.append((f"{length} m", f"{translation:.3f}", f"{rotation:.4f}", str(count)))
        if not drift.available:
            rows = [("all", drift.note or "n/a", "", "0")]
        return [Table(self.name, header, tuple(rows), f"{drift.recipe}.")]

    def cards(self, e: Evaluation) -> list[tuple[str, str, str]]:
        drift = self.of(e)
        name = f"{self.name}, {count_of(drift.segments, 'segment')}"
        return [(f"{drift.translation_percent:.2f}", "%", name)] if drift.available else []
