"""Loop candidates of a page: what is listed, in which order, and how large it gets."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from lslam.backend.loops.find_loops import FEW_POINTS, MOST_VIEWS
from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.core.types.run_record import PairView, RunRecord
from lslam.reports.page_data import candidate_data, pair_data


def rejected(k: int, stage: LoopStage = LoopStage.OVERLAP) -> LoopCandidate:
    return LoopCandidate(k % 25, 25 + k % 4, 9.0, 0.3, Verdict.REJECTED, stage, f"reason {k}")


def view(candidate: LoopCandidate, count: int = FEW_POINTS) -> PairView:
    points = np.random.default_rng(3).uniform(-60, 60, (count, 3)).astype(np.float32)
    return PairView(candidate, points, points, np.eye(4), None)


def unpacked(cloud: Any) -> Any:
    quanta = np.frombuffer(base64.b64decode(cloud["points"]), "<i2").reshape(-1, 3)
    return np.array(cloud["low"]) + np.array(cloud["step"]) * (quanta + 32768.0)


def test_candidates_are_listed_by_doubt_with_the_poses_of_their_scans(make_record: Callable[..., RunRecord]) -> None:
    loops = [
        LoopCandidate(1, 20, 3.0, 0.2, Verdict.ACCEPTED, LoopStage.AGREEMENT, "", 0.05, 0.75),
        rejected(2, LoopStage.THINNED),
        rejected(3),
        rejected(4, LoopStage.CONSISTENCY),
        LoopCandidate(0, 22, 3.0, 0.2, Verdict.ACCEPTED, LoopStage.MANUAL, "", 0.05, 0.2),
    ]
    record = make_record(60, loops=loops, keyframe_scans=np.arange(0, 60, 2), pair_views=[view(loops[3], 9)])
    data = candidate_data(record)
    assert data is not None
    listed = data["candidates"]
    assert [one["poses"] for one in listed] == [[8, 50], [2, 40], [6, 56], [0, 44]]
    assert [one["doubt"] for one in listed] == [0.667, 0.25, 0.222, 0.0]
    assert (listed[0]["reason"], listed[0]["overlap"], listed[1]["overlap"]) == ("reason 4", None, 0.75)
    assert list(data["views"]) == ["0"], "by its place in the list"
    json.dumps(data, allow_nan=False)


def test_clouds_come_back_and_a_page_of_them_stays_small(make_record: Callable[..., RunRecord]) -> None:
    one = view(rejected(0))
    np.testing.assert_allclose(unpacked(pair_data(one)["a"]), one.a, atol=120 / 65535)
    loops = [rejected(k) for k in range(300)]
    record = make_record(
        60, loops=loops, keyframe_scans=np.arange(60), pair_views=[view(c) for c in loops[:MOST_VIEWS]]
    )
    data = candidate_data(record)
    assert data is not None
    assert len(data["views"]) == MOST_VIEWS
    assert len(json.dumps(data)) < 600_000
    assert (
        pair_data(
            PairView(loops[0], np.zeros((0, 3), np.float32), np.full((2, 3), np.nan, np.float32), np.eye(4), None)
        )["b"]["count"]
        == 0
    )


def test_a_run_that_is_located_in_a_map_has_none(make_record: Callable[..., RunRecord]) -> None:
    assert candidate_data(make_record(12, map_fixes=[object()])) is None
    assert candidate_data(make_record(12)) == {"candidates": [], "views": {}, "crs": ""}
