"""`lslam deliver` of runs that lack a place, a map or an end, and to folders that are there or full: said, and all or nothing."""

from __future__ import annotations

import json
import re
import resource
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from calling import assert_one_sentence, lslam, strict_json
from made_runs import (
    AT_48,
    FILES,
    ORIGIN,
    PER_DEGREE,
    SCANS,
    T_ENU_WORLD,
    MadeRun,
    coordinates,
    delivered,
    far_point,
    flat,
    is_in,
    made,
    placed,
    point_file,
    refused,
    rows_of,
    text_of,
    truth_in,
    world_of,
)

from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.core.types.gnss import Georeference
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.formats.trajectory_lines import write_tum
from lslam.pipeline.back_end_pass import describe
from lslam.pipeline.deliver import deliver_run
from lslam.pipeline.outputs import write_loops
from lslam.pipeline.stored_map import map_of
from tests.maps.geoid_grids import write_gtx


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> MadeRun:
    return made(tmp_path_factory.mktemp("made") / "town")


@pytest.fixture
def geoid(tmp_path: Path) -> Path:
    return write_gtx(tmp_path / "geoid.gtx", AT_48, PER_DEGREE)


def test_a_run_without_a_place_is_delivered_in_its_own_coordinates_and_says_so(tmp_path: Path) -> None:
    problems = [
        f"problem {k} of a kind that takes more than one line of a column, which has 68 letters" for k in range(30)
    ]
    run = made(tmp_path / "town", is_placed=False, status="degraded", problems=problems)
    out = delivered(run, tmp_path / "out")
    # Of many problems the page has the first, and counts the others.
    words = text_of(out / "sheet.pdf")[1]
    (more,) = re.findall(r"and (\d+) more: see README.txt", words)
    assert len(re.findall(r"problem \d+ of a kind", words)) == 30 - int(more) > 5
    assert len(re.findall(r"problem \d+ of a kind", flat(out / "README.txt"))) == 30
    np.testing.assert_allclose(laspy.read(out / "map.laz").xyz, world_of(run.points), atol=2e-3)
    assert not [
        vlr for vlr in laspy.read(out / "map.laz").header.vlrs if type(vlr).__name__ == "WktCoordinateSystemVlr"
    ]
    rows = rows_of(out / "trajectory.csv")
    np.testing.assert_allclose([[float(row[f"{a}_m"]) for a in "xyz"] for row in rows], world_of(run.poses), atol=1e-4)
    assert placed(out / "plan.tif")[2] == {1024: 32767, 1025: 1}
    with closing(sqlite3.connect(out / "survey.gpkg")) as db:
        assert db.execute("SELECT DISTINCT srs_id FROM gpkg_contents WHERE data_type = 'features'").fetchall() == [
            (-1,)
        ]
    for words in (text_of(out / "sheet.pdf")[1], flat(out / "README.txt"), (out / "trajectory.csv").read_text()):
        assert "local coordinates" in words.lower()
        assert "easting" not in words
    assert "not georeferenced" in text_of(out / "sheet.pdf")[1]
    for flag, value in (("--crs", "EPSG:25832"), ("--geoid", "g.gtx"), ("--check", far_point(tmp_path / "points.csv"))):
        said = rf"{flag}: .*town is not georeferenced.*--gnss.*--origin.*--control points.csv"
        refused(2, said, run.folder, "--out", tmp_path / "no", flag, value)


@pytest.mark.parametrize(("epsg", "times"), [(3857, "1.5"), (32661, "1.1")])
def test_a_plane_that_stretches_lengths_is_none_for_a_survey(
    run: MadeRun, tmp_path: Path, epsg: int, times: str
) -> None:
    refused(2, f"lengths in it are {times}", run.folder, "--crs", f"EPSG:{epsg}", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_without_a_map_delivers_the_rest_and_says_it(tmp_path: Path) -> None:
    run = made(tmp_path / "town")
    map_of(run.folder).path.unlink()
    out = delivered(run, tmp_path / "out")
    assert {path.name for path in out.iterdir()} == FILES - {"map.laz", "plan.tif"}
    for words in (text_of(out / "sheet.pdf")[1], flat(out / "README.txt")):
        assert "There is no map, and no plan from above: the run was made without one" in words
    assert f"`lslam map {run.folder}` builds it" in flat(out / "README.txt")


@pytest.mark.parametrize("status", ["diverged", "interrupted", "running"])
def test_what_is_no_result_is_refused_and_marked_where_it_is_wanted_all_the_same(tmp_path: Path, status: str) -> None:
    run = made(tmp_path / "town", status=status)
    refused(1, f"is no result to hand over, it is {status}: .*--anyway", run.folder, "--out", tmp_path / "out")
    out = delivered(run, tmp_path / "out", "--anyway")
    for words in (text_of(out / "sheet.pdf")[1], flat(out / "README.txt")):
        assert is_in(
            f"The run is {status}: this is no finished result, and was delivered on request (--anyway).", words
        )


def test_scans_at_no_known_place_are_not_delivered_unasked(tmp_path: Path) -> None:
    run = made(tmp_path / "town", status="degraded", segments=[{"frame": 0}, {"frame": 1}])
    refused(1, "scans of it lie in a frame of their own, at no known place", run.folder, "--out", tmp_path / "out")


def test_a_merge_is_delivered_with_all_its_sessions(tmp_path: Path) -> None:
    runs = {name: made(tmp_path / name) for name in ("monday", "friday")}
    town = made(tmp_path / "town")
    place = describe(Georeference(ORIGIN, T_ENU_WORLD, 25832, "control"))
    rows = [
        {"name": name, "run": str(run.folder), "first_keyframe": 10 * k} for k, (name, run) in enumerate(runs.items())
    ]
    document = {
        "kind": "merge",
        "status": "done",
        "problems": [],
        "sessions": rows,
        "georeference": place,
        "graph": {"loops": 2},
    }
    (town.folder / "manifest.json").write_text(json.dumps(document))
    (town.folder / "sessions").mkdir()
    trajectory = read_trajectory(town.folder)
    for name in ("trajectory.tum", "scans.csv", "covariances.npz"):
        (town.folder / name).unlink()
    for k, name in enumerate(runs):
        there = trajectory.poses.copy()
        there[:, 2, 3] += k
        write_tum(town.folder / "sessions" / f"{name}.tum", replace(trajectory, poses=there))
    loop = LoopCandidate(2, 13, 1.0, 0.1, Verdict.ACCEPTED, LoopStage.GRAPH)
    write_loops(town.folder / "loops.csv", [loop], [k % 10 for k in range(20)])
    out = delivered(town, tmp_path / "out")
    assert {path.name for path in out.iterdir()} == FILES - {"trajectory.csv"} | {
        f"trajectory_{name}.csv" for name in runs
    }
    heights = [float(rows_of(out / f"trajectory_{name}.csv")[0]["height_m"]) for name in runs]
    np.testing.assert_allclose(heights, run_heights := town.poses[0, 2] + np.arange(2), atol=1e-3)
    with closing(sqlite3.connect(out / "survey.gpkg")) as db:
        assert db.execute("SELECT sequence, scans FROM trajectory ORDER BY fid").fetchall() == [
            (n, SCANS) for n in runs
        ]
        assert db.execute("SELECT sequence, count(*) FROM scans GROUP BY sequence").fetchall() == [
            ("friday", 20),
            ("monday", 20),
        ]
        (line,) = db.execute("SELECT geom FROM loops").fetchone()
    ends = truth_in(25832, town.poses[[2, 3]]) + np.array([[0, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(coordinates(line), ends, atol=1e-3, rtol=0)
    assert "Survey of monday, friday" in text_of(out / "sheet.pdf")[1]
    refused(
        2,
        "--check: .* is a merge",
        town.folder,
        "--check",
        far_point(tmp_path / "points.csv"),
        "--out",
        tmp_path / "no",
    )
    assert len(run_heights) == 2
    (tmp_path / "friday").rename(tmp_path / "gone")
    refused(3, "was merged from .*friday, which is gone", town.folder, "--out", tmp_path / "no")


def test_what_is_there_is_replaced_only_when_it_is_a_delivery_and_asked_for(run: MadeRun, tmp_path: Path) -> None:
    out = delivered(run, tmp_path / "out")
    before = (out / "map.laz").read_bytes()
    (out / "old").touch()
    refused(2, "out exists; name another folder with --out or replace it with --overwrite", run.folder, "--out", out)
    delivered(run, out, "--overwrite")
    assert {path.name for path in out.iterdir()} == FILES
    assert (out / "map.laz").read_bytes() == before
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "README.txt").write_text("my own")
    refused(2, "mine exists and is no delivery of lslam", run.folder, "--out", mine, "--overwrite")
    refused(2, "holds the run itself", run.folder, "--out", run.folder, "--overwrite")
    (tmp_path / "file").touch()
    refused(2, "file exists and is no delivery", run.folder, "--out", tmp_path / "file", "--overwrite")
    (tmp_path / "empty").mkdir()
    delivered(run, tmp_path / "empty")
    refused(3, "nowhere does not exist", tmp_path / "nowhere", "--out", tmp_path / "no")
    refused(3, "mine is no folder of a run", mine, "--out", tmp_path / "no")
    refused(
        2, "--crs EPSG:4326 .* does not count in metres", run.folder, "--crs", "EPSG:4326", "--out", tmp_path / "no"
    )
    assert not list(tmp_path.glob("*.new"))


@pytest.mark.parametrize("size", [100, 20_000, 60_000, 200_000])
def test_a_disk_that_is_full_leaves_nothing_and_what_was_there(
    run: MadeRun, tmp_path: Path, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = delivered(run, tmp_path / "out")
    largest = max(path.stat().st_size for path in out.iterdir())
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        done = lslam("deliver", run.folder, "--out", out, "--overwrite")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (done.returncode == 0) == (size > largest), done.stderr
    if done.returncode:
        assert (done.returncode, done.stdout) == (3, ""), done.stderr
        assert_one_sentence(done.stderr)
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_interrupted_delivery_leaves_nothing(run: MadeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    for name in ("write_las", "write_gpkg", "survey_pdf"):
        with monkeypatch.context() as patch:
            patch.setattr(deliver_run, name, stop)
            done = lslam("deliver", run.folder, "--out", tmp_path / "out")
        assert done.returncode == 130
        assert not list(tmp_path.iterdir()), name


def test_without_fudgeo_it_says_at_once_how_to_get_it(
    run: MadeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find: Callable[[str], Any] = deliver_run.find_spec
    monkeypatch.setattr(deliver_run, "find_spec", lambda name: None if name == "fudgeo" else find(name))
    refused(
        2,
        r"GeoPackage, which fudgeo writes: install it with: pip install .*\[geo\]",
        run.folder,
        "--out",
        tmp_path / "out",
    )


def test_json_and_what_a_map_lacks(run: MadeRun, tmp_path: Path) -> None:
    bare = made(tmp_path / "town")
    note = json.loads((bare.folder / "map.json").read_text())
    del note["attributes"]
    (bare.folder / "map.json").write_text(json.dumps(note))
    check = point_file(tmp_path / "check.csv", run, (4, 15), np.array([0.03, 0.04, -0.12]))
    done = lslam("deliver", bare.folder, "--out", tmp_path / "out", "--check", check, "--json")
    document = strict_json(done.stdout)
    (points,) = document["points"].values()
    assert (points["count"], points["rms_m"]) == (2, pytest.approx([0.05, 0.12], abs=3e-4))
    assert set(document["files"]) == FILES
    assert document["crs"] == "EPSG:25832"
    assert any("The points of the map have no times: `lslam map" in said for said in document["notes"])
    assert "no times" in flat(tmp_path / "out" / "README.txt")


@pytest.mark.parametrize(
    "name", ["map.ply", "trajectory.tum", "loops.csv", "occupancy.npz", "manifest.json", "scans.csv"]
)
def test_a_damaged_file_is_named(tmp_path: Path, name: str) -> None:
    run = made(tmp_path / "town")
    (run.folder / name).write_bytes(b"keyframe_a,scan_a\nx,y\n")
    done = lslam("deliver", run.folder, "--out", tmp_path / "out")
    assert done.returncode in (1, 3), done.stderr
    assert_one_sentence(done.stderr)
    assert name in done.stderr or name == "manifest.json"
    assert [path.name for path in tmp_path.iterdir()] == ["town"]
