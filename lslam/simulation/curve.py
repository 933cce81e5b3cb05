"""Smooth planar curves by arc length: the middle of a street, and the line a vehicle drives; and the uneven ground below them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import portable

DEGREE = 5
BEND_RAD = 0.22  # of a winding street
_REACH = 60  # points from one end after which nothing of it is left: an influence falls by 0.43 from knot to knot


def interpolating_spline(x: NDArray[Any], y: NDArray[Any], closed: bool = False) -> Any:
    """Quintic B-spline (scipy.interpolate.BSpline) through values `y` (N,) or (N, C) at increasing `x` (N,), N > 5.

    closed : the last point is the first one again, and all derivatives agree there
    """
    from scipy.interpolate import BSpline

    from lslam.core.kernels.linalg import solve_banded

    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if closed:
        # Beyond both ends the curve is gone round again, far enough for the ends of the spline not to be felt.
        count = len(x) - 1
        index = np.arange(-_REACH, count + _REACH + 1)
        x, y = x[index % count] + (index // count) * (x[-1] - x[0]), y[index % count]
    half = (DEGREE + 1) // 2
    knots = np.concatenate([np.repeat(x[0], DEGREE + 1), x[half:-half], np.repeat(x[-1], DEGREE + 1)])
    matrix = BSpline.design_matrix(x, knots, DEGREE)
    rows = np.repeat(np.arange(len(x)), np.diff(matrix.indptr))
    bands = np.zeros((len(x), 2 * DEGREE + 1))
    bands[rows, DEGREE + matrix.indices - rows] = matrix.data
    coefficients = y.reshape(len(x), -1).copy()
    solve_banded(bands, coefficients)
    return BSpline(knots, coefficients.reshape(y.shape), DEGREE)


def gaussian_smooth(values: NDArray[Any], sigma: float, mode: Literal["reflect", "wrap"] = "reflect") -> Floats:
    """`values` (N, ...) convolved along their first axis by a Gaussian of `sigma` steps; `mode` as scipy.ndimage's."""
    from scipy.ndimage import correlate1d

    reach = int(4 * sigma + 0.5)
    weights = portable.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(correlate1d(np.asarray(values, np.float64), weights / weights.sum(), axis=0, mode=mode))


KNOT_STEP_M = 0.5  # m between the spline's knots


@dataclass(frozen=True)
class RouteCurve:
    """Smooth planar curve (quintic spline), parametrised by arc length, m.

    Made by `smooth_curve`. On a closed curve any distance is valid and wraps; on an open one 0..length.
    """

    spline: Any
    length: float
    closed: bool

    def position(self, s: NDArray[Any]) -> Floats:
        """(M, 2) positions at distances `s` (M,), m."""
        return np.asarray(self.spline(self._wrap(s)))

    def tangent(self, s: NDArray[Any]) -> Floats:
        """(M, 2) unit tangents at distances `s` (M,), m."""
        d = np.asarray(self.spline(self._wrap(s), nu=1))
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def curvature(self, s: NDArray[Any]) -> Floats:
        """(M,) signed curvature, 1/m, positive to the left, at distances `s` (M,), m."""
        at = self._wrap(s)
        d, dd = np.asarray(self.spline(at, nu=1)), np.asarray(self.spline(at, nu=2))
        return np.asarray((d[:, 0] * dd[:, 1] - d[:, 1] * dd[:, 0]) / portable.dot(d, d) / portable.norm(d))

    def beside(self, s: NDArray[Any], offset: Any) -> Floats:
        """(M, 2) positions `offset` m to the left of the curve at distances `s` (M,), m."""
        t = self.tangent(s)
        left = np.stack([-t[:, 1], t[:, 0]], axis=1)
        return np.asarray(self.position(s) + np.broadcast_to(np.asarray(offset, np.float64), len(t))[:, None] * left)

    def sample(self, spacing: float) -> Floats:
        """(M,) distances about `spacing` m apart along the whole curve; on a closed one the start is not repeated."""
        count = max(int(np.ceil(self.length / spacing)), 2)
        return np.linspace(0, self.length, count + 1)[: -1 if self.closed else None]

    def _wrap(self, s: NDArray[Any]) -> Floats:
        """Distances, m, within one lap of a closed curve; unchanged on an open one."""
        s = np.asarray(s, np.float64)
        return np.asarray(np.mod(s, self.length) if self.closed else s)


def smooth_curve(points: NDArray[Any], closed: bool, smoothing: float = 1.5) -> RouteCurve:
    """RouteCurve through way-points (N, 2), corners rounded by a Gaussian of `smoothing` m along the line.

    A closed curve must not repeat its first point at the end.
    """
    points = np.asarray(points, np.float64)
    if closed:
        points = np.concatenate([points, points[:1]])
    even, step = _resample(points)
    if closed:
        even = gaussian_smooth(even[:-1], smoothing / step, "wrap")
        even = np.concatenate([even, even[:1]])
    else:
        # Mirroring the differences, not the positions, keeps the ends where they are and straight.
        reach = int(np.ceil(4 * smoothing / step))
        ahead, behind = 2 * even[0] - even[reach:0:-1], 2 * even[-1] - even[-2 : -reach - 2 : -1]
        even = gaussian_smooth(np.concatenate([ahead, even, behind]), smoothing / step)[reach:-reach]
    knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(even, axis=0), axis=1))])
    spline = interpolating_spline(knots, even, closed)
    return RouteCurve(spline, float(knots[-1]), closed)


def stretch(curve: RouteCurve, by: float) -> RouteCurve:
    """Open curve extended straight by `by` m at both ends; a closed one is returned unchanged."""
    if curve.closed or by <= 0:
        return curve
    ends = np.array([0.0, curve.length])
    at, along = curve.position(ends), curve.tangent(ends)
    steps = np.arange(2.0, by + 2.0, 2.0)[:, None]
    before, after = at[0] - steps[::-1] * along[0], at[1] + steps * along[1]
    return smooth_curve(np.concatenate([before, curve.position(curve.sample(1.0)), after]), closed=False)


def _resample(points: Floats) -> tuple[Floats, float]:
    """The polyline resampled at even distances near `KNOT_STEP_M`, and that distance, m."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    count = max(int(np.round(along[-1] / KNOT_STEP_M)), 12)
    at = np.linspace(0, along[-1], count + 1)
    return np.stack([np.interp(at, along, points[:, k]) for k in (0, 1)], axis=1), float(at[1])


def rounded_rectangle(width: float, depth: float, radius: float) -> Floats:
    """(N, 2) points, m, of a rounded rectangle about the origin, counter-clockwise, from the middle of the lower side along +x.

    width : m, in x; depth : m, in y; radius : m, of the corners
    """
    corners = []
    for k, (sx, sy) in enumerate(((1, -1), (1, 1), (-1, 1), (-1, -1))):
        angle = np.linspace(-np.pi / 2, 0, 48) + k * np.pi / 2
        centre = np.array([sx * (width / 2 - radius), sy * (depth / 2 - radius)])
        corners.append(centre + radius * np.stack([portable.cos(angle), portable.sin(angle)], axis=1))
    return np.concatenate([[[0.0, -depth / 2]], *corners])


def winding_line(rng: np.random.Generator, length: float) -> Floats:
    """(N, 2) points, m, 1 m apart, of a street of `length` m that begins near the origin, towards +x on the whole.

    Its heading swings by `BEND_RAD` over 200 to 260 m, and by half of that over 150 to 190 m.
    """
    s = np.arange(0, length + 1.0)
    heading = np.zeros_like(s)
    for wavelength, share in ((rng.uniform(200, 260), 1.0), (rng.uniform(150, 190), 0.5)):
        heading += BEND_RAD * share * portable.sin(2 * np.pi * s / wavelength + rng.uniform(0, 2 * np.pi))
    steps = np.stack([portable.cos(heading), portable.sin(heading)], axis=1)
    return np.asarray(np.cumsum(steps, axis=0))


@dataclass(frozen=True)
class Terrain:
    """Gently uneven ground: K plane waves `amplitude sin(wave . xy + phase)` on a plane, so height and gradient are exact.

    waves : (K, 2) wave vectors, rad/m; amplitudes : (K,) m; phases : (K,) rad
    tilt : gradient of the plane, m/m
    """

    waves: Floats
    amplitudes: Floats
    phases: Floats
    tilt: tuple[float, float] = (0.0, 0.0)

    def height(self, xy: NDArray[Any]) -> Floats:
        """Height at (..., 2) positions, m, shape (...)."""
        heights = portable.sin(self._phases_at(xy))
        return portable.dot(heights, self.amplitudes) + portable.dot(np.asarray(xy, np.float64), np.array(self.tilt))

    def slope(self, xy: NDArray[Any]) -> Floats:
        """Gradient of the height at (..., 2) positions, m/m, shape (..., 2)."""
        steepness = portable.cos(self._phases_at(xy)) * self.amplitudes
        return np.stack([portable.dot(steepness, self.waves[:, k]) + self.tilt[k] for k in (0, 1)], axis=-1)

    def _phases_at(self, xy: NDArray[Any]) -> Floats:
        """Phases (..., K), rad, of the waves at positions (..., 2), m."""
        xy = np.asarray(xy, np.float64)
        return np.asarray(xy[..., :1] * self.waves[:, 0] + xy[..., 1:] * self.waves[:, 1] + self.phases)


def rolling(
    rng: np.random.Generator,
    relief: float = 0.35,
    unevenness: float = 0.012,
    swell: float = 100.0,
    slope: tuple[float, float] = (0.0, 0.0),
) -> Terrain:
    """Uneven ground: about `relief` m up and down over about `swell` m, bumps of about `unevenness` m over 7 to 20 m.

    slope : least and greatest slope of the whole, m/m, in a random direction
    """
    lengths = np.concatenate([rng.uniform(0.6, 1.4, 4) * swell, rng.uniform(7, 20, 5)])
    amplitudes = np.concatenate([rng.uniform(0.4, 1.0, 4) * relief, rng.uniform(0.4, 1.0, 5) * unevenness])
    heading = rng.uniform(0, 2 * np.pi, len(lengths))
    waves = (2 * np.pi / lengths)[:, None] * np.stack([portable.cos(heading), portable.sin(heading)], axis=1)
    phases = rng.uniform(0, 2 * np.pi, len(lengths))
    fall, towards = rng.uniform(*slope), rng.uniform(0, 2 * np.pi)
    return Terrain(
        waves, amplitudes, phases, (float(fall * portable.cos(towards)), float(fall * portable.sin(towards)))
    )


def flat() -> Terrain:
    """Ground at height zero everywhere."""
    return Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1))
