"""Gating of loop candidates: by the uncertainty of odometry, by how often they are tried, and by what else a keyframe matches.

A bounded memory of places says which of those seen earlier are compared with a new one (Labbé and Michaud 2013).
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, insort
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from lslam.backend.kernels import gating
from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import so3
from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.core.types.trajectory import Keyframe

# Odometry is trusted to be wrong by at most so many standard deviations.
GATE_SIGMAS = 3.0


@dataclass(frozen=True)
class RelativeUncertainty:
    """Uncertainty relative to others: position (C, 3, 3), m2, world axes; turn (C,), rad, standard deviation."""

    position: Floats
    turn: Floats

    @property
    def reach(self) -> Floats:
        """(C,) m, standard deviation of the position where it is worst."""
        return np.asarray(np.sqrt(np.linalg.eigvalsh(self.position)[:, 2]))


class OdometryUncertainty:
    """Relative uncertainty of keyframe poses: odometry's covariances, and systematic drift that they do not model.

    Odometry's covariances accumulate independent errors, transported by the lever arm: with A = [[I, -hat(p_b - p_a)],
    [0, I]], the relative covariance of a and b is S_b - A S_a A^T. Errors of scale and bending are added as
    `drift_percent` of the distance travelled and `drift_deg` per 100 m of it, the latter by the rms distance from b to
    the keyframes since a.
    """

    def __init__(self, keyframes: Sequence[Keyframe], drift_percent: float, drift_deg: float) -> None:
        self.positions = np.array([k.T_world_lidar[:3, 3] for k in keyframes]).reshape(-1, 3)
        self.distances = np.array([k.distance for k in keyframes])
        known = all(k.covariance is not None for k in keyframes)
        self.covariances = np.array([k.covariance for k in keyframes]) if known and keyframes else None
        self._per_m = drift_percent / 100
        self._turn_per_m = np.deg2rad(drift_deg) / 100
        zero = np.zeros((1, 3))
        self._sum = np.concatenate([zero, np.cumsum(self.positions, axis=0)])
        self._squares = np.concatenate([[0.0], np.cumsum((self.positions**2).sum(axis=1))])

    def between(self, b: int, older: Longs) -> RelativeUncertainty:
        """Uncertainty of keyframe `b` relative to each of the keyframes `older`."""
        travelled = self.distances[b] - self.distances[older]
        turn = self._turn_per_m * travelled
        spread = (self._per_m * travelled) ** 2 + (turn * self._lever(b, older)) ** 2
        position = spread[:, None, None] * np.eye(3)
        square = turn**2
        if self.covariances is not None:
            A = np.tile(np.eye(6), (len(older), 1, 1))
            A[:, :3, 3:] = -so3.hat(self.positions[b] - self.positions[older])
            own = self.covariances[b] - A @ self.covariances[older] @ A.transpose(0, 2, 1)
            position = position + _positive(own[:, :3, :3])
            square = square + np.maximum(np.linalg.eigvalsh(own[:, 3:, 3:])[:, 2], 0.0)
        return RelativeUncertainty(position, np.sqrt(square))

    def gate(self, b: int, among: Longs, least: float, near: float, sigmas: float) -> Longs:
        """Older keyframes, of `among` (C,), that may show the place of keyframe `b`: at least `least` m of travel before it, and
        within `near` m or `sigmas` standard deviations of the position in its worst direction (`RelativeUncertainty.reach`).
        """
        covariances = np.zeros((0, 6, 6)) if self.covariances is None else self.covariances
        return np.asarray(
            gating.gate(
                b,
                among,
                self.positions,
                self.distances,
                covariances,
                self._sum,
                self._squares,
                (self._per_m, float(self._turn_per_m)),
                (float(least), float(near), float(sigmas)),
            )
        )

    def _lever(self, b: int, older: Longs) -> Floats:
        """(C,) m, rms distance of keyframe `b` from the keyframes since each of `older`."""
        count = b + 1 - older
        mean = (self._sum[b + 1] - self._sum[older]) / count[:, None]
        squares = (self._squares[b + 1] - self._squares[older]) / count
        p = self.positions[b]
        return np.asarray(np.sqrt(np.maximum(p @ p - 2 * mean @ p + squares, 0.0)))


def _positive(matrices: Floats) -> Floats:
    """Symmetric (C, 3, 3) without negative eigenvalues: the difference of two estimates may have some."""
    values, vectors = np.linalg.eigh(0.5 * (matrices + matrices.transpose(0, 2, 1)))
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1))


class LoopThrottle:
    """Distance between two attempts: `spacing` after a change of verdict, up to three times it while verdicts repeat.

    One more loop closure in a row of accepted ones adds little information, and so does one more rejection.
    """

    LONGEST = 3

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self.reset()

    def reset(self) -> None:
        """Make the next candidate due, whatever its distance: the last keyframe had none."""
        self._tried_at, self._row = -np.inf, 0
        self.last: Verdict | None = None

    @property
    def wait(self) -> float:
        """m between the last attempt and the next."""
        return self.spacing * min(self._row, self.LONGEST)

    def is_due(self, distance: float) -> bool:
        """Whether an attempt is due at `distance` m since the start."""
        return distance - self._tried_at >= self.wait

    def observe(self, distance: float, verdict: Verdict) -> None:
        """Count an attempt at `distance` m by its verdict."""
        self._row = self._row + 1 if verdict == self.last else 1
        self._tried_at, self.last = distance, verdict


def resolve_ambiguity(
    candidates: list[LoopCandidate], keyframes: Sequence[Keyframe], reach: Callable[[int, int], float]
) -> list[LoopCandidate]:
    """Candidates of one newer keyframe, the most similar first, with at most one loop closure accepted.

    reach : m, gate of odometry between an older and a newer keyframe

    All are rejected when two imply different poses of the keyframe, or when one of them was ambiguous by itself.
    """
    accepted = [c for c in candidates if c.is_accepted]
    ambiguous = next((c for c in candidates if c.stage == LoopStage.AMBIGUITY), None)
    if accepted and ambiguous is not None:
        return [_ambiguous(c, f"keyframe {ambiguous.a} looks as much alike, and is ambiguous") for c in candidates]
    if len(accepted) < 2:
        return candidates
    first = accepted[0]
    for other in accepted[1:]:
        gap = float(np.linalg.norm(_closure_position(other, keyframes) - _closure_position(first, keyframes)))
        if gap > reach(min(first.a, other.a), max(first.a, other.a)):
            reason = f"keyframes {first.a} and {other.a} fit, at places {gap:.1f} m apart"
            return [_ambiguous(c, reason) for c in candidates]
    reason = f"closed with keyframe {first.a} already"
    extra = {c.a for c in accepted[1:]}
    return [
        replace(c, verdict=Verdict.REJECTED, stage=LoopStage.THINNED, reason=reason) if c.a in extra else c
        for c in candidates
    ]


def _closure_position(candidate: LoopCandidate, keyframes: Sequence[Keyframe]) -> Floats:
    """(3,) m in the world, position of the newer keyframe by the loop closure and odometry's pose of the older one."""
    assert candidate.constraint is not None
    return np.asarray((keyframes[candidate.a].T_world_lidar @ candidate.constraint.T_a_b)[:3, 3])


def _ambiguous(candidate: LoopCandidate, reason: str) -> LoopCandidate:
    """The candidate, rejected as ambiguous unless it was rejected before."""
    if not candidate.is_accepted:
        return candidate
    return replace(candidate, verdict=Verdict.REJECTED, stage=LoopStage.AMBIGUITY, reason=reason)


T = TypeVar("T")


class SharedResults(Generic[T]):
    """Cache of a function of an integer for several threads; a thread that needs a result another is making waits for it.

    make : the function; size : how many results are kept, None for all

    >>> squares = SharedResults(lambda number: number**2, size=1)
    >>> squares.get(3), squares.get(3), squares.get(4)
    (9, 9, 16)
    """

    def __init__(self, make: Callable[[int], T], size: int | None = None) -> None:
        self._make, self._kept = make, size
        self._made: OrderedDict[int, Future[T]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, number: int) -> T:
        """The result for `number`; raises the exception that its computation raised."""
        with self._lock:
            future = self._made.get(number)
            result = Future() if future is None else future
            self._made[number] = result
            self._made.move_to_end(number)
            if self._kept is not None and len(self._made) > self._kept:
                self._made.popitem(last=False)
        if future is None:
            try:
                result.set_result(self._make(number))
            except BaseException as error:
                result.set_exception(error)
        return result.result()


# Places of one verified loop that are retrieved at each new place, as in the paper.
MOST_RETRIEVALS = 2
# Places on either side of a verified loop that it retrieves and protects from transfer.
LOOP_PLACES = 10


class WorkingMemory:
    """Places (runs of similar keyframes) to compare for loops; beyond a bound, the others are in long-term memory.

    A place enters when the run reaches it. Beyond the bound the place of least weight, of these the one that entered first, is
    transferred to long-term memory. Weight is the number of keyframes of a place (rehearsal); a verified loop gives the
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
        """Enter the place of `keyframe`, the next of the run; retrieve the last loop's neighbours, transfer the excess.

        Returns whether the keyframes that `before` returns changed.
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
        """Record a verified loop between keyframes `older` and `newer`: weights move to the newer place."""
        if self.bound is None:
            return
        self._loop, place = int(self._place_of[older]), int(self._place_of[newer])
        weight = self._weights[self._loop]
        self._weigh(place, self._weights[place] + weight)
        self._weigh(self._loop, 0)

    def before(self, keyframe: int) -> Longs:
        """Keyframes older than `keyframe`, ascending, that are compared with it.

        Keyframes after the newest entered place are included, so that `keyframe` may lie ahead of it.
        """
        if self.bound is None:
            return np.arange(keyframe)
        after = int(self._begins[self._newest + 1])
        parts = [np.arange(self._begins[p], self._begins[p + 1]) for p in self._members]
        searchable = np.concatenate([*parts, np.arange(after, keyframe)])
        return np.asarray(searchable[searchable < keyframe])

    def _enter(self, place: int) -> None:
        """Enter a place into the working memory, unless it is there."""
        at = bisect_left(self._members, place)
        if at == len(self._members) or self._members[at] != place:
            self._members.insert(at, place)
            self._entered[place] = self._newest
            insort(self._order, self._key(place))

    def _key(self, place: int) -> tuple[int, int, int]:
        """Sort key of a place for transfer: the least weight first, then the earliest entry."""
        return self._weights[place], self._entered[place], place

    def _weigh(self, place: int, weight: int) -> None:
        """Set the weight of `place` and keep the transfer order sorted."""
        at = bisect_left(self._order, self._key(place))
        is_member = at < len(self._order) and self._order[at] == self._key(place)
        if is_member:
            del self._order[at]
        self._weights[place] = weight
        if is_member:
            insort(self._order, self._key(place))

    def _retrieve(self, loop: int) -> None:
        """Enter a few places around place `loop`, the older one of a loop, the nearest along the way first."""
        entered = 0
        for step in range(1, LOOP_PLACES + 1):
            for place in (loop + step, loop - step):
                before = len(self._members)
                if entered < MOST_RETRIEVALS and 0 <= place < self._newest:
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
