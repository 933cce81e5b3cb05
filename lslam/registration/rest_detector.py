"""Rest of the sensor, by the poses of its registered scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.geometry import so3
from lslam.core.types.arrays import Floats
from lslam.core.types.state import Stateful
from lslam.registration.solver import RegistrationResult

# Squared Mahalanobis distance of six dimensions that two poses of one place exceed once in a thousand scans.
CHI2_LIMIT = 22.5
# Rest lasts longer than the time that the last motion took to show, by this factor.
REST_RATIO = 2


class RestDetector(Stateful):
    """Compares registered poses with that of the reference, where the sensor was last seen to move.

    A scan is near the reference where both poses differ by less than they err, and no point moves by more than its noise. A slow
    sensor is near, too, but leaves one reference after another. So it is at rest once it has stayed near for more than twice as
    many scans as it took to leave the reference before.

    sigma : m, noise of a point
    """

    STATE = ("_reference", "_stayed", "_last_stay")

    def __init__(self, sigma: float) -> None:
        self.sigma = sigma
        self._reference: Floats | None = None
        # Scans near the reference; scans that it took to leave the one before.
        self._stayed = self._last_stay = 0

    def judged(self, result: RegistrationResult) -> RegistrationResult:
        """The result, which says whether the sensor is at rest; a failed one says nothing."""
        if not result.ok:
            return result
        if self._is_near(result):
            self._stayed += 1
            return replace(result, is_stationary=self._stayed > REST_RATIO * self._last_stay)
        self._last_stay = 0 if self._reference is None else self._stayed + 1
        self._stayed, self._reference = 0, result.T_world_lidar.copy()
        return result

    def _is_near(self, result: RegistrationResult) -> bool:
        C, T, reference = result.covariance, result.T_world_lidar, self._reference
        if reference is None or C is None or not result.is_accepted:
            return False
        d = np.concatenate([T[:3, 3] - reference[:3, 3], so3.log(T[:3, :3] @ reference[:3, :3].T)])
        if d[:3] @ d[:3] + result.lever_arm**2 * (d[3:] @ d[3:]) > self.sigma**2:
            return False
        return float(d @ np.linalg.solve(2.0 * C, d)) < CHI2_LIMIT
