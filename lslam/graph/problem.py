"""A pose graph and its solution as plain values; nothing here knows gtsam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lslam.graph.fix_noise import Wander
from lslam.types.constraint import Constraint, LoopStage, Turn

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PositionFix:
    """A position that was measured: `keyframe`'s point `arm` (3,), m, in its own axes, lies at `position` (3,), m.

    sigma : (3,) m; the arm is the antenna at the instant of the fix, as seen from the keyframe by odometry
    instant : which of the graph's `wander` it errs by as well, None for none
    """

    keyframe: int
    position: Floats
    sigma: Floats
    arm: Floats
    instant: int | None = None


@dataclass(frozen=True)
class UpDirection:
    """Which way is up (3,), unit, in the axes of `keyframe`.

    sigma : rad; share : part of one measurement that it is, as errors of keyframes that follow each other are the same error
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
    """Where the map puts `keyframe`, seen from above: `pose` (3,) x, y (m), yaw (rad) in the frame of the map.

    information : (3, 3) in its axes, 1/m2 and 1/rad2, singular along what is free; rank : directions that are not
    share : what of it counts beside all others, since those that look at the same walls make the same error
    """

    keyframe: int
    pose: Floats
    information: Floats
    rank: int
    share: float = 1.0


@dataclass(frozen=True)
class DriftClaim:
    """A drift that odometry is said to have.

    rates, sigma : per m, the mean over the way: (3,) m along x and y of the world, rad of heading, to the left; or (6,) m along
        x, y and z, rad about them
    gain : how much lower minus twice the logarithm of the likelihood is with it; chance : what that stays below by chance
    rms : per m, the root mean square over the way of rates that wander; None of rates that last
    """

    rates: Floats
    sigma: Floats
    gain: float
    chance: float
    rms: Floats | None = None

    @property
    def does_wander(self) -> bool:
        """Whether the rates are others from place to place."""
        return self.rms is not None


@dataclass(frozen=True)
class PoseGraph:
    """Everything known of K keyframes.

    poses : (K, 4, 4) where they are now
    distances : (K,) m travelled up to each, for what odometry may have drifted
    world_up : (3,) unit, up in the world of `poses`, needed where there are `ups`
    map_priors : planar priors in the frame of a map that is off as a whole by `shift_sigma` m, and one sigma by `map_sigma` m
        about each place
    is_anchored : whether the first pose is held where it is; else the fixes hold the graph
    start : (3,) x, y (m), yaw (rad) that somebody gave of the first pose; None takes `poses`
    start_sigma : (3,) m, m, rad, how well these are known of a first pose that is held only otherwise
    is_rigid : odometry is trusted: the whole moves, and nothing bends it
    walk : factor on `drift.drift_covariance` that odometry errs by at the least beside its covariances
    spread : (K, 6, 6) what poses are unsure by beside all that, as the covariances of `Solution`; None for nothing
    claim : the drift that odometry was set right by before it came here
    wander : the error that fixes have in common, None where each has one of its own
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
    start: Floats | None = None
    start_sigma: Floats | None = None
    is_rigid: bool = False
    walk: float = 0.0
    spread: Floats | None = None
    claim: DriftClaim | None = None
    wander: Wander | None = None

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True)
class Solution:
    """Optimised keyframes.

    poses : (K, 4, 4); covariances : (K, 6, 6) marginal, of t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2
    loop_reasons : per loop of the graph, empty when it was believed, else why not
    loop_stages : per loop, what decided
    fix_believed : (F,) bool per fix
    map_reasons : per planar prior, empty when it was believed, else why not
    shift, shift_sigma : (2,) m by which the map is off as a whole (true minus map), and how well that is known
    drift : factor on `graph.drift.drift_covariance` that odometry's covariances were short of, 0 when loops bear them out
    rounds : solutions it took; error : half the sum of squared whitened residuals at the end
    """

    poses: Floats
    covariances: Floats
    loop_reasons: list[str]
    loop_stages: list[LoopStage]
    fix_believed: NDArray[np.bool_]
    map_reasons: list[str]
    shift: Floats
    shift_sigma: Floats
    drift: float
    rounds: int
    error: float
