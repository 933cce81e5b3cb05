"""`lslam deliver`: what is handed over lies where pyproj alone puts it, says what was measured, and is whole or not there."""

from __future__ import annotations

import re
import sqlite3
import tomllib
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from calling import SAMPLE, lslam, manifest
from defusedxml import ElementTree
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
    hold,
    is_in,
    made,
    placed,
    point_file,
    refused,
    rows_of,
    text_of,
    truth_in,
)
from pyproj import CRS, Transformer

from lslam.core.geometry import se3, so3
from lslam.core.geometry.geodesy import local_crs
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.maps.georeference import Projection
from lslam.reports.plans import nice
from tests.maps.geoid_grids import write_gtx
from tests.pages import page
from tests.test_tutorials import missing_lines


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> MadeRun:
    return made(tmp_path_factory.mktemp("made") / "town")


@pytest.fixture
def geoid(tmp_path: Path) -> Path:
    return write_gtx(tmp_path / "geoid.gtx", AT_48, PER_DEGREE)


@pytest.mark.parametrize("format_", ["laz", "laz in tiles"])
def test_a_map_in_the_delivered_coordinates_keeps_each_millimetre(
    tmp_path: Path, format_: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is it carried to the world of the run and back."""
    run = made(tmp_path / "town", format_)
    monkeypatch.setattr(Projection, "invert", lambda *_: pytest.fail("carried to the world"))
    out = delivered(run, tmp_path / "out")
    before = np.concatenate([laspy.read(path).xyz for path in run.folder.rglob("*.laz")])
    after = np.asarray(laspy.read(out / "map.laz").xyz)
    for xyz in (before, after):
        xyz[:] = xyz[np.lexsort(np.rint(xyz * 1000).T)]
    np.testing.assert_array_equal(np.rint(after * 1000), np.rint(before * 1000))


@pytest.mark.parametrize(
    ("format_", "epsg"),
    [
        ("ply", 25832), ("ply", 3035), ("pcd", 25832), ("laz", 32632), ("las", 25832),
        ("ply in tiles", 3035), ("pcd in tiles", 25832), ("laz in tiles", 32632), ("las in tiles", 25832),
    ],
)  # fmt: skip
def test_points_lie_where_pyproj_puts_them_with_all_that_the_map_has(tmp_path: Path, format_: str, epsg: int) -> None:
    run = made(tmp_path / "town", format_)
    out = delivered(run, tmp_path / "out", "--crs", f"EPSG:{epsg}")
    assert {path.name for path in out.iterdir()} == FILES
    cloud = laspy.read(out / "map.laz")
    cloud.points = cloud.points[np.argsort(cloud.gps_time)]  # tiles have them in an order of their own
    np.testing.assert_allclose(cloud.xyz, truth_in(epsg, run.points), atol=2e-3, rtol=0)
    # GPS is 18 s ahead of UTC; its epoch is 1980-01-06.
    assert cloud.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    expected = 1e-9 * run.columns["time_ns"] - 315_964_800 + 18 - 1e9
    np.testing.assert_allclose(cloud.gps_time, expected, atol=1e-6, rtol=0)
    np.testing.assert_array_equal(cloud["class"], run.columns["class"])
    np.testing.assert_array_equal(cloud.classification, np.where(run.columns["class"] == 40, 2, 6))
    np.testing.assert_array_equal(cloud.point_source_id, run.columns["scan"])
    np.testing.assert_array_equal(np.asarray(cloud.green) // 257, run.columns["green"])
    np.testing.assert_allclose(cloud.intensity, 65535 * np.linspace(0, 1, len(cloud)), atol=1)
    (wkt,) = [vlr.string for vlr in cloud.header.vlrs if type(vlr).__name__ == "WktCoordinateSystemVlr"]
    assert wkt.rstrip("\0").endswith(f'AUTHORITY["EPSG","{epsg}"]]')
    assert CRS.from_wkt(wkt.rstrip("\0")).is_projected


@pytest.mark.quick
def test_heights_are_above_the_geoid_and_never_silently_above_the_ellipsoid(
    run: MadeRun, geoid: Path, tmp_path: Path
) -> None:
    out = delivered(run, tmp_path / "out", "--crs", "EPSG:25832+7837", "--geoid", geoid)
    truth = truth_in(25832, run.points)
    truth[:, 2] -= AT_48 + PER_DEGREE * (run.points[:, 0] - 48.0)
    cloud = laspy.read(out / "map.laz")
    np.testing.assert_allclose(cloud.xyz, truth, atol=2e-3, rtol=0)
    (wkt,) = [vlr.string for vlr in cloud.header.vlrs if type(vlr).__name__ == "WktCoordinateSystemVlr"]
    assert [part.to_epsg() for part in CRS.from_wkt(wkt.rstrip("\0")).sub_crs_list] == [25832, 7837]
    heights = [float(row["height_m"]) for row in rows_of(out / "trajectory.csv")]
    np.testing.assert_allclose(heights, run.poses[:, 2] - AT_48 - PER_DEGREE * (run.poses[:, 0] - 48.0), atol=2e-3)
    for words in (flat(out / "README.txt"), text_of(out / "sheet.pdf")[1]):
        assert "eights above the geoid of geoid.gtx: physical heights, by a geoid" in words
        assert "ellipsoidal" not in words
    refused(
        2,
        r"PROJ lacks the grid de_bkg_gcg2016.tif.*--geoid",
        run.folder,
        "--crs",
        "EPSG:25832+7837",
        "--out",
        tmp_path / "no",
    )
    assert not (tmp_path / "no").exists()
    plain = delivered(run, tmp_path / "plain")
    for words in (flat(plain / "README.txt"), text_of(plain / "sheet.pdf")[1]):
        assert "ellipsoidal heights, no geoid was applied" in words


@pytest.mark.quick
def test_the_table_has_each_pose_in_the_grid_with_its_sigmas_and_status(run: MadeRun, tmp_path: Path) -> None:
    out = delivered(run, tmp_path / "out")
    rows = rows_of(out / "trajectory.csv")
    places = np.array([[float(row[f"{axis}_m"]) for axis in ("easting", "northing", "height")] for row in rows])
    np.testing.assert_allclose(places, truth_in(25832, run.poses), atol=2e-4, rtol=0)
    assert [row["status"] for row in rows] == ["bridged" if k == 7 else "ok" for k in range(SCANS)]
    assert [int(row["scan"]) for row in rows] == list(range(SCANS))
    assert rows[1]["utc"] == "2023-11-14T22:13:20.100000Z"
    # A turn by 2.1 rad of the world, up to the convergence of the grid, which is half a degree west here.
    ahead = truth_in(25832, ORIGIN + np.array([[0.0, 0.0, 0.0], [1e-4, 0.0, 0.0]]))
    convergence = np.arctan2(*(ahead[1] - ahead[0])[:2])
    yaw = np.radians([float(row["yaw_deg"]) for row in rows])
    np.testing.assert_allclose(np.unwrap(yaw), 2.1 - convergence + np.linspace(0, 1, SCANS), atol=2e-5)
    R = so3.exp(np.array([0.0, 0.0, 2.1 - convergence]))
    C = R @ np.diag([0.03, 0.01, 0.02]) ** 2 @ R.T
    sigmas = [float(rows[0][f"sigma_{axis}_m"]) for axis in ("easting", "northing", "height")]
    np.testing.assert_allclose(sigmas, np.sqrt(np.diag(C)), atol=1e-4)
    assert float(rows[0]["sigma_about_up_deg"]) == pytest.approx(np.degrees(0.004), abs=1e-4)
    head = [line for line in (out / "trajectory.csv").read_text().splitlines() if line.startswith("#")]
    assert any("EPSG:25832 (ETRS89 / UTM zone 32N); heights above the WGS84 ellipsoid" in line for line in head)
    # And lslam reads it back.
    back = read_trajectory(out / "trajectory.csv")
    np.testing.assert_allclose(back.positions, truth_in(25832, run.poses), atol=2e-4, rtol=0)
    assert (back.frame, back.has_rotations) == ("lidar", True)


def test_a_post_is_on_its_pixel_and_the_corner_of_the_floor_plan_where_it_belongs(run: MadeRun, tmp_path: Path) -> None:
    out = delivered(run, tmp_path / "out")
    image, transform, keys = placed(out / "plan.tif")
    assert keys == {1024: 1, 1025: 1, 3072: 25832}
    there = truth_in(25832, run.post[None])[0, :2]
    column, row = np.linalg.solve(transform[:, :2], there - transform[:, 2])
    assert image[int(row), int(column)] == image.min() < 50
    around = image[int(row) - 5 : int(row) + 6, int(column) - 5 : int(column) + 6]
    assert np.count_nonzero(around < 255) == 1
    plan, transform, keys = placed(out / "floor_plan.tif")
    assert plan.shape == (20, 10)
    assert keys[3072] == 25832
    # The world's origin is the lower left corner of the cells.
    inverse = Transformer.from_crs(local_crs(ORIGIN), 25832, always_xy=True)
    for world, pixel in (((0.0, 0.0), (0, 20)), ((5.0, 10.0), (10, 0))):
        enu = T_ENU_WORLD[:2, :2] @ world + T_ENU_WORLD[:2, 3]
        np.testing.assert_allclose(transform @ [*pixel, 1], inverse.transform(*enu), atol=2e-3, rtol=0)


def test_the_geopackage_has_points_and_loops_in_styles_that_qgis_takes(run: MadeRun, tmp_path: Path) -> None:
    moved = replace(run, folder=tmp_path / "town")
    made(moved.folder)
    hold(moved, point_file(tmp_path / "points.csv", run, (0, 10, 19), np.array([0.003, -0.004, 0.001])))
    check = point_file(tmp_path / "check.csv", run, (4, 15), np.array([0.03, 0.04, -0.12]))
    out = delivered(moved, tmp_path / "out", "--check", check)
    with closing(sqlite3.connect(out / "survey.gpkg")) as db:
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        names = "geom, point, status, off_easting_m, off_northing_m, off_height_m, off_horizontally_m"
        points = db.execute(f"SELECT {names} FROM control_points ORDER BY fid").fetchall()
        loops = db.execute("SELECT geom, scan_a, scan_b, status, reason FROM loops ORDER BY fid").fetchall()
        styles = dict(db.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"))
        (system,) = db.execute("SELECT DISTINCT srs_id FROM gpkg_contents WHERE data_type = 'features'").fetchone()
    assert system == 25832
    assert [row[2] for row in points] == ["used"] * 3 + ["kept out"] * 2
    np.testing.assert_allclose([row[3:] for row in points[:3]], [[0.003, -0.004, 0.001, 0.005]] * 3, atol=3e-4)
    np.testing.assert_allclose([row[3:] for row in points[3:]], [[0.03, 0.04, -0.12, 0.05]] * 2, atol=3e-4)
    expected = truth_in(25832, run.poses[[4, 15]]) + np.array([0.03, 0.04, -0.12])
    np.testing.assert_allclose([coordinates(row[0])[0] for row in points[3:]], expected, atol=3e-4, rtol=0)
    assert [row[1:] for row in loops] == [(0, 18, "accepted", ""), (2, 10, "rejected", "overlap 0.1")]
    np.testing.assert_allclose(coordinates(loops[0][0]), truth_in(25832, run.poses[[0, 18]]), atol=2e-4, rtol=0)
    drawn = {
        name: [category.get("value") for category in ElementTree.fromstring(style).iter("category")]
        for name, style in styles.items()
    }
    assert drawn == {
        "trajectory": [], "scans": ["ok", "bridged", "skipped"], "control_points": ["used", "kept out"],
        "loops": ["accepted", "rejected"],
    }  # fmt: skip


def test_the_page_says_what_was_measured_and_by_whom(run: MadeRun, tmp_path: Path) -> None:
    bare = delivered(run, tmp_path / "bare")
    pages, words = text_of(bare / "sheet.pdf")
    assert pages == 1
    convergence = (9 - ORIGIN[1]) * np.sin(np.radians(ORIGIN[0]))
    for said in (
        "Survey of drive", "EPSG:25832: ETRS89 / UTM zone 32N", "Accuracy was not measured: no check point was kept out",
        "internal precision", f"N is grid north, {convergence:.3f} deg west of true north", "1 : ", "Epoch: 2023-11-14, 2023.87",
        "20 scans, 19 registered", "lslam 0.1.0", "delivered on", "checked by", "signature",
    ):  # fmt: skip
        assert is_in(said, words), said
    assert "held the run" not in words
    held = made(tmp_path / "town", status="degraded", problems=["the IMU was refused: it lies on its side"])
    hold(held, point_file(tmp_path / "points.csv", run, (0, 10, 19), np.array([0.003, -0.004, 0.001])))
    check = point_file(tmp_path / "check.csv", run, (4, 15), np.array([0.03, 0.04, -0.12]))
    out = delivered(held, tmp_path / "out", "--check", check)
    readme = flat(out / "README.txt")
    for words in (text_of(out / "sheet.pdf")[1], readme):
        for said in (
            "Measured at 2 check points that the run did not use: RMS 0.050 m horizontally, 0.120 m vertically",
            "3 control points held the run: residuals of RMS 0.005 m horizontally, 0.001 m vertically",
            "not how accurate it is elsewhere", "The run is degraded.", "the IMU was refused: it lies on its side",
        ):  # fmt: skip
            assert is_in(said, words), said
        assert "not measured" not in words
    for said in ("lslam run drive", "stated accuracy 1 m; no grid", "ETRS89 to WGS 84", *FILES - {"README.txt"}):
        assert said in readme, said


def test_a_point_that_held_the_run_checks_nothing(run: MadeRun, tmp_path: Path) -> None:
    held = made(tmp_path / "town")
    control = point_file(tmp_path / "points.csv", run, (0, 10), np.zeros(3))
    hold(held, control)
    words = (held.folder, "--out", tmp_path / "out", "--check")
    refused(2, r"points.csv, line 2 is a control point that held the run", *words, control)
    refused(3, r"far.csv, line 2: scan 99 is none of the run's", *words, far_point(tmp_path / "far.csv"))
    refused(3, r"none.csv does not exist", *words, tmp_path / "none.csv")
    (held.folder / "control.csv").write_text("point,stamp_ns,east_m,north_m,up_m\np,1,0,0,0\n")
    refused(3, r"control.csv is of an earlier lslam and has no places", held.folder, "--out", tmp_path / "out")


def test_scales_are_round_and_never_too_small() -> None:
    values = np.random.default_rng(0).uniform(0.01, 9000, 500)
    assert all(nice(value) >= value * (1 - 1e-9) and nice(value) <= 2.5 * value for value in values)


@pytest.mark.slow
def test_the_page_of_the_task_hands_over_a_drive_within_its_error(tmp_path: Path) -> None:
    """From the recording to the folder, as the page has it. The truth in the grid is pyproj's, and never seen by the run."""
    shown = page("docs/tasks/delivering.md")
    (tmp_path / "sample_data").symlink_to(SAMPLE)
    for kind, text in shown.blocks:
        if kind == "csv":
            (tmp_path / text.split()[1]).write_text(text)
    printed = ""
    for call in shown.lslam_calls()[:2]:
        done = lslam(*call, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        printed = done.stdout
    assert missing_lines(shown.block("text"), printed) == []
    world = tomllib.loads((SAMPLE / "sequences/00/truth/world.toml").read_text())
    T, origin = np.array(world["T_enu_world"]), np.array(world["origin_lat_lon_alt"])
    enu = se3.apply(T, read_trajectory(SAMPLE / "sequences/00/truth/trajectory.tum").positions)
    x, y = Transformer.from_crs(local_crs(origin), 25832, always_xy=True).transform(enu[:, 0], enu[:, 1])
    truth = np.column_stack([x, y, enu[:, 2] + origin[2]])
    rows = rows_of(tmp_path / "handover" / "trajectory.csv")
    places = np.array([[float(row[f"{axis}_m"]) for axis in ("easting", "northing", "height")] for row in rows])
    assert np.linalg.norm(places - truth, axis=1).max() < 0.04
    # What is said to be measured is what these points are off.
    check = np.array(
        [[float(row[name]) for name in ("scan", "x", "y", "z")] for row in rows_of(tmp_path / "check.csv")]
    )
    off = check[:, 1:] - places[check[:, 0].astype(int)]
    said = re.search(r"Measured at 4 check points .*?: RMS ([\d.]+) m horizontally, ([\d.]+) m vertically", printed)
    assert said is not None
    expected = [np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()), np.sqrt((off[:, 2] ** 2).mean())]
    np.testing.assert_allclose([float(value) for value in said.groups()], expected, atol=6e-4)
    assert manifest(tmp_path / "runs" / "surveyed")["map_points"] == len(laspy.read(tmp_path / "handover" / "map.laz"))
