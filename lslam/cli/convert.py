"""`lslam convert`: a sequence in another layout, a trajectory in another format."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.io.formats.trajectory_files import FORMATS

if TYPE_CHECKING:
    from lslam.core.types.gnss import Georeference
    from lslam.core.types.sequence import Calibration, Sequence
    from lslam.core.types.trajectory import Trajectory
    from lslam.maps.georeference import Projection

SEQUENCES = ("bag", "mcap", "sqlite", "kitti")
EARTH = ("kml", "gpx")
IN_CRS = ("csv", "gpkg")
BAGS = {"bag": ".bag", "mcap": ".mcap", "sqlite": ".db3"}
OF_RUNS = ("no_clouds", "voxel", "sequence")
NOT_OF_RUNS = ("deskewed", "lidars", "start", "count", "skip_frames", "frame", "from_frame", "calib", "times")
BY_SUFFIX = {suffix: kind for kind, suffix in BAGS.items()} | {
    f".{kind}": kind for kind in (*EARTH, "gpkg", "tum", "csv")
}
EPILOG = """\b
Examples:
  lslam convert seq07 --data-root ~/kitti --to mcap --zstd --out seq07.mcap
  lslam convert drive.bag --to kitti --out drive
  lslam convert runs/first --to euroc --frame lidar --out first.csv
  lslam convert runs/town --to kml --out town.kml
  lslam convert runs/town --out town.gpkg
  lslam convert runs/town --to csv --crs EPSG:25832 --out town.csv
  lslam convert runs/first --to mcap --voxel 0.3 --zstd
  lslam convert drive.bag --deskewed runs/drive --to kitti --out drive_deskewed
"""


@click.command(epilog=EPILOG)
@click.argument("source")
@click.option(
    "--to",
    "kind",
    type=click.Choice(list(dict.fromkeys((*SEQUENCES, *FORMATS, *EARTH, "gpkg")))),
    help="bag is ROS 1, mcap and sqlite are ROS 2; tum, euroc and csv are for trajectories, kitti for both; kml, gpx and gpkg "
    "for georeferenced runs  [--out's suffix].",
)
@options.path("--out", "PATH", "File or folder to write  [RUN/run.mcap and so on, of a run to a bag].")
@options.flag("--overwrite", "Replace an existing PATH.")
@options.flag("--zstd", "is_zstd", "Compress (mcap, sqlite).")
@options.path("--deskewed", "RUN|TRAJ", "Deskew the scans by the trajectory of this run.")
@options.flag("--no-clouds", "RUN to a bag: poses and map alone, without the scans.")
@options.real("--voxel", "M", "RUN to a bag: one point of a scan per voxel of this edge.")
@options.path("--sequence", "PATH", "RUN to a bag: the raw scans, when they moved.")
@click.option(
    "--lidars",
    type=click.Choice(["merged", "topics", "frames"]),
    help="Several LiDARs to a bag: each on a topic of its own, or all on one  [merged into one].",
)
@options.scan_range
@options.option("--frame", "BODY", "Trajectory: lidar, cam0 or imu [default: what the format usually holds].")
@options.option("--from-frame", "BODY", "Trajectory: body of SOURCE's poses, where the file does not name it.")
@options.option("--crs", "EPSG:N[+M]", "csv and gpkg of a georeferenced run: coordinates  [those of its map].")
@options.option("--geoid", "GRID", "csv and gpkg: heights above this geoid (.gtx, .tif).")
@options.path("--calib", "FILE", "Trajectory: KITTI calibration with Tr.")
@options.path("--times", "FILE", "Trajectory: stamps of a KITTI file.")
@options.reading
@options.data_root
@options.as_json
@options.verbosity
def command(source: str, kind: str | None, out: Path | None, **given: Any) -> None:
    """Convert SOURCE, a sequence (path or name), a run folder or a trajectory file.

    Of a sequence points, per-point times, rings, IMU, fixes, extrinsics and ground truth are converted; the result reads as the
    same sequence. A run becomes a bag of its deskewed scans, poses, path, transforms and map for rviz and Foxglove.
    """
    from lslam.cli.console import setup_logging

    setup_logging(given["verbose"], given["quiet"])
    kind = kind or BY_SUFFIX.get("" if out is None else out.suffix.lower())
    if kind is None:
        raise click.UsageError(f"--to says what to write; an --out whose name ends in {', '.join(BY_SUFFIX)} does too")
    path = Path(source).expanduser()
    if kind in BAGS and (path / "trajectory.tum").is_file():
        why = f"is not for the folder of a run to {kind}: all its scans are written as they lie"
        _refuse(given, (*NOT_OF_RUNS, "crs", "geoid"), why)
        _convert_run(path, kind, out, given)
        return
    _refuse(given, OF_RUNS, "is for the folder of a run to bag, mcap or sqlite")
    if kind not in IN_CRS:
        _refuse(given, ("crs", "geoid"), "is for --to csv and gpkg")
    if out is None:
        raise click.UsageError("--out names the file or folder to write")
    if kind == "gpkg":
        _refuse(given, (*NOT_OF_RUNS, "is_zstd"), "is not for --to gpkg, which has the poses of a run as they lie")
        _convert_to_gpkg(path, out, given)
    elif kind not in SEQUENCES or _is_trajectory(path):
        _refuse(given, ("is_zstd", "deskewed"), f"is for sequences, and {source} to {kind} is a trajectory")
        _convert_trajectory(source, kind, out, given)
    else:
        _convert_sequence(source, kind, out, given)


def _refuse(given: dict[str, Any], names: tuple[str, ...], why: str) -> None:
    """Raise UsageError for an option of `names` that was given."""
    for name in names:
        if given[name] not in (None, False):
            raise click.UsageError(f"--{name.removeprefix('is_').replace('_', '-')} {why}")


def _is_trajectory(path: Path) -> bool:
    """Whether `path` is a run folder, or a file that is no bag."""
    from lslam.io.formats.bag_listing import list_bag_files

    return (path / "trajectory.tum").is_file() or (path.is_file() and not list_bag_files(path))


def _open(source: str, given: dict[str, Any]) -> Sequence:
    """Selected scans of a recording; without a trajectory that deskews them, point times are added only as stated."""
    from lslam.io.readers import open_sequence

    sequence = open_sequence(source, data_root=given["data_root"], **options.reading_of(given))
    from lslam.core.config.input import PreprocessConfig
    from lslam.core.types.sequence import select
    from lslam.odometry.frontend.point_times import with_point_times

    sequence = with_point_times(sequence, PreprocessConfig(), is_stated_only=given["deskewed"] is None)
    return select(sequence, given["start"] or 0, given["count"], given["skip_frames"] or 1)


def _convert_sequence(source: str, kind: str, out: Path, given: dict[str, Any]) -> None:
    """Convert a recording, deskewed by a trajectory if one is given. Raises click.UsageError for one without rotations."""
    from lslam.cli.console import log, progress
    from lslam.pipeline.convert import check_output

    check_output(kind, out, given["is_zstd"], given["overwrite"])
    options.require_there(given["deskewed"])
    sequence = _open(source, given)
    from lslam.io.formats.trajectory_files import read_trajectory
    from lslam.pipeline.convert.convert_sequence import convert_sequence

    for note in sequence.notes:
        log.info("%s", note)
    for problem in sequence.problems:
        log.warning("%s", problem)
    trajectory = None if given["deskewed"] is None else read_trajectory(given["deskewed"])
    if trajectory is not None and not trajectory.has_rotations:
        raise click.UsageError(f"--deskewed {given['deskewed']}: positions without rotations deskew no scan")
    with progress("convert", len(sequence)) as advance:
        count = convert_sequence(
            sequence,
            kind,
            out,
            is_zstd=given["is_zstd"],
            overwrite=given["overwrite"],
            trajectory=trajectory,
            lidars=given["lidars"] or "merged",
            on_scan=advance,
        )
    without = f", {count.unreadable} that could not be read left out" if count.unreadable else ""
    values = {"scans": count.scans, "skipped": count.unreadable}
    _print(f"{out}: {count.scans} scans{without}", out, kind, values, given)


def _convert_run(folder: Path, kind: str, out: Path | None, given: dict[str, Any]) -> None:
    """Convert a run to a bag, with its deskewed scans unless refused; `out` None is within the run."""
    from lslam.cli.console import progress
    from lslam.pipeline.convert import check_output

    out = folder / f"run{BAGS[kind]}" if out is None else out
    check_output(kind, out, given["is_zstd"], given["overwrite"])
    has_clouds = not given["no_clouds"]
    if not has_clouds:
        _refuse(given, ("voxel", "sequence"), "contradicts --no-clouds")
    options.require_there(given["sequence"])
    from lslam.pipeline.convert.convert_run import convert_run
    from lslam.pipeline.rebuild import open_scans, read_run

    run = read_run(folder)
    scans = None
    if has_clouds:
        flag = "--sequence, or leave them out with --no-clouds"
        scans = open_scans(run, given["sequence"], flag=flag, **options.reading_of(given))
    with progress("convert", len(run.trajectory)) as advance:
        count = convert_run(
            run,
            scans,
            kind,
            out,
            voxel=given["voxel"] or 0.0,
            is_zstd=given["is_zstd"],
            overwrite=given["overwrite"],
            on_scan=advance,
        )
    text = f"{out}: {count.poses} poses, {count.clouds} clouds, a map of {count.map_points} points"
    _print(text, out, kind, vars(count), given)


def _print(text: str, path: Path, kind: str, values: dict[str, Any], given: dict[str, Any]) -> None:
    """Print the result, as a line or with --json as one object."""
    from lslam.cli.console import show

    show((json.dumps({"path": str(path), "format": kind, **values}) if given["as_json"] else text) + "\n")


def _convert_to_gpkg(folder: Path, out: Path, given: dict[str, Any]) -> None:
    """Convert a run to the layers of a GeoPackage, and print their sizes."""
    from lslam.pipeline.convert.to_gpkg import convert_to_gpkg

    options.require_there(folder)
    layers = convert_to_gpkg(folder, out, crs=options.output_crs(given), overwrite=given["overwrite"])
    text = f"{out}: {', '.join(f'{len(layer.features)} in {layer.name}' for layer in layers)}"
    _print(text, out, "gpkg", {"features": {layer.name: len(layer.features) for layer in layers}}, given)


def _convert_trajectory(source: str, kind: str, out: Path, given: dict[str, Any]) -> None:
    """Convert a trajectory file; formats with coordinates on the Earth need a georeference beside it."""
    from lslam.maps.georeference import Projection
    from lslam.pipeline.convert.convert_trajectory import convert_trajectory, georeference_beside

    path = Path(source).expanduser()
    place: Georeference | Projection | None = _projection(path, given) if kind == "csv" else None
    if kind in EARTH:
        options.require_there(Path(source))
        place = georeference_beside(path, f"--to {kind}")
    trajectory, calibration = _read_trajectory(source, kind, given)
    how = {"frame": given["frame"], "overwrite": given["overwrite"]}
    result = convert_trajectory(trajectory, kind, out, calibration, place=place, **how)
    where = f" in {place.name}" if isinstance(place, Projection) else ""
    text = f"{out}: {len(result)} poses of {result.frame}{where}"
    _print(text, out, kind, {"poses": len(result), "frame": result.frame}, given)


def _projection(source: Path, given: dict[str, Any]) -> Projection | None:
    """Projection to the coordinates of the run's map, or of the options; None for a trajectory without a georeference."""
    from lslam.maps.georeference import Projection, in_crs
    from lslam.pipeline.convert.convert_trajectory import find_georeference, georeference_beside

    crs = options.output_crs(given)
    if crs is None:
        georeference = find_georeference(source)
    else:
        options.require_there(source)
        georeference = in_crs(georeference_beside(source, "--geoid" if crs.epsg is None else "--crs"), crs)
    return None if georeference is None else Projection(georeference)


def _read_trajectory(source: str, kind: str, given: dict[str, Any]) -> tuple[Trajectory, Calibration]:
    """Trajectory of the file, or ground truth of the sequence (InputError without), and calibration between bodies."""
    from lslam.core.errors import InputError
    from lslam.core.types.sequence import Calibration
    from lslam.io.formats.kitti_layout import read_cam0_lidar, read_transform
    from lslam.io.formats.trajectory_files import read_trajectory

    path = Path(source).expanduser()
    if _is_trajectory(path):
        trajectory = read_trajectory(path, times=given["times"])
        calibration = Calibration()
    else:
        sequence = _open(source, given)
        if sequence.ground_truth is None:
            raise InputError(f"{sequence.path} has no ground truth, which is what --to {kind} takes from a sequence")
        trajectory, calibration = sequence.ground_truth, sequence.calibration
    if given["from_frame"] is not None:
        trajectory = replace(trajectory, frame=given["from_frame"])
    if given["calib"] is not None:
        calibration = replace(calibration, T_cam0_lidar=read_cam0_lidar(given["calib"]))
    if given["extrinsics"] is not None:
        calibration = replace(calibration, T_lidar_imu=read_transform(given["extrinsics"]))
    return trajectory, calibration
