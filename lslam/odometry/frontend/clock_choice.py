"""Which clock the points of a turning sensor have where no field says when they were measured.

The order of the points and their azimuths propose clocks; the agreement of scans decides. A clock is taken only where it is
better beyond doubt than no times at all, than its reverse and than sweeps that begin elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from lslam.core.config.input import PreprocessConfig
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.odometry.frontend.clock_agreement import SCANS, ClockWindow, compare_clocks, mean_score, read_window
from lslam.registration.preprocessing.sweep_clock import Proposal, SweepClock, is_same_motion

Verdict = Literal["stated", "clear", "compensated", "unclear", "standing", "unknown"]

# Windows of moving scans that may be asked, and places along the recording where they are looked for.
_MOST_WINDOWS, _PLACES = 3, 9
# Turns of the sweep's beginning that are tried, and the finer ones about the best.
TURNS, _FINER = (0.25, 0.5, 0.75), (0.125, 0.0625)
# Turns nearer than this are the same clock, nearly.
_NEAR = 0.2
# A sweep of half the length must not fit better than by so many standard deviations.
_HALF_T = 2.0
# Student's t of a clock against its reverse that leaves no doubt that scans are distorted, and in which sense.
_FORWARD_T = 5.0


@dataclass(frozen=True)
class ClockChoice:
    """The clock of a recording's points, None for no times, and how it was decided.

    scores : mean distance of the held-out points from the surfaces of other scans, 0 to 1, by clock
    later : scans from which on it no longer fits, and their own choices
    """

    clock: SweepClock | None
    verdict: Verdict
    sentence: str
    scores: dict[str, float] = field(default_factory=dict)
    later: tuple[tuple[int, ClockChoice], ...] = ()

    def facts(self) -> dict[str, Any]:
        """Clock, verdict, scores and later choices as plain values, for the manifest."""
        later = [{"scan": first, **choice.facts()} for first, choice in self.later]
        return {
            "clock": None if self.clock is None else self.clock.facts(),
            "verdict": self.verdict,
            "scores": {name: round(value, 5) for name, value in self.scores.items()},
            **({"later": later} if later else {}),
        }


def choose_clock(sequence: Sequence, proposal: Proposal, sample: Scan, preprocess: PreprocessConfig) -> ClockChoice:
    """Choose the clock of a recording without per-point times, by the first of its scans in which the sensor moves.

    sample : any scan of the recording
    """
    windows: list[ClockWindow] = []
    choice, is_moving = None, False
    for window in _moving(sequence, preprocess):
        is_moving = True
        if window.is_astray(None) or (not proposal.is_guess and window.is_astray(proposal.clock)):
            continue
        windows.append(window)
        choice = _judge(windows, proposal, sample)
        if choice.verdict in ("clear", "compensated") or len(windows) == _MOST_WINDOWS:
            return choice
    if choice is not None:
        return choice
    if is_moving:
        return ClockChoice(None, "unclear", "point times: the motion of the scans is not clear enough to tell a clock")
    return ClockChoice(
        None, "standing", f"point times: {proposal.clock} may tell them; the sensor does not move enough to decide"
    )


def _moving(sequence: Sequence, preprocess: PreprocessConfig) -> Iterator[ClockWindow]:
    """Windows in which the sensor moves, at the begin and then at even intervals, in order of time."""
    last = max(len(sequence) - SCANS, 0)
    places = [0, SCANS, *np.linspace(0, last, _PLACES).round().astype(int).tolist()]
    end = 0
    for first in sorted(places):
        if not end <= first <= last:
            continue
        end = first + SCANS
        window = read_window(sequence, first, preprocess)
        if window is not None and window.is_moving:
            yield window


def _judge(windows: list[ClockWindow], proposal: Proposal, sample: Scan) -> ClockChoice:
    """Choose the clock, or no times, under which the scans of the windows agree best; none is chosen if that is unclear."""
    forward = proposal.clock
    backward = replace(forward, is_reversed=True)
    candidates: list[SweepClock | None] = [None, forward, backward]
    best = _best(windows, candidates)
    if proposal.is_guess or best is None:
        candidates += [replace(clock, turn=turn) for clock in (forward, backward) for turn in TURNS]
    else:
        candidates += [replace(best, turn=turn) for turn in TURNS]
    best = _best(windows, candidates)
    if best is not None and (best.turn or proposal.is_guess):
        for step in _FINER:
            near = [replace(best, turn=(best.turn + sign * step) % 1.0) for sign in (-1, 1)]
            candidates += near
            best = min((best, *near), key=lambda clock: mean_score(windows, clock))
    return _verdict(windows, candidates, best, sample, proposal.is_guess)


def _best(windows: list[ClockWindow], clocks: list[SweepClock | None]) -> SweepClock | None:
    """The clock of the lowest mean score."""
    return min(clocks, key=lambda clock: mean_score(windows, clock))


def _verdict(
    windows: list[ClockWindow],
    candidates: list[SweepClock | None],
    best: SweepClock | None,
    sample: Scan,
    is_guess: bool,
) -> ClockChoice:
    """The choice for the clock of best score: clear, unclear, or motion compensated; is_guess : the proposal is a mere guess."""
    scores = {_name(clock): mean_score(windows, clock) for clock in candidates}
    rivals = [clock for clock in candidates if clock is not best and not _is_alike(best, clock, sample)]
    results = {_name(clock): compare_clocks(windows, best, clock) for clock in rivals}
    closest = min(results, key=lambda name: results[name].t)
    count = sum(len(window.scores(None)) for window in windows)
    margin = f"t = {results[closest].t:.1f} against {closest}, {count} scans"
    # Under the reverse of a clock compensated scans agree as well as under the clock itself. Where it is worse beyond doubt they
    # are not, and for the rest it is enough that the order of the points speaks for the clock too.
    if best is not None and best == candidates[1] and not is_guess and _is_forward(windows, best, candidates[2]):
        is_clear = all(result.is_likely for result in results.values())
    else:
        is_clear = all(result.is_clear for result in results.values())
    # Under a wrong clock the motion may be lost. But what is proposed must have been judged before another, or none, is taken.
    needed = candidates if is_guess else candidates[:3] if best != candidates[1] else candidates[:2]
    is_clear &= not any(window.is_astray(clock) for window in windows for clock in needed)
    # The order tells better where a sweep begins than scans that agree a little better with another place near by.
    is_clear &= is_guess or best is None or not 0 < min(best.turn, 1 - best.turn) < _NEAR
    moving = best or next(clock for clock in candidates if clock is not None)
    half = replace(moving, seconds=0.5 * moving.seconds)
    if is_clear and compare_clocks(windows, half, best).t > _HALF_T:
        is_clear, margin = False, "a sweep of half the time between scans fits better"
    if not is_clear:
        return ClockChoice(
            None,
            "unclear",
            f"point times: not clear whether {_name(best or candidates[1])} tells them ({margin}): left without, point_times "
            "states them",
            scores,
        )
    if best is None:
        return ClockChoice(
            None,
            "compensated",
            f"point times: none fits, the scans agree best as they are, as motion compensated ones do ({margin})",
            scores,
        )
    return ClockChoice(best, "clear", f"point times: by {best}; clear by the agreement of scans ({margin})", scores)


def _is_forward(windows: list[ClockWindow], best: SweepClock, reverse: SweepClock | None) -> bool:
    """Whether the clock is far better than its reverse, and both were judged."""
    if any(window.is_astray(reverse) for window in windows):
        return False
    result = compare_clocks(windows, best, reverse)
    return result.is_clear and result.t >= _FORWARD_T


def _is_alike(best: SweepClock | None, other: SweepClock | None, sample: Scan) -> bool:
    """Whether two clocks are nearly equal, or deskew the points of `sample` alike, so that they cannot be distinguished."""
    if best is None or other is None:
        return best is other
    apart = abs((best.turn - other.turn + 0.5) % 1.0 - 0.5)
    if best.is_reversed == other.is_reversed and apart < _NEAR:
        return True
    return is_same_motion(best, other, sample.points)


def _name(clock: SweepClock | None) -> str:
    """Description of a clock, for the manifest."""
    if clock is None:
        return "no times"
    turn = f", begun {clock.turn:g} of a turn later" if clock.turn else ""
    return f"{clock.kind}{' reversed' if clock.is_reversed else ''}{turn}"
