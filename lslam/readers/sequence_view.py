"""A sequence seen otherwise: what the view does not set is the sequence's own."""

from __future__ import annotations

from typing import Any

from lslam.types.scan import Scan
from lslam.types.sequence import Sequence


class SequenceView:
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
