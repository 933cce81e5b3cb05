"""The recovery policies that a configuration switches on, in the order in which they are asked."""

from __future__ import annotations

from lslam.config.preprocess import PreprocessConfig
from lslam.config.recovery import RecoveryConfig
from lslam.config.registration import RegistrationConfig
from lslam.recovery.coarse_to_fine import CoarseToFine
from lslam.recovery.start_search import StartSearch
from lslam.registration.registration import Recovery, Registration


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
