"""`lslam deliver`: what is handed over lies where pyproj alone puts it, says what was measured, and is whole or not there."""

from __future__ import annotations

import csv
import json
import re
import resource
import sqlite3
import struct
import tomllib
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import shapely
from calling import SAMPLE, assert_one_sentence, lslam, manifest, strict_json
from defusedxml import ElementTree
from PIL import Image
from pyproj import CRS, Transformer

from lslam.backend.control_points import control_residuals
from lslam.backend.manual import read_control_points, write_control
from lslam.core.config import Config
from lslam.core.geometry import se3, so3
from lslam.core.geometry.geodesy import local_crs
from lslam.core.types.arrays import Floats
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.core.types.gnss import Georeference
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_files import read_trajectory, write_tum
from lslam.maps.occupancy import OccupancyGrid
from lslam.pipeline.back_end_pass import describe
from lslam.pipeline.deliver import deliver_run
from lslam.pipeline.map_files import MapNote, write_map, write_occupancy
from lslam.pipeline.outputs import config_text, write_loops
from lslam.pipeline.rebuild import map_of
from lslam.reports.survey_sheet import nice
from tests.maps.geoid_grids import write_gtx
from tests.pages import page
from tests.test_tutorials import missing_lines

ORIGIN = np.array([49.0113, 8.4256, 116.4])
# The run's world lies askew on the Earth.
T_ENU_WORLD = se3.make(so3.exp(np.array([0.0, 0.0, 2.1])), np.array([12.0, -7.0, 1.5]))
BEGIN_NS = 1_700_000_000_000_000_000
SCANS = 20
FILES = {"map.laz", "plan.tif", "floor_plan.tif", "trajectory.csv", "survey.gpkg", "sheet.pdf", "README.txt"}
# m; of the grid of `geoid`, 46 m at 48 deg and 2 m more for each degree.
AT_48, PER_DEGREE = 46.0, 2.0


def world_of(lat_lon_height: Floats) -> Floats:
    """Places on the Earth in the run's world, by pyproj alone."""
    east, north = Transformer.from_crs("EPSG:4326", local_crs(ORIGIN), always_xy=True).transform(
        lat_lon_height[:, 1], lat_lon_height[:, 0]
    )
    enu = np.column_stack([east, north, lat_lon_height[:, 2] - ORIGIN[2]])
    return (enu - T_ENU_WORLD[:3, 3]) @ T_ENU_WORLD[:3, :3]


def truth_in(epsg: int, lat_lon_height: Floats) -> Floats:
    """Easting, northing and ellipsoidal height of places, by pyproj alone."""
    x, y = Transformer.from_crs("EPSG:4326", epsg, always_xy=True).transform(lat_lon_height[:, 1], lat_lon_height[:, 0])
    return np.column_stack([x, y, lat_lon_height[:, 2]])


@dataclass(frozen=True)
class MadeRun:
    """A run folder and the truth behind it: places (N, 3) lat, lon (deg), height (m) of its points and of its poses."""

    folder: Path
    points: Floats
    poses: Floats
    columns: dict[str, Any]
    post: Floats


def spread(count: int, seed: int, metres: float) -> Floats:
    """Places within `metres` of the origin."""
    off = np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [metres / 111_000, metres / 73_000, 5.0]
    return np.asarray(ORIGIN + off)


def made(folder: Path, format_: str = "ply", is_placed: bool = True, **about: Any) -> MadeRun:
    """A run of exact poses and an exact map: a square of points, and a post of fifty alone beside it."""
    folder.mkdir(parents=True)
    post = ORIGIN + np.array([60 / 111_000, 60 / 73_000, 0.0])
    beyond = ORIGIN + np.array([80 / 111_000, 80 / 73_000, 0.0])
    places = np.concatenate(
        [spread(3000, 1, 40.0), np.repeat(post[None], 50, axis=0), np.repeat(beyond[None], 5, axis=0)]
    )
    poses = ORIGIN + np.linspace(-1, 1, SCANS)[:, None] * [20 / 111_000, 10 / 73_000, 0.5]
    count = len(places)
    columns = {
        "time_ns": BEGIN_NS + np.arange(count) * 1_000_000,
        "scan": (np.arange(count) % SCANS).astype(np.uint16),
        "class": np.where(np.arange(count) % 2, 40, 50).astype(np.uint16),
        **{name: ((np.arange(count) * k) % 256).astype(np.uint8) for k, name in enumerate(("red", "green", "blue"), 1)},
    }
    place = Georeference(ORIGIN, T_ENU_WORLD, 25832, "control") if is_placed else None
    stamps = BEGIN_NS + np.arange(SCANS) * 100_000_000
    turns = so3.exp(np.column_stack([np.zeros((SCANS, 2)), np.linspace(0, 1, SCANS)]))
    trajectory = Trajectory(stamps, se3.make(turns, world_of(poses)))
    write_tum(folder / "trajectory.tum", trajectory)
    statuses = ["bridged" if k == 7 else "ok" for k in range(SCANS)]
    (folder / "scans.csv").write_text("index,status\n" + "".join(f"{k},{s}\n" for k, s in enumerate(statuses)))
    sigmas = np.diag([0.03, 0.01, 0.02, 0.002, 0.001, 0.004]) ** 2
    np.savez_compressed(
        folder / "covariances.npz", stamps_ns=stamps, covariances=np.repeat(sigmas[None], SCANS, axis=0)
    )
    (folder / "config.toml").write_text(config_text(Config()))
    document = {
        "status": "done", "problems": [], "lslam": "0.1.0", "command": "lslam run drive", "written": "2026-11-30",
        "sequence": {"name": "drive", "path": "/gone"}, "frames": {"world": "LiDAR at the first scan", "pose_time": "scan_start"},
        **({"georeference": describe(place)} if place else {}), **about,
    }  # fmt: skip
    (folder / "manifest.json").write_text(json.dumps(document))
    note = MapNote("drive", 0.2, attributes={name: name for name in ("time", "scan", "class")})
    intensity = np.linspace(0, 1, count).astype(np.float32)
    write_map(folder / f"map.{format_}", ArrayCloud(world_of(places), intensity, columns), note, place)
    candidates = [
        LoopCandidate(0, 9, 1.0, 0.1, Verdict.ACCEPTED, LoopStage.GRAPH, overlap=0.9),
        LoopCandidate(1, 5, 2.0, 0.3, Verdict.REJECTED, LoopStage.OVERLAP, "overlap 0.1"),
    ]
    write_loops(folder / "loops.csv", candidates, [2 * k for k in range(10)])
    cells = np.argwhere(np.ones((10, 20, 8), bool)).astype(np.int32)
    write_occupancy(folder, OccupancyGrid(cells, np.where(cells[:, 2] < 3, 90, -90).astype(np.int16), 0.5), "a world")
    return MadeRun(folder, places, poses, columns, post)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> MadeRun:
    return made(tmp_path_factory.mktemp("made") / "town")


@pytest.fixture
def geoid(tmp_path: Path) -> Path:
    return write_gtx(tmp_path / "geoid.gtx", AT_48, PER_DEGREE)


def point_file(path: Path, run: MadeRun, scans: tuple[int, ...], off: Floats, epsg: int = 25832) -> Path:
    """Surveyed places of the sensor at these scans, each `off` (3,) m from the truth in the grid."""
    places = truth_in(epsg, run.poses[list(scans)]) + off
    rows = [f"{k},{x:.4f},{y:.4f},{z:.4f},0.02,EPSG:{epsg}" for k, (x, y, z) in zip(scans, places, strict=True)]
    path.write_text("\n".join(["scan,x,y,z,sigma,crs", *rows]) + "\n")
    return path


def hold(run: MadeRun, path: Path) -> None:
    """As if these points had been the run's --control."""
    trajectory = read_trajectory(run.folder)
    results = [
        ScanResult(k, int(s), T, "ok")
        for k, (s, T) in enumerate(zip(trajectory.stamps_ns, trajectory.poses, strict=True))
    ]
    place = Georeference(ORIGIN, T_ENU_WORLD, 25832)
    write_control(run.folder / "control.csv", control_residuals(read_control_points(path), results, place))


def text_of(pdf: Path) -> tuple[int, str]:
    """Number of pages, and the words on them, from the operators of the page's streams."""
    data = pdf.read_bytes()
    streams = []
    for match in re.finditer(rb"stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL):
        try:
            streams.append(zlib.decompressobj().decompress(match.group(1)))
        except zlib.error:
            continue
    shown = re.compile(rb"\((?:\\.|[^\\()])*\)\s*Tj|\[((?:\((?:\\.|[^\\()])*\)|[^\]()])*)\]\s*TJ")
    words = []
    for stream in streams:
        for match in shown.finditer(stream):
            parts = re.findall(rb"\(((?:\\.|[^\\()])*)\)", match.group(0))
            words.append(re.sub(rb"\\(.)", rb"\1", b"".join(parts)).decode("latin-1"))
    return len(re.findall(rb"/Type\s*/Page\b(?!s)", data)), " ".join(words)


def is_in(said: str, words: str) -> bool:
    """Whether a text has these words; on a page the letters f and i may be one glyph of a number of its own."""
    return re.search(re.escape(said).replace("fi", ".{1,4}"), words) is not None


def flat(path: Path) -> str:
    """Text without its line ends."""
    return " ".join(path.read_text().split())


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(line for line in stream if not line.startswith("#")))


def delivered(run: MadeRun, out: Path, *words: object) -> Path:
    done = lslam("deliver", run.folder, "--out", out, *words)
    assert done.returncode == 0, done.stderr
    return out


def refused(code: int, said: str, *words: object) -> None:
    done = lslam("deliver", *words)
    assert (done.returncode, done.stdout) == (code, ""), done.stderr
    assert_one_sentence(done.stderr)
    assert re.search(said, done.stderr), done.stderr


@pytest.mark.parametrize(
    ("format_", "epsg"), [("ply", 25832), ("ply", 3035), ("pcd", 25832), ("laz", 32632), ("las", 25832)]
)
def test_points_lie_where_pyproj_puts_them_with_all_that_the_map_has(tmp_path: Path, format_: str, epsg: int) -> None:
    run = made(tmp_path / "town", format_)
    out = delivered(run, tmp_path / "out", "--crs", f"EPSG:{epsg}")
    assert {path.name for path in out.iterdir()} == FILES
    cloud = laspy.read(out / "map.laz")
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


def placed(path: Path) -> tuple[Any, Any, dict[int, int]]:
    """Grey values of a GeoTIFF, its transform (2, 3) from column and row, and its keys."""
    image = Image.open(path)
    tags: Any = image.tag_v2  # type: ignore[attr-defined]
    keys = np.reshape(tags[34735], (-1, 4))
    return np.array(image), np.reshape(tags[34264], (4, 4))[:2, [0, 1, 3]], {int(k): int(v) for k, _, _, v in keys[1:]}


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


def coordinates(blob: bytes) -> Any:
    """(N, 3) of a feature: the standard's header, then WKB."""
    assert (blob[:2], struct.unpack_from("<i", blob, 4)[0]) == (b"GP", 25832)
    return shapely.get_coordinates(shapely.from_wkb(blob[8 + (0, 32, 48, 48, 64)[blob[3] >> 1 & 7] :]), include_z=True)


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
    refused(3, r"far.csv, line 2: scan 99 is none of the run's", *words, _far(tmp_path / "far.csv"))
    refused(3, r"none.csv does not exist", *words, tmp_path / "none.csv")
    (held.folder / "control.csv").write_text("point,stamp_ns,east_m,north_m,up_m\np,1,0,0,0\n")
    refused(3, r"control.csv is of an earlier lslam and has no places", held.folder, "--out", tmp_path / "out")


def _far(path: Path) -> Path:
    path.write_text("scan,x,y,z,sigma,crs\n99,456115,5427613,116,0.02,EPSG:25832\n")
    return path


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
    for flag, value in (("--crs", "EPSG:25832"), ("--geoid", "g.gtx"), ("--check", _far(tmp_path / "points.csv"))):
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
    map_of(run.folder).unlink()
    out = delivered(run, tmp_path / "out")
    assert {path.name for path in out.iterdir()} == FILES - {"map.laz", "plan.tif"}
    for words in (text_of(out / "sheet.pdf")[1], flat(out / "README.txt")):
        assert "There is no map, and no plan from above: the run was made without one" in words


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
        2, "--check: .* is a merge", town.folder, "--check", _far(tmp_path / "points.csv"), "--out", tmp_path / "no"
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
