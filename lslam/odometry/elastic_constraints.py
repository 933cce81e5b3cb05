"""An elastic sweep, and what holds it to the last one: location consistency and constant velocity (CT-ICP).

Each holds as surely as it lately held. A spinning sensor sees every direction at the same share of each sweep. A map that was
begun with wrong motion within the sweep is skewed from direction to direction, and all sweeps registered on it agree with that
error: it is one more unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lslam.core.geometry import noise, se3, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.state import Stateful
from lslam.odometry.inertial.constant_velocity import USUAL_ACCELERATION, middle_of


@dataclass(frozen=True)
class ElasticSweep:
    """Poses (4, 4) at the begin and the end of a sweep, translation linear and rotation along the geodesic between them.

    times : (K,) s from the stamp; bend : (K, 4, 4) by which the motion departs from that, in the sensor's axes at each time:
    what an IMU felt; None: nothing
    """

    begin: Floats
    end: Floats
    times: Floats
    bend: Floats | None = None

    @classmethod
    def of(cls, prior: MotionPrior) -> ElasticSweep:
        """Through both ends of the prior, with its bend where that was felt."""
        straight = cls(prior.poses[0], prior.poses[-1], prior.times)
        if not prior.is_bent:
            return straight
        return cls(straight.begin, straight.end, prior.times, se3.relative(straight.poses, prior.poses))

    @property
    def shares(self) -> Floats:
        """(K,) of the sweep, 0 to 1."""
        return np.asarray((self.times - self.times[0]) / (self.times[-1] - self.times[0]))

    @property
    def poses(self) -> Floats:
        """(K, 4, 4) T_world_lidar at `times`."""
        shares = self.shares[:, None]
        turn = so3.log(self.begin[:3, :3].T @ self.end[:3, :3])
        t = (1.0 - shares) * self.begin[:3, 3] + shares * self.end[:3, 3]
        straight = se3.make(self.begin[:3, :3] @ so3.exp(shares * turn), t)
        return straight if self.bend is None else straight @ self.bend

    @property
    def prior(self) -> MotionPrior:
        """The same as a motion over the sweep."""
        return MotionPrior(self.times, self.poses)

    def moved(self, d: Floats) -> ElasticSweep:
        """Both ends by d (2, 6): t' = t + d[:3], R' = exp(d[3:]) R."""
        begin, end = (
            se3.make(so3.exp(step[3:]) @ pose[:3, :3], pose[:3, 3] + step[:3])
            for step, pose in zip(d, (self.begin, self.end), strict=True)
        )
        return ElasticSweep(se3.normalise(begin), se3.normalise(end), self.times, self.bend)


# Of the covariance of a change of motion, what stays from scan to scan: a memory of five.
FORGETTING_FACTOR = 0.8
# m and rad, a change that registration cannot tell from none.
LEAST_CHANGE = 1e-3
# m and rad, likewise of the map, which is the mean of many scans.
LEAST_SKEW = 1e-4
# With an acceleration a of its own in each sweep of T seconds, lines fitted to neighbouring ones miss each other by
# (a2 - a1) T^2 / 12, the velocity of a line is ahead of that between their middles by (a1 + 2 a2) T^2 / 6, and the change of
# motion that is measured is (a0 + 4 a1 + a2) T^2 / 6: rms of the first two by that of the third.
MISS_RATIO = 1.0 / 6.0
LAG_RATIO = math.sqrt(10.0) / 6.0
NOTHING: Floats = np.zeros((6, 6))


@dataclass(frozen=True)
class ElasticConstraints:
    """What is known of a sweep before its points are looked at; information (6, 6) in world axes.

    expected, location : where it begins, and of that; velocity : of the motion within it being that since the middle of the
        last one; since : the sweep's part of the time since then
    skew, skewed : (6,) motion from begin to end that the sweeps lack which the map was made of, and of that
    """

    expected: ElasticSweep
    location: Floats
    velocity: Floats
    since: float
    skew: Floats
    skewed: Floats

    @classmethod
    def of_course(cls, prior: MotionPrior) -> ElasticConstraints:
        """Of a sweep whose motion later scans told as well: the map that they made has no skew."""
        assert prior.change is not None
        fixed = np.eye(6) / LEAST_SKEW**2
        return cls(ElasticSweep.of(prior), NOTHING, _inverse(prior.change), 0.0, np.zeros(6), fixed)

    def add_to(self, A: Floats, b: Floats, sweep: ElasticSweep) -> None:
        """Add all to the normal equations (18, 18), (18,) of begin, end and skew, in place.

        Location consistency and constant velocity: Dellenbach et al. 2022, section III-B.
        """
        begin, end = off(sweep.begin, self.expected.begin), off(sweep.end, self.expected.end)
        # The middle is half of both ends.
        steady = (-1.0 - self.since / 2, 1.0 - self.since / 2, 0.0)
        for W, signs in ((self.location, (1.0, 0.0, 0.0)), (self.velocity, steady), (self.skewed, (0.0, 0.0, 1.0))):
            b += np.kron(signs, W @ (signs[0] * begin + signs[1] * end - signs[2] * self.skew))
            A += np.kron(np.outer(signs, signs), W)


class LastSweep(Stateful):
    """Remembers the last sweep, how well it was known, and how much the motion lately changed from scan to scan."""

    STATE = ("_ends_ns", "_ends", "_covariance", "_change", "_skew", "_skewed")

    def __init__(self) -> None:
        # Begin and end, ns, the poses (2, 4, 4) there, and their covariance (12, 12), world axes.
        self._ends_ns = (0, 0)
        self._ends: Floats | None = None
        self._covariance: Floats | None = None
        # (6, 6) mean square of what registration corrected the prior by at the middle of a sweep, LiDAR axes.
        self._change: Floats | None = None
        # (6,) and covariance (6, 6), world axes, of the map's skew.
        self._skew = np.zeros(6)
        self._skewed: Floats | None = None

    def constraints(self, stamp_ns: int, prior: MotionPrior) -> ElasticConstraints:
        """Of the scan at `stamp_ns`: it follows the last sweep at the same velocity, or as an IMU felt that it does.

        Where scans between are missing the prior says where it begins.
        """
        begin_ns, end_ns = _ends_ns(stamp_ns, prior)
        Q = noise.rotate(self._change_over(prior.span_s), prior.pose[:3, :3])
        # The first sweep has the velocity at its end.
        M = Q if self._skewed is None else self._skewed
        expected, P = ElasticSweep.of(prior), self._covariance
        length = self._ends_ns[1] - self._ends_ns[0]
        location, since = NOTHING, 0.0
        if self._ends is not None and P is not None and abs(begin_ns - self._ends_ns[1]) < length / 2:
            location, since = _inverse(MISS_RATIO**2 * Q + P[6:, 6:]), 1.0
            if not prior.is_bent:
                twist = se3.log(se3.relative(*self._ends)) / length
                begin, end = (self._ends[1] @ se3.exp((ns - self._ends_ns[1]) * twist) for ns in (begin_ns, end_ns))
                expected = ElasticSweep(se3.normalise(begin), se3.normalise(end), prior.times)
        velocity, skewed = _inverse(LAG_RATIO**2 * Q), _inverse(M + LEAST_SKEW**2 * np.eye(6))
        return ElasticConstraints(expected, location, velocity, since, self._skew, skewed)

    def follow(
        self,
        stamp_ns: int,
        pose: Floats,
        sweep: MotionPrior,
        prior: MotionPrior,
        skew: Floats,
        covariance: Floats,
        share: float,
    ) -> None:
        """Take the `sweep` that was found for `prior`, its pose at the stamp now `pose` (4, 4).

        skew, covariance : as of `ElasticResult`; share : of the map that this scan is
        """
        self._ends_ns = _ends_ns(stamp_ns, sweep)
        self._ends = np.asarray(pose @ se3.relative(sweep.pose, sweep.poses[[0, -1]]))
        self._covariance = covariance[:12, :12]
        L = np.kron((-share, share, 1.0 - share), np.eye(6))
        self._skew, self._skewed = (1.0 - share) * skew, L @ covariance @ L.T
        middle, expected = middle_of(sweep, stamp_ns, pose)[0], middle_of(prior, stamp_ns, prior.pose)[0]
        change = se3.log(se3.relative(expected, middle))
        Q = self._change_over(prior.span_s)
        self._change = FORGETTING_FACTOR * Q + (1.0 - FORGETTING_FACTOR) * np.outer(change, change)

    def forget(self) -> None:
        """The last scan has no sweep, or a wrong one."""
        self._ends = self._covariance = None

    def _change_over(self, span_s: float) -> Floats:
        """(6, 6) covariance, LiDAR axes, of the change of motion from one sweep to the next."""
        usual = np.diag((USUAL_ACCELERATION * span_s**2) ** 2) if self._change is None else self._change
        return np.asarray(usual + LEAST_CHANGE**2 * np.eye(6))


def off(pose: Floats, expected: Floats) -> Floats:
    """(6,) d of t = t' + d[:3], R = exp(d[3:]) R' from the expected pose (4, 4) to another."""
    return np.concatenate([pose[:3, 3] - expected[:3, 3], so3.log(pose[:3, :3] @ expected[:3, :3].T)])


def _ends_ns(stamp_ns: int, sweep: MotionPrior) -> tuple[int, int]:
    return stamp_ns + round(1e9 * float(sweep.times[0])), stamp_ns + round(1e9 * float(sweep.times[-1]))


def _inverse(covariance: Floats) -> Floats:
    return np.asarray(np.linalg.inv(covariance), np.float64)
