"""The scans of loop candidates on each other, before and after registration, for people who say which are loops."""

from __future__ import annotations

import numpy as np

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.keyframes.submaps import submap
from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats, Points
from lslam.core.types.constraint import LoopCandidate, LoopStage
from lslam.core.types.run_record import PairView, RunRecord

# Candidates that a page shows without a server, and points of each of their clouds.
MOST_VIEWS, FEW_POINTS = 20, 1500


def view_pairs(record: RunRecord, store: KeyframeStore, size: int) -> list[PairView]:
    """The most doubtful candidates of a run; size : keyframes whose clouds make one submap."""
    tried = [c for c in record.loops if c.stage != LoopStage.THINNED]
    doubtful = sorted(tried, key=lambda c: (-c.doubt, c.a, c.b))[:MOST_VIEWS]
    poses = record.trajectory.poses
    return [view_pair(store, c, poses[record.keyframe_scans[c.a]], size, FEW_POINTS) for c in doubtful]


def view_pair(store: KeyframeStore, candidate: LoopCandidate, T_world_a: Floats, size: int, most: int) -> PairView:
    """The view of a candidate; T_world_a : (4, 4) the older keyframe in a level world; most : points of each cloud."""
    odometry = np.stack([k.T_world_lidar for k in store.keyframes])
    a, b = (_some(submap(store, odometry, k, size), most) for k in (candidate.a, candidate.b))
    R = se3.make(T_world_a[:3, :3], np.zeros(3))
    before = R @ se3.relative(odometry[candidate.a], odometry[candidate.b])
    closed = candidate.constraint
    return PairView(
        candidate,
        se3.apply(R, a).astype(np.float32),
        b,
        before,
        None if closed is None else R @ closed.T_a_b,
    )


def _some(points: Points, most: int) -> Points:
    """At most so many of the points, evenly chosen."""
    return points[:: max(1, -(-len(points) // most))]
