"""An elastic sweep: a pose at its begin, another at its end, and the motion between (CT-ICP)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior


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
