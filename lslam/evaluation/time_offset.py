"""Time offset at which an estimate fits its truth best, within one or two sweeps.

A LiDAR's stamp may be the start, the middle or the end of its sweep, and the truth's another instant. Distance and rotation
angle over short windows are compared, since they do not depend on frames. An offset is observable where speed or turn rate
change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Stamps
from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory

# Windows that are compared, s; how far an offset may lie from the one that is begun with, s; rounds of the fit.
WINDOW_S, FARTHEST_S, ROUNDS = 0.3, 0.5, 20
# Least correlation of how the motions of both change: where both merely rattle, each does so by itself.
MIN_COHERENCE = 0.5
# Blocks whose errors count as independent: so long, s, or a part of a shorter drive, but two windows; and how many at least.
BLOCK_S, PARTS, MIN_BLOCKS = 1.5, 12, 8
# An offset is clear from so many sigmas on, and from so many seconds on.
CLEAR_SIGMAS, CLEAR_S = 5.0, 0.005
# Noise of a way, m, and of a turn, rad, that is always allowed for.
FLOORS = (1e-4, 1e-5)
HUBER_SIGMAS = 2.0
HOLES = 5


@dataclass(frozen=True)
class OffsetFit:
    """Offset to add to the estimate's stamps, its one sigma, ns, and the coherence of the changes of both motions."""

    offset_ns: int
    sigma_ns: float
    coherence: float

    def is_clearly_off(self, other_ns: int = 0) -> bool:
        """Whether `other_ns` differs significantly, and by enough to matter."""
        is_far = abs(self.offset_ns - other_ns) > max(CLEAR_SIGMAS * self.sigma_ns, CLEAR_S * 1e9)
        return is_far and self.coherence > MIN_COHERENCE


def fit_offset(estimate: Trajectory, truth: Trajectory, start_ns: int = 0) -> OffsetFit | None:
    """Offset near `start_ns` at which distances and rotations over short windows agree best; None if it is unobservable."""
    if not (estimate.has_stamps and truth.has_stamps) or min(len(estimate), len(truth)) < 2 * MIN_BLOCKS:
        return None
    step = float(np.median(np.diff(estimate.stamps_ns)))
    count = max(1, round(WINDOW_S * 1e9 / step))
    turns = estimate.has_rotations and truth.has_rotations
    own = _motions(estimate.poses, count, turns)
    durations = estimate.stamps_ns[count:] - estimate.stamps_ns[:-count]
    is_whole = durations < 1.5 * count * step
    since = estimate.stamps_ns[:-count] - estimate.stamps_ns[0]
    block = max(min(BLOCK_S * 1e9, float(since[-1]) / PARTS), 2 * count * step)
    blocks = (since // int(block)).astype(int)
    reach = int(max(float(np.median(np.diff(truth.stamps_ns))), step))
    offset, last, gain = float(start_ns), 0.0, 1.0
    for _ in range(ROUNDS):
        fit = _linearise(estimate.stamps_ns + round(offset), truth, own, is_whole, count, reach, turns, blocks)
        if fit is None:
            return None
        change, sigma, coherence = fit
        # Between the truth's stamps its motion has kinks, over which whole steps jump to and fro.
        gain = gain / 2 if change * last < 0 else gain
        last = change
        offset += gain * float(np.clip(change, -0.1e9, 0.1e9))
        if abs(offset - start_ns) > FARTHEST_S * 1e9:
            return None
        if gain * abs(change) < max(1e4, 0.1 * sigma):
            return OffsetFit(round(offset), float(np.hypot(sigma, gain * change)), coherence)
    return None


def _linearise(
    stamps: Stamps,
    truth: Trajectory,
    own: Floats,
    is_whole: Bools,
    count: int,
    reach: int,
    turns: bool,
    blocks: NDArray[np.int_],
) -> tuple[float, float, float] | None:
    """Change of the offset, ns, its sigma, and coherence; None with little motion or overlap with the truth.

    own : (N - count, C) motions of the estimate over `count` poses, `is_whole` without gap, by their block
    reach : ns, over which the truth's motion is differentiated; turns : with rotations
    """
    inside = _covers(truth.stamps_ns, stamps - reach) & _covers(truth.stamps_ns, stamps + reach)
    use = inside[count:] & inside[:-count] & is_whole
    many = len(np.unique(blocks[use]))
    if many < MIN_BLOCKS:
        return None
    before, at, after = (
        _motions(se3.poses_at(truth.stamps_ns, truth.poses, stamps + shift), count, turns)[use]
        for shift in (-reach, 0, reach)
    )
    r = own[use] - at
    J = (after - before) / (2 * reach)
    scales = np.maximum(1.4826 * np.median(np.abs(r - np.median(r, axis=0)), axis=0), FLOORS[: r.shape[1]])
    w = np.minimum(HUBER_SIGMAS * scales / np.maximum(np.abs(r), 1e-12), 1.0) / scales**2
    information = float(np.sum(w * J * J))
    if information <= 0:
        return None
    pulls = np.bincount(blocks[use], weights=np.sum(w * J * r, axis=1))
    change = float(pulls.sum()) / information
    parts = np.bincount(blocks[use], weights=np.sum(w * J * J, axis=1))
    # What is left of each block once the offset is taken off, and no less than noise of the floors would leave.
    sigma = float(np.sqrt(np.sum((pulls - change * parts) ** 2) * many / (many - 1))) / information
    own_change = np.zeros_like(own)
    own_change[1:-1] = own[2:] - own[:-2]
    mine = own_change[use]
    coherence = float(np.sum(w * J * mine)) / max(float(np.sqrt(information * np.sum(w * mine * mine))), 1e-300)
    return change, max(sigma, information**-0.5 * 0.1), coherence


def _covers(truth_ns: Stamps, stamps: Stamps) -> Bools:
    """(N,) whether stamps lie within the truth's time range and in no gap of it."""
    after = np.clip(np.searchsorted(truth_ns, stamps, side="left"), 1, len(truth_ns) - 1)
    gaps = truth_ns[after] - truth_ns[after - 1]
    return np.asarray(
        (stamps >= truth_ns[0]) & (stamps <= truth_ns[-1]) & (gaps <= HOLES * np.median(np.diff(truth_ns)))
    )


def _motions(poses: Floats, count: int, turns: bool) -> Floats:
    """(N - count, 1 or 2) distance, m, and rotation angle, rad, between each pose and the one `count` later."""
    way = np.linalg.norm(poses[count:, :3, 3] - poses[:-count, :3, 3], axis=1)
    if not turns:
        return np.asarray(way[:, None])
    turn = so3.angle(so3.normalise(np.swapaxes(poses[:-count, :3, :3], -1, -2) @ poses[count:, :3, :3]))
    return np.stack([way, turn], axis=1)
