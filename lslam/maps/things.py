"""Things that stand on the ground, as a scan shows them: where a good share of one moves, all of it does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

# The ground is the lowest of some scans around a place, by squares of so many m; what is higher stands on it. On slopes
# above some 7 % ground does, too, as one large thing that does not move.
SQUARE, ABOVE = 1.0, 0.2
# m between two things, seen from above: beams of one ring are closer on a thing, and from ring to ring none is asked.
GAP = 0.3
# m from the sensor along each axis: farther, a thing is a few points.
REACH = 100.0
_SIDE = int(2 * REACH / SQUARE) + 2


@dataclass(frozen=True)
class Floor:
    """The lowest point of one scan in each square.

    first : (2,) number of the square in the corner, counted from the world's origin; lowest : (S, S) float32, m of the
        world's z, inf where there is no point
    """

    first: Ints
    lowest: NDArray[np.float32]

    def lower(self, image: NDArray[np.float32], first: Ints) -> None:
        """Put what is lower than in `image`, whose corner is the square `first`, into it."""
        shift = np.clip(self.first - first, -_SIDE, _SIDE)
        (x, y), (u, v) = np.maximum(shift, 0), np.maximum(-shift, 0)
        there = image[x : _SIDE - u, y : _SIDE - v]
        np.minimum(there, self.lowest[u : _SIDE - x, v : _SIDE - y], out=there)


def floor_of(points: NDArray[np.float32], sensor: NDArray[np.float64]) -> Floor:
    """Of points (N, 3) as seen from the sensor, but along the axes of a world whose z is up, m; sensor : (3,) where it is."""
    near = points[_within_reach(points)]
    first, squares = _squares(near, sensor)
    lowest = np.full((_SIDE, _SIDE), np.inf, np.float32)
    np.minimum.at(lowest.reshape(-1), squares, (near[:, 2] + sensor[2]).astype(np.float32))
    return Floor(first, lowest)


def standing(points: NDArray[np.float32], sensor: NDArray[np.float64], floors: Iterable[Floor]) -> NDArray[np.bool_]:
    """(N,) whether a point is within reach and above the ground, as far as `floors` know it.

    points, sensor : as for `floor_of`; floors : of this scan and of others around it
    """
    from scipy import ndimage

    stands = np.zeros(len(points), np.bool_)
    within = np.flatnonzero(_within_reach(points))
    near = points[within]
    first, squares = _squares(near, sensor)
    ground = np.full((_SIDE, _SIDE), np.inf, np.float32)
    for floor in floors:
        floor.lower(ground, first)
    # A wheel hides the ground below: the squares around it know.
    ground = ndimage.minimum_filter(ground, 3, mode="constant", cval=np.inf)
    stands[within] = near[:, 2] + sensor[2] > ground.reshape(-1)[squares] + ABOVE
    return stands


def things_of(points: NDArray[np.float32], chosen: NDArray[np.bool_]) -> Ints:
    """Number of the thing that each point (N, 3) is of, from 1, were there only the `chosen`; 0 for the others.

    points : as for `floor_of`; chosen : (N,), within reach
    """
    from scipy import ndimage

    labels = np.zeros(len(points), np.int64)
    x, y = np.floor((points[chosen, :2] + REACH) / GAP).astype(np.int64).T
    taken = np.zeros((int(2 * REACH / GAP) + 1,) * 2, np.bool_)
    taken[x, y] = True
    numbered, _ = ndimage.label(taken, np.ones((3, 3)))
    labels[chosen] = numbered[x, y]
    return labels


def whole(moves: NDArray[np.bool_], labels: Ints, share: float, least: int) -> NDArray[np.bool_]:
    """The mask (N,), and all of the things of which `share`, and `least` points, are masked."""
    total, moving = np.bincount(labels), np.bincount(labels, moves)
    chosen = (moving >= least) & (moving >= share * total)
    chosen[:1] = False  # 0 is no thing
    return np.asarray(moves | chosen[labels])


def _squares(near: NDArray[np.float32], sensor: NDArray[np.float64]) -> tuple[Ints, Ints]:
    """(2,) the square in the corner of what is in reach, and (N,) where points lie in an image of it, row after row."""
    first = np.floor((sensor[:2] - REACH) / SQUARE).astype(np.int64)
    at = np.floor((near[:, :2] + sensor[:2]) / SQUARE).astype(np.int64) - first
    return first, at[:, 0] * _SIDE + at[:, 1]


def _within_reach(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(N,) whether a point is; no NaN is."""
    x, y, z = np.abs(points).T
    return np.asarray((x < REACH) & (y < REACH) & (z < REACH))
