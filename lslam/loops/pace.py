"""How often loop candidates are registered."""

from __future__ import annotations

import numpy as np

from lslam.types.constraint import Verdict


class Pace:
    """How far to travel from one try to the next: `spacing` where things change, up to three times it while they do not.

    A closure after a row of closures adds little, and so does a refusal after a row of refusals.
    """

    LONGEST = 3

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self.reset()

    def reset(self) -> None:
        """Try at once: there were no candidates."""
        self._tried_at, self._row = -np.inf, 0
        self._last: Verdict | None = None

    @property
    def wait(self) -> float:
        """m between the last try and the next."""
        return self.spacing * min(self._row, self.LONGEST)

    def is_due(self, distance: float) -> bool:
        """Whether to try after so many metres since the start."""
        return distance - self._tried_at >= self.wait

    def observe(self, distance: float, verdict: Verdict) -> None:
        """A try, and what came of it."""
        self._row = self._row + 1 if verdict == self._last else 1
        self._tried_at, self._last = distance, verdict
