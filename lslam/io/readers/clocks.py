"""Comparison of the clocks of a stream of messages: an impossible clock is corrected by the others, and reported.

Header stamps are the finest clock, and the one that fails. They step when the sensor learns the time, stand still when a
driver repeats its own start, or alternate between two clocks. Times of recording are late, never early, and always advance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Longs, Stamps
from lslam.io.readers.ground_truth import Voice

# Median intervals of two clocks that both tell the time of the drive; beyond, one was played back at another speed.
_SLOWEST, _FASTEST = 0.8, 1.25
_WINDOWS = (1, 2, 6, 14, 50)  # intervals; where they are even in number, two clocks in turns cancel
_LEVEL_SAMPLES = 100  # the one of them that was recorded with the least delay says how far apart two clocks are
_SPREAD_SAMPLES = 8  # and four times as many
_REGULAR = 0.02  # of the interval, the median deviation of a clock that ticks
_SNAP = 0.3  # of the interval, how far an interval across a step may lie from whole ones
_MIN_SHARE = 0.05  # of all samples on a clock that may be the one the others are brought onto
MESSAGES_PER_STAMP = 5  # fewer are parts of one scan
_JUMP_INTERVALS = 10  # by which the times of recording jump before a sentence says so
_OFFSETS = 100  # of different clocks that are tried
_LATER_NS = 10**9  # by which some messages are recorded later than others; ten times that where their stamps share time
_JITTER = 0.03  # of the interval, by which stamps of arrival vary and those of a sensor do not
_MANY, _UNEVEN = 0.3, 0.25  # share of all messages; of the interval


@dataclass(frozen=True)
class Clock:
    """Readings of one clock for all messages, (N,) ns, and its name in the plural."""

    name: str
    stamps_ns: Stamps


def stands_still(stamps: Stamps, witness: Stamps) -> bool:
    """Whether a clock nearly always repeats the reading before, while the witness advances."""
    if not len(stamps) or np.any(np.diff(witness) < 0) or len(np.unique(witness)) < len(witness) / 2:
        return False
    if len(stamps) == 1:
        return not stamps.any() and bool(witness.any())
    return len(np.unique(stamps)) <= max(1, len(stamps) / MESSAGES_PER_STAMP)


def agree(headers: Stamps, late_ns: Stamps, witness: Clock, what: str, voice: Voice) -> Stamps:
    """Stamps `headers` (N,) with their clock's steps removed by comparison with the witness (N,), both in order of recording.

    late_ns : (N,) delay of messages that came out of order, 0 for most; delayed ones are not used

    Where both clocks pause, nothing is wrong. An interval of the headers is a step where the witness contradicts it and it is
    impossible for a clock whose messages are recorded late and never early. Regular headers remain regular: the interval
    across a step is a whole number of periods. A witness that runs at another speed is ignored.
    """
    is_set_back = _in_turns(headers, witness.stamps_ns) or _set_back(headers, witness.stamps_ns, late_ns)
    late_ns = np.where(is_set_back, 0, late_ns)
    keep = np.flatnonzero(late_ns == 0)
    h, w = headers[keep], witness.stamps_ns[keep]
    period, speed = _period_and_speed(h, w)
    if not period or _in_parts(h):
        return headers
    if not _SLOWEST <= speed <= _FASTEST:
        # A clock that stands still for a part of the drive seems slow.
        moves = np.diff(h, prepend=h[0] - 1) != 0
        period, speed = _period_and_speed(h[moves], w[moves])
    if not _SLOWEST <= speed <= _FASTEST:
        voice.notes.append(
            f"{what}: {witness.name} run {speed:.3g} times as fast as the stamps of the headers, as of a recording that was "
            "played back or written anew: the headers count"
        )
        return headers
    steps, jumps = np.diff(h), np.diff(w)
    spread = _delay_range(w, period)
    limit = max(0.5 * period + float(late_ns.max()), spread)
    is_apart = np.abs(steps - jumps) > limit
    is_odd = np.abs(steps - period) > 0.5 * period
    edges = np.flatnonzero(is_apart & is_odd)
    sizes = _step_sizes(h, w, edges, limit)
    longest = np.abs(jumps[is_apart & ~is_odd]).max(initial=0)
    if longest > _JUMP_INTERVALS * max(period, spread):
        voice.notes.append(
            f"{what}: {witness.name} jump by up to {longest * 1e-9:.3f} s where the stamps of the headers go on: the headers "
            "count"
        )
    edges, sizes = edges[sizes != 0], sizes[sizes != 0]
    if not len(edges):
        return headers
    new_steps = steps.copy()
    new_steps[edges] = _intervals(steps[edges] - sizes, steps, period)
    since_first = np.concatenate([[0], np.cumsum(new_steps)])
    offset = _offsets(h - h[0] - since_first, h - w, limit)
    first = int(edges[0])
    places = f" and at {len(edges) - 1} more" if len(edges) > 1 else ""
    how = f"step by {steps[first] * 1e-9:+.3f} s" if steps[first] else "stand still"
    voice.problems.append(
        f"{what}: the stamps of their headers {how} at message {keep[first + 1]}{places}, where {witness.name} go on by "
        f"{jumps[first] * 1e-9:.3f} s: brought onto one clock by {witness.name}"
    )
    return headers - offset[np.maximum(np.searchsorted(keep, np.arange(len(headers)), "right") - 1, 0)]


def follow(stamps: Stamps, scans: Stamps, new_stamps: Stamps, what: str, voice: Voice) -> Stamps:
    """Stamps (N,) of another stream, corrected like those of the scans, from `scans` to `new_stamps` (M,), all ns.

    They are unchanged unless their clock steps together with that of the scans. what : the stream, for notes
    """
    interval = float(np.median(np.diff(new_stamps))) if len(scans) > 1 else 0.0
    removed = np.diff(scans) - np.diff(new_stamps)
    at = np.flatnonzero(np.abs(removed) > 0.5 * interval)
    if not len(at) or len(stamps) < 3:
        return stamps
    steps = np.diff(stamps)
    slack = 0.5 * interval + float(np.median(steps))
    offset = np.full(len(stamps), scans[0] - new_stamps[0])
    last = -1
    for k, size in zip(at.tolist(), removed[at].tolist(), strict=True):
        is_alike = (np.abs(steps - size) < slack) & (np.abs(stamps[:-1] - scans[k]) < 2 * interval + slack)
        is_alike[: last + 1] = False
        if not is_alike.any():
            return stamps
        last = int(np.argmax(is_alike))
        offset[last + 1 :] += size
    voice.problems.append(f"{what}: its stamps step with those of the scans, {len(at)} times: moved alike")
    return np.asarray(stamps - offset)


def onto(stamps: Stamps, scans: Stamps, new_stamps: Stamps) -> Stamps:
    """`new_stamps` (M,) of the scans, moved as a whole to the one of several offsets at which they overlap a stream (N,) most.

    scans : (M,) ns, stamps before correction; their differences from `new_stamps` are the offsets
    """
    shared = {
        int(offset): np.count_nonzero((new_stamps + offset >= stamps.min()) & (new_stamps + offset <= stamps.max()))
        for offset in [0, *np.unique(scans - new_stamps)[:_OFFSETS]]
    }
    best: Stamps = new_stamps + max(shared, key=lambda offset: (shared[offset], offset == 0))
    return best


def ahead_of(
    own: Stamps, recording_ns: Stamps, stamps: Stamps, its_recording_ns: Stamps, what: str, voice: Voice
) -> int:
    """Offset of a stream's clock, `stamps` (N,), from that of the scans, `own` (M,), ns; 0 unless both measure the same time.

    recording_ns, its_recording_ns : times of recording of each. The messages with the least delay determine the offset, unless
    the times of recording run at another speed.
    """
    for h, w in (own, recording_ns), (stamps, its_recording_ns):
        if len(h) < 2 or not _SLOWEST <= _period_and_speed(h, w)[1] <= _FASTEST:
            return 0
    ahead = int((stamps - its_recording_ns).max() - (own - recording_ns).max())
    is_apart = stamps[0] > own[-1] or stamps[-1] < own[0]
    is_together = its_recording_ns.min() <= recording_ns.max() and its_recording_ns.max() >= recording_ns.min()
    if not is_together or abs(ahead) <= (_LATER_NS if is_apart else 10 * _LATER_NS):
        return 0
    voice.problems.append(
        f"{what}: its clock is {ahead * 1e-9:+.3f} s off that of the scans, though both were recorded at one time: moved onto it "
        "by the times of recording"
    )
    return ahead


def say_jitter(stamps: Stamps, what: str, voice: Voice) -> None:
    """Add a note about `what`, its subject in the plural, if intervals of increasing stamps (N,) vary more than a sensor's."""
    steps = np.diff(stamps).astype(np.float64)
    if len(steps) < _SPREAD_SAMPLES or steps.min() <= 0:
        return
    period = float(np.median(steps))
    off = steps - np.maximum(np.rint(steps / period), 1) * period
    sigma = 1.4826 * float(np.median(np.abs(off)))
    if sigma >= _JITTER * period:
        voice.notes.append(
            f"{what} follow each other unevenly, {sigma * 1e-6:.1f} ms (one sigma) about {period * 1e-6:.1f} ms: stamps of "
            "arrival, not of the sensor"
        )


def _period_and_speed(h: Stamps, w: Stamps) -> tuple[float, float]:
    """Usual interval, ns, of the clock `h` (N,), 0 if constant, and its ratio to that of the clock `w` (N,).

    Medians over windows of several lengths; the window in which both clocks agree best counts.
    """
    best = (np.inf, 0.0, 0.0)
    for length in _WINDOWS:
        if len(h) < 2 * length:
            break
        a, b = (float(np.median(c[length:] - c[:-length])) / length for c in (h, w))
        if a > 0 and b > 0:
            best = min(best, (abs(float(np.log(a / b))), a, a / b))
    return best[1], best[2]


def _in_turns(h: Stamps, w: Stamps) -> bool:
    """Whether the stamps `h` (N,) come from two clocks in turns: many are late and, sorted, irregular.

    The times of recording `w` (N,) are regular then.
    """
    if len(h) < _SPREAD_SAMPLES or np.mean(np.maximum.accumulate(h) > h) < _MANY:
        return False
    period, _ = _period_and_speed(h, w)
    is_irregular = np.abs(np.diff(np.sort(h)).astype(np.float64) - period) > _UNEVEN * period
    return bool(np.mean(is_irregular) > _MANY and _delay_range(w, period) < 0.5 * period)


def runs(mask: Bools) -> Longs:
    """(K, 2) begin and end (exclusive) of each run of true values."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]]))).reshape(-1, 2)


def _set_back(h: Stamps, w: Stamps, late_ns: Stamps) -> Bools:
    """(N,) mask of messages that are late only because their clock was set back for good; h, w : as of `_step_sizes`."""
    back = np.zeros(len(h), np.bool_)
    if not late_ns.any():
        return back
    ahead, period = h - w, _period_and_speed(h, w)[0]
    limit = max(0.5 * period, _delay_range(w, period))
    for begin, end in runs(late_ns > 0):
        before, after = ahead[max(begin - _LEVEL_SAMPLES, 0) : begin], ahead[end : end + _LEVEL_SAMPLES]
        own = ahead[begin:end].max()
        back[begin:end] = own < before.max() - limit and len(after) > 0 and after.max() < own + limit
    return back


def _in_parts(h: Stamps) -> bool:
    """Whether every scan consists of the same number of messages with one stamp; h : (N,) header stamps, ns."""
    counts = np.bincount(np.unique(h, return_inverse=True)[1], minlength=1)
    usual = int(np.median(counts))
    return 1 < usual < MESSAGES_PER_STAMP and bool(np.mean(counts == usual) > 1 - _MIN_SHARE)


def _delay_range(w: Stamps, period: float) -> float:
    """Spread of the recording delays of neighbouring messages, ns: messages often arrive in batches.

    w : (N,) ns, times of recording; period : ns
    """
    even = w - w[0] - np.arange(len(w)) * period
    spread = 0.0
    for length in _SPREAD_SAMPLES, 4 * _SPREAD_SAMPLES:
        if len(w) >= 3 * length:
            windows = np.lib.stride_tricks.sliding_window_view(even, length)
            spread = max(spread, float(np.median(windows.max(1) - windows.min(1))))
    return spread


def _step_sizes(h: Stamps, w: Stamps, edges: Stamps, limit: float) -> Stamps:
    """Step of the clock `h` between messages k and k + 1 for every k of `edges`, ns; 0 where there is none.

    h, w : (N,) ns, stamps of the header and of recording; limit : ns, smaller steps are none
    h - w is an offset minus the delay of recording, so its maxima count. A clock that goes back or is constant is
    wrong. Where it goes on, a delay could be the reason instead: it is a step only if no message on the same increasing
    stretch was recorded with so little delay.
    """
    ahead = h - w
    backward = np.flatnonzero(np.diff(h) <= 0)
    bounds = np.concatenate([[-1], edges, [len(h) - 1]])
    sizes = np.zeros(len(edges), np.int64)
    for i, k in enumerate(edges.tolist()):
        before = int(ahead[max(bounds[i] + 1, k + 1 - _LEVEL_SAMPLES) : k + 1].max())
        after = int(ahead[k + 1 : min(bounds[i + 2], k + _LEVEL_SAMPLES) + 1].max())
        step = after - before
        if h[k + 1] > h[k]:
            at = int(np.searchsorted(backward, k))
            begin = backward[at - 1] + 1 if at else 0
            end = backward[at] + 1 if at < len(backward) else len(h)
            stretch = ahead[begin : k + 1] if step > 0 else ahead[k + 1 : end]
            is_step = max(before, after) > stretch.max() + limit
        else:
            is_step = abs(step) > limit
        sizes[i] = step if is_step else 0
    return sizes


def _intervals(across: NDArray[Any], steps: Stamps, period: float) -> Stamps:
    """Intervals across steps, ns: whole periods where the clock ticks regularly; always positive."""
    is_regular = np.median(np.abs(steps - np.float64(period))) < _REGULAR * period
    count = np.maximum(np.rint(across / period), 1)
    is_near = np.abs(across / period - count) < _SNAP
    intervals = np.where(is_regular & is_near, np.rint(count * period), np.where(across > 0, across, period))
    return intervals.astype(np.int64)


def _offsets(offset: Stamps, ahead: Stamps, limit: float) -> Stamps:
    """Clock offset of each message, ns, relative to the clock, of those with many messages, that is nearest to recording.

    offset : (N,) ns, sum of the steps up to each message; ahead : (N,) ns, of the headers relative to recording
    limit : ns; a gap of half of it between sorted offsets parts two clocks
    """
    order = np.argsort(offset, kind="stable")
    clocks = np.split(order, np.flatnonzero(np.diff(offset[order]) > 0.5 * limit) + 1)
    levels = offset[[int(clock[len(clock) // 2]) for clock in clocks]]
    enough = max(_MIN_SHARE * len(offset), 2)
    candidates = [k for k, clock in enumerate(clocks) if len(clock) >= enough] or range(len(clocks))
    nearest = min(candidates, key=lambda k: abs(int(ahead[clocks[k]].max())))
    moved = np.empty_like(offset)
    for clock, level in zip(clocks, levels - levels[nearest], strict=True):
        moved[clock] = level
    return moved
