"""Alerts from the motion checks of a run: where its poses may be lost, and why."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.geometry import se3
from lslam.core.kernels.linearisation import OUTLIER_SIGMAS
from lslam.core.types.scan_result import MOST_ACCELERATION_M_S2, OPEN_M, OPEN_RAD, SAME_M, USUAL, MotionCheck
from lslam.odometry.integrity.pair_registration import EMPTIED_SHARE, is_within
from lslam.registration.policies import MUCH_RATIO

# Consistent checks in a row, two seconds of them, and least deviations, m and rad: few rings constrain tilt poorly.
IN_A_ROW = 4
LEAST_DEVIATION: Floats = np.array([0.06, 0.06, 0.08, *np.deg2rad([0.3, 0.3, 0.12])])
# One check is enough where it says so much more, and clearly explains more of the points.
LARGE: Floats = np.repeat([OPEN_M, OPEN_RAD], 3)
# Checks in a row between standing and moving: one is chance.
OPEN_IN_A_ROW = 2
AXIS_NAMES = ("ahead", "to the left", "up", "of roll", "of pitch", "of yaw")


@dataclass(frozen=True)
class Alert:
    """Scans whose poses may be lost, by their positions in the run, and why."""

    first: int
    last: int
    why: str


def alerts(checks: list[MotionCheck], positions: Floats, stamps_ns: Longs, frames: Longs | None = None) -> list[Alert]:
    """All alerts on the `positions` (N, 3), m, of scans at `stamps_ns` (N,), in their order.

    frames : (N,) in which the positions are given; None: all in one. From one frame to another nothing jumps.
    """
    rules = (_across_breaks, _inconsistent, _ambiguous, _open, _foreign)
    out = [alert for rule in rules for alert in rule(checks)]
    frames = np.zeros(len(positions), np.int64) if frames is None else frames
    for begin, end in pairwise([0, *(np.flatnonzero(np.diff(frames)) + 1).tolist(), len(frames)]):
        jumps = _jumps(positions[begin:end], stamps_ns[begin:end])
        out += [Alert(begin + jump.first, begin + jump.last, jump.why) for jump in jumps]
    return sorted(out, key=lambda alert: (alert.first, alert.last))


def _inconsistent(checks: list[MotionCheck]) -> list[Alert]:
    """Alerts where checks reject the motion of the poses; axes rejected together make one alert.

    Inconclusive checks do not separate conclusive ones.
    """
    checks = [check for check in checks if check.is_conclusive]
    if not checks:
        return []
    apart, sigma = (np.stack([getattr(check, name) for check in checks]) for name in ("apart", "sigma"))
    sigma = np.maximum(sigma, _noise(apart))
    spans = sorted(span for axis in range(6) for span in _stretches(checks, apart[:, axis], sigma[:, axis], axis))
    merged: list[tuple[int, int]] = []
    for begin, end in spans:
        if merged and begin < merged[-1][1]:
            merged[-1] = merged[-1][0], max(end, merged[-1][1])
        else:
            merged.append((begin, end))
    return [_alert(checks[begin:end], np.median(apart[begin:end], axis=0)) for begin, end in merged]


def _noise(apart: Floats) -> Floats:
    """(6,) usual difference of successive checks: a constant one is no alert."""
    if len(apart) < IN_A_ROW:
        return np.zeros(6)
    return np.asarray(1.4826 / np.sqrt(2) * np.median(np.abs(np.diff(apart, axis=0)), axis=0))


def _stretches(checks: list[MotionCheck], apart: Floats, sigma: Floats, axis: int) -> list[tuple[int, int]]:
    """Ranges of checks along one axis whose deviation `apart` (m or rad) is significant in a row, or large in a single check."""
    is_better = np.array([check.agreement > MUCH_RATIO * check.claimed_agreement for check in checks])
    is_large = is_better & (np.abs(apart) > LARGE[axis] + 2 * OUTLIER_SIGMAS * sigma)
    stretches = []
    for begin, end in _runs(np.where(np.abs(apart) > LEAST_DEVIATION[axis], np.sign(apart), 0)):
        part = slice(begin, end)
        mean, count = float(np.mean(apart[part])), end - begin
        bound = LEAST_DEVIATION[axis] + OUTLIER_SIGMAS * float(np.median(sigma[part])) / np.sqrt(count)
        if is_large[part].any() or (count >= IN_A_ROW and abs(mean) > bound):
            stretches.append((begin, end))
    return stretches


def _alert(run: list[MotionCheck], apart: Floats) -> Alert:
    """The alert of a run of checks, with the two axes of largest mean deviation `apart` (6,) in its text."""
    seconds = float(np.median([check.seconds for check in run]))
    worst = sorted(np.argsort(-np.abs(apart) / LEAST_DEVIATION)[:2].tolist())
    motion = " and ".join(
        f"{apart[axis]:+.2f} m {AXIS_NAMES[axis]}"
        if axis < 3
        else f"{np.rad2deg(apart[axis]):+.2f} deg {AXIS_NAMES[axis]}"
        for axis in worst
        if abs(apart[axis]) > LEAST_DEVIATION[axis]
    )
    each = "each" if len(run) > 1 else "it"
    why = f"beside the scan {seconds:.1f} s before, {each} moved by {motion or 'another way'} more than its pose says"
    return Alert(run[0].first + 1, run[-1].last, why)


def _across_breaks(checks: list[MotionCheck]) -> list[Alert]:
    """Where scans are missing or failed, and a check rejects the motion of the poses before and after."""
    out = []
    for check in checks:
        is_elsewhere = check.claimed_agreement < USUAL * check.usual
        if check.is_after_break and check.usual > 0 and (check.is_open or is_elsewhere):
            why = f"nothing in the scans confirms the motion over the {check.seconds:.1f} s before, in which scans failed or miss"
            out.append(Alert(check.first + 1, check.last, why))
    return out


def _ambiguous(checks: list[MotionCheck]) -> list[Alert]:
    """Where standing and moving explain the scans about equally well: a group of surfaces moves, or the sensor."""
    conclusive = [check for check in checks if check.is_conclusive]
    is_open = [
        check.rival is not None and _is_rest(check.rival) != _is_rest(check.found_motion) for check in conclusive
    ]
    return [
        Alert(
            conclusive[begin].first + 1,
            conclusive[end - 1].last,
            "standing and moving explain the scans about equally well: a group of surfaces around the sensor moves, or it does",
        )
        for begin, end in _runs(np.array(is_open, np.float64))
        if end - begin >= OPEN_IN_A_ROW
    ]


def _open(checks: list[MotionCheck]) -> list[Alert]:
    """Where the poses begin to move along a direction that the scans leave open; checks one after the other make one alert."""
    spans: list[tuple[int, int, float, str]] = []
    reference: MotionCheck | None = None
    pairs = 1.0  # since the reference, up to the first of an alert
    for check in checks:
        if not check.is_open:
            reference = check
            continue
        if reference is None or min(reference.seconds, check.seconds) <= 0:
            continue
        longer = check.seconds / reference.seconds
        more = (check.claimed_motion - se3.exp(longer * se3.log(reference.claimed_motion)))[:3, 3]
        axis = int(np.argmax(np.abs(more)))
        # What a shorter pair does not tell grows with the time; so does the change of speed of a sensor that was on its way.
        is_next = bool(spans) and spans[-1][1] == check.first
        if not is_next:
            pairs = (
                1.0
                if _is_rest(reference.claimed_motion)
                else (check.last - reference.last) / (check.last - check.first)
            )
        if abs(more[axis]) <= LARGE[axis] * max(longer, pairs, 1.0):
            continue
        if is_next:
            spans[-1] = (
                spans[-1][0],
                check.last,
                *max(spans[-1][2:], (more[axis], AXIS_NAMES[axis]), key=lambda m: abs(m[0])),
            )
        else:
            spans.append((check.first, check.last, more[axis], AXIS_NAMES[axis]))
    return [
        Alert(
            first + 1,
            last,
            f"the scans leave open whether the sensor began to move by {off:+.2f} m {axis}, as its poses do",
        )
        for first, last, off, axis in spans
    ]


def open_throughout(checks: list[MotionCheck]) -> list[Alert]:
    """The alert of a run of which no two scans tell the motion, as in a bare tunnel: standing there looks like any speed."""
    if len(checks) < IN_A_ROW or not all(check.is_open for check in checks):
        return []
    why = "no two scans tell how the sensor moved, as in a bare tunnel: nothing confirms the poses"
    return [Alert(checks[0].first + 1, checks[-1].last, why)]


def _is_rest(motion: Floats) -> bool:
    """Whether a motion (4, 4) is too small to count as motion."""
    return is_within(motion, SAME_M)


def _foreign(checks: list[MotionCheck]) -> list[Alert]:
    """Alerts where the poses are constant although previously filled viewing directions are empty: clouds in another frame."""
    return [
        Alert(
            checks[begin].first + 1,
            checks[end - 1].last,
            f"the poses stand, yet {100 * max(check.emptied_share for check in checks[begin:end]):.0f} % of the directions in "
            "which there were points are empty: the clouds are not in the frame of the sensor, perhaps in that of a world",
        )
        for begin, end in _runs(np.array([check.emptied_share > EMPTIED_SHARE for check in checks], np.float64))
        if end - begin >= IN_A_ROW
    ]


def _jumps(positions: Floats, stamps_ns: Longs) -> list[Alert]:
    """Alerts where the positions (N, 3) change their velocity more than any vehicle could, and the stamps are not the cause."""
    seconds: Floats = (stamps_ns - stamps_ns[:1]).astype(np.float64) * 1e-9
    if len(seconds) < 3 or np.any(np.diff(seconds) <= 0):
        return []
    jumps: dict[int, tuple[float, float]] = {}
    for apart in _jump_spans(seconds):
        change, between = _velocity_changes(positions, seconds, apart)
        at = np.flatnonzero(_is_jump(change, between) & ~_is_by_stamps(positions, seconds, apart)) + apart
        # The second of three poses that make a jump; where they contain a faster one, that is meant.
        slower = [k for k in at.tolist() if all(abs(k - faster) > apart for faster in jumps)]
        jumps |= {k: (float(change[k - apart] * between[k - apart]), float(between[k - apart])) for k in slower}
    return [
        Alert(
            int(group[0]),
            int(group[-1]) + 1,
            "the poses jump, by {:.1f} m within {:.2g} s against the motion before: a wrong place, or scans out of order".format(
                *max(jumps[k] for k in group.tolist())
            ),
        )
        for group in _groups(np.array(sorted(jumps), np.int64))
    ]


def stamp_faults(positions: Floats, stamps_ns: Longs) -> tuple[list[int], float]:
    """Scans whose wrong stamps alone make the poses jump, by index in the run, and the largest error of a step, s."""
    seconds: Floats = (stamps_ns - stamps_ns[:1]).astype(np.float64) * 1e-9
    steps = np.diff(seconds)
    if len(steps) < 2 or np.any(steps <= 0):
        return [], 0.0
    at = np.flatnonzero(_is_jump(*_velocity_changes(positions, seconds)) & _is_by_stamps(positions, seconds))
    if not len(at):
        return [], 0.0
    off = np.abs(steps - np.median(steps))
    return (at + 1).tolist(), float(np.max(np.maximum(off[at], off[at + 1])))


def _jump_spans(seconds: Floats) -> list[int]:
    """Numbers of scans between poses that are compared: one, and as many as the least jump takes at `MOST_ACCELERATION_M_S2`.

    A wrong place that the map takes three scans to let go is no jump from one scan to the next.
    """
    apart = int(np.ceil(np.sqrt(OPEN_M / MOST_ACCELERATION_M_S2) / np.median(np.diff(seconds))))
    return sorted({1, apart}) if 2 * apart < len(seconds) else [1]


def _velocity_changes(positions: Floats, seconds: Floats, apart: int = 1) -> tuple[Floats, Floats]:
    """(N - 2 apart,) changes of the velocity, m/s, and the times in which they happen, s.

    positions : (N, 3) m, at `seconds` (N,); a velocity is that from a pose to the one so many scans `apart`
    """
    velocity = (positions[apart:] - positions[:-apart]) / (seconds[apart:] - seconds[:-apart])[:, None]
    between = (seconds[2 * apart :] - seconds[: -2 * apart]) / 2
    return np.linalg.norm(velocity[apart:] - velocity[:-apart], axis=1), between


def _is_jump(change: Floats, between: Floats) -> Bools:
    """Whether nothing that carries a sensor changes its velocity so much, m/s, in such a time, s."""
    return np.asarray((change / between > MOST_ACCELERATION_M_S2) & (change * between > OPEN_M))


def _is_by_stamps(positions: Floats, seconds: Floats, apart: int = 1) -> Bools:
    """(N - 2 apart,) whether three poses would not jump had their scans followed each other at the period of the sensor.

    A rotor keeps its period to a thousandth; stamps that a computer gives when packets arrive do not. A wrong place, or scans
    out of order, stay wrong at any stamps.
    """
    regular: Floats = np.arange(len(seconds)) * np.median(np.diff(seconds))
    return ~_is_jump(*_velocity_changes(positions, regular, apart))


def _groups(at: Longs) -> list[Longs]:
    """Split the ascending indices of jumps into groups: more than three scans apart begins another."""
    return np.split(at, np.flatnonzero(np.diff(at) > 3) + 1) if len(at) else []


def _runs(signs: Floats) -> list[tuple[int, int]]:
    """Begin and end of the stretches of equal signs, those of 0 left out."""
    edges = [0, *(np.flatnonzero(np.diff(signs)) + 1).tolist(), len(signs)]
    return [(a, b) for a, b in pairwise(edges) if b > a and signs[a] != 0]
