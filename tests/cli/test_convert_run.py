"""`lslam convert RUN`: a bag, read by rosbags and, by its schemas alone, by Foxglove's library; a GeoPackage, by SQL and WKB."""

from __future__ import annotations

import json
import shutil
import sqlite3
import struct
from collections import defaultdict
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from calling import SAMPLE, assert_one_sentence, lslam, manifest
from defusedxml import ElementTree
from fudgeo import GeoPackage
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from pyproj import Transformer
from rosbags.highlevel import AnyReader
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from lslam.core.geometry import se3, so3
from lslam.core.geometry.geodesy import from_local
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.formats.trajectory_lines import write_tum
from lslam.pipeline.convert.convert_run import PATHS, convert_run
from lslam.pipeline.rebuild import open_scans, read_run

SCANS, VOXEL = 48, 0.2
SEQUENCE = SAMPLE / "sequences" / "00"
BEGIN_NS = 1_700_000_000_123_456_000
TYPES = {
    "/map": "sensor_msgs/msg/PointCloud2",
    "/points": "sensor_msgs/msg/PointCloud2",
    "/odometry": "nav_msgs/msg/Odometry",
    "/path": "nav_msgs/msg/Path",
    "/tf": "tf2_msgs/msg/TFMessage",
}
COUNTS = {"/map": 1, "/points": SCANS, "/odometry": SCANS, "/path": PATHS, "/tf": SCANS}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every other scan of the sample, held by buildings; the map lies in its UTM zone, the poses do not."""
    out = tmp_path_factory.mktemp("bag") / "town"
    words = (
        "--skip-frames",
        2,
        "--no-loops",
        "--georeference",
        "--osm",
        SEQUENCE / "map.osm",
        "--set",
        "map.format=laz",
    )
    assert (done := lslam("run", SAMPLE, *words, "--out", out)).returncode == 0, done.stderr
    assert json.loads((out / "map.json").read_text())["crs"] == "EPSG:32632"
    return out


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Stamp and message by topic, by the definitions in the file alone."""
    found = defaultdict(list)
    with path.open("rb") as stream:
        for _, channel, message, content in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found[channel.topic].append((message.log_time, content))
    return found


def ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def pose_of(place: Any, turn: Any) -> np.ndarray:
    return se3.make(
        so3.from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w])), np.array([place.x, place.y, place.z])
    )


def table_of(cloud: Any) -> np.ndarray:
    """(N, 4) x, y, z, intensity, from the bytes."""
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("intensity", 12, 7, 1),
    ]  # fmt: skip
    assert (cloud.point_step, cloud.height, cloud.is_dense, cloud.is_bigendian) == (16, 1, True, False)
    assert cloud.row_step == len(cloud.data) == 16 * cloud.width
    return np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 4)


def test_every_viewer_finds_the_run_in_the_file(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "town.mcap"
    done = lslam("convert", run, "--out", out)
    points = manifest(run)["map_points"]
    said = f"{out}: {SCANS} poses, {SCANS} clouds, a map of {points} points\n"
    assert (done.returncode, done.stdout) == (0, said), done.stderr
    with out.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    channels = {c.topic: c for c in summary.channels.values()}
    schemas = {topic: summary.schemas[c.schema_id] for topic, c in channels.items()}
    assert {topic: schema.name for topic, schema in schemas.items()} == TYPES
    assert {schema.encoding for schema in schemas.values()} == {"ros2msg"}
    assert {c.message_encoding for c in channels.values()} == {"cdr"}
    assert {t: summary.statistics.channel_message_counts[c.id] for t, c in channels.items()} == COUNTS
    # Who comes late, as rviz, hears of the whole: durability 1 is transient local.
    assert {t for t, c in channels.items() if "durability: 1" in c.metadata["offered_qos_profiles"]} == {
        "/map",
        "/path",
    }

    topics = decoded(out)
    trajectory = read_trajectory(run)
    stamps = trajectory.stamps_ns.tolist()
    with np.load(run / "covariances.npz") as arrays:
        covariances = arrays["covariances"]
    for k, ((at, message), (then, tree)) in enumerate(zip(topics["/odometry"], topics["/tf"], strict=True)):
        assert at == then == ns(message.header) == stamps[k]
        assert (message.header.frame_id, message.child_frame_id) == ("map", "lidar")
        pose = message.pose.pose
        np.testing.assert_allclose(pose_of(pose.position, pose.orientation), trajectory.poses[k], atol=1e-11)
        np.testing.assert_array_equal(np.reshape(message.pose.covariance, (6, 6)), covariances[k])
        (one,) = tree.transforms
        assert (ns(one.header), one.header.frame_id, one.child_frame_id) == (stamps[k], "map", "lidar")
        T = pose_of(one.transform.translation, one.transform.rotation)
        np.testing.assert_allclose(T, trajectory.poses[k], atol=1e-11)
    (at, whole), (last, path) = topics["/map"][0], topics["/path"][-1]
    assert (at, whole.header.frame_id) == (stamps[0], "map")
    assert (last, len(path.poses)) == (stamps[-1], SCANS)
    assert [ns(p.header) for p in path.poses] == stamps


def test_points_lie_on_the_map_where_tf_puts_them_and_nowhere_else(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "town.mcap"
    assert lslam("convert", run, "--to", "mcap", "--zstd", "--voxel", 0.5, "--out", out).returncode == 0
    topics = decoded(out)
    tree = cKDTree(table_of(topics["/map"][0][1])[:, :3])
    section = read_run(run).config.map
    for k in (1, SCANS - 1):
        at, cloud = topics["/points"][k]
        assert (at, cloud.header.frame_id) == (topics["/tf"][k][0], "lidar")
        points = table_of(cloud)[:, :3].astype(np.float64)
        assert len(np.unique(np.floor(points / 0.5), axis=0)) == len(points) > 500
        distance = np.linalg.norm(points, axis=1)
        points = points[(distance > section.range_min) & (distance < section.range_max)]
        moved = topics["/tf"][k][1].transforms[0].transform
        off, _ = tree.query(se3.apply(pose_of(moved.translation, moved.rotation), points))
        # A point and the mean of its voxel are in one cube.
        assert off.max() < VOXEL * 3**0.5 + 1e-3
        if k > 1:
            assert np.median(tree.query(points)[0]) > np.median(off), "the first pose would do as well"


@pytest.mark.parametrize("name", ["a.bag", "a.db3"])
def test_rosbags_reads_every_message_and_poses_need_no_scans(run: Path, tmp_path: Path, name: str) -> None:
    moved = tmp_path / "town"
    shutil.copytree(run, moved)
    about = manifest(moved)
    about["sequence"]["path"] = str(tmp_path / "gone")
    (moved / "manifest.json").write_text(json.dumps(about))
    out = tmp_path / name
    refused = lslam("convert", moved, "--out", out)
    assert refused.returncode == 3
    assert "say where they are with --sequence, or leave them out with --no-clouds" in refused.stderr
    assert_one_sentence(refused.stderr)
    assert not out.exists()
    is_bag = name == "a.bag"
    assert (
        lslam("convert", moved, "--out", out, *(("--no-clouds",) if is_bag else ("--sequence", SAMPLE))).returncode == 0
    )
    seen: dict[str, int] = defaultdict(int)
    with AnyReader([out]) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == {
            t: k for t, k in TYPES.items() if t != "/points" or not is_bag
        }
        for connection, stamp, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            assert ns(message.transforms[0].header if connection.topic == "/tf" else message.header) == stamp
            seen[connection.topic] += 1
    assert seen == {t: n for t, n in COUNTS.items() if t in seen}
    assert len(seen) == len(TYPES) - is_bag


def test_what_is_interrupted_leaves_nothing_and_what_was_there_stays(run: Path, tmp_path: Path) -> None:
    opened, out, left = read_run(run), tmp_path / "a.mcap", iter(range(5))
    out.write_bytes(b"mine")

    def stop() -> None:
        if next(left) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert_run(opened, open_scans(opened), "mcap", out, overwrite=True, on_scan=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    assert out.read_bytes() == b"mine"


def test_what_does_not_belong_to_a_run_is_refused(run: Path, tmp_path: Path) -> None:
    before = sorted(run.iterdir())
    (tmp_path / "there.mcap").touch()
    out = tmp_path / "a.mcap"
    for words, code, sentence in (
        ((run, "--out", tmp_path / "there.mcap"), 2, "--overwrite"),
        ((run, "--out", tmp_path / "a.bag", "--to", "mcap"), 2, "not for --to mcap"),
        ((run, "--out", run, "--to", "mcap", "--overwrite"), 2, "holds the run itself"),
        ((run, "--out", out, "--voxel", "-1"), 2, "--voxel -1: an edge in m"),
        ((run, "--out", out, "--voxel", "1", "--no-clouds"), 2, "--voxel contradicts --no-clouds"),
        ((run, "--out", out, "--count", "3"), 2, "--count is not for the folder of a run"),
        ((run, "--out", out, "--frame", "imu"), 2, "--frame is not for the folder of a run"),
        ((run, "--out", out, "--sequence", tmp_path / "none"), 3, "none does not exist"),
        ((SAMPLE, "--out", out, "--no-clouds"), 2, "--no-clouds is for the folder of a run"),
        ((run, "--out", tmp_path / "a.xyz"), 2, "--to says what to write"),
        ((run,), 2, "--to says what to write"),
        ((SAMPLE, "--to", "mcap"), 2, "--out names the file"),
    ):
        done = lslam("convert", *words)
        assert done.returncode == code, done.stderr
        assert sentence in done.stderr
        assert_one_sentence(done.stderr)
    assert [p.name for p in tmp_path.iterdir()] == ["there.mcap"]
    assert sorted(run.iterdir()) == before


def shape_of(blob: bytes) -> BaseGeometry:
    """The standard's header, which has the box and the reference system, then WKB."""
    assert (blob[:2], blob[2]) == (b"GP", 0)
    assert struct.unpack_from("<i", blob, 4)[0] == 32632
    return shapely.from_wkb(blob[8 + (0, 32, 48, 48, 64)[blob[3] >> 1 & 7] :])


def test_a_geopackage_has_every_scan_and_building_where_it_lies(run: Path, tmp_path: Path) -> None:
    dated, out = tmp_path / "dated", tmp_path / "town.gpkg"
    shutil.copytree(run, dated)
    trajectory = read_trajectory(run)
    write_tum(dated / "trajectory.tum", replace(trajectory, stamps_ns=trajectory.stamps_ns + BEGIN_NS))
    buildings = json.loads((run / "buildings.geojson").read_text())["features"]
    known = [f for f in buildings if f["properties"]["status"] != "new"]
    done = lslam("convert", dated, "--out", out)
    said = f"1 in trajectory, {SCANS} in scans, {len(known)} in buildings, {len(buildings) - len(known)} in new_walls"
    assert (done.returncode, done.stdout) == (0, f"{out}: {said}\n"), done.stderr

    told = manifest(run)["georeference"]
    positions = se3.apply(np.array(told["T_enu_world"]), trajectory.positions)
    lat_lon = from_local(positions, np.array(told["origin_lat_lon_height"]))
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    places = np.column_stack([*to_utm.transform(lat_lon[:, 1], lat_lon[:, 0]), lat_lon[:, 2]])
    with np.load(run / "covariances.npz") as arrays:
        sigmas = np.sqrt(np.linalg.eigvalsh(arrays["covariances"][:, :3, :3])[:, -1])
    with closing(sqlite3.connect(out)) as db:
        assert db.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        systems = db.execute("SELECT DISTINCT organization, organization_coordsys_id FROM gpkg_contents JOIN "
                             "gpkg_spatial_ref_sys USING (srs_id)").fetchall()  # fmt: skip
        assert systems == [("EPSG", 32632)]
        box = db.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = 'scans'").fetchone()
        np.testing.assert_allclose(box, [*places[:, :2].min(0), *places[:, :2].max(0)], atol=1e-4, rtol=0)
        assert db.execute("SELECT count(*) FROM rtree_scans_geom").fetchone() == (SCANS,)
        scans = db.execute("SELECT geom, scan, stamp_ns, utc, status, sigma_m FROM scans ORDER BY fid").fetchall()
        (line,) = db.execute("SELECT geom FROM trajectory").fetchone()
        styles = dict(db.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"))
        houses = db.execute("SELECT geom, osm_id, status, displacement_east_m FROM buildings ORDER BY fid").fetchall()
    shapes, numbers, stamps, times, statuses, spread = zip(*scans, strict=True)
    np.testing.assert_allclose([np.array(shape_of(s).coords)[0] for s in shapes], places, atol=1e-4, rtol=0)
    np.testing.assert_allclose(shapely.get_coordinates(shape_of(line), include_z=True), places, atol=1e-4, rtol=0)
    assert numbers == tuple(range(0, 2 * SCANS, 2))
    assert stamps == tuple((trajectory.stamps_ns + BEGIN_NS).tolist())
    assert times[0] == "2023-11-14T22:13:20.123Z"
    assert set(statuses) == {"ok"}
    np.testing.assert_allclose(spread, sigmas, rtol=1e-9)
    for (blob, name, status, east), feature in zip(houses, known, strict=True):
        about, on_earth = feature["properties"], shapely.geometry.shape(feature["geometry"])
        wanted = shapely.transform(on_earth, to_utm.transform, interleaved=False)
        assert (name, status, east) == (about["@id"], about["status"], about["displacement_east_m"])
        assert shape_of(blob).is_valid
        assert shape_of(blob).hausdorff_distance(wanted) < 0.02  # GeoJSON has 7 decimals of a degree
    for name, drawn in {
        "trajectory": [],
        "scans": ["ok", "bridged", "skipped"],
        "buildings": ["seen", "unseen", "absent"],
    }.items():
        style = ElementTree.fromstring(styles[name])
        assert [category.get("value") for category in style.iter("category")] == drawn
        assert len(list(style.iter("symbol"))) == max(len(drawn), 1)
    # As its own library reads it.
    assert {name: len(layer) for name, layer in GeoPackage(out).feature_classes.items()}["buildings"] == len(known)


def test_a_geopackage_is_of_a_run_that_lies_on_the_earth(run: Path, tmp_path: Path) -> None:
    bare, out = tmp_path / "bare", tmp_path / "a.gpkg"
    shutil.copytree(run, bare)
    about = manifest(bare)
    del about["georeference"]
    (bare / "manifest.json").write_text(json.dumps(about))
    for words, code, sentence in (
        ((bare, "--out", out), 2, "is not georeferenced"),
        ((run / "trajectory.tum", "--out", out), 3, "is no folder of a run"),
        ((run, "--to", "gpkg", "--out", tmp_path / "a.sqlite"), 2, "its name ends in .gpkg"),
        ((run, "--out", out, "--frame", "imu"), 2, "--frame is not for --to gpkg"),
        ((run, "--out", out, "--zstd"), 2, "--zstd is not for --to gpkg"),
    ):
        done = lslam("convert", *words)
        assert done.returncode == code, done.stderr
        assert sentence in done.stderr
        assert_one_sentence(done.stderr)
    assert [p.name for p in tmp_path.iterdir()] == ["bare"]
    out.write_bytes(b"mine")
    assert lslam("convert", run, "--out", out).returncode == 2
    assert out.read_bytes() == b"mine"
    assert lslam("convert", run, "--out", out, "--overwrite").returncode == 0
    assert out.read_bytes()[:15] == b"SQLite format 3"
