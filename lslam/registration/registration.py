"""Registration of scans, one after the other: predict, align, judge, recover, enter; of points or of features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RecoveryConfig, RegistrationConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.scan_result import StageClock
from lslam.core.types.state import Stateful
from lslam.registration.acceptance import failure
from lslam.registration.attempt import Attempt, Policy, Target
from lslam.registration.history import History
from lslam.registration.local_map import LocalMap
from lslam.registration.optimiser import KERNEL_MIN_M, Annealing
from lslam.registration.policies import policies_of
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.registration.rest import RestDetector
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import VoxelTarget


class Registration(Stateful):
    """Registers scans one after the other against a local map that it keeps, and recovers lost ones.

    recovery : which of the standard recovery policies are tried; None: all
    target : the maps and residuals; None: Gaussian voxels of all points
    policies : recovery policies in place of those of `recovery`, in the order in which they are tried

    >>> import numpy as np
    >>> from lslam import Registration
    >>> registration = Registration()
    >>> result = registration.register(np.random.default_rng(0).uniform(-20, 20, (5000, 3)))
    >>> result.T_world_lidar.shape
    (4, 4)
    """

    STATE = ("target", "history", "rest_detector", "_last", "_index")

    def __init__(
        self,
        config: RegistrationConfig | None = None,
        preprocess: PreprocessConfig | None = None,
        recovery: RecoveryConfig | None = None,
        target: Target | None = None,
        policies: Sequence[Policy] | None = None,
    ) -> None:
        self.config, self.preprocess = config or RegistrationConfig(), preprocess or PreprocessConfig()
        self.target: Any = VoxelTarget(self.config, self.preprocess) if target is None else target
        self.policies = policies_of(recovery or RecoveryConfig()) if policies is None else tuple(policies)
        self.history = History(self.config, self.preprocess)
        self.rest_detector = RestDetector(self.config.sigma)
        # Of `register`: the last two poses, and how many scans there were.
        self._last, self._index = (np.eye(4), np.eye(4)), 0

    def fresh(self) -> Registration:
        """A new registration with an empty map and the same settings."""
        return Registration(self.config, self.preprocess, target=self.target.fresh(), policies=self.policies)

    @property
    def map(self) -> LocalMap:
        """The local map of the target."""
        local_map: LocalMap = self.target.map
        return local_map

    def register(self, points: NDArray[Any], prior: Floats | None = None) -> RegistrationResult:
        """Register points (N, 3), m, LiDAR frame, and enter them into the map; without `prior` (4, 4) by constant velocity."""
        return self.align(prepare_points(points, self.preprocess, self._index), prior)

    def align(self, points: Any, prior: Floats | None = None) -> RegistrationResult:
        """Pose of prepared points, as of `register`: without `prior` (4, 4) the sensor is taken to move on at constant velocity.

        Raises InputError for a prior that is no finite (4, 4).
        """
        before, last = self._last
        T_prior = se3.normalise(last @ se3.relative(before, last)) if prior is None else np.asarray(prior, np.float64)
        if T_prior.shape != (4, 4) or not np.isfinite(T_prior).all():
            raise InputError(f"the motion prior has shape {T_prior.shape}: a finite (4, 4) pose is needed")
        result = self.update(self.locate(points, T_prior))
        self._last = (last, result.T_world_lidar) if self._index else (result.T_world_lidar, result.T_world_lidar)
        self._index += 1
        return result

    def locate(
        self,
        points: Any,
        T_prior: Floats,
        is_near: bool = False,
        information: Floats | None = None,
        clock: StageClock | None = None,
    ) -> RegistrationResult:
        """Register prepared points without updating the map; the result says whether it is accepted.

        is_near : local registration: narrow kernel, no recovery
        information : (6, 6) of the prior, world axes, added to the normal equations; None: the prior is the initial guess only
        """
        count = self.target.count(points)
        if reason := self.target.refusal(points):
            return replace(failure(T_prior, count, reason), points=points)
        if len(self.target) == 0:
            return RegistrationResult(T_prior, covariance=np.diag([1e-12] * 6), source_points=count, points=points)
        attempt = self.attempt(points, T_prior, is_near, clock, information)
        result = attempt.judge(self.target.align(attempt, T_prior, attempt.annealing, information))
        for policy in () if is_near else self.policies:
            result = policy.recover(attempt, result)
        return replace(result, points=points)

    def attempt(
        self,
        points: Any,
        T_prior: Floats,
        is_near: bool = False,
        clock: StageClock | None = None,
        information: Floats | None = None,
    ) -> Attempt:
        """The scan with its prior (4, 4), of that `information` (6, 6), target and history, as recovery policies take it."""
        ready, clock = self.target.ready(points), clock or StageClock()
        return Attempt(self.target, ready, T_prior, self.config, self.history, is_near, clock, information=information)

    def update(self, result: RegistrationResult) -> RegistrationResult:
        """Insert the scan into the map unless its registration failed; adapt to it unless its pose was rejected.

        Returns the result, which says whether the sensor is at rest.
        """
        is_first = len(self.target) == 0
        result = self.rest_detector.judge(result)
        self.enter(result)
        if not (result.ok and is_first):
            self.history.observe(result)
        else:
            self.history.matches.observe(self._own_share(result))
        return result

    def _own_share(self, result: RegistrationResult) -> float:
        """Inlier share of the first scan on the map that it made itself: the largest that a right pose can be expected to have.

        It depends on scene, voxels and noise: a share of 16 % is right in a small room, and wrong in a street.
        """
        attempt = self.attempt(result.points, result.T_world_lidar)
        return float(self.target.align(attempt, result.T_world_lidar, Annealing.once(KERNEL_MIN_M)).inlier_share)

    def enter(self, result: RegistrationResult) -> None:
        """Insert the scan into the map at its pose unless its registration failed.

        Scans from one place share the error of their rays: a map that each enters at its own pose follows that error. A scan
        of a sensor at rest enters at the pose of the one before.
        """
        if not result.ok:
            return
        if result.is_stationary:
            result = replace(result, T_world_lidar=self.history.recent[-1][1])
        self.target.enter(result)
        self.history.enter(self.target.cloud(result.points), result.T_world_lidar, result.lever_arm)
