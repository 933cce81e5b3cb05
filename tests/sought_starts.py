"""The first step of a drive is sought once, however many runs take it, of whichever worker."""

from __future__ import annotations

import hashlib
import os
import pickle
from pathlib import Path
from threading import get_ident

from lslam.registration.attempt import Attempt
from lslam.registration.policies import best_by_non_ground
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import VoxelTarget


class SoughtStarts:
    """Stands in for the search of a scan among a few others, which takes as long as ten scans that follow.

    A search is known by all that it is given, to the byte: scan, map, history, settings, and what was found before. What it
    finds lies in `folder`, where all workers look.
    """

    def __init__(self) -> None:
        self.folder = Path()

    def best_by_non_ground(
        self, attempt: Attempt, result: RegistrationResult, *, may_be_anywhere: bool = False
    ) -> RegistrationResult:
        """As the function of this name; the result itself where that found nothing better."""
        target = attempt.target
        if type(target) is not VoxelTarget:
            return best_by_non_ground(attempt, result, may_be_anywhere=may_be_anywhere)
        given = (
            attempt.config, target.config, target.preprocess, target.state(), attempt.history.state(), attempt.points,
            attempt.T_prior, attempt.is_near, result, may_be_anywhere,
        )  # fmt: skip
        key = hashlib.sha256(pickle.dumps(given)).hexdigest()
        path = self.folder / key
        if not path.exists():
            found = best_by_non_ground(attempt, result, may_be_anywhere=may_be_anywhere)
            part = path.with_suffix(f".{os.getpid()}-{get_ident()}")
            part.write_bytes(pickle.dumps(None if found is result else found))
            part.replace(path)
        known: RegistrationResult | None = pickle.loads(path.read_bytes())
        return result if known is None else known
