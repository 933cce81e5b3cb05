"""A pose graph and its solution as plain values; nothing here knows gtsam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lslam.backend.graph.fix_noise import GaussMarkovNoise
from lslam.backend.graph.marginals import PosePrior
from lslam.core.arrays import Bools, Floats
from lslam.core.types.constraint import Constraint, LoopStage, Turn
from lslam.core.types.imu import InertialChain


@dataclass(frozen=True)
class PositionFix:
    """A measured position: `keyframe`'s point `arm` (3,), m, in its own axes, lies at `position` (3,), m.

    sigma : (3,) m; the arm is the antenna at the instant of the fix, relative to the keyframe by odometry
    instant : index of the correlated error in the graph's `fix_noise`, None for none
    is_binding : a control point: no outlier candidate of the graph
    share, next_arm : of an instant on the way to the next keyframe, which has the point there (3,), and counts by `share`, 0..1
    """

    keyframe: int
    position: Floats
    sigma: Floats
    arm: Floats
    instant: int | None = None
    is_binding: bool = False
    share: float = 0.0
    next_arm: Floats = field(default_factory=lambda: np.zeros(3))

    def predict(self, poses: Floats) -> Floats:
        """(3,) m, where the keyframes at `poses` (K, 4, 4) have the point."""
        here = poses[self.keyframe, :3, :3] @ self.arm + poses[self.keyframe, :3, 3]
        if not self.share:
            return np.asarray(here)
        after = poses[self.keyframe + 1]
        return np.asarray((1.0 - self.share) * here + self.share * (after[:3, :3] @ self.next_arm + after[:3, 3]))


@dataclass(frozen=True)
class UpDirection:
    """Which way is up (3,), unit, in the axes of `keyframe`.

    sigma : rad; share : weight as a part of one measurement, as errors of successive keyframes are correlated
    """

    keyframe: int
    up: Floats
    sigma: float
    share: float = 1.0


@dataclass(frozen=True)
class FloorPlane:
    """The floor seen from `keyframe`: normal . p + offset = 0 in its axes, normal (3,) up; sigmas : rad, m."""

    keyframe: int
    normal: Floats
    offset: float
    sigma_rad: float
    sigma_m: float


@dataclass(frozen=True)
class PlanarPrior:
    """Planar prior on `keyframe`: `pose` (3,) x, y (m), yaw (rad) in the frame of the map.

    information : (3, 3) in its axes, 1/m2 and 1/rad2, singular along unobserved directions; rank : observed ones
    share : weight beside the other priors, since those from the same walls have correlated errors
    """

    keyframe: int
    pose: Floats
    information: Floats
    rank: int
    share: float = 1.0


@dataclass(frozen=True)
class EstimatedDrift:
    """An estimated drift of odometry.

    rates, sigma : per m, the mean over the way: (3,) m along x and y of the world, rad of heading, to the left; or (6,) m along
        x, y and z, rad about them
    gain : likelihood ratio statistic against no drift; chance : its critical value under the null hypothesis
    rms : per m, the root mean square over the way of varying rates; None for constant ones
    """

    rates: Floats
    sigma: Floats
    gain: float
    chance: float
    rms: Floats | None = None

    @property
    def is_varying(self) -> bool:
        """Whether the rates vary along the way."""
        return self.rms is not None


@dataclass(frozen=True)
class PoseGraph:
    """The measurements of K keyframes.

    poses : (K, 4, 4) initial values
    distances : (K,) m travelled up to each, for the model of odometry's drift
    world_up : (3,) unit, up in the world of `poses`, needed where there are `ups`
    map_priors : planar priors in the frame of a map with a common shift of `shift_sigma` m, and errors of `map_sigma` m
        about each place
    is_anchored : whether the first pose has a tight prior; else the fixes anchor the graph
    tilt_sigma : rad, prior of the first pose's tilt where fixes anchor the graph
    start : (3,) x, y (m), yaw (rad), prior of the first pose; None takes `poses`
    start_sigma : (3,) m, m, rad, its sigmas; height, roll and pitch keep the tight prior
    is_rigid : odometry has no error: the trajectory moves as a whole
    walk : least factor on `drift.drift_covariance` that is added to odometry's covariances
    spread : (K, 6, 6) covariances of poses to be added to those of `Solution`; None for nothing
    estimated_drift : the drift that odometry was corrected by
    fix_noise : correlated noise of the fixes, None where they are independent
    inertial : the IMU between keyframes, which replaces the `ups` of those it levels; None for none
    """

    poses: Floats
    odometry: Sequence[Constraint]
    loops: Sequence[Constraint] = ()
    fixes: Sequence[PositionFix] = ()
    ups: Sequence[UpDirection] = ()
    turns: Sequence[Turn] = ()
    floors: Sequence[FloorPlane] = ()
    distances: Floats = field(default_factory=lambda: np.zeros(0))
    world_up: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    map_priors: Sequence[PlanarPrior] = ()
    shift_sigma: float = 0.0
    map_sigma: float = 0.0
    is_anchored: bool = True
    tilt_sigma: float = 3.0
    start: Floats | None = None
    start_sigma: Floats | None = None
    is_rigid: bool = False
    walk: float = 0.0
    spread: Floats | None = None
    estimated_drift: EstimatedDrift | None = None
    fix_noise: GaussMarkovNoise | None = None
    inertial: InertialChain | None = None

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def free_ups(self) -> Sequence[UpDirection]:
        """The up directions of keyframes that no IMU factor levels."""
        level = frozenset[int]() if self.inertial is None else self.inertial.level
        return [up for up in self.ups if up.keyframe not in level]


@dataclass(frozen=True)
class Solution:
    """Optimised keyframes.

    poses : (K, 4, 4); covariances : (K, 6, 6) marginal, of t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2
    loop_reasons : per loop closure of the graph why it is rejected, empty when accepted
    loop_stages : per loop closure, what decided: `consistency` or `graph`
    fix_inliers : (F,) bool per fix
    map_reasons : per planar prior why it is rejected, empty when accepted
    shift, shift_sigma : (2,) m, common shift of the map (true minus map), and its sigma
    drift : factor on `graph.drift.drift_covariance` added to odometry's covariances, 0 when they are consistent
    rounds : solutions it took; error : half the sum of squared whitened residuals at the end
    pose_prior : what all but LiDAR knows of the poses, where they have a place on the Earth and `graph.refine` asks for it
    """

    poses: Floats
    covariances: Floats
    loop_reasons: list[str]
    loop_stages: list[LoopStage]
    fix_inliers: Bools
    map_reasons: list[str]
    shift: Floats
    shift_sigma: Floats
    drift: float
    rounds: int
    error: float
    pose_prior: PosePrior | None = None
