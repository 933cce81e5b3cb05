"""Both scans of a candidate on each other: registered they are one cloud, before as far apart as odometry has them."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.loops.find_loops import FEW_POINTS, MOST_VIEWS, view_pair, view_pairs
from lslam.core.geometry import se3, so3
from lslam.core.types.constraint import Constraint, LoopCandidate, LoopStage, Verdict
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe, Trajectory

WORLD = np.random.default_rng(0).uniform((-20, -20, 0), (20, 20, 4), (4000, 3))
TRUE = np.stack([se3.make(so3.exp(np.array([0.1, 0, k])), np.array([k, 0.5 * k, 0])) for k in (0.0, 1.0, 2.0)])
DRIFT = se3.make(so3.exp(np.array([0, 0, 0.2])), np.array([3.0, 0, 0]))


@pytest.fixture
def store() -> KeyframeStore:
    """Three keyframes that see one world; odometry has the last one elsewhere."""
    store = KeyframeStore()
    for k, T in enumerate(TRUE):
        odometry = DRIFT @ T if k == 2 else T
        points = se3.apply(se3.inverse(T), WORLD).astype(np.float32)
        store.add(Keyframe(k, 10 * k, k * 10**9, odometry, distance=2.0 * k), points)
    return store


def candidate(
    a: int, b: int, stage: LoopStage = LoopStage.AGREEMENT, overlap: float = 0.9, closed: bool = True
) -> LoopCandidate:
    verdict = Verdict.ACCEPTED if stage == LoopStage.AGREEMENT else Verdict.REJECTED
    constraint = Constraint(a, b, se3.relative(TRUE[a], TRUE[b]), np.eye(6)) if closed else None
    return LoopCandidate(a, b, 1.0, 0.1, verdict, stage, "", 0.05, overlap, constraint)


def test_registered_both_are_one_cloud_in_level_axes_about_the_older(store: KeyframeStore) -> None:
    view = view_pair(store, candidate(0, 2), TRUE[0], 1, 10_000)
    level = WORLD - TRUE[0, :3, 3]
    np.testing.assert_allclose(view.a, level, atol=1e-4)
    assert view.after is not None
    np.testing.assert_allclose(se3.apply(view.after, view.b.astype(float)), level, atol=1e-4)
    apart = se3.apply(view.before, view.b.astype(float)) - level
    np.testing.assert_allclose(apart, se3.apply(DRIFT, WORLD) - WORLD, atol=1e-4)


def test_what_was_not_registered_has_no_after_and_few_points_are_kept(store: KeyframeStore) -> None:
    view = view_pair(store, candidate(0, 2, closed=False), TRUE[0], 1, 500)
    assert view.after is None
    assert 400 <= len(view.a) <= 500
    # Of a submap, the neighbours as odometry has them.
    assert len(view_pair(store, candidate(0, 2), TRUE[0], 3, 10**6).a) == 2 * len(WORLD)


def test_the_most_doubtful_are_shown_and_what_was_not_tried_is_not(store: KeyframeStore) -> None:
    loops = [
        candidate(0, 1),
        candidate(0, 2, overlap=0.3),
        candidate(0, 2, LoopStage.THINNED),
        candidate(1, 2, LoopStage.OVERLAP),
        candidate(0, 1, LoopStage.GRAPH),
    ]
    results = [ScanResult(10 * k, k * 10**9, T) for k, T in enumerate(TRUE)]
    trajectory = Trajectory(np.arange(3) * 10**9, TRUE)
    record = RunRecord("", "icp", None, results, trajectory, None, 0.1, loops=loops, keyframe_scans=np.arange(3))
    views = view_pairs(record, store, 1)
    assert [view.candidate for view in views] == [loops[4], loops[1], loops[3], loops[0]]
    assert all(len(view.a) <= FEW_POINTS for view in views)
    assert len(view_pairs(RunRecord(**{**vars(record), "loops": loops * 10}), store, 1)) == MOST_VIEWS
