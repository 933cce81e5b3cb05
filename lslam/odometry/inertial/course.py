"""The course of the sensor through poses at known instants: the motion within a sweep by the scans before and after it."""

from __future__ import annotations

import numpy as np

from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats, Longs

# Poses on each side of those within a sweep. From one to the next its influence on a natural spline falls by 3.7.
NEIGHBOUR_SWEEPS = 3
# Of the motion from begin to end of a sweep.
MOTION_SIGMA_M, MOTION_SIGMA_RAD = 0.003, 0.001


class Course:
    """Natural cubic splines through the poses within and around each sweep.

    instants_ns : (N,); poses : (N, 4, 4). A pose no later than one before it, as of a sliver of a sweep, is left out.
    """

    def __init__(self, instants_ns: Longs, poses: Floats) -> None:
        is_later = np.append(True, instants_ns[1:] > np.maximum.accumulate(instants_ns)[:-1])
        self.instants_ns, self.poses = instants_ns[is_later], poses[is_later]

    def at(self, stamp_ns: int, times: Floats) -> Floats | None:
        """(K, 4, 4) poses at `times` (K,) of a sweep, s from the stamp; None where no pose lies within, or there are few."""
        begin, end = stamp_ns + 1e9 * times[0], stamp_ns + 1e9 * times[-1]
        first, last = np.searchsorted(self.instants_ns, begin), np.searchsorted(self.instants_ns, end, side="right")
        if len(times) < 2 or len(self.instants_ns) < NEIGHBOUR_SWEEPS or first == last:
            return None
        k = int(first + np.argmin(np.abs(self.instants_ns[first:last] - (begin + end) / 2)))
        around = slice(max(first - NEIGHBOUR_SWEEPS, 0), last + NEIGHBOUR_SWEEPS)
        nodes = 1e-9 * (self.instants_ns[around] - stamp_ns)
        twists = se3.log(se3.relative(self.poses[k], self.poses[around]))
        return se3.normalise(self.poses[k] @ se3.exp(natural_spline(np.asarray(nodes), twists, times)))


def motion_covariance() -> Floats:
    """(6, 6) of the motion from begin to end of a sweep, m2 and rad2."""
    return np.diag(np.repeat([MOTION_SIGMA_M, MOTION_SIGMA_RAD], 3) ** 2)


def natural_spline(nodes: Floats, values: Floats, times: Floats) -> Floats:
    """(K, C) cubic spline at `times` (K,) through `values` (N, C) at increasing `nodes` (N,), N > 2; beyond them straight."""
    from scipy.interpolate import CubicSpline

    spline, inside = CubicSpline(nodes, values, bc_type="natural"), np.clip(times, nodes[0], nodes[-1])
    return np.asarray(spline(inside) + (times - inside)[:, None] * spline(inside, 1))
