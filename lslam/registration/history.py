"""What earlier scans taught about the next one: errors of the prior, the usual inlier share, the last poses."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.types.arrays import Floats
from lslam.core.types.state import Stateful
from lslam.registration.rest import Rest
from lslam.registration.result import RegistrationResult
from lslam.registration.robust import KERNEL_MIN_M, AdaptiveThreshold, UsualAgreement


class History(Stateful):
    """Adapts to registrations, scan after scan.

    threshold : kernel width by the recent errors of the motion prior
    agreement, matches : recent inlier shares, of all source points and of those with a match
    starting : initialisation scans that remain; inserted : scans in the map
    rest : the spot that the sensor has not left
    recent : points (N, 3), LiDAR frame, and pose (4, 4) of the last scans in the map
    """

    STATE = ("threshold", "agreement", "matches", "starting", "inserted", "recent", "rest")

    def __init__(self, config: RegistrationConfig, preprocess: PreprocessConfig | None = None) -> None:
        self.start_scans = config.start_scans
        self.threshold = AdaptiveThreshold(KERNEL_MIN_M, config.kernel_max)
        self.agreement, self.matches = (UsualAgreement(config.min_agreement) for _ in range(2))
        self.starting, self.inserted = config.start_scans, 0
        self.recent: tuple[tuple[NDArray[Any], Floats], ...] = ()
        self.rest = Rest(preprocess or PreprocessConfig(), config.sigma, config.voxel_size)

    @property
    def is_young(self) -> bool:
        """Whether the map is made of the first scans alone."""
        return self.inserted <= self.start_scans

    def enter(self, points: NDArray[Any], T_world_lidar: Floats, lever_arm: float = 1.0) -> None:
        """One more scan is in the map; `lever_arm` of its rotation, m."""
        self.inserted += 1
        self.rest.enter(points, T_world_lidar, lever_arm)
        self.recent = (*self.recent, (points, T_world_lidar))[-self.start_scans :]

    def observe(self, result: RegistrationResult) -> None:
        """Adapt to a registration, unless its pose was rejected."""
        if not result.ok:
            self.starting = max(self.starting, 1)
            self.threshold.widen()
            self.agreement.relax()
        elif not result.is_rejected:
            self.starting = max(self.starting - 1, 0)
            # All points agree less with their map than features do with theirs.
            own = result if result.replaced is None else result.replaced
            if own.ok:
                self.agreement.observe(own.agreement)
                self.matches.observe(own.inlier_share)
            move, turn = result.prior_error
            self.threshold.observe(move + turn * result.lever_arm)
