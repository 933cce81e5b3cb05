"""How long is left of steps that are made several at once, from those that are done."""

from __future__ import annotations

import time
from collections.abc import Callable

from lslam.printable import lasting


class TimeLeft:
    """Told when a step ends; `at_once` are made together, and one begins when another ends.

    A step that is under way counts for what the mean of those done leaves of it. Steps are taken for done in the order they
    began: of two that change places the sum of their times is the same.
    """

    def __init__(self, total: int, at_once: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.at_once = max(1, min(at_once, total))
        self._total, self._clock = total, clock
        self._done = 0
        self._took = 0.0
        self._begun = [clock()] * self.at_once

    def step(self) -> None:
        """One is done, and the next begins, where there is one."""
        now = self._clock()
        self._done += 1
        if self._begun:
            self._took += now - self._begun.pop(0)
        if self._done + len(self._begun) < self._total:
            self._begun.append(now)

    @property
    def mean(self) -> float:
        """s that one takes; nan before the first is done."""
        return self._took / self._done if self._done else float("nan")

    @property
    def seconds(self) -> float:
        """s until all are done, when each of the others takes the mean; nan before the first is done.

        >>> now = [0.0]
        >>> left = TimeLeft(5, 2, lambda: now[0])
        >>> now[0] = 10.0
        >>> left.step(); left.step()
        >>> left.seconds  # two now, and then the fifth
        20.0
        """
        now, mean = self._clock(), self.mean
        rest = sorted(max(mean - (now - began), 0.0) for began in self._begun)
        if not rest:
            return 0.0
        rounds, last = divmod(self._total - self._done - len(rest), len(rest))
        return rest[last - 1] + (rounds + 1) * mean if last else rest[-1] + rounds * mean

    @property
    def pace(self) -> str:
        """For people: how long one takes, and how many are made at once."""
        return f"{self.mean:.1f} s each" + (f", {self.at_once} at once" if self.at_once > 1 else "")

    @property
    def text(self) -> str:
        """For people; empty before the first is done."""
        return f"about {lasting(self.seconds)} left" if self._done else ""
