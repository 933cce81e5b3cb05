"""`lslam convert RUN --to kml|gpx`: the places of a georeferenced run, told again by the libraries and by plain XML."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime
from pathlib import Path

import gpxpy
import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, manifest
from defusedxml import ElementTree
from fastkml import KML
from fastkml.utils import find_all
from pyproj import Proj, Transformer

from lslam.core.geometry import se3, so3
from lslam.core.geometry.geodesy import from_local
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.text_tables import utc_of
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.formats.trajectory_lines import write_tum

KML_NS, GX_NS = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"
GPX_NS = "{http://www.topografix.com/GPX/1/1}"
BEGIN_NS = 1_700_000_000_123_456_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the sample with its fixes; its stamps begin at zero."""
    out = tmp_path_factory.mktemp("earth") / "town"
    done = lslam("run", SAMPLE, "--poses", SAMPLE / "poses" / "00.txt", "--georeference", "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def dated(run: Path, folder: Path) -> Path:
    """The same run as if its clock had told the date."""
    folder.mkdir()
    old = read_trajectory(run)
    write_tum(folder / "trajectory.tum", Trajectory(old.stamps_ns + BEGIN_NS, old.poses, old.frame))
    (folder / "manifest.json").write_bytes((run / "manifest.json").read_bytes())
    return folder


def expected(run: Path) -> np.ndarray:
    """(N, 3) lat, lon, height from the manifest's numbers alone."""
    told = manifest(run)["georeference"]
    positions = se3.apply(np.array(told["T_enu_world"]), read_trajectory(run).positions)
    return from_local(positions, np.array(told["origin_lat_lon_height"]))


def test_kml_holds_the_places_and_no_time_that_nobody_knows(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.kml"
    done = lslam("convert", run, "--to", "kml", "--out", out)
    assert (done.returncode, done.stdout) == (0, f"{out}: 95 poses of lidar\n"), done.stderr
    root = ElementTree.parse(out).getroot()
    texts = [node.text.split() for node in root.iter(f"{KML_NS}coordinates")]
    assert len(texts) == 1
    rows = np.array([[float(v) for v in text.split(",")] for text in texts[0]])
    np.testing.assert_allclose(rows[:, [1, 0]], expected(run)[:, :2], atol=6e-8, rtol=0)
    np.testing.assert_allclose(rows[:, 2], expected(run)[:, 2], atol=6e-4, rtol=0)
    assert not list(root.iter(f"{KML_NS}when"))
    line = json.loads((run / "trajectory.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    np.testing.assert_array_equal(rows, line)


def test_kml_has_a_track_in_time_where_stamps_are_unix_time(run: Path, tmp_path: Path) -> None:
    folder = dated(run, tmp_path / "dated")
    out = tmp_path / "a.kml"
    assert lslam("convert", folder / "trajectory.tum", "--to", "kml", "--out", out).returncode == 0
    stamps = read_trajectory(folder).stamps_ns
    root = ElementTree.parse(out).getroot()
    whens = [datetime.fromisoformat(node.text) for node in root.iter(f"{KML_NS}when")]
    np.testing.assert_allclose([t.timestamp() for t in whens], stamps * 1e-9, atol=2e-6, rtol=0)
    assert all(t.utcoffset().total_seconds() == 0 for t in whens)
    coords = np.array([[float(v) for v in node.text.split()] for node in root.iter(f"{GX_NS}coord")])
    np.testing.assert_allclose(coords[:, [1, 0]], expected(run)[:, :2], atol=6e-8, rtol=0)
    names = {mark.name for mark in find_all(KML.parse(out), name="a, in time")}
    assert names == {"a, in time"}


def test_gpx_reads_back(run: Path, tmp_path: Path) -> None:
    folder = dated(run, tmp_path / "dated")
    for source, has_times in ((folder, True), (run, False)):
        out = tmp_path / f"{source.name}.gpx"
        done = lslam("convert", source, "--to", "gpx", "--out", out)
        assert done.returncode == 0, done.stderr
        (track,) = gpxpy.parse(out.read_text()).tracks
        (segment,) = track.segments
        rows = np.array([[p.latitude, p.longitude, p.elevation] for p in segment.points])
        np.testing.assert_allclose(rows[:, :2], expected(run)[:, :2], atol=6e-8, rtol=0)
        np.testing.assert_allclose(rows[:, 2], expected(run)[:, 2], atol=6e-4, rtol=0)
        times = [p.time for p in segment.points]
        if has_times:
            stamps = read_trajectory(folder).stamps_ns * 1e-9
            np.testing.assert_allclose([t.timestamp() for t in times], stamps, atol=2e-6, rtol=0)
        else:
            assert times == [None] * 95
        points = list(ElementTree.parse(out).getroot().iter(f"{GPX_NS}trkpt"))
        np.testing.assert_array_equal([[float(p.get("lat")), float(p.get("lon"))] for p in points], rows[:, :2])
        again = tmp_path / "again.gpx"
        assert lslam("convert", source, "--to", "gpx", "--out", again, "--overwrite").returncode == 0
        assert again.read_text().replace("again", source.name) == out.read_text()


def test_a_table_is_in_the_coordinates_of_the_map_and_turned_with_its_grid(run: Path, tmp_path: Path) -> None:
    folder, told = dated(run, tmp_path / "dated"), manifest(run)["georeference"]
    for words, epsg in (((), 32632), (("--crs", "EPSG:25833"), 25833)):
        out = tmp_path / f"{epsg}.csv"
        done = lslam("convert", folder, "--to", "csv", "--out", out, *words)
        assert (done.returncode, done.stdout) == (0, f"{out}: 95 poses of lidar in EPSG:{epsg}\n"), done.stderr
        with out.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        there = np.array([[float(row[name]) for name in ("x_m", "y_m", "z_m")] for row in rows])
        lat, lon, height = expected(run).T
        to_plane = Transformer.from_crs("EPSG:4326", f"EPSG:{epsg}", always_xy=True)
        np.testing.assert_allclose(there, np.column_stack([*to_plane.transform(lon, lat), height]), atol=1e-3, rtol=0)
        assert {row["crs"] for row in rows} == {f"EPSG:{epsg}"}
        assert rows[0]["utc"] == "2023-11-14T22:13:20.123456Z"
        assert [int(row["stamp_ns"]) for row in rows] == read_trajectory(folder).stamps_ns.tolist()
        # True north against grid north, as PROJ has it.
        convergence = np.radians(Proj(f"EPSG:{epsg}").get_factors(lon[0], lat[0]).meridian_convergence)
        T_enu_body = np.array(told["T_enu_world"]) @ read_trajectory(folder).poses
        again = read_trajectory(out)
        np.testing.assert_array_equal(again.stamps_ns, read_trajectory(folder).stamps_ns)
        turned = so3.exp(np.array([0.0, 0.0, convergence])) @ T_enu_body[:, :3, :3]
        apart = so3.angle(np.swapaxes(turned, 1, 2) @ again.poses[:, :3, :3])
        assert apart.max() < 2e-6
        assert abs(convergence) > 1e-3


def test_a_table_of_a_run_that_lies_nowhere_has_its_world(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.csv"
    assert lslam("convert", run / "trajectory_odometry.tum", "--out", out).returncode == 0
    np.testing.assert_allclose(
        read_trajectory(out).poses, read_trajectory(run / "trajectory_odometry.tum").poses, atol=1e-9, rtol=0
    )
    assert "crs" not in out.read_text()
    for source, words, sentence in (
        (run / "trajectory_odometry.tum", ("--crs", "EPSG:25832"), "neither the folder of a run"),
        (run, ("--crs", "EPSG:4326"), "does not count in metres"),
        (run, ("--crs", "32632"), "is no EPSG code"),
        (run, ("--to", "kml", "--crs", "EPSG:25832"), "--crs is for --to csv and gpkg"),
    ):
        done = lslam("convert", source, "--out", tmp_path / "b.csv", *words)
        assert done.returncode == 2, done.stderr
        assert sentence in done.stderr
        assert_one_sentence(done.stderr)
    assert not (tmp_path / "b.csv").exists()


def test_what_has_no_place_is_refused_with_the_way_out(run: Path, tmp_path: Path) -> None:
    bare = dated(run, tmp_path / "bare")
    about = manifest(bare)
    del about["georeference"]
    (bare / "manifest.json").write_text(json.dumps(about))
    alone = tmp_path / "alone.tum"
    alone.write_bytes((run / "trajectory.tum").read_bytes())
    out = tmp_path / "a.kml"
    for source, words, code, sentence in (
        (bare, (), 2, "run the sequence again with --gnss or --georeference"),
        (alone, (), 2, "neither the folder of a run"),
        (run / "trajectory_odometry.tum", (), 2, "neither the folder of a run"),
        (SAMPLE, (), 2, "neither the folder of a run"),
        (tmp_path / "none", (), 3, "does not exist"),
        (run, ("--frame", "cam0"), 2, "a world of their own"),
        (run, ("--frame", "imu"), 3, "needs T_lidar_imu"),
        (run, ("--zstd",), 2, "--zstd is for sequences"),
    ):
        done = lslam("convert", source, "--to", "kml", "--out", out, *words)
        assert done.returncode == code, done.stderr
        assert sentence in done.stderr
        assert_one_sentence(done.stderr)
    assert not out.exists()
    out.write_text("mine")
    assert lslam("convert", run, "--to", "gpx", "--out", out).returncode == 2
    assert out.read_text() == "mine"


def test_only_unix_time_is_utc() -> None:
    assert utc_of(np.array([0, 100], np.int64)) is None
    assert utc_of(np.zeros(0, np.int64)) is None
    at = utc_of(np.array([BEGIN_NS], np.int64))
    assert at == [datetime(2023, 11, 14, 22, 13, 20, 123456, tzinfo=UTC)]
