"""Coarse to fine: the capture range of metres where the motion prior may be wrong by as much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
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
