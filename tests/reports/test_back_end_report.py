"""What summary and report say of loops and fixes."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lslam.core.config.outputs import EvalConfig
from lslam.core.geometry import se3
from lslam.core.types.building import OsmMatches
from lslam.core.types.constraint import LoopCandidate
from lslam.core.types.gnss import Georeference
from lslam.core.types.run_record import LoopSurroundings, LoopView, RunRecord
from lslam.evaluation.evaluate import evaluate
from lslam.reports.back_end import back_end_figures, back_end_rows, loop_figures


def test_a_run_without_a_back_end_says_nothing(make_record: Callable[..., RunRecord]) -> None:
    record = make_record(40)
    assert back_end_rows(record, None) == []
    assert back_end_figures(record, None) == []


def test_loops_and_fixes_are_counted_and_drawn(make_record: Callable[..., RunRecord]) -> None:
    record = make_record(40)
    shift = se3.make(np.eye(3), np.array([0.5, 0.0, 0.0]))
    record.odometry = replace(record.trajectory, poses=shift @ record.trajectory.poses)
    record.trajectory = replace(record.trajectory, covariances=np.tile(1e-4 * np.eye(6), (40, 1, 1)))
    record.keyframe_scans = np.arange(0, 40, 2)
    record.loops = [
        LoopCandidate(0, 15, 1.0, 0.1, "accepted", "agreement"),
        LoopCandidate(1, 16, 1.0, 0.1, "rejected", "overlap", "too little"),
        LoopCandidate(1, 17, 1.0, 0.1, "rejected", "thinned", "another is near"),
    ]
    record.georeference = Georeference(np.array([49.0, 8.4, 115.0]), np.eye(4), fixes=10, used=9, rmse_horizontal=0.5)
    rows = dict(back_end_rows(record, None))
    assert rows["loops"] == "1 closed of 2 tried"
    assert "9 of 10 fixes" in rows["georeference"]
    assert "49.0000000, 8.4000000" in rows["georeference"]
    (figure,) = back_end_figures(record, None)
    labels = [label for _, label in figure.legend]
    assert "1 loop closed" in labels
    assert "odometry" in labels
    # Before, after and one loop; ellipses of 3 cm are no pixel of a plan of 55 m.
    assert figure.svg.count('class="line') == 3
    assert "moved poses by at most 0.500 m" in figure.caption
    assert "3 sigma: at most 0.030 m, too small to be drawn" in figure.caption


def test_what_cannot_be_seen_is_said_and_what_is_drawn_is_to_scale(make_record: Callable[..., RunRecord]) -> None:
    record = make_record(40)
    shift = se3.make(np.eye(3), np.array([0.0, 0.003, 0.0]))
    record.odometry = replace(record.trajectory, poses=shift @ record.trajectory.poses)
    record.trajectory = replace(record.trajectory, covariances=np.tile(np.eye(6), (40, 1, 1)))
    (figure,) = back_end_figures(record, None)
    assert figure.title == "After the pose graph"
    assert [label for _, label in figure.legend] == ["after the pose graph", "3 sigma, to scale"]
    assert "moved poses by at most 0.0030 m" in figure.caption
    # An ellipse, here a circle of 3 m, against the ticks of the plan.
    ring = re.findall(r'class="line s4" d="M([^"]+)"', figure.svg)[0]
    drawn = np.ptp(np.array(re.findall(r"[\d.]+", ring), float).reshape(-1, 2)[:, 0])
    x0, x1, _, _, left, right, *_ = map(float, re.findall(r'data-view="([^"]+)"', figure.svg)[0].split())
    assert drawn * (x1 - x0) / (right - left) == pytest.approx(6.0, abs=0.05)


def test_a_loop_is_shown_where_it_moved_the_map_by_a_pixel(make_record: Callable[..., RunRecord]) -> None:
    points = np.random.default_rng(0).uniform(-10, 10, (500, 3))
    at = LoopSurroundings(points, points[:5, :2], points[5:9, :2], np.zeros(2))
    assert loop_figures(LoopView(1, 9, 0.2, at, at)) == []
    figures = loop_figures(LoopView(1, 9, 0.6, at, at))
    assert [f.title for f in figures] == ["Map at a loop, before the pose graph", "Map at a loop, after the pose graph"]


def test_the_shift_of_the_map_is_not_drawn_about_each_pose(make_record: Callable[..., RunRecord]) -> None:
    """A trajectory known to half a metre on a map known to two metres: the ellipses are those of the trajectory."""
    record = make_record(40)
    record.odometry = replace(record.trajectory, poses=record.trajectory.poses + 0.1)
    own = np.tile(0.25 * np.eye(6), (40, 1, 1))
    record.trajectory = replace(record.trajectory, covariances=own)
    alone = back_end_figures(record, None)[0]
    sigma = np.array([2.0, 1.5])
    none = (np.zeros((0, 2, 2)), np.zeros(0, np.int64), (), ())
    record.osm = OsmMatches(np.zeros(3), (), *none, shift_sigma=sigma)
    shifted = own.copy()
    shifted[:, :2, :2] += np.diag(sigma**2)
    record.trajectory = replace(record.trajectory, covariances=shifted)
    figure = back_end_figures(record, None)[0]
    assert figure.svg == alone.svg
    assert "3 sigma beside the map's own shift, to scale" in [label for _, label in figure.legend]


def test_the_error_is_drawn_before_and_after(make_record: Callable[..., RunRecord]) -> None:
    record = make_record(40)
    assert record.ground_truth is not None
    record.odometry = record.trajectory
    halfway = record.ground_truth.poses.copy()
    halfway[:, :3, 3] += 0.5 * (record.trajectory.positions - halfway[:, :3, 3])
    record.trajectory = replace(record.trajectory, poses=halfway)
    before, after = (evaluate(t, record.ground_truth, EvalConfig()) for t in (record.odometry, record.trajectory))
    figures = back_end_figures(record, replace(after, odometry=before))
    assert [f.title for f in figures][1:] == ["Position error before and after the pose graph"]
    was, now = (e.ate["se3"].translation for e in (before, after))
    assert was is not None
    assert now is not None
    assert now.rmse < 0.6 * was.rmse
    assert f"ATE se3 {was.rmse:.3f} m before the pose graph, {now.rmse:.3f} m after" in figures[1].caption
    assert figures[1].svg.count('class="line') == 2
    assert len(back_end_figures(record, after)) == 1, "nothing is said of odometry that was not scored"


def test_a_graph_that_moved_nothing_draws_nothing(make_record: Callable[..., RunRecord]) -> None:
    record = make_record(40)
    record.odometry = record.trajectory
    assert back_end_figures(record, None) == []
