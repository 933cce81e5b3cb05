"""The building pages: every outline, wall and refusal is drawn or counted, and the picture keeps the corners."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.building import (
    Building,
    BuildingCorrection,
    BuildingMatch,
    CorrectedMap,
    Footprint,
    KeyframeMatch,
    OsmMatches,
)
from lslam.core.types.run_record import RunRecord
from lslam.reports.back_end import back_end_rows
from lslam.reports.buildings import MOST_ROWS, building_figures, building_pages, building_tables, drift_tables

Floats = NDArray[np.float64]

SQUARE = np.array([[0.0, 0.0], [10, 0], [10, 8], [0, 8]])


def scene(houses: int = 4) -> tuple[CorrectedMap, OsmMatches, Floats]:
    buildings = tuple(
        Building(
            f"way/{k}", (Footprint(SQUARE + np.array([14.0 * k, 5])),), tags={"name": "Town hall"} if k == 1 else {}
        )
        for k in range(houses)
    )
    status = ["seen", "seen", "absent", "unseen"]
    corrected = tuple(
        BuildingCorrection(b, np.array([0.1 * k, -0.2, 0.01]), 0.01 * np.eye(3), status[k % 4], 5 - k % 4, k % 2)  # type: ignore[arg-type]
        for k, b in enumerate(buildings)
    )
    poses = np.column_stack([np.linspace(0, 50, 6), np.zeros(6), np.zeros(6)])
    wall = np.array([[[2.0, 5.0], [8.0, 5.0]]])
    keyframes = tuple(
        KeyframeMatch(k, wall, np.zeros((1, 2)), poses[k], np.ones(3), poses[k], np.eye(3), rank=3 if k < 3 else 2,
                      kind="edges" if k < 3 else "lines", verdict="accepted" if k != 5 else "rejected",
                      reason="" if k != 5 else "7.1 times as far from odometry as it may have drifted")
        for k in range(6)
    )  # fmt: skip
    local = (
        BuildingMatch(0, 0, np.zeros(3), np.eye(3), 3, "edges", 50.0, 0.5, 0.1, np.zeros((1, 2), np.int64)),
        BuildingMatch(1, 0, np.zeros(3), np.eye(3), 3, "edges", 50.0, 0.5, 0.1, np.zeros((1, 2), np.int64), "rejected",
                      "another place fits nearly as well"),
    )  # fmt: skip
    matches = OsmMatches(np.zeros(3), buildings, np.zeros((0, 2, 2)), np.zeros(0, np.int64), keyframes, local)
    new = np.array([[[0.0, -9.0], [6.0, -9.0]]])
    return (
        CorrectedMap(np.zeros(3), corrected, "two-level", np.array([0.3, -0.1]), new, ((0, 1),), "© OSM"),
        matches,
        poses,
    )


def paths(svg: str, style: str) -> int:
    return len(re.findall(rf'class="line {style}"', svg))


def test_the_plan_shows_each_building_before_and_after_with_the_walls_seen() -> None:
    found, matches, poses = scene()
    plan, holds = building_figures(found, matches, poses)
    drawn = {style: paths(plan.svg, style) for style in ("gt", "s1", "s2", "s4", "s5")}
    assert drawn == {"gt": 4, "s1": 3, "s2": 1, "s4": 1, "s5": 6}
    assert "© OSM" in plan.caption
    assert "5 of 6 keyframes" in holds.caption
    assert [label for _, label in holds.legend][1:] == [
        "held by walls of two directions", "held across parallel walls only", "match not used",
    ]  # fmt: skip
    assert holds.svg.count("cross") == 1


def test_a_large_map_keeps_its_corners_and_the_page_its_size() -> None:
    found, matches, poses = scene(1200)
    way = np.column_stack([np.linspace(0, 17000, 6), np.zeros(6), np.zeros(6)])
    plan, _ = building_figures(found, matches, way)
    assert paths(plan.svg, "gt") == 1200
    far = building_figures(found, matches, poses)[0]
    assert paths(far.svg, "gt") == 6


def test_the_tables_name_displacements_and_refusals() -> None:
    found, matches, _ = scene()
    moves, verdicts = building_tables(found, matches)
    assert [row[:2] for row in moves.rows] == [
        ("way/2", "absent"), ("way/1 Town hall", "seen"), ("way/0", "seen"), ("way/3", "unseen"),
    ]  # fmt: skip
    assert moves.rows[1][2:] == ("+0.10", "-0.20", "+0.57", "1.00", "4", "1")
    assert "4 buildings: 2 seen, 1 not, 1 absent" in moves.recipe
    assert "the map as a whole lies -0.30 m east and +0.10 m north of the run; 1 pair still overlap" in moves.recipe
    assert ("keyframe on the map", "… times as far from odometry as it may have drifted", "1") in verdicts.rows
    assert ("building on the walls seen", "another place fits nearly as well", "1") in verdicts.rows
    assert sum(int(row[2]) for row in verdicts.rows) == 8
    many, matches, _ = scene(200)
    assert len(building_tables(many, matches)[0].rows) == MOST_ROWS


def test_an_empty_map_draws_the_way() -> None:
    found = CorrectedMap(np.zeros(3), (), "two-level")
    _, matches, poses = scene()
    nothing = OsmMatches(np.zeros(3), (), np.zeros((0, 2, 2)), np.zeros(0, np.int64), (), ())
    plan, holds = building_figures(found, nothing, poses)
    assert plan.svg == ""
    assert paths(holds.svg, "gt") == 1
    moves, verdicts = building_tables(found, nothing)
    assert moves.rows == verdicts.rows == ()
    assert matches.accepted_matches


def test_a_corrected_drift_is_reported_with_its_sigma(make_record: Callable[..., RunRecord]) -> None:
    found, matches, poses = scene()
    record = make_record(len(poses), buildings=found, osm=matches)
    record.keyframe_scans = np.arange(len(poses))
    pages = building_pages(record)
    assert pages is not None
    assert "Steady drift of odometry" not in [table.title for table in pages.tables]
    assert "steady drift" not in dict(back_end_rows(record, None))
    claim = {
        "east_percent": {"estimate": -2.4, "sigma": 0.1234}, "north_percent": {"estimate": 3.2, "sigma": 0.2},
        "left_deg_per_100m": {"estimate": 1.5, "sigma": 0.03}, "log_likelihood_gain": 61.25, "gain_by_chance": 13.9,
    }  # fmt: skip
    record.manifest = {"graph": {"steady_drift": claim}}
    pages = building_pages(record)
    assert pages is not None
    (table,) = [table for table in pages.tables if table.title == "Steady drift of odometry"]
    assert table.rows == (
        ("to the east, %", "-2.400", "0.123"), ("to the north, %", "+3.200", "0.200"),
        ("turn to the left, deg/100 m", "+1.500", "0.030"),
    )  # fmt: skip
    assert "higher with the drift by 61.2; chance stays below 13.9." in table.recipe
    said = dict(back_end_rows(record, None))["steady drift"]
    assert said.startswith("to the east, % -2.400 ± 0.123; ")
    assert said.endswith("+1.500 ± 0.030, set right")
    assert "walls moved while they were passed" in table.recipe


def test_a_drift_estimated_by_loops_is_reported_along_the_axes_of_the_run(
    make_record: Callable[..., RunRecord],
) -> None:
    record = make_record(10)
    told = {"estimate": 0.5, "sigma": 0.01}
    names = ["x_percent", "y_percent", "z_percent", "about_x_deg_per_100m", "about_y_deg_per_100m", "left_deg_per_100m"]
    claim = dict.fromkeys(names, told) | {"log_likelihood_gain": 60.0, "gain_by_chance": 11.2}
    record.manifest = {"graph": {"steady_drift": claim}}
    (table,) = drift_tables(record)
    assert [word for word, _, _ in table.rows] == [
        "along x, %", "along y, %", "along z, %", "turn about x, deg/100 m", "turn about y, deg/100 m",
        "turn to the left, deg/100 m",
    ]  # fmt: skip
    assert "loops over different ways tell one rate" in table.recipe
    assert dict(back_end_rows(record, None))["steady drift"].startswith("along x, % +0.500 ± 0.010; ")


def test_a_wandering_drift_is_reported_with_its_size(make_record: Callable[..., RunRecord]) -> None:
    record = make_record(10)
    told = {"estimate": 0.5, "sigma": 0.01, "rms": 1.25}
    names = ["east_percent", "north_percent", "left_deg_per_100m"]
    claim = dict.fromkeys(names, told) | {"log_likelihood_gain": 60.0, "gain_by_chance": 11.2}
    record.manifest = {"graph": {"wandering_drift": claim}}
    (table,) = drift_tables(record)
    assert table.title == "Wandering drift of odometry"
    assert table.header == ("drift", "estimate", "sigma", "rms, from place to place")
    assert table.rows[0] == ("to the east, %", "+0.500", "0.010", "1.250")
    said = dict(back_end_rows(record, None))["wandering drift"]
    assert said.startswith("to the east, % +0.500 ± 0.010 (rms 1.250); ")
    assert said.endswith("(rms 1.250), set right")


def test_the_summary_counts_buildings(make_record: Callable[..., RunRecord]) -> None:
    found, _, _ = scene()
    rows = dict(back_end_rows(make_record(10, buildings=found), None))
    assert rows["buildings"] == "2 seen, moved by 0.21 m (median); 1 absent; 1 wall without a building; 1 overlap left"
    nothing = CorrectedMap(np.zeros(3), (), "prior")
    rows = dict(back_end_rows(make_record(10, buildings=nothing), None))
    assert rows["buildings"] == "0 seen; 0 absent; 0 walls without a building; 0 overlaps left"
