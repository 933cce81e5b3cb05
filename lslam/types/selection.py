"""Views of a sequence, and the one of the part that --start, --count and --skip-frames leave."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.types.scan import Scan
from lslam.types.sequence import Scans, Sequence


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
