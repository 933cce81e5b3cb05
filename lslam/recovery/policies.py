"""The recovery policies that a configuration switches on, in the order in which they are asked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.config.recovery import RecoveryConfig
from lslam.config.registration import RegistrationConfig
from lslam.preprocessing.prepare import PreparedPoints
from lslam.recovery.start_search import StartSearch
from lslam.registration.registration import Recovery, Registration
from lslam.registration.solver import RegistrationResult


class CoarseToFine:
    """Aligns with the coarse planes, annealed slowly, then with the fine ones; of two results the larger consensus is taken.

    Fine registration alone loses a start above 0.7 m per scan: its kernel opens no wider than its voxels.
    """

    name = "coarse-to-fine"

    def recover(
        self,
        registration: Registration,
        points: PreparedPoints,
        T_prior: NDArray[np.float64],
        found: RegistrationResult,
    ) -> RegistrationResult:
        """Acts while the speed is unknown, and on results that fail, correct their prior by much or agree less than usual."""
        usual = registration.agreement
        is_sure = found.ok and registration.is_small(found)
        if is_sure and registration.starting == 0 and not usual.is_less(found.agreement):
            return found
        coarse = registration.judged(registration.alignment.coarse_to_fine(points, T_prior), T_prior)
        iterations = found.iterations + coarse.iterations
        is_started = registration.starting == 0
        # Forty steps that lead nowhere are no consensus; the ten of a usual scan may end a millimetre short of it.
        is_consensus = found.ok and (found.converged or is_started)
        is_better = coarse.ok and (not is_consensus or coarse.inliers > found.inliers)
        if is_sure and is_started:
            # What hides part of the map, as a crowd does, hides it from both.
            is_better = is_better and not usual.is_less(coarse.agreement)
        return (
            replace(coarse, iterations=iterations, posed_by=self.name)
            if is_better
            else replace(found, iterations=iterations)
        )


def policies_of(config: RecoveryConfig) -> tuple[Recovery, ...]:
    """Nearest first: what one of them finds, the next one sees."""
    policies: list[Recovery] = []
    if config.coarse_to_fine:
        policies.append(CoarseToFine())
    if config.start_search:
        policies.append(StartSearch())
    return tuple(policies)


class RecoveringRegistration(Registration):
    """Registers scans one after the other against a local map that it keeps, with all that recovers a lost one.

    >>> import numpy as np
    >>> from lslam import Registration
    >>> registration = Registration()
    >>> result = registration.register(np.random.default_rng(0).uniform(-20, 20, (5000, 3)))
    >>> result.T_world_lidar.shape
    (4, 4)
    """

    def __init__(
        self, config: RegistrationConfig | None = None, preprocess: PreprocessConfig | None = None,
        recovery: RecoveryConfig | None = None,
    ) -> None:  # fmt: skip
        super().__init__(config, preprocess, policies_of(recovery or RecoveryConfig()))
