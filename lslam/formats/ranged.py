"""An object of storage read by ranges: small reads come out of blocks that are kept, and what is expected is fetched together.

A request takes tens of milliseconds, whatever it asks for; a bag is walked over in thousands of small steps.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Iterable

from lslam.remote import RemotePath

BLOCK = 1 << 15
# Blocks asked for together, and blocks kept: 2 and 8 MB.
_AHEAD, _KEPT = 64, 256


class RangedFile:
    """Bytes of an object, from any thread; `size` of them."""

    def __init__(self, path: RemotePath) -> None:
        self.path, self.size = path, path.stat().st_size
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._expected: list[int] = []
        self._lock = threading.Lock()

    def expect(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Say which (position, size) will be read next, in any order; what was expected before is forgotten.

        Nothing is expected twice: what is read again later is asked for by itself.
        """
        last = max(self.size - 1, 0) // BLOCK
        numbers = {
            k
            for position, size in ranges
            if size > 0
            for k in range(max(position, 0) // BLOCK, min((position + size - 1) // BLOCK, last) + 1)
        }
        with self._lock:
            self._expected = sorted(numbers)

    def read(self, position: int, size: int) -> bytes:
        """`size` bytes from `position`, fewer where the object ends."""
        size = min(size, self.size - position)
        if size <= 0:
            return b""
        first, last = position // BLOCK, (position + size - 1) // BLOCK
        with self._lock:
            if size >= BLOCK and not self._is_expected(first):
                return self.path.read_ranges([(position, position + size)])[0]
            data = b"".join(self._block(k, last) for k in range(first, last + 1))
        return data[position - first * BLOCK :][:size]

    def _is_expected(self, number: int) -> bool:
        at = bisect_left(self._expected, number)
        return number in self._blocks or (at < len(self._expected) and self._expected[at] == number)

    def _block(self, number: int, last: int) -> bytes:
        """A block; where it has to be fetched, those up to `last` and those expected next are fetched with it."""
        if number not in self._blocks:
            at = bisect_left(self._expected, number)
            next_ones = self._expected[at : at + _AHEAD] if self._is_expected(number) else []
            wanted = [k for k in sorted({*range(number, last + 1), *next_ones}) if k not in self._blocks]
            del self._expected[at : at + len(next_ones)]
            runs = _runs(wanted)
            while len(self._blocks) > max(_KEPT - len(wanted), 0):
                self._blocks.popitem(last=False)
            found = self.path.read_ranges([(a * BLOCK, min(b * BLOCK, self.size)) for a, b in runs])
            for (begin, end), data in zip(runs, found, strict=True):
                for k in range(begin, end):
                    self._blocks[k] = data[(k - begin) * BLOCK : (k - begin + 1) * BLOCK]
        self._blocks.move_to_end(number)
        return self._blocks[number]


def _runs(numbers: list[int]) -> list[tuple[int, int]]:
    """Neighbours as one: [begin, end) of each run of numbers in order.

    >>> _runs([1, 2, 3, 7])
    [(1, 4), (7, 8)]
    """
    runs: list[tuple[int, int]] = []
    for number in numbers:
        if runs and runs[-1][1] == number:
            runs[-1] = (runs[-1][0], number + 1)
        else:
            runs.append((number, number + 1))
    return runs
