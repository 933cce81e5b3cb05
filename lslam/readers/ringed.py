"""A sequence whose scans all have rings, for the methods that walk along them."""

from __future__ import annotations

from dataclasses import replace

from lslam.errors import InputError
from lslam.preprocessing.rings import RingRule, decide_rings
from lslam.readers.sequence_view import SequenceView
from lslam.types.scan import Scan
from lslam.types.sequence import Sequence

# Scans the rule is decided on: the first that can be read.
_LOOKED_AT = 3


class Ringed(SequenceView):
    """A sequence with the rings of its scans filled in; all else is the sequence's own."""

    def __init__(self, whole: Sequence, rule: RingRule) -> None:
        super().__init__(whole, notes=[*whole.notes, str(rule)])
        self.rule = rule

    def scan(self, index: int) -> Scan:
        """Read scan `index` and find its rings. Raises InputError when either fails."""
        scan = self.whole.scan(index)
        return replace(scan, rings=self.rule.rings_of(scan)) if len(scan) else scan


def with_rings(sequence: Sequence, wanted: str = "auto") -> Sequence:
    """`sequence` with rings in every scan, found as `input.rings` says; the rule is among its notes.

    The first scans of the recording decide, whatever part of it is used, so that a run that is resumed decides alike.
    Raises InputError naming --rings when there are no rings to be found.
    """
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
