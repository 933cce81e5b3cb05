"""loops.csv: every loop candidate of a run, what became of it and why."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lslam.formats.atomic import write_text
from lslam.types.constraint import LoopCandidate
from lslam.types.keyframe import Keyframe

COLUMNS = (
    "keyframe_a", "keyframe_b", "scan_a", "scan_b", "distance_m", "descriptor_distance", "verdict", "stage", "rmse_m",
    "overlap", "sigma_m", "sigma_deg", "reason",
)  # fmt: skip


def write_loops(path: Path, candidates: Sequence[LoopCandidate], keyframes: Sequence[Keyframe]) -> None:
    """One row per candidate in their order; `sigma` is the standard deviation where it is largest, empty when unknown.

    Raises OutputError when the file cannot be written.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for c in candidates:
        sigma_m, sigma_deg = _sigmas(c)
        row = (
            c.a, c.b, keyframes[c.a].scan, keyframes[c.b].scan, f"{c.distance:.3f}", _number(c.descriptor_distance),
            c.verdict, c.stage, _number(c.rmse), _number(c.overlap), _number(sigma_m), _number(sigma_deg), c.reason,
        )  # fmt: skip
        table.writerow(row)
    write_text(path, text.getvalue())


def _sigmas(candidate: LoopCandidate) -> tuple[float, float]:
    """m and deg."""
    if candidate.constraint is None:
        return float("nan"), float("nan")
    C = candidate.constraint.covariance
    largest = [float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0.0))) for block in (C[:3, :3], C[3:, 3:])]
    return largest[0], float(np.rad2deg(largest[1]))


def _number(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""
