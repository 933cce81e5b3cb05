"""Association: pairs of poses of the estimate and of the ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs, Stamps
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory

LEAST_POSES = 3
# Interpolation pays when truth has a pose at least every 0.6 estimate intervals, and stops at holes of 5 of its own.
DENSER, HOLE = 0.6, 5
LEAST_OVERLAP = 0.6  # of the shorter trajectory
LEAST_SCORE = 0.8
SAME_STAMPS_NS = 1_000_000
WINDOW_POSES = 5
SECOND_BEST_RATIO = 1.2


@dataclass(frozen=True)
class Matches:
    """Matched poses: estimate (N, 4, 4), truth (N, 4, 4), stamps_ns (N,) on the truth's clock, or on the only known one.

    seconds : (N,) s since the first match, None when neither file knows time; recipe : the rule, for people
    """

    estimate: Floats
    truth: Floats
    stamps_ns: Stamps
    seconds: Floats | None
    possible: int
    recipe: str


def associate(estimate: Trajectory, truth: Trajectory, max_diff: float = 0.01, offset_ns: int = 0) -> Matches:
    """Match poses: by index when a file has no stamps, else by nearest stamp one to one, interpolating denser truth.

    max_diff : s, largest difference of stamps in a pair
    offset_ns : added to the estimate's stamps first
    Raises InputError when fewer than 3 poses match, with both time ranges, or when counts differ and there are no stamps.
    """
    for which, trajectory in (("estimate", estimate), ("ground truth", truth)):
        if len(trajectory) < LEAST_POSES:
            raise InputError(
                f"{which} {trajectory.source or 'without a name'} has {len(trajectory)} poses, {LEAST_POSES} are needed "
                f"(estimate: {time_range(estimate)}; ground truth: {time_range(truth)})"
            )
    if not (estimate.has_stamps and truth.has_stamps):
        return _by_index(estimate, truth)
    limit = round(max_diff * 1e9)
    stamps = estimate.stamps_ns + offset_ns
    if _is_denser(truth.stamps_ns, stamps):
        matches = _interpolate(estimate, stamps, truth, limit)
    else:
        matches = _nearest(estimate, stamps, truth, limit)
        # Moved by part of a sweep, no stamp meets one of the truth.
        if offset_ns and len(matches.stamps_ns) < LEAST_OVERLAP * matches.possible:
            between = _interpolate(estimate, stamps, truth, limit, "ground truth interpolated at the moved stamps")
            matches = max(between, matches, key=lambda m: len(m.stamps_ns))
    if len(matches.stamps_ns) < LEAST_POSES:
        raise InputError(_no_overlap(estimate, stamps, truth, len(matches.stamps_ns), max_diff))
    return matches


def nearest_one_to_one(stamps: Stamps, others: Stamps, limit_ns: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices into two increasing lists of stamps: nearest neighbours within `limit_ns`, each used once.

    As in evo the shorter list looks for partners; when two want the same one, the nearer gets it.
    """
    if len(others) < len(stamps):
        b, a = nearest_one_to_one(others, stamps, limit_ns)
        return a, b
    after = np.clip(np.searchsorted(others, stamps, side="right"), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    partner = np.where(np.abs(others[after] - stamps) < np.abs(others[before] - stamps), after, before)
    off = np.abs(others[partner] - stamps)
    order = np.lexsort((np.arange(len(stamps)), off))
    order = order[off[order] <= limit_ns]
    _, first = np.unique(partner[order], return_index=True)
    chosen = np.sort(order[first])
    return chosen, partner[chosen]


def time_range(trajectory: Trajectory, offset_ns: int = 0) -> str:
    """First and last stamp in words."""
    if not trajectory.has_stamps:
        return f"{len(trajectory)} poses without stamps"
    if len(trajectory) == 0:
        return "no poses"
    first, last = (int(s) + offset_ns for s in trajectory.stamps_ns[[0, -1]])
    return f"{first / 1e9:.3f} .. {last / 1e9:.3f} s"


def _by_index(estimate: Trajectory, truth: Trajectory) -> Matches:
    """Pair pose i with pose i where a trajectory has no stamps. Raises InputError when the numbers of poses differ."""
    bare = [name for name, t in (("estimate", estimate), ("ground truth", truth)) if not t.has_stamps]
    who = " and ".join(bare) + (" have" if len(bare) == 2 else " has")
    if len(estimate) != len(truth):
        raise InputError(
            f"{who} no stamps and the counts differ: {len(estimate)} poses in {estimate.source}, {len(truth)} in "
            f"{truth.source}; give the stamps of the KITTI file with --times, or use a format that has them (TUM)"
        )
    clock = truth if truth.has_stamps else estimate
    recipe = f"by index (line i with line i), because {who} no stamps"
    matches = _matches(estimate.poses, truth.poses, clock.stamps_ns, len(truth), recipe)
    return matches if clock.has_stamps else replace(matches, seconds=None)


def _nearest(estimate: Trajectory, stamps: Stamps, truth: Trajectory, limit: int) -> Matches:
    """Match poses with the nearest stamps, one to one, within `limit` ns."""
    i, j = nearest_one_to_one(stamps, truth.stamps_ns, limit)
    possible, recipe = min(len(estimate), len(truth)), f"nearest stamp, one to one, within {limit / 1e9:g} s"
    return _matches(estimate.poses[i], truth.poses[j], truth.stamps_ns[j], possible, recipe)


def _interpolate(
    estimate: Trajectory,
    stamps: Stamps,
    truth: Trajectory,
    limit: int,
    recipe: str = "denser ground truth interpolated at the estimate's stamps",
) -> Matches:
    """Pair estimated poses with the truth interpolated at `stamps`, outside its holes or within `limit` ns of a true pose."""
    known = truth.stamps_ns
    after = np.clip(np.searchsorted(known, stamps, side="left"), 1, len(known) - 1)
    gap = known[after] - known[after - 1]
    hole = max(HOLE * float(np.median(np.diff(known))), 2 * limit)
    nearest = np.minimum(np.abs(known[after] - stamps), np.abs(known[after - 1] - stamps))
    inside = (stamps >= known[0]) & (stamps <= known[-1]) & (gap <= hole)
    i = np.flatnonzero(inside | (nearest <= limit))
    truth_poses = se3.poses_at(known, truth.poses, stamps[i]) if len(i) else np.zeros((0, 4, 4))
    return _matches(estimate.poses[i], truth_poses, stamps[i], len(estimate), recipe)


def _is_denser(truth: Stamps, estimate: Stamps) -> bool:
    """Whether truth has clearly more poses per second than the estimate, and other stamps."""
    if float(np.median(np.diff(truth))) >= DENSER * float(np.median(np.diff(estimate))):
        return False
    return not bool(np.isin(estimate, truth).all())


def _matches(estimate: Floats, truth: Floats, stamps: Stamps, possible: int, recipe: str) -> Matches:
    """Matched poses with seconds since the first; possible : largest number of matches."""
    seconds = np.asarray((stamps - stamps[:1]) / 1e9, np.float64)
    return Matches(estimate, truth, stamps, seconds, possible, recipe)


def _no_overlap(estimate: Trajectory, stamps: Stamps, truth: Trajectory, count: int, max_diff: float) -> str:
    """Message for only `count` matched poses: time ranges of both trajectories, and the option that can help.

    stamps : (N,) ns, of the estimate on the clock of the truth; max_diff : s, within which stamps match
    """
    ranges = (
        f"estimate {estimate.source} covers {stamps[0] / 1e9:.3f} .. {stamps[-1] / 1e9:.3f} s, "
        f"ground truth {truth.source} {time_range(truth)}"
    )
    if stamps[0] <= truth.stamps_ns[-1] and truth.stamps_ns[0] <= stamps[-1]:
        after = np.clip(np.searchsorted(truth.stamps_ns, stamps), 1, len(truth) - 1)
        off = np.minimum(np.abs(truth.stamps_ns[after] - stamps), np.abs(truth.stamps_ns[after - 1] - stamps))
        way_out = (
            f"their stamps are {np.median(off) / 1e9:.3f} s apart (median): raise --max-diff or try --time-offset auto"
        )
    else:
        way_out = "they share no time: try --time-offset auto (or seconds) if one clock is shifted"
    return f"only {count} poses match within {max_diff:g} s, {LEAST_POSES} are needed: {ranges}; {way_out}"


def estimate_offset(estimate: Trajectory, truth: Trajectory) -> tuple[int, float]:
    """Shift, ns, to add to the estimate's stamps, and the correlation at that shift, 0..1.

    Speed and rotation rate, which no frame changes, are correlated over all shifts in which at least 60 % of the shorter
    trajectory overlaps; the best one is refined between samples. When the stamps then agree up to one constant to 1 ms,
    that constant is the answer.
    Raises InputError when a trajectory has no stamps or fewer than 3 poses, or when the motion does not determine the shift.
    """
    for which, t in (("estimate", estimate), ("ground truth", truth)):
        if not t.has_stamps or len(t) < LEAST_POSES:
            raise InputError(f"--time-offset auto: {which} {t.source} has no stamps or fewer than {LEAST_POSES} poses")
    step = _step(estimate, truth)
    a, b = _rates(estimate, step), _rates(truth, step)
    if min(len(a), len(b)) < 10:
        raise InputError(f"--time-offset auto: the trajectories are shorter than 15 samples of {step / 1e9:.2f} s")
    scores, lags = _correlation(a, b)
    if not len(scores) or scores.max() < LEAST_SCORE:
        highest = f"{scores.max():.2f}" if len(scores) else "none"
        raise InputError(
            f"--time-offset auto: the speeds and turns of both trajectories fit nowhere (best correlation {highest}, "
            f"{LEAST_SCORE} needed; estimate {time_range(estimate)}, ground truth {time_range(truth)}); "
            "give the offset in seconds"
        )
    zero = int(truth.stamps_ns[0]) - int(estimate.stamps_ns[0])
    peaks = _peaks(scores, lags)
    refined = [(_refine(estimate, truth, zero + int(lags[p]) * step, step), p) for p in peaks]
    (cost, offset, best), *others = sorted((cost, offset, p) for (offset, cost), p in refined)
    if others and others[0][0] <= SECOND_BEST_RATIO * cost + 1e-9:
        raise InputError(
            f"--time-offset auto: {offset / 1e9:.3f} s and {others[0][1] / 1e9:.3f} s fit alike; give the offset in seconds"
        )
    return _snap(estimate, truth, offset, step), float(scores[best])


def _peaks(scores: Floats, lags: Longs) -> list[int]:
    """Indices of at most 20 best scores, best first, that are not poor and not within `2 WINDOW_POSES` of a better one."""
    chosen: list[int] = []
    for k in np.argsort(-scores, kind="stable")[:2000].tolist():
        if scores[k] < LEAST_SCORE or len(chosen) == 20:
            break
        if all(abs(int(lags[k] - lags[c])) > 2 * WINDOW_POSES for c in chosen):
            chosen.append(k)
    return chosen


def _step(estimate: Trajectory, truth: Trajectory) -> int:
    """Sample distance, ns: the coarser of both, which averages out noise between dense poses."""
    slow = max(float(np.median(np.diff(t.stamps_ns))) for t in (estimate, truth))
    return int(np.clip(slow, 50_000_000, 1_000_000_000))


def _rates(t: Trajectory, step: int, first: int | None = None, count: int | None = None) -> Floats:
    """(M, 2) speed m/s and rotation rate rad/s, a sample every `step` ns, each over WINDOW_POSES samples against pose noise.

    first : stamp of the first sample, ns; count : samples, of which WINDOW_POSES yield no rate; both of the whole by default
    """
    first = int(t.stamps_ns[0]) if first is None else first
    if count is None:
        count = int((t.stamps_ns[-1] - t.stamps_ns[0]) // step) + 1
    if count <= WINDOW_POSES:
        return np.zeros((0, 2))
    poses = se3.poses_at(t.stamps_ns, t.poses, first + step * np.arange(count))
    start, end = poses[:-WINDOW_POSES], poses[WINDOW_POSES:]
    speed = np.linalg.norm(end[:, :3, 3] - start[:, :3, 3], axis=1)
    turn = so3.angle(np.swapaxes(start[:, :3, :3], -1, -2) @ end[:, :3, :3])
    return np.stack([speed, turn], axis=1) * (1e9 / (WINDOW_POSES * step))


def _correlation(a: Floats, b: Floats) -> tuple[Floats, Longs]:
    """Pearson correlation of a (N, C), shifted by each lag, against b (M, C), mean of channels that vary, and the lags."""
    from scipy.signal import correlate

    n, m = len(a), len(b)
    lags = np.arange(-(n - 1), m)
    overlap = np.rint(correlate(np.ones(m), np.ones(n), method="fft"))
    allowed = overlap >= max(LEAST_OVERLAP * min(n, m), 10)
    total = np.zeros(len(lags))
    channels = 0
    for k in range(a.shape[1]):
        x, y = a[:, k] - a[:, k].mean(), b[:, k] - b[:, k].mean()
        spread = min(float(x.std()), float(y.std()))
        if spread < (0.02, 0.002)[k]:
            continue
        sx, sy = correlate(np.ones(m), x, method="fft"), correlate(y, np.ones(n), method="fft")
        sxx, syy = correlate(np.ones(m), x * x, method="fft"), correlate(y * y, np.ones(n), method="fft")
        count = np.maximum(overlap, 1)
        cov = correlate(y, x, method="fft") - sx * sy / count
        var_x, var_y = sxx - sx * sx / count, syy - sy * sy / count
        # A stretch that hardly varies correlates with anything: such shifts count as no evidence.
        floor = 0.05 * count
        enough = (var_x > floor * x.var()) & (var_y > floor * y.var())
        total += np.where(enough, cov / np.sqrt(np.where(enough, var_x * var_y, 1.0)), 0.0)
        channels += 1
    if channels == 0:
        return np.zeros(0), np.zeros(0, np.int64)
    return total[allowed] / channels, lags[allowed]


def _refine(estimate: Trajectory, truth: Trajectory, start: int, step: int) -> tuple[int, float]:
    """Shift, ns, within `step` of `start` with least difference of rates, and that, 0..1; `start` and 1 if too short."""
    from scipy.optimize import minimize_scalar

    low = max(int(estimate.stamps_ns[0]), int(truth.stamps_ns[0]) - start + step)
    high = min(int(estimate.stamps_ns[-1]), int(truth.stamps_ns[-1]) - start - step)
    count = (high - low) // step + 1
    if count < WINDOW_POSES + 3:
        return start, 1.0
    own = _rates(estimate, step, low, count)
    scale = own.std(axis=0) + np.array([0.02, 0.002])

    def cost(shift: float) -> float:
        other = _rates(truth, step, low + start + round(shift), count)
        return float(np.mean(np.minimum(np.abs(own - other) / scale, 1.0) ** 2))

    best = minimize_scalar(cost, bounds=(-step, step), method="bounded", options={"xatol": 1e4})
    return start + round(float(best.x)), float(best.fun)


def _snap(estimate: Trajectory, truth: Trajectory, offset: int, step: int) -> int:
    """Exact constant, ns, if stamps differ by one, paired within half a `step`, ns; else `offset` unchanged."""
    stamps = estimate.stamps_ns + offset
    i, j = nearest_one_to_one(stamps, truth.stamps_ns, step // 2)
    if len(i) < LEAST_POSES:
        return offset
    rest = truth.stamps_ns[j] - stamps[i]
    middle = int(np.median(rest))
    is_constant = float(np.mean(np.abs(rest - middle) <= SAME_STAMPS_NS)) >= 0.9
    return offset + middle if is_constant else offset
