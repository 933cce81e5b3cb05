"""A trajectory in another format, of another body (LiDAR, camera 0 or IMU), or for map programs: KML by fastkml, GPX by gpxpy."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np

from lslam.core import __version__
from lslam.core.arrays import Floats
from lslam.core.errors import InputError, UsageError
from lslam.core.extras import importing, install_hint
from lslam.core.geometry import se3
from lslam.core.types.gnss import Georeference
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.atomic import write_text
from lslam.io.formats.sequence_toml import FRAMES
from lslam.io.formats.text_tables import utc_of
from lslam.io.formats.trajectory_csv import write_csv
from lslam.io.formats.trajectory_files import FORMATS
from lslam.maps.georeference import Projection, to_lat_lon
from lslam.pipeline.map_files import georeference_of, read_json
from lslam.pipeline.run_folder import MANIFEST, require_new

log = logging.getLogger("lslam")


def convert_trajectory(
    trajectory: Trajectory,
    kind: str,
    out: Path,
    calibration: Calibration,
    *,
    frame: str | None = None,
    overwrite: bool = False,
    place: Georeference | Projection | None = None,
) -> Trajectory:
    """Write `trajectory` to `out` as `kind`, as poses of `frame`, by default the format's own body. Returns the written one.

    place : where on the Earth the world of the poses lies. `kml` and `gpx` need a georeference; with a projection, `csv` is a
        table in its coordinate reference system. Poses that are not finite are left out then.
    Raises InputError: the change of body needs an extrinsic that `calibration` does not have, or no pose is finite. UsageError:
    unknown `kind` or `frame`, or a coordinate reference system that is not in metres. OutputExistsError: `out` exists and
    `overwrite` is not set.
    """
    if kind not in FORMATS and kind not in WRITERS:
        raise UsageError(f"no trajectory format {kind!r} to write: {', '.join((*FORMATS, *WRITERS))} are")
    if isinstance(place, Projection):
        place.check()
    if place is not None and frame == "cam0":
        raise UsageError(f"--frame cam0: poses of the camera have a world of their own, --to {kind} takes lidar or imu")
    require_new(out, overwrite)
    if place is None:
        return _convert(trajectory, kind, out, calibration, frame)
    result = change_frame(trajectory, frame or trajectory.frame, calibration)
    result = result.select(np.isfinite(result.positions).all(axis=1))
    if not len(result):
        raise InputError(f"{trajectory.source} has no pose that is finite")
    out.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(place, Georeference):
        _write_on_earth(result, kind, out, place)
        return result
    # Rotations are about east, north and up of the grid.
    result = replace(result, poses=place.carry(result.poses), covariances=None)
    write_csv(out, result, place.name)
    return result


def _convert(trajectory: Trajectory, kind: str, out: Path, calibration: Calibration, frame: str | None) -> Trajectory:
    """Write the poses in their own world, not georeferenced. Raises InputError for a format with stamps and poses without."""
    file_format = FORMATS[kind]
    result = change_frame(trajectory, frame or file_format.frame or trajectory.frame, calibration)
    if not file_format.has_stamps:
        log.info("%s files have no stamps: line i is pose i", kind.upper())
    elif not trajectory.has_stamps:
        raise InputError(
            f"{trajectory.source} has no stamps and --to {kind} needs them: --times names them, one a line"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    file_format.write(out, result)
    return result


def _write_on_earth(trajectory: Trajectory, kind: str, out: Path, georeference: Georeference) -> None:
    """Write the positions for map programs.

    Degrees have 7 decimals (1 cm), heights above the WGS84 ellipsoid 3. Times are UTC, and left out where stamps are not
    Unix time.
    """
    places = [
        (round(lat, 7), round(lon, 7), round(h, 3))
        for lat, lon, h in to_lat_lon(trajectory.positions, georeference).tolist()
    ]
    about = f"poses of {trajectory.frame} by lslam, heights in m above the WGS84 ellipsoid"
    if georeference.method == "osm":
        about += "; placed by buildings, © OpenStreetMap contributors, ODbL 1.0"
    times = utc_of(trajectory.stamps_ns) if trajectory.has_stamps else None
    WRITERS[kind](out, places, times, out.stem, about)


def change_frame(trajectory: Trajectory, frame: str, calibration: Calibration) -> Trajectory:
    """The same motion as poses of the body `frame`.

    Camera poses live in the world of camera 0 at the start, T_cam0 = Tr T_world_lidar inv(Tr); IMU poses share the LiDAR's
    world, T_world_imu = T_world_lidar T_lidar_imu. Raises InputError when the extrinsic for that is unknown, or the trajectory's
    own body; UsageError for an unknown `frame`.
    """
    if frame == trajectory.frame:
        return trajectory
    if frame not in FRAMES:
        raise UsageError(f"no frame {frame!r}: {', '.join(FRAMES)} are")
    if trajectory.frame not in FRAMES:
        raise UsageError(
            f"{trajectory.source} does not say whose poses it holds: --from-frame {'|'.join(FRAMES)} does, --frame "
            f"{trajectory.frame} leaves them as they are"
        )
    poses = trajectory.poses
    if trajectory.frame == "cam0":
        T = _require_extrinsic(calibration, "T_cam0_lidar", trajectory, frame)
        poses = se3.inverse(T) @ poses @ T
    elif trajectory.frame == "imu":
        poses = poses @ se3.inverse(_require_extrinsic(calibration, "T_lidar_imu", trajectory, frame))
    if frame == "cam0":
        T = _require_extrinsic(calibration, "T_cam0_lidar", trajectory, frame)
        poses = T @ poses @ se3.inverse(T)
    elif frame == "imu":
        poses = poses @ _require_extrinsic(calibration, "T_lidar_imu", trajectory, frame)
    log.info("poses of %s carried to %s", trajectory.frame, frame)
    return replace(trajectory, poses=se3.normalise(poses), frame=frame, covariances=None)


def _require_extrinsic(calibration: Calibration, name: str, trajectory: Trajectory, frame: str) -> Floats:
    """Extrinsic `name` (4, 4), m. Raises InputError with the option that gives it when it is unknown."""
    T: Floats | None = getattr(calibration, name)
    if T is None:
        flag = (
            "--calib (a KITTI calib.txt with Tr)" if name == "T_cam0_lidar" else "--extrinsics (the IMU in the LiDAR)"
        )
        raise InputError(
            f"{trajectory.source} holds poses of {trajectory.frame} and {frame} is wanted, which needs {name}: give {flag}, or "
            f"--frame {trajectory.frame} to leave them as they are"
        )
    return T


Place = tuple[float, float, float]


def write_kml(path: Path, places: Sequence[Place], times: Sequence[datetime] | None, name: str, about: str) -> None:
    """Write positions lat, lon (deg), height (m), WGS84, as a line, and as a track if `times` (UTC) are known.

    The line is drawn on the ground, since KML's heights are above the sea and ours above the ellipsoid; the coordinates keep
    them.
    Raises OutputError when the file cannot be written, InputError without fastkml.
    """
    with importing("fastkml", install_hint("geo")), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without lxml it does not indent
        from fastkml import KML, Document, Placemark, gx
        from fastkml.enums import AltitudeMode
        from fastkml.geometry import LineString
        from fastkml.times import KmlDateTime
        from pygeoif import geometry
    coordinates = [(lon, lat, height) for lat, lon, height in places]
    # KML asks for two points of a line.
    line = geometry.LineString(coordinates if len(coordinates) > 1 else coordinates * 2)
    marks = [
        Placemark(
            name=name,
            description=about,
            kml_geometry=LineString(
                geometry=line,
                tessellate=True,
                altitude_mode=AltitudeMode.clamp_to_ground,
            ),
        )
    ]
    if times is not None:
        track = gx.Track(
            altitude_mode=AltitudeMode.clamp_to_ground, whens=[KmlDateTime(t) for t in times], coords=coordinates
        )
        marks.append(Placemark(name=f"{name}, in time", kml_geometry=track))
    document = KML(features=[Document(name=name, description=about, features=marks)])
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + document.to_string() + "\n")


def write_gpx(path: Path, places: Sequence[Place], times: Sequence[datetime] | None, name: str, about: str) -> None:
    """Write positions lat, lon (deg), height (m), WGS84, as one segment, with `times` (UTC) if they are known.

    Raises OutputError when the file cannot be written, InputError without gpxpy.
    """
    with importing("gpxpy", install_hint("geo")):
        from gpxpy.gpx import GPX, GPXTrack, GPXTrackPoint, GPXTrackSegment
    points = [
        GPXTrackPoint(lat, lon, elevation=height, time=None if times is None else times[k])
        for k, (lat, lon, height) in enumerate(places)
    ]
    document = GPX()
    document.creator = f"lslam {__version__}"
    track = GPXTrack(name=name, description=about)
    track.segments.append(GPXTrackSegment(points))
    document.tracks.append(track)
    write_text(path, document.to_xml(version="1.1") + "\n")


WRITERS = {"kml": write_kml, "gpx": write_gpx}
TRAJECTORY = "trajectory.tum"


def find_georeference(source: Path) -> Georeference | None:
    """Georeference in the manifest of a run, by its folder or its `trajectory.tum`; None where there is none."""
    folder = source if source.is_dir() else source.parent
    if not (source.is_dir() or source.name == TRAJECTORY):
        return None
    return georeference_of(read_json(folder / MANIFEST).get("georeference"))


def georeference_beside(source: Path, words: str) -> Georeference:
    """The georeference of the run that `source` belongs to, by `find_georeference`.

    Raises UsageError with a remedy when it is unknown; words : the option that needs it.
    """
    georeference = find_georeference(source)
    if georeference is not None:
        return georeference
    folder = source if source.is_dir() else source.parent
    if not (folder / MANIFEST).is_file() or not (source.is_dir() or source.name == TRAJECTORY):
        raise UsageError(
            f"{words} needs to know where on the Earth the poses lie: {source} is neither the folder of a run nor its "
            f"{TRAJECTORY}"
        )
    raise UsageError(
        f"{words} needs to know where on the Earth the poses lie, and {folder} is not georeferenced: run the sequence "
        "again with --gnss or --georeference where it has fixes, or with --osm"
    )
