"""The page of a drive in an old map: every scan held or carried as its record says, and what differs from the map."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_html import parse, scored
from test_page_data import data_of, unpack

from lslam.core.geometry import se3
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import Constraint, FixStatus, LoopCandidate, MapFix, Verdict
from lslam.core.types.run_record import Crispness, RunRecord
from lslam.reports.back_end import STATES, localization_figures, localization_tracks
from lslam.reports.facts import loop_residuals
from lslam.reports.html import render_report, with_new_map

MakeRecord = Callable[..., RunRecord]
STATUSES: list[FixStatus] = ["held", "held", "changed", "beyond", "unread", "held"]
CRISPNESS = Crispness(-3.21, 0.0009, 10, 20, 30, 0.5, 5)


def located(make_record: MakeRecord, scans: int = 60, **changes: Any) -> RunRecord:
    """Ten scans of each state in turn, the second ten held in doubt; six points of the map are gone and three not in it."""
    record = make_record(scans, **changes)
    fixes = []
    for k, result in enumerate(record.results):
        status = STATUSES[k * len(STATUSES) // scans]
        share, moved = (0.8, 0.01 + 0.001 * k) if status == "held" else (0.2, 0.0)
        is_doubtful = scans // 6 <= k < scans // 3
        fixes.append(MapFix(result.T_world_lidar, np.eye(6), status, 0.9, share, (moved, 0.0), "", is_doubtful))
    points = np.random.default_rng(0).uniform((-10, -5, 0), (60, 35, 8), (900, 3))
    change = np.zeros(900, np.int8)
    change[:6], change[6:9] = -1, 1
    found = {"voxel_m": 0.4, "gone": 2, "not_in_the_map": 1}
    manifest = {
        "status": "done",
        "localization": {"map": "runs/monday", "start": {"votes": 2, "tried": 3}, "differences": found},
    }
    return replace(
        record,
        map_fixes=fixes,
        map_sample=ArrayCloud(points, columns={"change": change}),
        manifest=record.manifest | manifest,
    )


def tiles(page: str) -> list[tuple[str, str]]:
    """Value and name of each."""
    return re.findall(r"<li><b>([^<]*)</b>[^<]*<span>([^<]*)</span>", page)


def test_the_states_of_the_page_are_those_of_the_records(make_record: MakeRecord) -> None:
    record = located(make_record)
    page = render_report(record, scored(record))
    data = data_of(page, "scans")
    words = [data["states"][code][0] for code in unpack(data["fixes"], "u1")]
    expected = [STATES["doubted" if fix.is_doubtful else fix.status][0] for fix in record.map_fixes]
    assert words == expected
    assert Counter(words)["held by the map"] == 20
    assert ("30/60", "scans held by the map") in tiles(page)
    assert "The drive on the map" in page
    assert "No map was made" not in page
    text = parse(page).text
    for said in (
        "held by the map, 20 scans",
        "held, the map has changed there, 10 scans",
        "carried by odometry, 30 scans",
    ):
        assert said in text
    assert "2 things gone, that beams passed through, and 1 thing not in it" in text
    assert ("2 + 1", "things gone + not in the map") in tiles(page)


def test_the_parts_of_the_trajectory_are_those_scans_and_leave_no_gap(make_record: MakeRecord) -> None:
    record = located(make_record)
    tracks, _ = localization_tracks(record)
    shown = {track.style: np.isfinite(track.xy).all(1) for track in tracks}
    own = {"s2": [*range(10), *range(50, 60)], "s4": range(10, 20), "carried": range(20, 50)}
    for style, scans in own.items():
        reach = {*scans, *(k + 1 for k in scans)} & set(range(60))
        assert set(np.flatnonzero(shown[style]).tolist()) == reach


def test_carried_scans_are_marked_over_distance(make_record: MakeRecord) -> None:
    record = located(make_record)
    agreement, correction = localization_figures(record)
    for figure in (agreement, correction):
        marks = re.findall(r'class="failed" d="([^"]+)"', figure.svg)
        assert "".join(marks).count("M") == 30
        assert figure.legend[-1] == ("failed", "carried by odometry, 30 scans")
    assert localization_figures(make_record(10)) == []


def test_what_differs_is_on_the_map_in_its_two_kinds(make_record: MakeRecord) -> None:
    record = located(make_record)
    page = render_report(record, None)
    cloud = data_of(page, "cloud")
    change = unpack(cloud["change"], "i1")
    shown = np.array(cloud["low"]) + np.array(cloud["step"]) * (unpack(cloud["points"], "<i2").reshape(-1, 3) + 32768.0)
    assert record.map_sample is not None
    for code, own in ((-1, slice(6)), (1, slice(6, 9))):
        expected = record.map_sample.points[own]
        np.testing.assert_allclose(np.sort(shown[change == code], axis=0), np.sort(expected, axis=0), atol=0.01)
    assert Counter(change.tolist()) == {0: 891, -1: 6, 1: 3}
    dots = {style: d.count("M") for style, d in re.findall(r'<path class="points (gone|appeared)" d="([^"]+)"', page)}
    assert dots == {"gone": 6, "appeared": 3}
    # A map of its own, built later, has none of it.
    own = replace(
        record,
        map_fixes=[],
        map_sample=make_record(60).map_sample,
        manifest=record.manifest | {"map": {"file": "map.ply"}},
    )
    renewed = with_new_map(page, replace(own, crispness=CRISPNESS))
    assert "change" not in data_of(renewed, "cloud")
    assert ("3.0", "thickness of planes in the map") in tiles(renewed)
    assert "Map entropy -3.21" in renewed


@pytest.mark.parametrize("is_located", [False, True])
def test_there_are_six_tiles_at_most_whatever_is_known(make_record: MakeRecord, is_located: bool) -> None:
    bad = {7: ("bridged", "too few")}
    record = located(make_record, bad=bad) if is_located else make_record(60, bad=bad)
    record.results[9] = replace(record.results[9], degenerate=np.eye(6)[:1])
    record.results[7] = replace(record.results[7], degenerate=np.eye(6)[:1])
    record = replace(record, crispness=CRISPNESS)
    page = render_report(record, scored(record))
    found = tiles(page)
    assert len(found) == 6
    assert ("3.3", "scans bridged, skipped or degenerate") in found
    assert any(name.startswith("ATE rmse") for _, name in found)


def test_without_truth_a_tile_says_what_is_left_at_loops(make_record: MakeRecord) -> None:
    record = make_record(40, with_truth=False)
    assert [name for _, name in tiles(render_report(record, None))].count("real time") == 1
    poses = record.trajectory.poses
    loops = []
    for a, b, off in ((0, 30, 0.05), (5, 35, 0.2), (8, 20, 9.0)):
        T = se3.relative(poses[a], poses[b]) @ se3.make(np.eye(3), np.array([off, 0.0, 0.0]))
        loops.append(
            LoopCandidate(
                a,
                b,
                1.0,
                0.1,
                Verdict.ACCEPTED if off < 1 else Verdict.REJECTED,
                "registration",
                constraint=Constraint(a, b, T, np.eye(6)),
            )
        )
    closed = replace(record, loops=loops, keyframe_scans=np.arange(40))
    np.testing.assert_allclose(loop_residuals(closed), [0.05, 0.2], atol=1e-9)
    assert ("0.125", "left at 2 loops, median") in tiles(render_report(closed, None))
    control = record.manifest | {
        "graph": {"control_points": {"count": 4, "rms_horizontal_m": 0.03, "rms_vertical_m": 0.1, "worst_sigmas": 2.0}}
    }
    assert ("0.030", "rms at 4 control points, horizontally") in tiles(
        render_report(replace(closed, manifest=control), None)
    )
    moved = located(make_record, with_truth=False)
    assert ("0.025", "correction by the map a scan, median") in tiles(render_report(moved, None))


def test_ten_thousand_scans_in_an_old_map_stay_small(make_record: MakeRecord) -> None:
    record = located(make_record, 10_000)
    rng = np.random.default_rng(0)
    record.map_image = rng.poisson(2.0, (1600, 1600)).astype(np.float32)
    record.map_heights = rng.uniform(0, 9, (1600, 1600)).astype(np.float32)
    change = rng.integers(-1, 2, 150_000).astype(np.int8)
    record.map_sample = ArrayCloud(rng.uniform(0, 900, (150_000, 3)), columns={"change": change})
    assert len(render_report(record, scored(record))) < 6_000_000
