"""Rows of studies whose truth is known: errors and times follow formulas, noise is seeded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lslam.core.config.study import ExpectedFinding
from lslam.core.types.study import FindingVerdict, StudyRow
from lslam.evaluation.sensitivity import evaluate_study

Formula = Callable[[float], float]


def rows_of(
    values: Sequence[Any],
    parameter: str = "input.skip_frames",
    *,
    error: Formula = lambda v: 0.5,
    angular: Formula = lambda v: 1.0,
    total: Formula = lambda v: 10.0,
    stages: Callable[[float], dict[str, float]] = lambda v: {"register": 50.0},
    seeds: Sequence[int] = (0, 1, 2),
    noise: float = 0.0,
    diverges: Callable[[float], bool] = lambda v: False,
    at: dict[str, Any] | None = None,
    **more: Any,
) -> list[StudyRow]:
    """One row per value and seed; `noise` is the relative standard deviation of every number."""
    rows = []
    for value in values:
        for seed in seeds:
            draw = np.random.default_rng([seed, len(rows)])
            factor = 1 + noise * draw.standard_normal(3)
            is_lost = diverges(value)
            row = {
                "run": f"r{len(rows)}", "study": "skip", "sequence": "open", "seed": seed, "method": "thesis-icp",
                "parameters": {parameter: value, **(at or {})},
                "status": "diverged" if is_lost else "done",
                "reason": "lost the motion" if is_lost else "",
                "thesis_rmse": 80.0 if is_lost else float(error(value) * factor[0]),
                "angular_rmse_deg": float(angular(value) * factor[1]),
                "total_time_s": float(total(value) * factor[2]),
                "stages_ms": {"read": 3.0, **stages(value)},
                "scans": 100, "metric": "thesis_rmse",
            }  # fmt: skip
            rows.append(StudyRow(**(row | more)))
    return rows


def by_seed(rows: list[StudyRow], change: Callable[[float, int], dict[str, Any]]) -> list[StudyRow]:
    """Rows with other numbers, by value of the first parameter and seed."""
    return [replace(row, **change(float(next(iter(row.parameters.values()))), row.seed)) for row in rows]


def verdict(rows: list[StudyRow], kind: str, *values: float, **more: Any) -> FindingVerdict:
    """What a finding of that kind comes to on rows of one curve or more."""
    finding = ExpectedFinding.model_validate({"text": "So it is.", "kind": kind, "values": values, **more})
    return evaluate_study(rows, [finding])[0].verdicts[0]


def outcome(rows: list[StudyRow], kind: str, *values: float, **more: Any) -> str:
    """In a word."""
    return verdict(rows, kind, *values, **more).outcome
