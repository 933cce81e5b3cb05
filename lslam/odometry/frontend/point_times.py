"""Times for the points of a recording: its own field, what is stated, or a clock that the agreement of scans decides on.

Scans further on are asked whether that clock goes on to fit, and decide again where it does not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lslam.core.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError
from lslam.core.kernels import jit
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence, SequenceView, StatedTimes, select
from lslam.odometry import create_odometry
from lslam.odometry.frontend.clock_agreement import FEWEST_SCANS, ClockWindow, compare_clocks, read_window
from lslam.odometry.frontend.clock_choice import TURNS, ClockChoice, choose_clock
from lslam.registration.preprocessing.sweep_clock import (
    Proposal,
    SweepClock,
    azimuth_proposal,
    columns_clock,
    is_same_motion,
    order_clock,
    propose_clock,
)
from lslam.registration.preprocessing.views import ClockView, MergedLidars

log = logging.getLogger("lslam")

# Scans that propose a clock, spread over the recording.
_SAMPLES = 5


def with_point_times(sequence: Sequence, preprocess: PreprocessConfig, is_stated_only: bool = False) -> Sequence:
    """The sequence with point times where no field has them; the decision is among its notes.

    is_stated_only : no scan is registered, so no clock is estimated

    A sequence with times, one that is motion compensated and one whose points fit no clock are returned unchanged. The
    whole recording decides, whatever part of it is used. Raises InputError when the stated times do not fit the scans.
    """
    stated = getattr(sequence, "stated_times", StatedTimes())
    if getattr(sequence, "further_lidars", ()):
        # The order and the azimuths of points of several LiDARs tell nothing; their reader said which have no times.
        if stated.kind not in (None, "field"):
            raise InputError(f"{sequence.path}: point_times = {stated.kind!r} is of one LiDAR, and several are merged")
        return sequence
    is_merged = isinstance(
        sequence, MergedLidars
    )  # their points follow one another: no order, and no azimuth of one sensor
    if stated.kind is None and (sequence.motion_compensated or is_stated_only or is_merged):
        return sequence
    if stated.kind == "none":
        return _with(sequence, ClockChoice(None, "stated", "point times: none, as stated"))
    scans = _samples(sequence)
    if not scans:
        return sequence  # nothing can be read, which is said in its turn
    # A message without times, as the first may be, is read by itself.
    has_times = 2 * sum(scan.times is not None for scan in scans) > len(scans)
    if stated.kind == "field" and not has_times:
        raise InputError(f"{sequence.path}: point_times = 'field', and the points have no time field that can be read")
    if stated.kind == "field" or (stated.kind is None and has_times):
        return sequence
    nominal = SweepClock("order", 1 / sequence.rate_hz, stated.reference == "end")
    if stated.kind is not None:
        return _with(sequence, _stated_clock(sequence, scans, stated.kind, nominal, preprocess))
    if len(sequence) < FEWEST_SCANS:
        return sequence
    choice = _by_agreement(sequence, scans, nominal, preprocess)
    return sequence if choice is None else _with(sequence, choice)


def _by_agreement(
    sequence: Sequence, scans: list[Scan], nominal: SweepClock, preprocess: PreprocessConfig
) -> ClockChoice | None:
    """Clock that the order of points proposes and the agreement of scans confirms, also for later parts; else None."""
    rows = getattr(sequence, "rows", None)

    def decide(first: int) -> ClockChoice:
        part = select(sequence, first)
        samples = _samples(part) if first else scans
        proposal = propose_clock(samples, nominal, rows)
        if proposal is None:
            return ClockChoice(None, "unknown", "point times: none, the sensor makes no full turns")
        return _decide(part, proposal, samples[0], preprocess)

    choice = decide(0)
    if choice.clock is None:
        return None if choice.verdict == "unknown" else choice
    return replace(choice, later=tuple(later_choices(sequence, choice.clock, decide, preprocess)))


def _decide(sequence: Sequence, proposal: Proposal, sample: Scan, preprocess: PreprocessConfig) -> ClockChoice:
    """Compile the kernels, and choose the clock by `choose_clock`."""
    with jit.announce_compiling(log):
        create_odometry(Config()).warm_up()
        return choose_clock(sequence, proposal, sample, preprocess)


def _with(sequence: Sequence, choice: ClockChoice) -> Sequence:
    """The sequence with the times of the chosen clock; the choice is its `clock_choice`, for the manifest."""
    again = [f"from scan {first} on the clock no longer fits: {later.sentence}" for first, later in choice.later]
    notes = [*sequence.notes, choice.sentence, *again]
    if choice.verdict == "compensated" and sequence.motion_compensated is None:
        return SequenceView(sequence, notes=notes, clock_choice=choice, motion_compensated=True)
    if choice.clock is None and choice.verdict != "stated":
        return SequenceView(sequence, notes=notes, clock_choice=choice)
    clocks = [(first, later.clock) for first, later in choice.later]
    return ClockView(sequence, choice.clock, clocks, notes=notes, clock_choice=choice)


def _stated_clock(
    sequence: Sequence, scans: list[Scan], kind: str, nominal: SweepClock, preprocess: PreprocessConfig
) -> ClockChoice:
    """The clock of the `kind` that `input.point_times` states. Raises InputError where the scans lack the fields it needs."""
    clock: SweepClock | None
    if kind == "columns":
        clock = columns_clock(scans, nominal, getattr(sequence, "rows", None))
        if clock is None:
            raise InputError(
                f"{sequence.path}: point_times = 'columns', and the clouds are not organised in rows of equal length: state "
                "rows and cols, or point_times = 'order' or 'azimuth'"
            )
    elif kind == "order":
        clock = order_clock(scans, nominal) or nominal
    else:
        proposal = azimuth_proposal(scans, nominal)
        clock = proposal.clock
        if proposal.is_guess:
            choice = _decide(sequence, proposal, scans[0], preprocess)
            if choice.clock is None:
                raise InputError(
                    f"{sequence.path}: point_times = 'azimuth', and neither the order of the points nor the agreement of "
                    f"scans tells in which sense the sensor turns and where it begins ({choice.sentence})"
                )
            return choice
    return ClockChoice(clock, "stated", f"point times: by {clock}, as stated")


def _samples(sequence: Sequence) -> list[Scan]:
    """A few readable scans with points, from the first on; only the first if it has times."""
    scans: list[Scan] = []
    last = len(sequence) - 1
    for index in sorted({*range(min(10, last + 1)), *np.linspace(0, last, _SAMPLES).astype(int).tolist()}):
        if len(scans) > 1 and index < 10:
            continue
        try:
            scan = sequence.scan(index)
        except InputError:
            continue
        if len(scan):
            scans.append(scan)
        if scans and scans[0].times is not None:
            break
    return scans


# Scans from one place that is asked to the next: ten times what is registered there.
_EVERY = 400
# Scans within which a change is found.
_NEARLY = 4


def later_choices(
    sequence: Sequence, clock: SweepClock, decide: Callable[[int], ClockChoice], preprocess: PreprocessConfig
) -> list[tuple[int, ClockChoice]]:
    """Scans from which on another clock than before was chosen, each with its choice.

    clock : of the first scans; decide : returns the choice for the scans from a number on
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
    """Whether two clocks deskew the points of `sample` alike."""
    return a == b or (a is not None and b is not None and is_same_motion(a, b, sample.points))


def _candidates(clock: SweepClock) -> tuple[SweepClock | None, ...]:
    """No clock, the clock, its reverse, and the clock begun parts of a turn later."""
    turned = (replace(clock, turn=(clock.turn + turn) % 1.0) for turn in TURNS)
    return None, clock, replace(clock, is_reversed=not clock.is_reversed), *turned


def _refuting(
    sequence: Sequence,
    first: int,
    clock: SweepClock | None,
    rivals: tuple[SweepClock | None, ...],
    preprocess: PreprocessConfig,
) -> ClockWindow | None:
    """The scans from `first` on where they agree beyond doubt better under a rival of the clock; else None."""
    window = read_window(sequence, first, preprocess)
    if window is None or not window.is_moving or window.is_astray(None) or window.is_astray(clock):
        return None
    others = [rival for rival in rivals if rival != clock]
    return window if any(compare_clocks([window], rival, clock).is_clear for rival in others) else None
