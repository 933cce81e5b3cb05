"""The first step of a drive is sought once, however many runs of a worker take it."""

from __future__ import annotations

import hashlib
import pickle
from copy import deepcopy

from lslam.registration.attempt import Attempt
from lslam.registration.solver import RegistrationResult
from lslam.registration.start_search import held_by_non_ground
from lslam.registration.voxel_target import VoxelTarget


class SoughtStarts:
    """Stands in for the search of a scan among a few others, which takes as long as ten scans that follow.

    A search is known by all that it is given, to the byte: scan, map, history, settings, and what was found before.
    """

    def __init__(self) -> None:
        self._held: dict[str, RegistrationResult | None] = {}

    def held_by_non_ground(
        self, attempt: Attempt, result: RegistrationResult, *, is_lost: bool = False
    ) -> RegistrationResult:
        """As the function of this name; the result itself where that found nothing better."""
        target = attempt.target
        if type(target) is not VoxelTarget:
            return held_by_non_ground(attempt, result, is_lost=is_lost)
        given = (
            attempt.config, target.config, target.preprocess, target.state(), attempt.history.state(), attempt.points,
            attempt.T_prior, attempt.is_near, result, is_lost,
        )  # fmt: skip
        key = hashlib.sha256(pickle.dumps(given)).hexdigest()
        if key not in self._held:
            found = held_by_non_ground(attempt, result, is_lost=is_lost)
            self._held[key] = None if found is result else found
        known = self._held[key]
        return result if known is None else deepcopy(known)
