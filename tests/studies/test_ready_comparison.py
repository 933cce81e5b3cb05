"""The comparisons that ship: what they run, what they say of it, and that the same command goes on."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lslam.core.types.comparison import Comparison, RunScore
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.readers import open_sequence
from lslam.simulation.scenario_files import scenario_names
from lslam.studies.compare import Plan, run_comparison
from lslam.studies.grid import Cell
from lslam.studies.options import OutputOptions
from lslam.studies.ready_comparison import comparison_names, find_comparison
from lslam.studies.subjects import Subject

SAMPLE = Path(__file__).parents[2] / "sample_data" / "sequences" / "00"


def runs_of(sequence: str, method: str, key: str, *values: float, angular: float = 1.0) -> list[RunScore]:
    scores = [{key: value, "thesis_angular": angular, "thesis_angular_max": 4 * angular} for value in values]
    return [RunScore(sequence, method, seed, Path(), "done", values=score) for seed, score in enumerate(scores)]


@pytest.mark.parametrize("name", comparison_names())
def test_what_is_printed_and_stated_is_of_what_is_run(name: str) -> None:
    """A number of a drive or a system that nobody runs would never be judged."""
    ready = find_comparison(name)
    systems = {variant.name.split("@")[0] for variant in ready.variants(())}
    assert set(ready.sequences) <= set(scenario_names())
    assert set(ready.quick.sequences) <= set(ready.sequences)
    assert {printed.sequence for printed in ready.numbers} <= set(ready.sequences)
    assert {system for printed in ready.numbers for system in printed.values} <= systems
    assert {end for stated in ready.claims for end in (stated.left, stated.right)} <= systems


def test_numbers_are_those_of_the_theses() -> None:
    girolimetto, del_tufo = find_comparison("girolimetto"), find_comparison("del-tufo")
    assert girolimetto._number("closed", "thesis-icp", "before") == 2.046  # table 4.3
    assert girolimetto._number("closed-hard", "thesis-icp", "after") == 1.169  # table 4.3
    assert girolimetto._number("small-eight", "thesis-loam-map+imu", "after") == 0.360  # table 5.4
    assert girolimetto._number("open", "thesis-loam+imu", "before") is None
    assert del_tufo._number("residential", "thesis-improved@mild", "ate") == 1.223  # table 4.2


def test_a_number_and_an_order_are_judged_by_runs() -> None:
    ready, key = find_comparison("girolimetto"), "odometry.thesis_rmse"
    runs = runs_of("open", "thesis-icp", key, *[0.1] * 5)
    runs += runs_of("open", "thesis-icp+imu", key, *[0.3] * 5, angular=1.5)
    numbers, stated, _ = ready.beside(runs)
    rows = {(row[1], row[2]): row[3:] for row in numbers.rows}
    assert rows["thesis-icp", "rmse before the graph, m"][:4] == ("0.843", "0.1 / 0.1", "easier", "undecided")
    assert rows["thesis-icp+imu", "rmse before the graph, m"][:4] == ("0.418", "0.3 / 0.3", "as hard", "reproduced")
    row, angular, time = stated.rows
    assert (time[0], time[3]) == ("the IMU costs ICP a little time", "undecided")  # no run has a time
    assert (angular[0], angular[3]) == ("the IMU lowers the angular error of ICP", "refuted")
    assert row[:4] == ("the IMU makes ICP more accurate", "open", "0.50", "refuted")
    assert row[4] == "so in 0 of 5 seeds; median ratio 3.00"


@pytest.mark.parametrize(("is_alone", "verdict"), [(True, "refuted"), (False, "undecided")])
def test_times_are_compared_of_runs_that_had_the_machine_alone_and_judged_by_the_limit(
    is_alone: bool, verdict: str
) -> None:
    ready = find_comparison("girolimetto")
    times = {"thesis-loam-map": 80.0, "thesis-loam-map+imu": 120.0, "thesis-icp": 450.0}
    runs = [
        replace(run, is_timed_alone=is_alone, limit=0.4)
        for name, ms in times.items()
        for run in runs_of("open", name, "time.mean", *[ms] * 5)
    ]
    numbers, stated, _ = ready.beside(runs)
    said = {row[0]: row[2:5] for row in stated.rows}
    ratio, decided, why = said["the IMU saves LOAM map a fifth of its time"]
    assert (ratio, decided) == ("0.78", verdict)  # table 5.3: 0.172 / 0.221 s, -22 %
    assert ("runs shared the machine" in why) != is_alone
    kept = {row[1]: row[3:7:3] for row in numbers.rows if row[2] == "time per scan, s"}
    assert kept == {
        "thesis-loam-map": ("0.221", "reproduced"),
        "thesis-loam-map+imu": ("0.172", "reproduced"),
        "thesis-icp": ("0.115", "undecided"),
    }


def test_share_of_the_length_and_errors_per_axis() -> None:
    ready = find_comparison("girolimetto")
    values = {"thesis_rmse": 1.2, "path": 812.25, "thesis_z": 0.4, "inlier_share": 0.5}
    numbers, _, unprinted = ready.beside([RunScore("closed", "thesis-icp", 0, Path(), "done", values=values)])
    (percent,) = [row for row in numbers.rows if "% of length" in row[2]]
    assert percent[3:5] == ("0.14", "0.1477 / 0.1477")  # 100 * 1.2 / 812.25
    (row,) = [dict(zip(unprinted.header, row, strict=True)) for row in unprinted.rows]
    assert (row["z, m"], row["share of inliers"], row["x, m"]) == ("0.4 / 0.4", "0.5 / 0.5", "failed / failed")


def test_a_further_system_runs_where_a_number_of_it_is_printed() -> None:
    ready = find_comparison("girolimetto")
    (integrated,) = [v for v in ready.variants(()) if v.config.imu.velocity == "integrated"]
    assert integrated.uses_imu
    runs = {
        drive: integrated in ready.variants_on(ready.variants(()), Cell(drive, SAMPLE, 0, ""), Path())
        for drive in ready.sequences
    }
    assert [drive for drive, is_run in runs.items() if is_run] == ["open", "open-hard"]


def test_a_system_on_a_map_is_judged_against_one_without_and_one_on_the_same() -> None:
    ready = find_comparison("del-tufo")
    systems = {"hdl": 1.0, "thesis-baseline@mild": 2.0, "thesis-improved@mild": 0.5}
    runs = [run for name, ate in systems.items() for run in runs_of("residential", name, "planar_ate", *[ate] * 5)]
    _, stated, unprinted = ready.beside(runs)
    assert not unprinted.rows
    said = {row[0]: row[1:4] for row in stated.rows if "smoother" not in row[0]}
    assert said == {
        "the improved system is more accurate than hdl_graph_slam": ("residential@mild", "0.73", "reproduced"),
        "the baseline is more accurate than hdl_graph_slam": ("residential@mild", "0.92", "refuted"),
        "the improved system is more accurate than the baseline": ("residential@mild", "0.79", "reproduced"),
    }


def test_maps_are_wrong_as_it_is_said(tmp_path: Path) -> None:
    ready = find_comparison("del-tufo")
    cell = Cell("residential", SAMPLE, 3, "")
    configs = {variant.name: variant.config for variant in ready.variants_on(ready.variants(()), cell, tmp_path)}
    assert {config.debug.drift_seed for config in configs.values()} == {3}
    assert not configs["hdl"].osm.extract
    extracts = {kind: Path(configs[f"thesis-improved@{kind}"].osm.extract) for kind in ready.maps}
    assert (extracts["exact"], extracts["wrong"]) == (SAMPLE / "map.osm", SAMPLE / "map_perturbed.osm")
    origin = np.array(configs["thesis-improved@exact"].osm.origin)
    middles = []
    for kind in ("exact", "mild"):
        middles.append({b.osm_id: b.middle for b in read_buildings(extracts[kind], origin)[1].buildings})
    assert middles[0].keys() == middles[1].keys()
    away = np.array([np.linalg.norm(middles[1][name] - middles[0][name]) for name in middles[0]])
    assert away.max() <= 0.3 + 0.6 + 0.05
    assert np.median(away) > 0.1


def made(out: Path) -> Comparison:
    few = {"methods": ("thesis-loam",), "imu": "off", "settings": ("input.count=8",), "systems": {}}
    ready = find_comparison("girolimetto").model_copy(update=few)
    subjects = (Subject("open", scenario="open"),)
    output = OutputOptions(out, resume=out.is_dir(), command="lslam")
    plan = Plan(subjects, tuple(ready.variants(())), (5,), output, ready=ready)
    return run_comparison(plan)


@pytest.mark.usefixtures("forked_runs")
def test_it_runs_says_what_came_of_it_and_runs_nothing_twice(tmp_path: Path) -> None:
    out = tmp_path / "out"
    first, again = made(out), made(out)
    assert [run.is_reused for run in (*first.runs, *again.runs)] == [False, True]
    assert again.beside == first.beside
    (run,) = first.runs
    assert 0 < run.values["odometry.thesis_rmse"] == run.values["thesis_rmse"]
    assert 0 < run.values["inlier_share"] < 1
    axes = [run.values[f"thesis_{axis}"] for axis in "xyz"]
    assert np.linalg.norm(axes) == pytest.approx(
        np.sqrt(3) * run.values["thesis_rmse"]
    )  # both are over 3 N coordinates
    assert len(open_sequence(out / "simulated" / "open-5-29" / "sequences" / "00")) == 29
    assert "number by number" in (out / "compare.html").read_text()
    assert "| open " in (out / "beside.md").read_text()
    rows = list(csv.reader((out / "beside.csv").read_text().splitlines()))
    assert rows[1][:4] == ["open", "thesis-loam", "rmse before the graph, m", "0.844"]
    (run.folder / "scans.csv").write_text("index,status,source_points\n1,ok,many\n")
    (broken,) = made(out).runs
    assert (broken.status, "scans.csv cannot be read" in broken.reason) == ("failed", True)
