"""The map about the loop closure with the largest correction, by odometry's poses and by the final ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.backend.outcome import BackEnd
from lslam.geometry import se3
from lslam.keyframes.store import KeyframeStore
from lslam.types.constraint import LoopCandidate
from lslam.types.run_record import LoopSurroundings, LoopView, RunRecord

Floats = NDArray[np.float64]

# Keyframes before and after each end of the loop whose clouds are shown.
AROUND = 10


def view_loop(record: RunRecord, done: BackEnd, store: KeyframeStore) -> LoopView | None:
    """The view; None without an accepted loop closure or an optimised graph."""
    closed = [c for c in record.loops if c.is_accepted]
    if record.odometry is None or not done.is_optimised or not closed:
        return None
    scans = record.keyframe_scans
    before, after = record.T_final_odometry @ record.odometry.poses[scans], record.trajectory.poses[scans]

    def correction(loop: LoopCandidate) -> float:
        was, now = (se3.relative(poses[loop.a], poses[loop.b])[:3, 3] for poses in (before, after))
        return float(np.linalg.norm(now - was))

    loop = max(closed, key=correction)
    return LoopView(
        int(scans[loop.a]),
        int(scans[loop.b]),
        correction(loop),
        _surroundings(before, loop, store),
        _surroundings(after, loop, store),
    )


def _surroundings(poses: Floats, loop: LoopCandidate, store: KeyframeStore) -> LoopSurroundings:
    older, newer = (range(max(end - AROUND, 0), min(end + AROUND + 1, len(store))) for end in (loop.a, loop.b))
    points = np.concatenate([se3.apply(poses[k], store.points(k)) for k in sorted({*older, *newer})])
    return LoopSurroundings(points, poses[list(older), :2, 3], poses[list(newer), :2, 3], poses[loop.a, :2, 3])
