"""Per-point times of a sensor that turns, where its scans have no time field: by column, by order or by azimuth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats
from lslam.registration.preprocessing.firing_order import follow_sweep

Kind = Literal["columns", "order", "azimuth"]

_FULL = 2 * np.pi
# Share of a turn by which the first point of a scan may lie before the azimuth at which sweeps begin.
_EARLY = 0.1
# rad; columns are even where nine in ten of the points lie so near to their azimuth, lasers being offset by some degrees.
_EVEN_RAD = np.radians(12.0)
# Points of a scan that tell whether its columns are even.
_LOOKED_AT = 4000


@dataclass(frozen=True)
class SweepClock:
    """When each point of a scan was measured, as a share of the sweep, 0 to 1, and the sweep's length.

    kind : columns: by the column of an organised cloud; order: by the azimuth that is followed along the order of the points,
        or by the index alone where `sense` is 0; azimuth: by the azimuth of each point
    seconds : length of a sweep, s; is_stamp_at_end : the stamp belongs to the sweep's end, not to its start
    rows, is_columnwise : of `columns`: number of rows, and whether points are stored column after column
    sense : 1 counter-clockwise from above, -1 clockwise; 0 unknown
    begin_rad : azimuth at which sweeps begin; None: each with its first point
    is_reversed : the shares run backwards; turn : share of a sweep that is added, modulo 1
    """

    kind: Kind
    seconds: float
    is_stamp_at_end: bool = False
    rows: int = 0
    is_columnwise: bool = False
    sense: int = 0
    begin_rad: float | None = None
    is_reversed: bool = False
    turn: float = 0.0

    def times_of(self, points: NDArray[Any]) -> tuple[NDArray[np.float32], str]:
        """Times (N,) float32, s from the stamp, of points (N, 3), and why they are not by the rule; empty where they are."""
        shares, why = self._shares(points)
        shares = 1 - shares if self.is_reversed else shares
        if self.turn:
            shares = np.mod(shares + self.turn, 1.0)
        begin_s = -self.seconds if self.is_stamp_at_end else 0.0
        return (begin_s + self.seconds * shares).astype(np.float32), why

    def _shares(self, points: NDArray[Any]) -> tuple[Floats, str]:
        n = len(points)
        if self.kind == "columns":
            why = f"{n} points are not {self.rows} rows of equal length"
            if n % self.rows == 0:
                index, columns = np.arange(n), n // self.rows
                shares = (index // self.rows if self.is_columnwise else index % columns) / columns
                if not self.sense or even_begin(points, shares, self.sense) is not None:
                    return shares, ""
                why = "its columns do not turn as those of the other scans"
            if self.begin_rad is None:
                return np.arange(n) / max(n, 1), f"{why}: the order of the points instead"
            return _turned(azimuths(points), self.begin_rad, self.sense), f"{why}: the azimuth of each instead"
        if self.kind == "azimuth":
            return _turned(azimuths(points), self.begin_rad or 0.0, self.sense), ""
        if not self.sense:
            return np.arange(n) / max(n, 1), ""
        sweep = follow_sweep(points)
        if sweep is None or sweep.sense != self.sense:
            why = "its points are not in the order of those of the other scans"
            if self.begin_rad is None:
                return np.arange(n) / max(n, 1), f"{why}: their index instead"
            return _turned(azimuths(points), self.begin_rad, self.sense), f"{why}: the azimuth of each instead"
        late = 0.0
        if self.begin_rad is not None:
            late = float(_turned(np.array([sweep.begin_rad]), self.begin_rad, self.sense)[0])
            late = late - 1 if late > 1 - _EARLY else late
        return late + sweep.turned_rad / _FULL, ""

    def facts(self) -> dict[str, Any]:
        """As plain values, for a manifest."""
        return asdict(self)

    def __str__(self) -> str:
        how = {
            "columns": f"the columns of clouds of {self.rows} rows",
            "order": "the order of the points",
            "azimuth": "the azimuth of the points",
        }[self.kind]
        details = []
        if self.sense:
            sense = self.sense * (-1 if self.is_reversed else 1)
            details.append("counter-clockwise" if sense > 0 else "clockwise")
            begin = self.begin_deg
            details.append("each from its first point" if begin is None else f"from azimuth {round(begin)} deg")
        elif self.is_reversed:
            details.append("backwards")
        instant = "end" if self.is_stamp_at_end else "start"
        details.append(f"{self.seconds:.3g} s a sweep, stamped at its {instant}")
        return f"{how}, {', '.join(details)}"

    @property
    def begin_deg(self) -> float | None:
        """Azimuth of the first point of a sweep, deg from -180 to 180; None where none is fixed."""
        if self.begin_rad is None:
            return None
        share = -self.turn if not self.is_reversed else self.turn
        angle = self.begin_rad + self.sense * _FULL * share
        return float(np.degrees(np.remainder(angle + np.pi, _FULL) - np.pi))


def azimuths(points: NDArray[Any]) -> Floats:
    """(N,) rad, counter-clockwise from x; 0 for points that are not finite."""
    angle = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
    return np.where(np.isfinite(angle), angle, 0.0)


def even_begin(points: NDArray[Any], shares: Floats, sense: int) -> float | None:
    """Azimuth, rad, at which points (N, 3) begin that turn evenly in this sense with `shares` (N,) of the sweep.

    None where they do not; 0 for points of which none is usable.
    """
    step = len(points) // _LOOKED_AT | 1  # odd: rows are even in number
    points, shares = points[::step], shares[::step]
    is_used = np.isfinite(points).all(axis=1) & (points[:, :2] != 0).any(axis=1)
    if not is_used.any():
        return 0.0
    apart = np.exp(1j * (azimuths(points[is_used]) - sense * _FULL * shares[is_used]))
    middle = apart.mean()
    off = np.abs(np.angle(apart * np.conj(middle)))
    return float(np.angle(middle)) if np.percentile(off, 90) < _EVEN_RAD else None


def _turned(angle: Floats, begin_rad: float, sense: int) -> Floats:
    """Shares of a turn (N,), 0 to 1, from `begin_rad` to each angle (N,), rad."""
    return np.asarray(np.mod((angle - begin_rad) * (sense / _FULL), 1.0))


def is_same_motion(first: SweepClock, second: SweepClock, points: NDArray[Any]) -> bool:
    """Whether two clocks give nearly all points (N, 3) times that differ by one constant: deskewing cannot tell them apart."""
    apart = first.times_of(points)[0] - second.times_of(points)[0]
    return float((np.abs(apart - np.median(apart)) > _APART * first.seconds).mean()) < _FEW


# Share of a sweep by which times must differ, and of the points for which they must.
_APART, _FEW = 0.1, 0.04
