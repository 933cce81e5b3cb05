"""Whether the clock of a recording's points goes on to fit: scans further on are asked, and decide again where it does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lslam.core.config.input import PreprocessConfig
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.odometry.frontend.clock_agreement import FEWEST_SCANS, ClockWindow, compare_clocks, read_window
from lslam.odometry.frontend.clock_choice import TURNS, ClockChoice
from lslam.registration.preprocessing.sweep_clock import SweepClock, is_same_motion

# Scans from one place that is asked to the next: ten times what is registered there.
_EVERY = 400
# Scans within which a change is found.
_NEARLY = 4


def later_choices(
    sequence: Sequence, clock: SweepClock, decide: Callable[[int], ClockChoice], preprocess: PreprocessConfig
) -> list[tuple[int, ClockChoice]]:
    """The scans from which on another clock than the one before was chosen, and the choices.

    clock : what the first scans chose; decide : the choice of the scans from this one on
    """
    later: list[tuple[int, ClockChoice]] = []
    rivals = _candidates(clock)
    now: SweepClock | None = clock
    fitting = 0
    for place in range(_EVERY, len(sequence) - FEWEST_SCANS + 1, _EVERY):
        window = _refuting(sequence, place, now, rivals, preprocess)
        if window is None:
            fitting = place
            continue
        first = place
        while first - fitting > _NEARLY:
            middle = (fitting + first) // 2
            if _refuting(sequence, middle, now, rivals, preprocess) is None:
                fitting = middle
            else:
                first = middle
        choice = decide(first)
        if not _is_same(choice.clock, now, window.scans[0]):
            later.append((first, choice))
            now = choice.clock
            rivals = rivals if now is None else _candidates(now)
        fitting = place
    return later


def _is_same(a: SweepClock | None, b: SweepClock | None, sample: Scan) -> bool:
    return a == b or (a is not None and b is not None and is_same_motion(a, b, sample.points))


def _candidates(clock: SweepClock) -> tuple[SweepClock | None, ...]:
    turned = (replace(clock, turn=(clock.turn + turn) % 1.0) for turn in TURNS)
    return None, clock, replace(clock, is_reversed=not clock.is_reversed), *turned


def _refuting(
    sequence: Sequence, first: int, clock: SweepClock | None, rivals: tuple[SweepClock | None, ...],
    preprocess: PreprocessConfig,
) -> ClockWindow | None:  # fmt: skip
    """The scans from `first` on where they agree beyond doubt better under a rival of the clock; else None."""
    window = read_window(sequence, first, preprocess)
    if window is None or not window.is_moving or window.is_astray(None) or window.is_astray(clock):
        return None
    others = [rival for rival in rivals if rival != clock]
    return window if any(compare_clocks([window], rival, clock).is_clear for rival in others) else None
