"""Throttling of loop detection: how often loop candidates are registered."""

from __future__ import annotations

import numpy as np

from lslam.types.constraint import Verdict


class LoopThrottle:
    """Distance between two attempts: `spacing` after a change of verdict, up to three times it while verdicts repeat.

    One more loop closure in a row of accepted ones adds little information, and so does one more rejection.
    """

    LONGEST = 3

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self.reset()

    def reset(self) -> None:
        """Attempt at the next candidate: there were none."""
        self._tried_at, self._row = -np.inf, 0
        self.last: Verdict | None = None

    @property
    def wait(self) -> float:
        """m between the last attempt and the next."""
        return self.spacing * min(self._row, self.LONGEST)

    def is_due(self, distance: float) -> bool:
        """Whether an attempt is due at `distance` m since the start."""
        return distance - self._tried_at >= self.wait

    def observe(self, distance: float, verdict: Verdict) -> None:
        """Take the verdict of an attempt at `distance` m."""
        self._row = self._row + 1 if verdict == self.last else 1
        self._tried_at, self.last = distance, verdict
