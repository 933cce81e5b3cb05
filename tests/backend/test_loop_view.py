"""The map at a loop: a wall seen twice is doubled by odometry's poses and one wall by the final ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.outcome import CLOUD_KEYFRAMES, BackEnd, view_loop
from lslam.core.geometry import se3
from lslam.core.types.constraint import Constraint, LoopCandidate, Verdict
from lslam.core.types.run_record import RunRecord
from lslam.core.types.trajectory import Keyframe, Trajectory
from lslam.reports.back_end import loop_figures

COUNT, DRIFT, WALL = 60, 0.05, 7.0
SOLVED = BackEnd([], [], constraints=[Constraint(0, 1, np.eye(4), np.eye(6))])


def poses_of(drift: float) -> NDArray[np.float64]:
    """There and back again beside a wall at y = `WALL`; odometry drifts sideways by so much per keyframe."""
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    k = np.arange(COUNT)
    poses[:, 0, 3], poses[:, 1, 3] = np.minimum(k, COUNT - 1 - k), drift * k
    return poses


def loop(a: int, b: int, verdict: Verdict = "accepted") -> LoopCandidate:
    return LoopCandidate(a, b, 1.0, 0.1, verdict, "agreement")


@pytest.fixture
def store() -> KeyframeStore:
    found, rng = KeyframeStore(), np.random.default_rng(0)
    for k in range(COUNT):
        points = np.column_stack([rng.uniform(-8, 8, 300), np.full(300, WALL), rng.uniform(-1, 3, 300)])
        found.add(Keyframe(k, 2 * k, 10**9 * k, poses_of(DRIFT)[k]), points.astype(np.float32))
    return found


@pytest.fixture
def record() -> RunRecord:
    """Every second of 119 scans is a keyframe; the trajectory's world is another than odometry's."""
    stamps = 10**9 * np.arange(2 * COUNT - 1)

    def trajectory(drift: float) -> Trajectory:
        return Trajectory(stamps, np.repeat(poses_of(drift), 2, axis=0)[:-1], frame="lidar", source="test")

    turned = se3.make(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([100.0, 50.0, 0.0]))
    after = trajectory(0.0)
    record = RunRecord("a", "icp", Path(), [], Trajectory(stamps, turned @ after.poses), None, 0.1)
    record.odometry, record.T_final_odometry = trajectory(DRIFT), turned
    record.keyframe_scans = 2 * np.arange(COUNT)
    record.loops = [loop(20, 39), loop(5, 54), loop(0, 59, "rejected")]
    return record


def test_the_loop_that_was_corrected_most_is_shown(record: RunRecord, store: KeyframeStore) -> None:
    view = view_loop(record, SOLVED, store)
    assert view is not None
    assert (view.older_scan, view.newer_scan) == (10, 108)
    assert view.correction == pytest.approx(DRIFT * 49)
    back = se3.inverse(record.T_final_odometry)
    walls = [se3.apply(back, place.points)[:, 1] for place in (view.before, view.after)]
    np.testing.assert_allclose(walls[1], WALL, atol=1e-5)
    drifted = WALL + DRIFT * np.r_[0 : 5 + CLOUD_KEYFRAMES + 1, 54 - CLOUD_KEYFRAMES : COUNT]
    np.testing.assert_allclose(np.unique(walls[0].round(4)), drifted, atol=1e-3)
    assert (len(view.after.older), len(view.after.newer)) == (5 + CLOUD_KEYFRAMES + 1, COUNT - 54 + CLOUD_KEYFRAMES)
    np.testing.assert_allclose(view.after.centre, record.trajectory.positions[10, :2])


def test_both_maps_are_drawn_with_the_ways(record: RunRecord, store: KeyframeStore) -> None:
    figures = loop_figures(view_loop(record, SOLVED, store))
    assert [figure.title for figure in figures] == [
        "Map at a loop, before the pose graph", "Map at a loop, after the pose graph",
    ]  # fmt: skip
    for figure in figures:
        assert figure.svg.count("data:image/png") == 1
        assert figure.svg.count('class="line') == 2
        assert "by 2.45 m" in figure.caption
    assert figures[0].svg != figures[1].svg


def test_without_a_closed_loop_or_a_graph_there_is_nothing_to_show(record: RunRecord, store: KeyframeStore) -> None:
    assert loop_figures(None) == []
    loops, record.loops = record.loops, [loop(0, 59, "rejected")]
    assert view_loop(record, SOLVED, store) is None
    record.loops = loops
    assert view_loop(record, BackEnd([], loops), store) is None, "a graph that failed, in a world levelled since"
