"""Data that stay read while a process makes one run after the other: opened sequences, and their scans within bounds."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import fields

import numpy as np

from lslam.readers.sequence_view import SequenceView
from lslam.types.scan import Scan
from lslam.types.sequence import Sequence

# Bytes of scans a process keeps at most, and its share of what was free when it began.
_MOST, _SHARE = 2 * 10**9, 0.2


class ScanStore:
    """Scans by key, those used least lately forgotten first; any thread may ask."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes, self.bytes = most_bytes, 0
        self._scans: OrderedDict[tuple[int, int], Scan] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[int, int], read: Callable[[], Scan]) -> Scan:
        """The scan of `key`, read now unless it is kept. Raises what `read` raises."""
        with self._lock:
            if key in self._scans:
                self._scans.move_to_end(key)
                return self._scans[key]
        scan = read()
        with self._lock:
            if key not in self._scans:  # another thread may have read it meanwhile
                self._scans[key] = scan
                self.bytes += size_of(scan)
            while self.bytes > self.most_bytes:
                self.bytes -= size_of(self._scans.popitem(last=False)[1])
        return scan


def size_of(scan: Scan) -> int:
    """Bytes of its arrays."""
    values = (getattr(scan, f.name) for f in fields(scan))
    return sum(value.nbytes for value in values if isinstance(value, np.ndarray))


class CachedSequence(SequenceView):
    """A whole sequence whose scans come from a store; `number` tells it from the others there."""

    def __init__(self, whole: Sequence, store: ScanStore, number: int) -> None:
        super().__init__(whole, notes=list(whole.notes), problems=list(whole.problems))
        self._store, self._number = store, number

    def scan(self, index: int) -> Scan:
        """Scan `index`, read at most once while it is kept. Raises InputError as the sequence's own."""
        return self._store.get((self._number, index), lambda: self.whole.scan(index))


class SequenceCache:
    """Opened sequences of a process by what they were opened with."""

    def __init__(self, store: ScanStore) -> None:
        self.store = store
        self._opened: dict[object, Sequence] = {}

    def get(self, key: object, opening: Callable[[], Sequence]) -> Sequence:
        """The sequence of `key`, opened now unless it was before; each run has notes and problems of its own."""
        if key not in self._opened:
            self._opened[key] = opening()
        whole = self._opened[key]
        number = list(self._opened).index(key)
        return CachedSequence(whole, self.store, number)


def memory_bound() -> int:
    """Bytes of scans that this process may keep."""
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return _MOST // 4
    return min(_MOST, int(_SHARE * free))
