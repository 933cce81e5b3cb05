"""The results of an evaluation: plain frozen values, each with its recipe."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats, Longs
from lslam.evaluation import ALIGNMENTS

# A path this short, m, is the rounding of poses that do not move.
STANDS_M = 1e-3
UNITS = {"scan": "scans", "m": "m", "s": "s"}


@dataclass(frozen=True)
class Statistics:
    """Seven numbers and the count, in the unit of the errors (`sse` in its square). `std` divides by n (ddof 0)."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float
    n: int


def describe(errors: NDArray[Any]) -> Statistics | None:
    """Statistics of errors (N,), None when there are none."""
    e = np.asarray(errors, np.float64)
    if len(e) == 0:
        return None
    squares = np.power(e, 2)
    return Statistics(
        rmse=float(np.sqrt(np.mean(squares))),
        mean=float(np.mean(e)),
        median=float(np.median(e)),
        std=float(np.std(e)),
        min=float(np.min(e)),
        max=float(np.max(e)),
        sse=float(np.sum(squares)),
        n=len(e),
    )


def percent_of_length(rmse: float, truth: Floats) -> float:
    """An error, m, in % of the path of the poses `truth` (N, 4, 4); NaN for a sensor that stood still."""
    length = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    return 100 * rmse / length if length > STANDS_M else float("nan")


@dataclass(frozen=True)
class AbsoluteError:
    """ATE under one alignment: q_i - S p_i over the N matched poses.

    translation, horizontal, vertical : m; rotation_deg : |log(inv(R_est) R_gt)|; percent_of_length : rmse in % of the
        ground truth's path length; nan when the path has none
    T_gt_est, scale : the alignment, q ~ scale * R p + t
    errors : (N, 3) estimate minus ground truth in the ground truth's world axes, m; aligned_positions : (N, 3) m
    available : False when the alignment is not determined; `note` then says why, and the statistics are None
    """

    alignment: str
    available: bool
    note: str
    translation: Statistics | None
    rotation_deg: Statistics | None
    horizontal: Statistics | None
    vertical: Statistics | None
    percent_of_length: float
    T_gt_est: Floats
    scale: float
    errors: Floats
    rotation_errors_deg: Floats
    aligned_positions: Floats

    @property
    def recipe(self) -> str:
        """Alignment and number of poses, for people."""
        return f"alignment {self.alignment}: {ALIGNMENTS[self.alignment]}; {len(self.errors)} poses"


@dataclass(frozen=True)
class RelativeError:
    """RPE at one distance: E = inv(inv(Q_i) Q_j) (inv(P_i) P_j) over pairs (i, j).

    translation : |E_t|, m; rotation_deg : |log E_R|; both None when no pair exists, and `note` says so
    pair_ends : (n_pairs,) index j of each pair among the matched poses; translation_errors, rotation_errors_deg : (n_pairs,)
    """

    delta: float
    unit: str
    pairs: str
    n_pairs: int
    translation: Statistics | None
    rotation_deg: Statistics | None
    note: str
    rule: str = ""
    pair_ends: Longs = field(default_factory=lambda: np.zeros(0, np.int64))
    translation_errors: Floats = field(default_factory=lambda: np.zeros(0))
    rotation_errors_deg: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def name(self) -> str:
        """For example `10 m, all pairs`."""
        unit = "scan" if self.unit == "scan" and self.delta == 1 else UNITS[self.unit]
        return f"{self.delta:g} {unit}, {self.pairs} pairs"

    @property
    def recipe(self) -> str:
        """Distance, pair rule and number of pairs, for people."""
        return f"{self.name}: {self.rule}; {self.n_pairs} pairs; no alignment"


@dataclass(frozen=True)
class Evaluation:
    """One estimate against one ground truth.

    matched, possible : pairs found, pairs at most; stamps_ns : (N,) of the matched poses, on the ground truth's clock
    distance : (N,) m travelled along the ground truth; gt_positions : (N, 3) m; path_length : m
    scores : by key of the metric (`evaluation.evaluate`), each with its recipe; shown : words of `eval.metrics`
    time_offset : s added to the estimate's stamps; association : recipe sentence; notes : decisions and warnings
    faults : those of the notes that say what makes the numbers wrong
    odometry : of a run whose poses a graph moved, the same of the poses before
    """

    estimate: str
    ground_truth: str
    matched: int
    possible: int
    stamps_ns: Longs
    distance: Floats
    gt_positions: Floats
    path_length: float
    scores: dict[str, Any]
    time_offset: float
    association: str
    notes: list[str]
    faults: tuple[str, ...] = ()
    shown: tuple[str, ...] = ()
    odometry: Evaluation | None = None

    @property
    def ate(self) -> dict[str, AbsoluteError]:
        """Absolute errors by alignment."""
        errors: dict[str, AbsoluteError] = self.scores["ate"]
        return errors

    @property
    def rpe(self) -> list[RelativeError]:
        """Relative errors by distance."""
        errors: list[RelativeError] = self.scores["rpe"]
        return errors
