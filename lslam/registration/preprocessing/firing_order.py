"""Whether the points of a scan lie in the order of a sensor that turns: block by block, or ring after ring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats

_FULL = 2 * np.pi
# Blocks of a sweep, about a degree each, and points in a block of rings, at least.
_BLOCKS, _FEWEST = 360, 24
# Length of the mean of unit vectors to the points of a block: they lie within some 40 deg.
_NARROW = 0.85
# Net turn of the blocks over the sum of their steps: 0 for points in no order, 1 for an even turn.
_STRAIGHT = 0.6
# Turns of points in the order of firing; ring after ring they are as many as rings, with two returns one after the other two.
_SWEEP = (0.3, 1.3)
_RINGS = 1.6
# A step back by more is a step forward over a gap.
_GAP_RAD = np.radians(60.0)


@dataclass(frozen=True)
class FollowedSweep:
    """The azimuth along the order of the points of one sweep.

    sense : 1 counter-clockwise from above, -1 clockwise; begin_rad : azimuth of the first points
    turned_rad : (N,) angle from there to each point, by blocks of points, so that the offsets of lasers average out
    """

    sense: int
    begin_rad: float
    turned_rad: Floats


@dataclass(frozen=True)
class RingOrder:
    """Points that go round several times, ring after ring: the sense of each turn, and the azimuth of the first points, rad."""

    sense: int
    begin_rad: float


def follow_sweep(points: NDArray[Any]) -> FollowedSweep | None:
    """The sweep along the order of points (N, 3), m; None where their azimuth does not go round once in that order."""
    blocks = _Blocks.of(points, _BLOCKS)
    if blocks is None or not blocks.is_ordered or not _SWEEP[0] <= blocks.turns <= _SWEEP[1]:
        return None
    turned = np.maximum.accumulate(blocks.turned)
    # Block means lie in the middles of the blocks.
    slope = np.median(np.diff(turned)) / np.median(np.diff(blocks.middles))
    at = np.arange(len(points), dtype=np.float64)
    along = np.interp(at, blocks.middles, turned)
    along += slope * (np.minimum(at - blocks.middles[0], 0) + np.maximum(at - blocks.middles[-1], 0))
    return FollowedSweep(
        blocks.sense, float(blocks.angles[0] + blocks.sense * along[0]), np.asarray(along - along[0], np.float64)
    )


def follow_rings(points: NDArray[Any]) -> RingOrder | None:
    """The order of points (N, 3), m, that are stored ring after ring; None where they are not."""
    blocks = _Blocks.of(points, len(points) // _FEWEST)
    if blocks is None or not blocks.is_ordered or blocks.turns < _RINGS:
        return None
    return RingOrder(blocks.sense, float(blocks.angles[0]))


@dataclass(frozen=True)
class _Blocks:
    """Mean azimuths of blocks of points in their order.

    middles : (B,) index of the middle of each block; angles : (B,) rad; turned : (B,) rad from the first block, in the sense
    """

    middles: Floats
    angles: Floats
    turned: Floats
    sense: int
    is_ordered: bool

    @property
    def turns(self) -> float:
        """Whole turns from the first block to the last."""
        return float(self.turned[-1]) / _FULL

    @classmethod
    def of(cls, points: NDArray[Any], count: int) -> _Blocks | None:
        """Blocks of equally many points (N, 3) that are finite and off the axis; None where they are too few."""
        x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
        flat = np.hypot(x, y)
        where = np.flatnonzero(np.isfinite(flat) & (flat > 0))
        count = min(count, len(where) // _FEWEST)
        if count < 16:
            return None
        starts = np.linspace(0, len(where), count, endpoint=False).astype(np.int64)
        sizes = np.diff(np.append(starts, len(where)))
        cosine, sine, middle = (
            np.add.reduceat(values[where], starts) / sizes
            for values in (_over(x, flat), _over(y, flat), np.arange(len(points), dtype=np.float64))
        )
        angles = np.arctan2(sine, cosine)
        steps = np.remainder(np.diff(angles) + np.pi, _FULL) - np.pi
        sense = 1 if steps.sum() >= 0 else -1
        steps = sense * steps
        steps[steps < -_GAP_RAD] += _FULL
        is_ordered = (
            float(np.median(np.hypot(cosine, sine))) > _NARROW
            and abs(float(steps.sum())) > _STRAIGHT * float(np.abs(steps).sum())
            and _is_even(steps)
        )
        return cls(middle, angles, np.concatenate([[0.0], np.cumsum(steps)]), sense, is_ordered)


def _is_even(steps: Floats) -> bool:
    """Whether most steps go forward."""
    return bool((steps > 0).mean() > _STRAIGHT)


def _over(values: Floats, by: Floats) -> Floats:
    return np.divide(values, by, out=np.zeros_like(values), where=by > 0)
