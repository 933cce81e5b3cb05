"""A sequence whose points have the times that a clock gives them, or none."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np

from lslam.preprocessing.sweep_clock import SweepClock
from lslam.readers.selection import SequenceView
from lslam.types.scan import Scan
from lslam.types.sequence import Sequence

log = logging.getLogger("lslam")


class Clocked(SequenceView):
    """The sequence with the times of its points by `clock`, without any where that is None; all else is the sequence's own."""

    def __init__(self, whole: Sequence, clock: SweepClock | None, **own: Any) -> None:
        super().__init__(whole, **own)
        self.sweep_clock = clock

    def scan(self, index: int) -> Scan:
        """Read scan `index`; says so where its points break the rule. Raises InputError as the sequence does."""
        scan = self.whole.scan(index)
        if self.sweep_clock is None:
            return replace(scan, times=None)
        if not len(scan):
            return replace(scan, times=np.zeros(0, np.float32))
        times, why = self.sweep_clock.times_of(scan.points)
        if why:
            log.warning("scan %d: point times: %s", scan.index, why)
        return replace(scan, times=times)
