"""The course of the sensor through the middles of sweeps: the motion within a sweep by the scans before and after it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3

Floats = NDArray[np.float64]

# Middles on each side of a sweep. From one to the next its influence on a natural spline falls by 3.7.
NEIGHBOURS = 3
# m and rad, sigma of the motion from begin to end of a sweep.
MOTION_SIGMA = np.repeat([0.003, 0.001], 3)
COVARIANCE = np.diag(MOTION_SIGMA**2)


class Course:
    """Natural cubic splines through the poses of middles around each sweep.

    instants_ns : (N,) increasing; poses : (N, 4, 4)
    """

    def __init__(self, instants_ns: NDArray[np.int64], poses: Floats) -> None:
        self.instants_ns, self.poses = instants_ns, poses

    def at(self, stamp_ns: int, times: Floats) -> Floats | None:
        """(K, 4, 4) poses at `times` (K,) of a sweep, s from the stamp; None where no middle lies within, or there are few."""
        begin, end = stamp_ns + 1e9 * times[0], stamp_ns + 1e9 * times[-1]
        k = int(np.argmin(np.abs(self.instants_ns - (begin + end) / 2)))
        if len(times) < 2 or len(self.instants_ns) < NEIGHBOURS or not begin <= self.instants_ns[k] <= end:
            return None
        around = slice(max(k - NEIGHBOURS, 0), k + NEIGHBOURS + 1)
        nodes = 1e-9 * (self.instants_ns[around] - stamp_ns)
        twists = se3.log(se3.relative(self.poses[k], self.poses[around]))
        return se3.normalise(self.poses[k] @ se3.exp(natural_spline(np.asarray(nodes), twists, times)))


def natural_spline(nodes: Floats, values: Floats, times: Floats) -> Floats:
    """(K, C) cubic spline at `times` (K,) through `values` (N, C) at increasing `nodes` (N,), N > 2; beyond them straight."""
    step = np.diff(nodes)
    slope = np.diff(values, axis=0) / step[:, None]
    # Second derivatives (N, C), none at both ends: elimination, and substitution in the opposite direction.
    bend, diagonal = np.zeros_like(values), np.ones(len(nodes))
    for i in range(1, len(step)):
        factor = step[i - 1] / diagonal[i - 1] if i > 1 else 0.0
        diagonal[i] = 2 * (step[i - 1] + step[i]) - factor * step[i - 1]
        bend[i] = 6 * (slope[i] - slope[i - 1]) - factor * bend[i - 1]
    for i in range(len(step) - 1, 0, -1):
        bend[i] = (bend[i] - step[i] * bend[i + 1]) / diagonal[i]
    inside = np.clip(times, nodes[0], nodes[-1])
    left = np.clip(np.searchsorted(nodes, inside, side="right") - 1, 0, len(step) - 1)
    h, a = step[left, None], (inside - nodes[left])[:, None]
    b = h - a
    line = (values[left] * b + values[left + 1] * a) / h
    curve = (bend[left] * (b**3 / h - h * b) + bend[left + 1] * (a**3 / h - h * a)) / 6
    first, last = slope[0] - step[0] * bend[1] / 6, slope[-1] + step[-1] * bend[-2] / 6
    before, after = np.minimum(times - nodes[0], 0.0)[:, None], np.maximum(times - nodes[-1], 0.0)[:, None]
    return np.asarray(line + curve + before * first + after * last)
