"""What holds an elastic sweep to the last one: location consistency and constant velocity, each as surely as it lately held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import noise, se3, so3
from lslam.registration.constant_velocity import middle_of
from lslam.registration.deskew_uncertainty import USUAL
from lslam.registration.elastic_sweep import ElasticSweep
from lslam.types.motion_prior import MotionPrior
from lslam.types.state import Stateful

Floats = NDArray[np.float64]

# Of the covariance of a change of motion, what stays from scan to scan: a memory of five.
FORGETTING = 0.8
# m and rad, a change that registration cannot tell from none.
LEAST_CHANGE = 1e-3
# Under a constant acceleration a line fitted to a sweep of T seconds is a T^2 / 12 off at both ends, and the next one likewise,
# to the same side: sweeps do not meet by a sixth of the change of velocity.
MISS = 1.0 / 6.0
NOTHING: Floats = np.zeros((6, 6))


@dataclass(frozen=True)
class ElasticConstraints:
    """Where a sweep is expected; information (6, 6), world axes, of its begin and of the motion from there to its end."""

    expected: ElasticSweep
    location: Floats
    velocity: Floats

    def add_to(self, A: Floats, b: Floats, sweep: ElasticSweep) -> None:
        """Add both to the normal equations (12, 12), (12,) of begin and end, in place (Dellenbach et al. 2022, section III-B)."""
        begin, end = off(sweep.begin, self.expected.begin), off(sweep.end, self.expected.end)
        for W, signs, rest in ((self.location, (1.0, 0.0), begin), (self.velocity, (-1.0, 1.0), end - begin)):
            b += np.kron(signs, W @ rest)
            A += np.kron(np.outer(signs, signs), W)


class LastSweep(Stateful):
    """Remembers the last sweep, how well it was known, and how much the motion lately changed from scan to scan."""

    STATE = ("_ends_ns", "_ends", "_covariance", "_change")

    def __init__(self) -> None:
        # Begin and end, ns, the poses (2, 4, 4) there, and their covariance (12, 12), world axes.
        self._ends_ns = (0, 0)
        self._ends: Floats | None = None
        self._covariance: Floats | None = None
        # (6, 6) mean square of what registration corrected the prior by at the middle of a sweep, LiDAR axes.
        self._change: Floats | None = None

    def constraints(self, stamp_ns: int, prior: MotionPrior, is_felt: bool) -> ElasticConstraints:
        """Of the scan at `stamp_ns`: it follows the last sweep at the same velocity, or as an IMU felt that it does (`is_felt`).

        Where scans between are missing the prior says where it begins.
        """
        begin_ns, end_ns = _ends_ns(stamp_ns, prior)
        Q = self._change_over(prior.span_s)
        Q = noise.rotated(Q, prior.pose[:3, :3])
        expected, P = ElasticSweep.of(prior, is_bent=is_felt), self._covariance
        length = self._ends_ns[1] - self._ends_ns[0]
        if self._ends is None or P is None or abs(begin_ns - self._ends_ns[1]) > length / 2:
            return ElasticConstraints(expected, NOTHING, np.linalg.inv(Q))
        if not is_felt:
            twist = se3.log(se3.relative(*self._ends)) / length
            begin, end = (self._ends[1] @ se3.exp((ns - self._ends_ns[1]) * twist) for ns in (begin_ns, end_ns))
            expected = ElasticSweep(se3.normalise(begin), se3.normalise(end), prior.times)
        way = P[:6, :6] + P[6:, 6:] - P[:6, 6:] - P[6:, :6]
        return ElasticConstraints(expected, np.linalg.inv(MISS**2 * Q + P[6:, 6:]), np.linalg.inv(Q + way))

    def follow(self, stamp_ns: int, pose: Floats, sweep: MotionPrior, prior: MotionPrior, covariance: Floats) -> None:
        """Take the `sweep` that was found for `prior`, its pose at the stamp now `pose` (4, 4), with the covariance (12, 12)."""
        self._ends_ns = _ends_ns(stamp_ns, sweep)
        self._ends = np.asarray(pose @ se3.relative(sweep.pose, sweep.poses[[0, -1]]))
        self._covariance = covariance
        found, expected = middle_of(sweep, stamp_ns, pose)[0], middle_of(prior, stamp_ns, prior.pose)[0]
        change = se3.log(se3.relative(expected, found))
        Q = self._change_over(prior.span_s)
        self._change = FORGETTING * Q + (1.0 - FORGETTING) * np.outer(change, change)

    def forget(self) -> None:
        """The last scan has no sweep, or a wrong one."""
        self._ends = self._covariance = None

    def _change_over(self, span_s: float) -> Floats:
        """(6, 6) covariance, LiDAR axes, of the change of motion from one sweep to the next."""
        usual = np.diag((USUAL * span_s**2) ** 2) if self._change is None else self._change
        return np.asarray(usual + LEAST_CHANGE**2 * np.eye(6))


def off(pose: Floats, expected: Floats) -> Floats:
    """(6,) d of t = t' + d[:3], R = exp(d[3:]) R' from the expected pose (4, 4) to another."""
    return np.concatenate([pose[:3, 3] - expected[:3, 3], so3.log(pose[:3, :3] @ expected[:3, :3].T)])


def _ends_ns(stamp_ns: int, sweep: MotionPrior) -> tuple[int, int]:
    return stamp_ns + round(1e9 * float(sweep.times[0])), stamp_ns + round(1e9 * float(sweep.times[-1]))
