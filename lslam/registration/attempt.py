"""One scan on its target: the alignments that are tried, and whether they are accepted."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import noise
from lslam.core.types.scan_result import OPEN_RAD, StageClock
from lslam.core.types.state import Stateful
from lslam.registration.acceptance import Acceptance, correction
from lslam.registration.history import History
from lslam.registration.optimiser import KERNEL_DECAY, KERNEL_MIN_M, START_ITERATIONS, Annealing
from lslam.registration.result import RegistrationResult

# m; around a pose that is nearly right the kernel opens one step wider than it ends. Larger corrections of the prior are checked
# coarse to fine, or turns of `OPEN_RAD`: priors of steady motion are better.
RECOVER_M = KERNEL_MIN_M / KERNEL_DECAY


class Target(Stateful, ABC):
    """The maps that scans are registered on, and the residuals of their points or features there."""

    config: RegistrationConfig
    # Words for what is registered.
    source: str
    # Steps as a multiple of those configured.
    times_steps: int

    @abstractmethod
    def fresh(self) -> Target:
        """An empty one of the same settings."""

    @abstractmethod
    def __len__(self) -> int:
        """Voxels, or features, of the scans that were entered; 0: empty."""

    @abstractmethod
    def count(self, points: Any) -> int:
        """Number of points or features that registration uses."""

    @abstractmethod
    def refusal(self, points: Any) -> str:
        """The reason why a scan cannot be registered; empty where it can."""

    def ready(self, points: Any) -> Any:
        """The points with all that the residual needs of them (covariances, ring gaps), unchanged if that is nothing more."""
        return points

    @abstractmethod
    def align(
        self, attempt: Attempt, T_start: Floats, annealing: Annealing, information: Floats | None = None
    ) -> RegistrationResult:
        """Align the scan from `T_start` (4, 4); `information` (6, 6) of it as a prior, world axes, None: only a start."""

    @abstractmethod
    def capture(self, attempt: Attempt) -> RegistrationResult:
        """Aligned with the coarse planes first, which catch a scan from metres off, and judged."""

    @abstractmethod
    def enter(self, result: RegistrationResult) -> None:
        """Insert a scan at its pose, and take out those that no longer belong there."""

    @abstractmethod
    def cloud(self, points: Any) -> NDArray[Any]:
        """All points (N, 3) of a scan, m, LiDAR frame."""


@dataclass
class Attempt:
    """A scan, its motion prior (4, 4), and the state of the registration that is to place it.

    start : where the coarse planes put the scan, which the result began from; the prior where they were not tried
    information : (6, 6) of the prior, world axes, 1/m2 and 1/rad2; None where nobody knows it
    """

    target: Any
    points: Any
    T_prior: Floats
    config: RegistrationConfig
    history: History
    is_near: bool = False
    clock: StageClock = field(default_factory=StageClock)
    start: RegistrationResult | None = None
    information: Floats | None = None

    @property
    def annealing(self) -> Annealing:
        """Kernel widths and steps: the first width is the recent error of the motion prior, or `RECOVER_M` with `is_near`."""
        c, h = self.config, self.history
        width = RECOVER_M if self.is_near else h.threshold.width
        steps = c.max_iterations * self.target.times_steps
        if not self.is_near and h.starting > 0:
            steps = START_ITERATIONS
        return Annealing(width, steps)

    def judge(self, result: RegistrationResult, T_prior: Floats | None = None) -> RegistrationResult:
        """The result with its correction of the prior, or a failed one at the prior with the reason."""
        c, history, T_expected = self.config, self.history, self.T_prior if T_prior is None else T_prior
        # What the prior does not confirm must agree as usual: nothing else tells it from a place that looks alike.
        asks_more = history.starting == 0 and not self._confirms(T_expected, result.T_world_lidar)
        limits = Acceptance(
            c.min_overlap,
            history.matches.LESS * history.matches.usual
            if asks_more and c.min_agreement > 0
            else history.matches.least,
            max_jump_m=c.max_jump_m,
            max_jump_deg=c.max_jump_deg,
            usual=history.agreement,
            source=self.target.source,
        )
        return limits.judge(result, T_expected)

    def credit(self, result: RegistrationResult, pose_source: str) -> RegistrationResult:
        """The result labelled with the policy `pose_source` that produced it, and with its correction of the prior."""
        return replace(result, prior_error=correction(self.T_prior, result.T_world_lidar), pose_source=pose_source)

    @property
    def is_young(self) -> bool:
        """Whether the map is made of so few scans that the next may lie anywhere within `start_reach`."""
        return self.config.start_reach > 0 and self.history.is_young

    def is_small(self, result: RegistrationResult) -> bool:
        """Whether the result corrects the motion prior by less than `RECOVER_M` and `RECOVER_DEG`."""
        move, turn = result.prior_error
        return move < RECOVER_M and turn < OPEN_RAD

    def _confirms(self, T_prior: Floats, pose: Floats) -> bool:
        """Whether a pose (4, 4) is no other place than the prior: as near as that of steady motion, or as its information says.

        Turns lead to no other place, and a hand's come as a surprise.
        """
        if np.linalg.norm(pose[:3, 3] - T_prior[:3, 3]) < RECOVER_M:
            return True
        if self.information is None:
            return False
        change = noise.changes(T_prior, pose)
        return bool(change @ self.information @ change < noise.quantile(noise.RIGHT_PROBABILITY, 6))


class Policy(Protocol):
    """A recovery policy: tried where a registration from the motion prior may not be enough."""

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """A better result, whose `pose_source` is this policy, or the result."""
        ...
