"""What summary and report say of loops and fixes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lslam.config.eval import EvalConfig
from lslam.evaluation.evaluate import evaluate
from lslam.geometry import se3
from lslam.reports.back_end import back_end_figures, back_end_rows
from lslam.types.building import OsmMatches
from lslam.types.constraint import LoopCandidate
from lslam.types.gnss import Georeference
from lslam.types.run_record import RunRecord


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
    assert any(label.startswith("3 sigma, drawn") for label in labels)
    # Before, after, one loop and sixteen ellipses.
    assert figure.svg.count('class="line') == 19


@pytest.mark.parametrize(("variance", "said"), [(1e-4, "3 sigma, drawn 100 times as large"), (100.0, "3 sigma")])
def test_ellipses_are_enlarged_until_they_are_seen(
    make_record: Callable[..., RunRecord], variance: float, said: str
) -> None:
    record = make_record(40)
    record.odometry = replace(record.trajectory, poses=record.trajectory.poses + 0.1)
    record.trajectory = replace(record.trajectory, covariances=np.tile(variance * np.eye(6), (40, 1, 1)))
    assert said in [label for _, label in back_end_figures(record, None)[0].legend]


def test_the_shift_of_the_map_is_not_drawn_about_each_pose(make_record: Callable[..., RunRecord]) -> None:
    """A trajectory known to a centimetre on a map known to two metres: the ellipses are those of the trajectory."""
    record = make_record(40)
    record.odometry = replace(record.trajectory, poses=record.trajectory.poses + 0.1)
    own = np.tile(1e-4 * np.eye(6), (40, 1, 1))
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
    assert "3 sigma beside the map's own shift, drawn 100 times as large" in [label for _, label in figure.legend]


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
