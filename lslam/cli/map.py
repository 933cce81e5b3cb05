"""`lslam map`: a run's map anew with other settings, numbers about any map, and what changed between two drives."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.cli.console import progress, setup_logging, show
from lslam.core.errors import UsageError
from lslam.core.stopping import handle_signals

if TYPE_CHECKING:
    from lslam.core.types.gnss import OutputCrs
    from lslam.core.types.run_record import Crispness
    from lslam.maps.changes import ChangedCells
    from lslam.pipeline.rebuild import EarlierRun


# What a map is made with, and how clouds are scored: no part of a comparison of drives.
_OTHERS = (
    "file_format",
    "attributes",
    "crop",
    "clean",
    "colour",
    "occupancy",
    "denoise",
    "mesh",
    "crs",
    "geoid",
    "out",
    "is_scored",
    "threshold",
    "radius",
)
_FLAGS = {"file_format": "format", "is_scored": "score"}
# Rows of the table, at most; the files have all.
_MOST = 20


def compare_drives(target: Path, given: dict[str, Any]) -> None:
    """Compare the drives and write what changed."""
    folder, against = given["changes"], given["against"]
    if against is None:
        raise UsageError("--changes needs the run to compare with: --against RUN")
    for name in _OTHERS:
        if given[name]:
            raise UsageError(f"--{_FLAGS.get(name, name)} has no meaning with --changes: leave one out")
    options.require_there(target, against)
    from lslam.pipeline.change_pass import compare_runs, frame_between, output_folder, write_changes
    from lslam.pipeline.rebuild import open_scans, read_run

    settings = of_the_map(given["settings"])
    if given["voxel"] is not None:
        settings.append(f"map.occupancy_voxel={given['voxel']}")
    new, old = read_run(target, settings), read_run(against)
    T = frame_between(new, old)
    scans = open_scans(new, given["sequence"], **options.reading_of(given))
    earlier = open_scans(old, given["against_sequence"], flag="--against-sequence")
    steps = len(old.trajectory) + len(new.trajectory)
    with output_folder(folder, given["overwrite"]), handle_signals() as stop, progress("changes", steps) as advance:
        stop.is_gentle = True
        found = compare_runs((new, scans), (old, earlier), T, spool=folder, on_step=advance, should_stop=stop)
        write_changes(folder, found, new, old)
    _print_changes(folder, found, given["as_json"])


def of_the_map(settings: Iterable[str]) -> list[str]:
    """Settings of --set. Raises UsageError for a key that neither belongs to the map nor selects points."""
    for setting in settings:
        if not setting.startswith(("map.", "preprocess.drop_labels=")):
            raise UsageError(f"--set {setting}: only keys of the map can be changed after the run")
    return list(settings)


def _print_changes(folder: Path, found: ChangedCells, as_json: bool) -> None:
    from lslam.pipeline.change_pass import AREAS, CLOUD, properties

    things = [properties(number, change) for number, change in enumerate(found.changes, 1)]
    cells = {
        "same": len(found.same),
        "occupied_new": found.occupied_new,
        "occupied_old": found.occupied_old,
        "unseen_new": found.unseen_new,
        "unseen_old": found.unseen_old,
    }
    if as_json:
        document = {
            "cloud": str(folder / CLOUD),
            "areas": str(folder / AREAS),
            "voxel_m": found.voxel,
            "cells": cells,
            "appeared": len(found.of("appeared")),
            "vanished": len(found.of("vanished")),
            "things": things,
        }
        show(json.dumps(document, allow_nan=False) + "\n")
        return
    rows = [
        ("changes", f"{folder / CLOUD}, {folder / AREAS}: cells of {found.voxel:g} m"),
        ("appeared", f"{len(found.of('appeared'))} things"),
        ("vanished", f"{len(found.of('vanished'))} things"),
        ("same", f"{len(found.same)} of {found.occupied_new} occupied cells"),
        ("unseen", f"{found.unseen_new} cells now, {found.unseen_old} before, that the other drive never saw"),
    ]
    lines = [f"{name:<10} {value}\n" for name, value in rows]
    if things:
        lines.append(
            f"\n{'':5} {'kind':<10}{'x':>9} {'y':>9} {'length':>7} {'width':>6} {'height':>6} {'cells':>7}  m\n"
        )
    for thing in things[:_MOST]:
        lines.append(
            f"{thing['thing']:>5} {thing['kind']:<10}{thing['x_m']:>9.1f} {thing['y_m']:>9.1f} {thing['length_m']:>7.1f} "
            f"{thing['width_m']:>6.1f} {thing['height_m']:>6.1f} {thing['cells']:>7}\n"
        )
    if len(things) > _MOST:
        lines.append(f"      and {len(things) - _MOST} more in {folder / AREAS}\n")
    show("".join(lines))


EPILOG = """\b
Examples:
  lslam map runs/first --voxel 0.1 --format laz
  lslam map runs/first --clean --crop -50,50,-50,50 --out square.ply
  lslam map runs/first --tiles 50 --format laz
  lslam map runs/first --voxel 0 --tiles 50 --format laz --attributes time,scan,ring
  lslam map runs/first --against survey.laz --threshold 0.1
  lslam map somebody-elses.ply --score
  lslam map runs/tuesday --against runs/monday --changes changed
"""


@click.command(epilog=EPILOG)
@click.argument("target", metavar="RUN|FILE", type=click.Path(path_type=Path))
@click.option("--voxel", type=float, metavar="M", help="Edge of a voxel, 0 for every point  [as the run].")
@click.option("--format", "file_format", metavar="NAME", help="ply, pcd, las or laz  [--out's suffix, or as the run].")
@click.option(
    "--attributes", metavar="NAMES", help="Of each point: time,scan,ring,range,observations,class  [as the run]."
)
@click.option("--crop", metavar="BOX", help="Keep x_min,x_max,y_min,y_max[,z_min,z_max] of the world, m.")
@click.option("--clean", is_flag=True, help="Remove moving objects, such as cars and people.")
@click.option("--colour", is_flag=True, help="Colour the points by the images of the recording's cameras.")
@click.option("--occupancy", is_flag=True, help="Write occupied and free cells too, and a floor plan.")
@click.option("--denoise", is_flag=True, help="Remove points far from their neighbours (Open3D).")
@click.option("--mesh", is_flag=True, help="Write a surface too, FILE_mesh.ply (Open3D).")
@click.option("--crs", metavar="EPSG:N[+M]", help="Coordinates of las and laz of a georeferenced run, +M of heights.")
@click.option("--geoid", metavar="GRID", help="Heights of las and laz above this geoid (.gtx, .tif).")
@click.option(
    "--tiles", type=float, metavar="M", help="Square tiles with this edge and an index, for maps of any size."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="Map file  [RUN/map.FORMAT], or folder of tiles  [RUN/tiles].",
)
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
@options.moved_sequence
@click.option("--score", "is_scored", is_flag=True, help="Only compute the crispness of the map of RUN, or of FILE.")
@click.option(
    "--against", type=click.Path(path_type=Path), metavar="CLOUD|RUN", help="Only compare with this cloud or run."
)
@click.option(
    "--changes",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="--against RUN: write there what appeared and vanished.",
)
@click.option(
    "--against-sequence",
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="--changes: sequence of the other run's raw scans, when it has moved.",
)
@click.option("--threshold", type=float, metavar="M", help="--against: largest distance of matching points  [0.2].")
@click.option("--radius", type=float, metavar="M", help="--score: radius of neighbourhoods  [0.5].")
@options.reading
@click.option("--set", "settings", multiple=True, metavar="map.KEY=VALUE", help="Set one key of the map; repeatable.")
@options.as_json
@options.verbosity
def command(target: Path, **given: Any) -> None:
    """Build the map of a run anew from its raw scans and poses, with other settings and without odometry.

    With --score or --against the map of RUN, or FILE, is only scored: by crispness, which needs no ground truth, or by F1 and
    Chamfer distance against a reference cloud in the same frame. With --changes the beams of RUN and of an earlier run, in whose
    map `lslam localize` located it, say what appeared and what vanished; what one of them never saw is neither.
    """
    setup_logging(given["verbose"], given["quiet"])
    if given["changes"] is not None:
        compare_drives(target, given)
    elif given["against_sequence"] is not None:
        raise click.UsageError("--against-sequence belongs to --changes")
    elif given["is_scored"] or given["against"] is not None:
        _measure(target, given)
    else:
        _rebuild(target, given)


def _measure(target: Path, given: dict[str, Any]) -> None:
    options.require_there(target, given["against"])
    from lslam.io.formats.point_files import read_cloud
    from lslam.maps.crispness import RADIUS, THRESHOLD, compare, crispness
    from lslam.pipeline.rebuild import map_of
    from lslam.reports.evaluations import crispness_document, strict

    path = map_of(target)
    cloud = read_cloud(path)
    document: dict[str, Any] = {"file": str(path)}
    rows = [("map", str(path))]
    if given["is_scored"]:
        score = crispness(cloud, given["radius"] or RADIUS)
        document["crispness"] = crispness_document(score)
        rows += crispness_rows(score)
    if given["against"] is not None:
        found = compare(
            cloud, read_cloud(given["against"]), THRESHOLD if given["threshold"] is None else given["threshold"]
        )
        document["against"] = strict({"file": str(given["against"]), "recipe": found.recipe, **asdict(found)})
        rows += [
            ("against", str(given["against"])),
            ("F1", f"{found.f1:.4f} (precision {found.precision:.4f}, recall {found.recall:.4f})"),
            (
                "Chamfer",
                f"{found.chamfer:.4f} m (to it {found.mean_to_reference:.4f}, from it {found.mean_from_reference:.4f})",
            ),
            ("", found.recipe),
        ]
    _print(rows, document, given["as_json"])


def _rebuild(target: Path, given: dict[str, Any]) -> None:
    from lslam.core.errors import UsageError
    from lslam.pipeline.run_folder import require_run

    for flag in ("threshold", "radius"):
        if given[flag] is not None:
            raise UsageError(f"--{flag} belongs to {'--against' if flag == 'threshold' else '--score'}")
    settings = _settings(given if given["tiles"] is None else {**given, "out": None})
    require_run(target)
    from lslam.pipeline.rebuild import check_output, open_scans, read_run, rebuild
    from lslam.reports.evaluations import crispness_document

    out: Path | None = given["out"]
    crs = options.output_crs(given)
    run = read_run(target, settings)
    if given["tiles"] is not None:
        _rebuild_tiles(run, out or target / "tiles", crs, given)
        return
    check_output(out or target / f"map.{run.config.map.format}", given["overwrite"])
    sequence = open_scans(run, given["sequence"], **options.reading_of(given))
    with handle_signals() as stop, progress("map", len(run.trajectory)) as advance:
        stop.is_gentle = True
        built = rebuild(run, sequence, out, overwrite=given["overwrite"], crs=crs, on_step=advance, should_stop=stop)
    rows = [("map", f"{built.path}: {built.points} points of {built.scans} scans")]
    document: dict[str, Any] = {"file": str(built.path), "points": built.points, "scans": built.scans}
    if built.colour is not None:
        rows.append(("colour", str(built.colour)))
        document["colour"] = asdict(built.colour)
    if built.crispness is not None:
        document["crispness"] = crispness_document(built.crispness)
    _print([*rows, *crispness_rows(built.crispness)], document, given["as_json"])


def _rebuild_tiles(run: EarlierRun, folder: Path, crs: OutputCrs | None, given: dict[str, Any]) -> None:
    from lslam.core.errors import UsageError
    from lslam.pipeline.map_tiles import check_tiles, rebuild_in_tiles
    from lslam.pipeline.rebuild import open_scans

    if given["mesh"] or given["occupancy"]:
        raise UsageError("--tiles divides the points alone: leave out --mesh and --occupancy")
    check_tiles(folder, given["tiles"], given["overwrite"])
    sequence = open_scans(run, given["sequence"], **options.reading_of(given))
    with handle_signals() as stop, progress("map", len(run.trajectory)) as advance:
        stop.is_gentle = True
        index = rebuild_in_tiles(run, sequence, folder, given["tiles"], crs=crs, on_step=advance, should_stop=stop)
    tiles = len(index["tiles"])
    rows = [
        ("tiles", f"{folder}: {tiles} of {given['tiles']:g} m, {index['points']} points"),
        ("index", str(folder / "map.json")),
    ]
    _print(rows, {"folder": str(folder), **index}, given["as_json"])


def _settings(given: dict[str, Any]) -> list[str]:
    """Flags over --set, as settings of the section `map`."""
    from lslam.core.errors import UsageError

    out: Path | None = given["out"]
    suffix = None if out is None else out.suffix.lower().lstrip(".")
    file_format = given["file_format"]
    if file_format is not None and suffix is not None and file_format != suffix:
        raise UsageError(f"--format {file_format} contradicts --out {out}: leave one out")
    flags = {
        "voxel": given["voxel"],
        "attributes": given["attributes"],
        "format": file_format
        if file_format is not None
        else suffix
        if suffix in ("ply", "pcd", "las", "laz")
        else None,
        "crop": None if given["crop"] is None else f"[{given['crop']}]",
        **{name: "true" if given[name] else None for name in ("clean", "colour", "occupancy", "denoise", "mesh")},
    }
    return [
        *of_the_map(given["settings"]),
        *(f"map.{key}={value}" for key, value in flags.items() if value is not None),
    ]


def crispness_rows(score: Crispness | None) -> list[tuple[str, str]]:
    """Table rows of a map's entropy scores."""
    if score is None:
        return [("crispness", "n/a: the map has every point; those of voxels are scored")]
    if score.entropy is None or score.plane_variance is None:
        return [("crispness", f"n/a: {score.recipe}")]
    return [
        ("entropy", f"{score.entropy:.4f} nats (mean map entropy, lower is crisper)"),
        ("planes", f"{score.plane_variance:.3e} m2 mean plane variance, {score.plane_variance**0.5:.4f} m thick"),
        ("", score.recipe),
    ]


def _print(rows: list[tuple[str, str]], document: dict[str, Any], as_json: bool) -> None:
    show(json.dumps(document, allow_nan=False) + "\n" if as_json else "".join(f"{n:<10} {v}\n" for n, v in rows))
