"""Runs of exact poses on an exact map, as `lslam deliver` finds them, and the truth behind them by pyproj alone."""

from __future__ import annotations

import csv
import json
import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from calling import assert_one_sentence, lslam
from PIL import Image
from pyproj import Transformer

from lslam.backend.control_points import control_residuals
from lslam.backend.manual import read_control_points, write_control
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.geometry import se3, so3
from lslam.core.geometry.geodesy import local_crs
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.core.types.gnss import Georeference
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.formats.trajectory_lines import write_tum
from lslam.maps.occupancy import OccupancyGrid
from lslam.pipeline.back_end_pass import describe
from lslam.pipeline.map_files import MapNote, write_map, write_occupancy
from lslam.pipeline.map_tiles import write_tiles
from lslam.pipeline.outputs import config_text, write_loops

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
    """A run of exact poses and an exact map: a square of points, and a post of fifty alone beside it.

    format_ : suffix of the map, "laz in tiles" for one of tiles alone
    """
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
    cloud = ArrayCloud(world_of(places), np.linspace(0, 1, count).astype(np.float32), columns)
    suffix, _, tiled = format_.partition(" ")
    if tiled:
        (folder / "tiles").mkdir()
        write_tiles(folder / "tiles", cloud, note, 25.0, suffix, place)
    else:
        write_map(folder / f"map.{suffix}", cloud, note, place)
    candidates = [
        LoopCandidate(0, 9, 1.0, 0.1, Verdict.ACCEPTED, LoopStage.GRAPH, overlap=0.9),
        LoopCandidate(1, 5, 2.0, 0.3, Verdict.REJECTED, LoopStage.OVERLAP, "overlap 0.1"),
    ]
    write_loops(folder / "loops.csv", candidates, [2 * k for k in range(10)])
    cells = np.argwhere(np.ones((10, 20, 8), bool)).astype(np.int32)
    write_occupancy(folder, OccupancyGrid(cells, np.where(cells[:, 2] < 3, 90, -90).astype(np.int16), 0.5), "a world")
    return MadeRun(folder, places, poses, columns, post)


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


def placed(path: Path) -> tuple[Any, Any, dict[int, int]]:
    """Grey values of a GeoTIFF, its transform (2, 3) from column and row, and its keys."""
    image = Image.open(path)
    tags: Any = image.tag_v2  # type: ignore[attr-defined]
    keys = np.reshape(tags[34735], (-1, 4))
    return np.array(image), np.reshape(tags[34264], (4, 4))[:2, [0, 1, 3]], {int(k): int(v) for k, _, _, v in keys[1:]}


def coordinates(blob: bytes) -> Any:
    """(N, 3) of a feature: the standard's header, then WKB."""
    assert (blob[:2], struct.unpack_from("<i", blob, 4)[0]) == (b"GP", 25832)
    return shapely.get_coordinates(shapely.from_wkb(blob[8 + (0, 32, 48, 48, 64)[blob[3] >> 1 & 7] :]), include_z=True)


def far_point(path: Path) -> Path:
    path.write_text("scan,x,y,z,sigma,crs\n99,456115,5427613,116,0.02,EPSG:25832\n")
    return path
