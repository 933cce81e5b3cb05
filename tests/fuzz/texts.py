"""Files of text: trajectories, stamps, calibrations, tables, configurations, maps, and what a run leaves behind."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz.cases import Files, Parser
from osm_builders import ExtractMaker

from lslam.backend.manual import read_control_points, read_named_pairs
from lslam.core import __version__
from lslam.core.config import load_config
from lslam.core.config.config import to_toml
from lslam.core.config.study import read_batch, read_study
from lslam.core.errors import LslamError
from lslam.core.types.study import StudyRow
from lslam.evaluation.timing import read_timing
from lslam.io.formats.geojson import read_line
from lslam.io.formats.kitti_layout import read_cam0_lidar, read_mcd_extrinsics, read_oxts, read_transform
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.sequence_toml import read_sequence_toml
from lslam.io.formats.stamped_csv import read_gnss_csv, read_imu_csv
from lslam.io.formats.state_files import read_state, write_state
from lslam.io.formats.time_columns import read_stamps, read_times
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers.scan_stamps import stamps_in_names
from lslam.osm.bounds import Bounds
from lslam.osm.buildings_geojson import read_buildings_geojson
from lslam.osm.overpass import kept_reply
from lslam.pipeline.plot_run import view_run
from lslam.pipeline.rebuild import read_run
from lslam.pipeline.resume import may_go_on
from lslam.pipeline.stored_map import map_of
from lslam.simulation.osm_extract import read_perturbation
from lslam.simulation.record import read_mark
from lslam.simulation.routes import read_way_points
from lslam.simulation.scenario_files import find_scenario
from lslam.studies import results_csv
from lslam.studies.results_csv import read_study_csv, write_study_csv

_ROOT = Path(__file__).resolve().parents[2]
_SAMPLE = _ROOT / "sample_data" / "sequences" / "00"


def _text_parser(name: str, file: str, read: Callable[[Path], object], *texts: str | bytes) -> Parser:
    """A parser of one file of lines, or of one tree."""
    contents = [t if isinstance(t, bytes) else t.encode() for t in (*texts, "", "\ufeff", b"\xff\xfe\x00", "[" * 5000)]
    is_tree = file.endswith((".json", ".geojson", ".toml"))
    return Parser(
        name, lambda folder: read(folder / file), lambda _: [{file: data} for data in contents],
        trees=(file,) if is_tree else (), tables=() if is_tree else (file,),
    )  # fmt: skip


def _read_names(path: Path) -> None:
    """What the names of files say of their times; a name that no disk takes is none."""
    lines = path.read_text(errors="replace").splitlines()
    names = [Path(f"{line}.bin") for line in lines if line.strip("/.") and "\0" not in line and len(line) < 250]
    if names:
        stamps_in_names(names)


_TUM = "# frame: lidar\n" + "".join(f"{1.5 + k / 10} {k} 0 0 0 0 0 1\n" for k in range(5))
_EUROC = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n" + "".join(
    f"{1670403902235281229 + k},{k},0,0,1,0,0,0\n" for k in range(4)
)
_CSV = "t,x,y,z,qx,qy,qz,qw\n" + "".join(f"{k},{k},0,0,0,0,0,1\n" for k in range(4))
_KITTI = "1 0 0 0 0 1 0 0 0 0 1 0\n" * 4
_IMU = "stamp_ns,accel_x,accel_y,accel_z,gyro_x,gyro_y,gyro_z\n0,0,0,9.81,0,0,0\n10000000,0,0,9.81,0,0,0\n"
_GNSS = "time,lat,lon,alt\n0.0,49,8.4,110\n0.1,49.00001,8.4,110\n"
_CALIB = "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
_MCD = "body:\n  os_sensor:\n    T:\n    - [1, 0, 0, 0]\n    - [0, 1, 0, 0]\n    - [0, 0, 1, 0]\n    - [0, 0, 0, 1]\n"
_STUDY = """summary = "a study"
methods = ["icp"]
seeds = [1, 2]
grid = "one-way"
[[sequences]]
path = "sample_data"
count = 5
[parameters]
"map.voxel" = [0.1, 0.2]
"input.skip_frames" = {start = 1, stop = 4, step = 1}
"registration.max_distance" = {start = 0.5, stop = 4.0, num = 3, log = true}
[config.map]
format = "ply"
"""
_BATCH = """[config.map]
voxel = 0.2
[[jobs]]
sequences = ["07", {scenario = "block", scans = 5}]
methods = ["icp"]
seeds = [0, 1]
"""
_SCENARIO = 'base = "block"\nspeed = 5.0\nlidar = "vlp16"\n[world]\nrelief = 1.0\n'
_PRESET = 'summary = "mine"\nbase = "thesis-icp"\n[map]\nvoxel = 0.3\n'
_TIMING = "index,stamp_ns,read,register,total\n0,0,0.01,0.02,0.03\n1,100000000,0.01,0.02,0.03\n"
_LINE = json.dumps({
    "type": "FeatureCollection",
    "features": [{"type": "Feature", "properties": {}, "geometry": {
        "type": "LineString", "coordinates": [[8.4, 49.0, 110], [8.41, 49.0, 110], [8.41, 49.01, 112]]}}],
})  # fmt: skip
_OUTLINES = json.dumps({
    "type": "FeatureCollection",
    "features": [{"type": "Feature", "properties": {"building": "yes", "@id": "way/12", "height": "8"}, "geometry": {
        "type": "Polygon", "coordinates": [[[8.4, 49.0], [8.4001, 49.0], [8.4001, 49.0001], [8.4, 49.0]]]}},
        {"type": "Feature", "properties": {"osm_id": 5}, "geometry": {"type": "GeometryCollection", "geometries": [{
         "type": "MultiPolygon", "coordinates": [[[[8.41, 49.0], [8.4101, 49.0], [8.4101, 49.0001], [8.41, 49.0]]]]}]}}],
})  # fmt: skip
CORRECTED = json.dumps({
    "type": "FeatureCollection", "schema": "lslam-buildings-1", "attribution": "x", "origin": [49.0, 8.4, 0.0], "mode": "one",
    "map_shift_m": [0.1, 0.2, 0.0], "features": [
        {"type": "Feature", "properties": {
            "@id": "way/12", "status": "seen", "displacement_east_m": 0.1, "displacement_north_m": 0.2, "turn_deg": 0.1,
            "covariance": np.eye(3).tolist(), "matches": 5, "matches_rejected": 1, "overlaps": ["way/12"], "height_m": 7.5,
            "base_m": 0.0, "tags": {"building": "yes"}, "confidence": 1.0},
         "geometry": {"type": "Polygon", "coordinates": [[[8.4, 49.0], [8.4001, 49.0], [8.4001, 49.0001], [8.4, 49.0]]]}},
        {"type": "Feature", "properties": {"status": "new"},
         "geometry": {"type": "LineString", "coordinates": [[8.4, 49.0], [8.4001, 49.0]]}}],
})  # fmt: skip
_PERTURBED = json.dumps({
    "schema": "lslam-osm-perturbation-1", "shift_m": [1.0, 2.0], "attribution": None, "buildings": [],
    "not_yet_built": [{"id": "way/1", "outline_m": [[0, 0], [1, 0], [1, 1]], "height_m": 5.0, "tags": {}}],
})  # fmt: skip
_BOUNDS = Bounds(49.0, 8.41, 49.02, 8.43)


def _extract(kind: str) -> Callable[[Path], list[Files]]:
    def make(folder: Path) -> list[Files]:
        maker = ExtractMaker()
        maker.square(1, 0, 0, 10, building="yes", height="12.5 m")
        maker.square(2, 30, 0, 8, building="house", building__levels="3")
        outer, inner = maker.nodes([[60, 0], [80, 0], [80, 20], [60, 20]]), maker.nodes([[65, 5], [70, 5], [70, 10]])
        maker.way(3, [*outer, outer[0]])
        maker.way(4, [*inner, inner[0]])
        maker.relation(5, [(3, "outer"), (4, "inner")], type="multipolygon", building="yes")
        path = folder / f"map.{kind}"
        data = (maker.write_xml(path) if kind == "osm" else maker.write_json(path)).read_bytes()
        drawn = b'{"elements":[{"type":"way","id":1,"tags":{"building":"yes"},"geometry":[{"lat":49,"lon":8},null]}]}'
        bad = [b"", b"<osm>", b"<osm><node/></osm>", b"<osm>" * 10_000, drawn, b'{"elements":[1]}', b"[" * 5000]
        if kind == "osm":
            bad.append(data.replace(b"?>", b'?><!DOCTYPE osm [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>', 1))
            bad.append(data.decode().encode("utf-16"))
        return [{path.name: d} for d in (data, *bad)]

    return make


def _results(folder: Path) -> list[Files]:
    row = StudyRow("a", "s", "q", 1, "icp", parameters={"map.voxel": 0.1}, stages_ms={"read": 1.0}, scans=5)
    write_study_csv(folder / "results.csv", [row, row])
    return [{"results.csv": (folder / "results.csv").read_bytes()}]


def _named_pairs(folder: Path) -> list[Files]:
    return [
        {"a.csv": b"scan_a,scan_b,verdict,x_m,within_m\n0,84,known,2.5,4\n2,88,accepted,,\n3,90,forbidden,,\n"},
        {"a.csv": b"stamp_a;stamp_b;verdict\n12.5;99.25;known\n"},
    ]


def _control_points(folder: Path) -> list[Files]:
    row = b"7,457799.014,5428861.26,115.006,0.01,EPSG:25832,1,2,-1.5\n"
    return [{"a.csv": b"scan,x,y,z,sigma,crs,lidar_x,lidar_y,lidar_z\n" + row + row}]


def _state(folder: Path) -> list[Files]:
    write_state(folder / "a.npz", {"a": [1, 2.0, "x", None], "b": (np.eye(3), {"c": np.arange(4)})}, 1)
    return [{"a.npz": (folder / "a.npz").read_bytes()}]


def _oxts(folder: Path) -> list[Files]:
    rows = {f"data/{k:010d}.txt": (" ".join(["49.0"] * 30)).encode() for k in range(3)}
    stamps = b"".join(b"2011-09-26 13:04:32.%d49659964\n" % k for k in range(3))
    return [rows | {"timestamps.txt": stamps}, rows | {"timestamps.txt": b"9999-99-99 99:99:99\n"}]


_IDENTITY = dict.fromkeys(("input", "reading", "imu", "wheels", "gnss", "osm", "poses", "manual"), "x")
_SCANS_CSV = "index,stamp_ns,status,posed_by\n" + "".join(f"{k},0,ok,\n" for k in range(5))
_GEOREFERENCE = {
    "origin_lat_lon_height": [49.0, 8.4, 110.0],
    "T_enu_world": np.eye(4).tolist(),
    "epsg": None,
    "method": "fit",
}


def _run(folder: Path) -> list[Files]:
    manifest = {
        "lslam": __version__, "status": "interrupted",
        "sequence": {"name": "a", "path": "/nowhere", "reading": {"lidar_topic": "/p"}},
        "frames": {"world": "LiDAR at the first scan"}, "identity": _IDENTITY, "problems": ["one"], "counts": {"scans": 5},
        "georeference": _GEOREFERENCE, "peak_memory_mb": 100.0,
    }  # fmt: skip
    ply = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
    note = {"file": "map.ply", "crs": 32632, "georeference": _GEOREFERENCE}
    files = {
        "manifest.json": json.dumps(manifest).encode(), "config.toml": to_toml(load_config()).encode(),
        "trajectory.tum": _TUM.encode(), "scans.csv": _SCANS_CSV.encode(), "timing.csv": _TIMING.encode(),
        "map.ply": ply, "map.json": json.dumps(note).encode(),
    }  # fmt: skip
    return [files, files | {"scans.csv": _SCANS_CSV.replace("\n2", "\n\n2").encode()}, files | {"manifest.json": b"[]"}]


def _read_run(folder: Path) -> None:
    """What `map`, `view`, `eval` and `--resume` read of a run folder, each for itself."""
    refused: list[LslamError] = []
    steps: list[Callable[[], object]] = [
        lambda: read_run(folder), lambda: map_of(folder), lambda: view_run(folder),
        lambda: may_go_on(folder, _IDENTITY, load_config()), lambda: read_timing(folder / "timing.csv"),
    ]  # fmt: skip
    for step in steps:
        try:
            step()
        except LslamError as error:
            refused.append(error)
    if refused:
        raise refused[0]


def _kept(folder: Path) -> list[Files]:
    from lslam.osm.overpass import _file_name

    maker = ExtractMaker()
    maker.square(1, 0, 0, 10, building="yes")
    return [{_file_name(_BOUNDS): json.dumps(maker.tree()).encode()}]


_OF_TOOLS = (
    "%time,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z\n1,2,3,4,5\n2,3,4,5,nan\n",
    "sec;nsec;x;y;z\n7;100000000;1,5;2,5;3\n7;200000000;1,5;2,5;3\n8;1;0;0;0\n",
    "1 1 0 0 5 0 1 0 6 0 0 1 7\n4 1 0 0 5 0 1 0 6 0 0 1 8\n",
    "0 7.5 0 0 0 0 0 0 1\n1 7.6 1 0 0 0 0 0 1\n2 7.7 2 1 0 0 0 0 1\n",
    "1670403902235281229,1,0,0,5,0,1,0,6,0,0,1,7\n1670403902335281229,1,0,0,5,0,1,0,6,0,0,1,8\n",
    "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up\n7.1,1,2,3,4,5,6\n7.2,2,2,3,4,5,6\n7.4,3,3,3,4,5,6\n",
)
_NAMES = (
    "1618033.5\n1618033.6\n1618033.8\n",
    "a_1670403902.235281229\na_1670403902.35281229\n",
    "000_1670403902235\n001_1670403902335\n",
    "2023-11-14T22-13-20.123\n2023-11-14T22-13-20.223\n",
    "1000000000000\n1000100000000\n1000200000000\n",
    "000000\n000001\n",
)
PARSERS = [
    _text_parser("trajectory", "a.txt", read_trajectory, _TUM, _EUROC, _CSV, _KITTI),
    _text_parser("trajectory of another tool", "a.csv", read_trajectory, *_OF_TOOLS),
    _text_parser("times", "times.txt", read_times, "0.0\n1.036224e-01\n0.2\n"),
    _text_parser("stamps", "stamps.txt", read_stamps, "0.0\n0.1\n", "2011-09-26 13:04:32.349659964\n2011-09-26 13:04:33\n",
                 "stamp\n1670403902235281229\n1670403902335281229\n"),
    _text_parser("stamps in columns", "stamps.csv", read_stamps, "#sec,nsec\n7,100000000\n7,300000000\n8,1\n",
                 "0 1670403902.2\n1 1670403902.3\n2 1670403902.4\n"),
    _text_parser("names of scans", "names.txt", _read_names, *_NAMES),
    _text_parser("imu.csv", "imu.csv", read_imu_csv, _IMU, "sec,nanosec," + _IMU.split(",", 1)[1].replace("\n", "\n7,", 1)),
    _text_parser("gnss.csv", "gnss.csv", read_gnss_csv, _GNSS,
                 "%time,field.latitude,field.longitude,field.altitude\n1670403902235281229,49,8,100\n"),
    _text_parser("KITTI calibration", "calib.txt", read_cam0_lidar, _CALIB, "R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n"),
    _text_parser("MCD calibration", "a_calib.yaml", read_mcd_extrinsics, _MCD),
    _text_parser("transform", "T.txt", lambda p: read_transform(str(p)), "1 0 0 0 0 1 0 0 0 0 1 0\n", "0,0,0,0,0,0,1", _CALIB),
    Parser("OXTS", read_oxts, _oxts, tables=("timestamps.txt", "data/0000000001.txt")),
    _text_parser("timing.csv", "timing.csv", read_timing, _TIMING),
    Parser("results.csv", lambda f: read_study_csv(f / "results.csv"), _results, tables=("results.csv",)),
    Parser("named pairs", lambda f: read_named_pairs(f / "a.csv"), _named_pairs, tables=("a.csv",)),
    Parser("control points", lambda f: read_control_points(f / "a.csv"), _control_points, tables=("a.csv",)),
    Parser("run state", lambda f: read_state(f / "a.npz", ()), _state),
    _text_parser("sequence.toml", "sequence.toml", read_sequence_toml, (_SAMPLE / "sequence.toml").read_bytes()),
    _text_parser("configuration", "c.toml", load_config, to_toml(load_config()), '[odometry]\npreset = "hdl"\n'),
    _text_parser("preset", "p.toml", lambda p: load_config(None, [f"odometry.preset={p}"]), _PRESET),
    _text_parser("study", "s.toml", lambda p: read_study(p).points(), _STUDY),
    _text_parser("batch", "b.toml", read_batch, _BATCH),
    _text_parser("scenario", "s.toml", lambda p: find_scenario(str(p)), _SCENARIO),
    _text_parser("way-points, TOML", "w.toml", read_way_points, "points = [[0, 0], [5.5, 0], [5, 5], [0, 5]]\nclosed = true\n"),
    _text_parser("way-points, csv", "w.csv", read_way_points, "x,y\n0,0\n50,0\n50,50\n", "0,0\n10,10\n20,20\n"),
    _text_parser("way-points, GeoJSON", "w.geojson", read_way_points, _LINE),
    Parser("OSM XML", lambda f: read_buildings(f / "map.osm"), _extract("osm"), tables=("map.osm",)),
    Parser("Overpass JSON", lambda f: read_buildings(f / "map.json"), _extract("json")),
    _text_parser("GeoJSON outlines", "map.geojson", read_buildings, _OUTLINES),
    _text_parser("GeoJSON line", "line.geojson", read_line, _LINE),
    _text_parser("buildings.geojson", "buildings.geojson", read_buildings_geojson, CORRECTED),
    _text_parser("perturbed map", "p.json", read_perturbation, _PERTURBED),
    Parser("kept reply", lambda f: kept_reply(_BOUNDS, f), _kept),
    _text_parser("job state", "state.json", results_csv.read_state,
                 json.dumps({"digest": "a", "status": "done", "reason": "", "jobs": 1, "load": 0.5, "seconds": 1.0,
                             "is_alone": True, "waited": 0.0, "machine": "m"})),
    _text_parser("simulation mark", "simulation.json", lambda p: read_mark(p.parent), '{"fingerprint": "a"}'),
    Parser("run folder", _read_run, _run, trees=("manifest.json", "map.json", "config.toml"), tables=("scans.csv", "timing.csv")),
]  # fmt: skip
