"""A sequence with the rings, or with the times, of its points filled in by a rule."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from lslam.core.errors import InputError
from lslam.core.labels import table_of
from lslam.core.types.scan import NO_RING, Scan
from lslam.core.types.sequence import Sequence, SequenceView, readable
from lslam.registration.preprocessing.rings import RingRule, decide_rings
from lslam.registration.preprocessing.sweep_clock import SweepClock

log = logging.getLogger("lslam")
# Scans the rule is decided on: the first that can be read.
_LOOKED_AT = 5


class Clocked(SequenceView):
    """The sequence with the times of its points by `clock`, without any where that is None; all else is the sequence's own.

    later : scans from which on another clock tells them
    """

    def __init__(
        self, whole: Sequence, clock: SweepClock | None, later: Iterable[tuple[int, SweepClock | None]] = (), **own: Any
    ) -> None:
        super().__init__(whole, **own)
        self.sweep_clock = clock
        self._clocks = [(0, clock), *later]

    def scan(self, index: int) -> Scan:
        """Read scan `index`; says so where its points break the rule. Raises InputError as the sequence does."""
        scan = self.whole.scan(index)
        clock = next(clock for first, clock in reversed(self._clocks) if first <= index)
        if clock is None:
            return replace(scan, times=None)
        if not len(scan):
            return replace(scan, times=np.zeros(0, np.float32))
        times, why = clock.times_of(scan.points)
        if why:
            log.warning("scan %d: point times: %s", scan.index, why)
        return replace(scan, times=times)


class Ringed(SequenceView):
    """A sequence with the rings of its scans filled in; all else is the sequence's own.

    is_required : points without a ring are left out, and scans without rings are an error
    """

    def __init__(self, whole: Sequence, rule: RingRule, is_required: bool = True) -> None:
        super().__init__(whole, notes=[*whole.notes, str(rule)])
        self.rule, self._is_required = rule, is_required

    def scan(self, index: int) -> Scan:
        """Read scan `index` and find its rings, by itself where it does not obey the rule.

        Raises InputError when it cannot be read, or when rings are required and cannot be found.
        """
        scan = self.whole.scan(index)
        if not len(scan):
            return scan
        try:
            rings = self.rule.rings_of(scan)
        except InputError as error:
            try:
                rule = decide_rings([scan])
            except InputError:
                if self._is_required:
                    raise error from None
                log.warning("scan %d: its points get no ring: %s", scan.index, error)
                return scan
            rings = rule.rings_of(scan)
            why = f"{error}: {rule}"
            scan = replace(scan, fault="; ".join(filter(None, (scan.fault, why))))
        scan = replace(scan, rings=rings)
        has_ring = rings != NO_RING
        return scan if has_ring.all() or not self._is_required else scan.select(has_ring)


class WithoutClasses(SequenceView):
    """A sequence whose scans lack the points of some classes; all else is the sequence's own."""

    def __init__(self, whole: Sequence, classes: Iterable[str]) -> None:
        names = tuple(classes)
        super().__init__(whole, notes=[*whole.notes, f"points of {', '.join(names)} are left out"])
        self._is_dropped = table_of(names)

    def scan(self, index: int) -> Scan:
        """Read scan `index` and leave points out; one without labels stays whole and says so. Raises InputError as before."""
        scan = self.whole.scan(index)
        if scan.labels is None:
            why = "its points have no labels and none is left out"
            return replace(scan, fault="; ".join(filter(None, (scan.fault, why)))) if len(scan) else scan
        dropped = self._is_dropped[scan.labels]
        return scan.select(~dropped) if dropped.any() else scan


def with_rings(sequence: Sequence, wanted: str = "auto", is_required: bool = True) -> Sequence:
    """`sequence` with rings in every scan, found as `input.rings` says; the rule is among its notes.

    is_required : as of `Ringed`

    The first scans of the recording decide, whatever part of it is used, so that a run that is resumed decides alike.
    Raises InputError naming --rings when there are no rings to be found.
    """
    # Several LiDARs do it each by itself.
    ring: Callable[[Sequence, str, bool], Sequence] = getattr(type(sequence), "ringed", _ringed)
    return ring(sequence, wanted, is_required)


def _ringed(sequence: Sequence, choice: str, is_required: bool) -> Sequence:
    scans = [scan for _, scan in islice(readable(range(len(sequence)), sequence.scan), _LOOKED_AT)]
    if not scans:
        return sequence  # nothing can be read, which is said in its turn
    rows = getattr(sequence, "rows", None)
    try:
        if rows and choice == "auto":
            rule = RingRule("rows", rows)  # as the reader filled them in
        else:
            rule = decide_rings(scans, choice, rows or getattr(sequence, "rings", None))
    except InputError as error:
        raise InputError(f"{sequence.path}: {error}") from None
    return Ringed(sequence, rule, is_required)
