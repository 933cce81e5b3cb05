"""The beams of a LiDAR, found as clusters among the elevations of its points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats

_BIN_DEG = 0.01
_WIDTHS_DEG = (0.02, 0.04, 0.08, 0.16, 0.32)  # smoothing that is tried, the finest first
_VALLEY = 0.3  # between two beams the density falls below this share of the smaller one
_LEAST_POINTS = 5  # of a beam
_SMALL = 0.05  # of the points of a usual beam: fewer are strays
_TIGHT = 0.15  # median distance from the beam over the distance between beams; 0.25 is no clustering at all
FEWEST, MOST = 4, 300


def elevation_borders(elevation: Floats, count: int | None = None) -> Floats | None:
    """Borders (beams - 1,) rad, increasing, between the beams that elevations (N,), rad, cluster round.

    Beams may be unevenly spaced and differ much in their points. With `count` exactly so many are found. None when the
    elevations do not cluster.
    """
    for width in _WIDTHS_DEG:
        borders = _borders(elevation, width)
        n = len(borders) + 1
        if (count is not None and n == count) or (
            count is None and FEWEST <= n <= MOST and _is_tight(elevation, borders)
        ):
            return borders
    return None


def ring_gap(points: NDArray[np.float32]) -> float:
    """The usual angle, rad, between neighbouring rings of points (N, 3), LiDAR frame; 0 where elevations do not cluster."""
    p = points.astype(np.float64)
    borders = elevation_borders(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
    return 0.0 if borders is None else float(np.median(np.diff(borders)))


def _borders(elevation: Floats, width_deg: float) -> Floats:
    edges = np.radians(np.arange(-90.0, 90.0 + _BIN_DEG, _BIN_DEG))
    counts = np.histogram(elevation, edges)[0].astype(np.float64)
    reach = round(3 * width_deg / _BIN_DEG)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * _BIN_DEG / width_deg) ** 2)
    density = np.convolve(counts, weights, mode="same")
    centres = (edges[:-1] + edges[1:]) / 2
    valleys = _valleys(density)
    return np.asarray(centres[_without_small(valleys, np.concatenate([[0.0], np.cumsum(counts)]))])


def _valleys(density: Floats) -> list[int]:
    """Where the density falls far enough between two peaks."""
    rising = np.diff(density, prepend=0.0) > 0
    peaks = np.flatnonzero(rising & (np.diff(density, append=0.0) <= 0))
    heights: list[float] = []
    borders: list[int] = []
    for k, peak in enumerate(peaks):
        if k:
            low = peaks[k - 1] + density[peaks[k - 1] : peak + 1].argmin()
            flat = np.flatnonzero(density[low:peak] > density[low])
            borders.append(int(low + (flat[0] if len(flat) else 0) // 2))
        heights.append(float(density[peak]))
        while borders and density[borders[-1]] >= _VALLEY * min(heights[-2:]):
            heights[-2:] = [max(heights[-2:])]
            borders.pop()
    return borders


def _without_small(borders: list[int], total: Floats) -> list[int]:
    """Leave out stray points: a cluster of next to none joins the neighbour that has less. `total` counts points up to a bin."""
    while borders:
        mass = np.diff(total[[0, *borders, len(total) - 1]])
        least = int(mass.argmin())
        if mass[least] >= max(_LEAST_POINTS, _SMALL * float(np.median(mass))):
            break
        left, right = (mass[k] if 0 <= k < len(mass) else np.inf for k in (least - 1, least + 1))
        borders = [b for k, b in enumerate(borders) if k != (least - 1 if left < right else least)]
    return borders


def _is_tight(elevation: Floats, borders: Floats) -> bool:
    """Whether points lie near the middle of their cluster, measured by the distance to the next one."""
    beam = np.searchsorted(borders, elevation)
    order = np.lexsort((elevation, beam))
    parts = np.split(elevation[order], np.flatnonzero(np.diff(beam[order])) + 1)
    middles = np.array([np.median(part) for part in parts])
    spread = np.median(np.concatenate([np.abs(part - middle) for part, middle in zip(parts, middles, strict=True)]))
    return bool(spread < _TIGHT * np.median(np.diff(middles)))
