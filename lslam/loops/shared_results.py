"""What several threads need is made once, by the first that asks."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

T = TypeVar("T")


class SharedResults(Generic[T]):
    """Results of a function of a number, the last used ones kept; who asks for one that another thread makes waits for it.

    make : the function; kept : how many results, None for all

    >>> squares = SharedResults(lambda number: number**2, kept=1)
    >>> squares.get(3), squares.get(3), squares.get(4)
    (9, 9, 16)
    """

    def __init__(self, make: Callable[[int], T], kept: int | None = None) -> None:
        self._make, self._kept = make, kept
        self._made: OrderedDict[int, Future[T]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, number: int) -> T:
        """The result for `number`; raises what making it raised."""
        with self._lock:
            known = self._made.get(number)
            result = Future() if known is None else known
            self._made[number] = result
            self._made.move_to_end(number)
            if self._kept is not None and len(self._made) > self._kept:
                self._made.popitem(last=False)
        if known is None:
            try:
                result.set_result(self._make(number))
            except BaseException as error:
                result.set_exception(error)
        return result.result()
