"""Bounded memory of places: which of those seen earlier are compared with a new one (Labbé and Michaud 2013)."""

from __future__ import annotations

import math
from bisect import bisect_left, insort

import numpy as np

from lslam.core.types.arrays import Floats, Longs

# Places of one verified loop that are retrieved at each new place, as in the paper.
RETRIEVED = 2
# Places on either side of a verified loop that it retrieves and protects from transfer.
LOOP_PLACES = 10


class WorkingMemory:
    """Places are keyframes in a row that look alike; so many of them are compared, the others lie in long-term memory.

    A place enters when the run reaches it. Beyond the bound the place of least weight, of these the one that entered first, is
    transferred to long-term memory. Weight is how many keyframes a place stands for (rehearsal); a verified loop gives the
    weight of the older place to the newer one. It also retrieves the neighbours of the older place, the nearest first.

    place_of : (K,) place of each keyframe, from 0 in steps of 0 or 1
    distances : (K,) m travelled at each keyframe; bound : places compared at most; None: all
    recent_m : m; places on the way just travelled are not candidates yet and stay (short-term memory)
    """

    def __init__(self, place_of: Longs, distances: Floats, bound: int | None, recent_m: float) -> None:
        self.bound = bound
        self._place_of, self._distances, self._recent_m = place_of, distances, recent_m
        count = int(place_of[-1]) + 1 if len(place_of) else 0
        # Keyframes of place p: _begins[p] to _begins[p + 1].
        self._begins = np.searchsorted(place_of, np.arange(count + 1))
        self._weights = np.diff(self._begins).tolist()
        self._members: list[int] = []
        # Transfer order of the members: weight, which place was the newest when they entered, number.
        self._order: list[tuple[int, int, int]] = []
        self._entered = [0] * count
        self._newest = -1
        self._loop: int | None = None

    def __len__(self) -> int:
        return len(self._members)

    def reach(self, keyframe: int) -> bool:
        """Enter the place of `keyframe`, which comes next; retrieve neighbours of the last loop, transfer what is too much.

        Whether that changed what `before` says.
        """
        place = int(self._place_of[keyframe])
        if self.bound is None or place == self._newest:
            return False
        self._newest = place
        self._enter(place)
        if self._loop is not None:
            self._retrieve(self._loop)
        self._transfer(self.bound)
        return True

    def close(self, older: int, newer: int) -> None:
        """Take a verified loop between two keyframes."""
        if self.bound is None:
            return
        self._loop, place = int(self._place_of[older]), int(self._place_of[newer])
        weight = self._weights[self._loop]
        self._weigh(place, self._weights[place] + weight)
        self._weigh(self._loop, 0)

    def before(self, keyframe: int) -> Longs:
        """Keyframes older than `keyframe`, increasing, that are compared with it.

        Places behind the newest one that was entered count, so that the memory can be asked about keyframes to come.
        """
        if self.bound is None:
            return np.arange(keyframe)
        after = int(self._begins[self._newest + 1])
        parts = [np.arange(self._begins[p], self._begins[p + 1]) for p in self._members]
        searchable = np.concatenate([*parts, np.arange(after, keyframe)])
        return np.asarray(searchable[searchable < keyframe])

    def _enter(self, place: int) -> None:
        at = bisect_left(self._members, place)
        if at == len(self._members) or self._members[at] != place:
            self._members.insert(at, place)
            self._entered[place] = self._newest
            insort(self._order, self._key(place))

    def _key(self, place: int) -> tuple[int, int, int]:
        return self._weights[place], self._entered[place], place

    def _weigh(self, place: int, weight: int) -> None:
        at = bisect_left(self._order, self._key(place))
        is_member = at < len(self._order) and self._order[at] == self._key(place)
        if is_member:
            del self._order[at]
        self._weights[place] = weight
        if is_member:
            insort(self._order, self._key(place))

    def _retrieve(self, loop: int) -> None:
        """Enter a few neighbours of the loop's older place, the nearest along the way first."""
        entered = 0
        for step in range(1, LOOP_PLACES + 1):
            for place in (loop + step, loop - step):
                before = len(self._members)
                if entered < RETRIEVED and 0 <= place < self._newest:
                    self._enter(place)
                entered += len(self._members) - before

    def _transfer(self, bound: int) -> None:
        """Transfer the places of least weight beyond the bound, but not recent ones and those about the last loop."""
        recent = self._distances[self._begins[self._newest]] - self._recent_m
        about = (math.inf, -math.inf) if self._loop is None else (self._loop - LOOP_PLACES, self._loop + LOOP_PLACES)
        at = 0
        while len(self._members) > bound and at < len(self._order):
            place = self._order[at][-1]
            if about[0] <= place <= about[1] or self._distances[self._begins[place]] > recent:
                at += 1
                continue
            del self._order[at]
            del self._members[bisect_left(self._members, place)]
