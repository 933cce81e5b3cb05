"""Constraints on poses: between keyframes, by a person who knows pairs or positions, by a map that exists."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np

from lslam.core.arrays import Floats

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
    is_binding : a person vouches for it: no outlier candidate of the graph
    """

    a: int
    b: int
    T_a_b: Floats
    covariance: Floats
    kind: ConstraintKind = "loop"
    is_binding: bool = False


@dataclass(frozen=True)
class Turn:
    """Rotation R_a_b (3, 3) between keyframes, as a gyroscope measured it; sigma : rad."""

    a: int
    b: int
    R_a_b: Floats
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

    @property
    def doubt(self) -> float:
        """Doubt about the verdict, 0 to 1: large if accepted with little overlap, or rejected late and with much.

        A person looks at the most doubtful candidates first.
        """
        overlap, stages = float(np.nan_to_num(self.overlap)), list(LoopStage)
        if self.is_accepted:
            return 0.0 if self.stage == LoopStage.MANUAL else 1.0 - overlap
        return (stages.index(self.stage) + overlap) / len(stages)


@dataclass(frozen=True)
class Instant:
    """A scan by its number in the recording, or a stamp, ns; `source` : where it was said, for messages."""

    source: str
    scan: int | None = None
    stamp_ns: int | None = None


@dataclass(frozen=True)
class NamedPair:
    """Two scans that show one place (`known`), or do not whatever they look like (`forbidden`).

    place : (2,) m, roughly, of the later in the axes of the earlier; within : m, how far it may lie from there
    """

    first: Instant
    second: Instant
    verdict: Literal["known", "forbidden"]
    place: Floats = field(default_factory=lambda: np.zeros(2))
    within: float | None = None


@dataclass(frozen=True)
class ControlPoint:
    """A surveyed position of the sensor, or of a point it saw, at an instant.

    position : (3,) in the coordinates `epsg`: easting, northing, height, m, or longitude, latitude, deg, height, m
    sigma : (3,) m; point_lidar : (3,) m, the point in the axes of the LiDAR; the sensor itself is the origin
    height_epsg : of the heights, None for those of `epsg`
    """

    at: Instant
    position: Floats
    sigma: Floats
    epsg: int
    point_lidar: Floats = field(default_factory=lambda: np.zeros(3))
    height_epsg: int | None = None


@dataclass(frozen=True)
class Manual:
    """All of it; what is empty was not given."""

    pairs: tuple[NamedPair, ...] = ()
    points: tuple[ControlPoint, ...] = ()


@dataclass(frozen=True)
class KnownPair:
    """Keyframes `a` and, newer, `b` that a person knows to show one place.

    place : (3,) m, roughly, of b in the axes of a; within : m, how far it may lie from there, None for the configuration's
    source : where it was said
    """

    a: int
    b: int
    place: Floats
    within: float | None = None
    source: str = ""


@dataclass(frozen=True)
class ControlResidual:
    """Residual of a control point.

    residual : (3,) m, east, north, up, surveyed minus solved; place : (3,) as surveyed, lat, lon (deg), height (m), WGS84
    """

    point: ControlPoint
    stamp_ns: int
    residual: Floats
    place: Floats

    @property
    def size(self) -> float:
        """The residual in sigmas, all axes together."""
        return float(np.linalg.norm(self.residual / self.point.sigma))


# held : by the map; changed : the map is there and disagrees; beyond : the map ends; unread : the scan has no points
FixStatus = Literal["held", "changed", "beyond", "unread"]


@dataclass(frozen=True)
class MapFix:
    """A scan against the map.

    T_map_lidar : (4, 4); covariance : (6, 6) of it, t' = t + d[:3], R' = exp(d[3:]) R, map axes, m2 and rad2
    status : `held` registered on the map; else odometry carries the pose on: the map has `changed`, ends (`beyond`), or the scan
        is `unread`
    overlap : share of the source points that find the map; inlier_share : of those, within the kernel
    innovation : correction of what odometry carried here, m and rad
    reason : why it is not held, empty where it is
    is_doubtful : held, but by fewer of its points than elsewhere in the run: something there has changed
    """

    T_map_lidar: Floats
    covariance: Floats
    status: FixStatus = "held"
    overlap: float = 0.0
    inlier_share: float = 0.0
    innovation: tuple[float, float] = (0.0, 0.0)
    reason: str = ""
    is_doubtful: bool = False

    @property
    def is_binding(self) -> bool:
        """Whether the map holds the scan."""
        return self.status == "held"
