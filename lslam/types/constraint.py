"""Constraints between keyframes, and loop candidates."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

ConstraintKind = Literal["odometry", "loop"]


class Verdict(StrEnum):
    """Whether a measurement constrains the poses."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"


class LoopStage(StrEnum):
    """What decided on a loop candidate, in the order in which it is asked; `manual` : a person knows the pair."""

    THINNED = "thinned"
    REGISTRATION = "registration"
    OVERLAP = "overlap"
    AMBIGUITY = "ambiguity"
    AGREEMENT = "agreement"
    GATE = "gate"
    CONSISTENCY = "consistency"
    GRAPH = "graph"
    MANUAL = "manual"


@dataclass(frozen=True)
class Constraint:
    """A measured pose of keyframe `b` relative to keyframe `a`.

    T_a_b : (4, 4); covariance : (6, 6) of t' = t + d[:3], R' = exp(d[3:]) R in the axes of keyframe a, m2 and rad2
    is_held : a person vouches for it: no outlier candidate of the graph
    """

    a: int
    b: int
    T_a_b: NDArray[np.float64]
    covariance: NDArray[np.float64]
    kind: ConstraintKind = "loop"
    is_held: bool = False


@dataclass(frozen=True)
class Turn:
    """Rotation R_a_b (3, 3) between keyframes, as a gyroscope measured it; sigma : rad."""

    a: int
    b: int
    R_a_b: NDArray[np.float64]
    sigma: float


@dataclass(frozen=True)
class LoopCandidate:
    """A candidate loop closure with its verdict: a row of loops.csv.

    a : the older keyframe; b : the newer one
    distance : m between their odometry positions; descriptor_distance : 0 (alike) to 1, of Scan Context; NaN without
    stage : what decided
    reason : why it was rejected, one clause; empty when accepted
    constraint : the measured loop closure, also of one that was rejected after registration
    """

    a: int
    b: int
    distance: float
    descriptor_distance: float
    verdict: Verdict
    stage: LoopStage
    reason: str = ""
    rmse: float = float("nan")
    overlap: float = float("nan")
    constraint: Constraint | None = None

    @property
    def is_accepted(self) -> bool:
        """Whether its constraint holds the poses."""
        return self.verdict == Verdict.ACCEPTED
