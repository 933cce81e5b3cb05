"""Views of a sequence: the part that --start, --count and --skip-frames leave, with rings, or with times of the points."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, UsageError
from lslam.preprocessing.rings import RingRule, decide_rings
from lslam.preprocessing.sweep_clock import SweepClock
from lslam.types.scan import NO_RING, Scan
from lslam.types.sequence import Scans, Sequence

log = logging.getLogger("lslam")
# Scans the rule is decided on: the first that can be read.
_LOOKED_AT = 5


class SequenceView(Scans):
    """Delegates to `whole` whatever `own` does not replace; a subclass says which scans there are and what they hold."""

    def __init__(self, whole: Sequence, **own: Any) -> None:
        self.whole = whole
        vars(self).update(own)

    def __getattr__(self, name: str) -> Any:
        if name == "whole":  # a copy that is not filled in yet
            raise AttributeError(name)
        return getattr(self.whole, name)

    def __len__(self) -> int:
        return len(self.whole)

    def scan(self, index: int) -> Scan:
        """Scan `index` of the whole. Raises InputError as it does."""
        return self.whole.scan(index)

    def ringed(self, wanted: str) -> Sequence:
        """This view with rings, see `with_rings`."""
        return _ringed(self, wanted)


class Selection(SequenceView):
    """Every `step`-th scan of a sequence; scans keep their index of the recording, all else is the sequence's own."""

    def __init__(self, whole: Sequence, indices: NDArray[np.int64]) -> None:
        super().__init__(whole, stamps_ns=whole.stamps_ns[indices])
        self.indices = indices

    def __len__(self) -> int:
        return len(self.indices)

    def scan(self, index: int) -> Scan:
        """Read the `index`-th scan of the selection; its own `index` counts in the whole recording."""
        if not 0 <= index < len(self.indices):
            raise IndexError(f"scan {index} of {len(self.indices)}")
        return self.whole.scan(int(self.indices[index]))


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


def select(sequence: Sequence, start: int = 0, count: int | None = None, skip_frames: int = 1) -> Sequence:
    """Scans `start`, `start + skip_frames`, ..., at most `count` of them; the sequence itself when that is all.

    `rate_hz` stays the recording's. Raises UsageError when nothing is left or a number is out of range.
    """
    if start < 0 or skip_frames < 1 or (count is not None and count < 1):
        raise UsageError(
            f"--start {start} --count {count} --skip-frames {skip_frames}: start from 0, the others from 1"
        )
    if start >= len(sequence):
        raise UsageError(f"--start {start} is beyond the last scan of {sequence.name}, which has {len(sequence)} scans")
    indices = np.arange(start, len(sequence), skip_frames, dtype=np.int64)[:count]
    if len(indices) == len(sequence):
        return sequence
    return Selection(sequence, indices)


class Ringed(SequenceView):
    """A sequence with the rings of its scans filled in; all else is the sequence's own."""

    def __init__(self, whole: Sequence, rule: RingRule) -> None:
        super().__init__(whole, notes=[*whole.notes, str(rule)])
        self.rule = rule

    def scan(self, index: int) -> Scan:
        """Read scan `index` and find its rings, by itself where it does not obey the rule; points that have none are left out.

        Raises InputError when either fails.
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
                raise error from None
            rings = rule.rings_of(scan)
            why = f"{error}: {rule}"
            scan = replace(scan, fault="; ".join(filter(None, (scan.fault, why))))
        scan = replace(scan, rings=rings)
        has_ring = rings != NO_RING
        return scan if has_ring.all() else scan.select(has_ring)


def with_rings(sequence: Sequence, wanted: str = "auto") -> Sequence:
    """`sequence` with rings in every scan, found as `input.rings` says; the rule is among its notes.

    The first scans of the recording decide, whatever part of it is used, so that a run that is resumed decides alike.
    Raises InputError naming --rings when there are no rings to be found.
    """
    return sequence.ringed(wanted) if isinstance(sequence, SequenceView) else _ringed(sequence, wanted)


def _ringed(sequence: Sequence, wanted: str) -> Sequence:
    scans = _first_scans(sequence)
    if not scans:
        return sequence  # nothing can be read, which is said in its turn
    rows = getattr(sequence, "rows", None)
    try:
        if rows and wanted == "auto":
            rule = RingRule("rows", rows)  # as the reader filled them in
        else:
            rule = decide_rings(scans, wanted, rows or getattr(sequence, "rings", None))
    except InputError as error:
        raise InputError(f"{sequence.path}: {error}") from None
    return Ringed(sequence, rule)


def _first_scans(sequence: Sequence) -> list[Scan]:
    scans: list[Scan] = []
    for index in range(len(sequence)):
        try:
            scan = sequence.scan(index)
        except InputError:
            continue
        if len(scan):
            scans.append(scan)
        if len(scans) == _LOOKED_AT:
            break
    return scans
