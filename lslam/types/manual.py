"""What a person knows of a recording: pairs of scans that show one place or do not, and surveyed positions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Instant:
    """A scan by its number in the recording, or a stamp, ns; `said` : where it was said, for messages."""

    said: str
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
    sigma : (3,) m; seen : (3,) m, the point in the axes of the LiDAR; the sensor itself is the origin
    height_epsg : of the heights, None for those of `epsg`
    """

    at: Instant
    position: Floats
    sigma: Floats
    epsg: int
    seen: Floats = field(default_factory=lambda: np.zeros(3))
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
    said : where it was said
    """

    a: int
    b: int
    place: Floats
    within: float | None = None
    said: str = ""


@dataclass(frozen=True)
class ControlResidual:
    """What is left of a control point: `residual` (3,) m, east, north, up, surveyed minus solved; `sigma` (3,) m, as stated."""

    point: ControlPoint
    stamp_ns: int
    residual: Floats

    @property
    def size(self) -> float:
        """The residual in sigmas, all axes together."""
        return float(np.linalg.norm(self.residual / self.point.sigma))
