"""`lslam map`: a run's map anew with other settings, numbers about any map, and what changed between two drives."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.cli.console import setup_logging, show, show_json, show_rows
from lslam.cli.one_run import watch_pass
from lslam.core.errors import UsageError

if TYPE_CHECKING:
    from lslam.core.types.gnss import OutputCrs
    from lslam.core.types.run_record import Crispness
    from lslam.maps.changes import ChangedCells
    from lslam.pipeline.rebuild import EarlierRun


# What a map is made with, and how clouds are scored: no part of a comparison of drives.
_NOT_OF_CHANGES = (
    *("file_format", "attributes", "crop", "clean", "colour", "occupancy", "denoise", "mesh", "crs", "geoid", "out"),
    *("scores", "threshold", "radius"),
)
_FLAGS = {"file_format": "format", "scores": "score"}
# Rows of the table, at most; the files have all.
_MOST = 20


def compare_drives(target: Path, given: dict[str, Any]) -> None:
    """Compare the drives and write what changed. Raises UsageError for flags without use here."""
    folder, against = given["changes"], given["against"]
    if against is None:
        raise UsageError("--changes needs the run to compare with: --against RUN")
    for name in _NOT_OF_CHANGES:
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
    with output_folder(folder, given["overwrite"]), watch_pass("changes", steps) as watch:
        result = compare_runs((new, scans), (old, earlier), T, spool=folder, watch=watch)
        write_changes(folder, result, new, old)
    _print_changes(folder, result, given["as_json"])


def of_the_map(settings: Iterable[str]) -> list[str]:
    """Settings of --set. Raises UsageError for a key that neither belongs to the map nor selects points."""
    for setting in settings:
        if not setting.startswith(("map.", "preprocess.drop_labels=")):
            raise UsageError(f"--set {setting}: only keys of the map can be changed after the run")
    return list(settings)


def _print_changes(folder: Path, result: ChangedCells, as_json: bool) -> None:
    """Print numbers and files of the changes, or all of them as JSON."""
    from lslam.pipeline.change_pass import AREAS, CLOUD, properties

    things = [properties(number, change) for number, change in enumerate(result.changes, 1)]
    appeared, vanished, same = len(result.of("appeared")), len(result.of("vanished")), len(result.same)
    names = ("occupied_new", "occupied_old", "unseen_new", "unseen_old")
    if as_json:
        document = {
            "cloud": str(folder / CLOUD),
            "areas": str(folder / AREAS),
            "voxel_m": result.voxel,
            "cells": {"same": same, **{name: getattr(result, name) for name in names}},
            "appeared": appeared,
            "vanished": vanished,
            "things": things,
        }
        show_json(document)
        return
    rows = [
        ("changes", f"{folder / CLOUD}, {folder / AREAS}: cells of {result.voxel:g} m"),
        ("appeared", f"{appeared} things"),
        ("vanished", f"{vanished} things"),
        ("same", f"{same} of {result.occupied_new} occupied cells"),
        ("unseen", f"{result.unseen_new} cells now, {result.unseen_old} before, that the other drive never saw"),
    ]
    show_rows(rows)
    if things:
        show(f"\n{'':5} {'kind':<10}{'x':>9} {'y':>9} {'length':>7} {'width':>6} {'height':>6} {'cells':>7}  m\n")
    for thing in things[:_MOST]:
        show(
            f"{thing['thing']:>5} {thing['kind']:<10}{thing['x_m']:>9.1f} {thing['y_m']:>9.1f} {thing['length_m']:>7.1f} "
            f"{thing['width_m']:>6.1f} {thing['height_m']:>6.1f} {thing['cells']:>7}\n"
        )
    if len(things) > _MOST:
        show(f"      and {len(things) - _MOST} more in {folder / AREAS}\n")


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
@options.real("--voxel", "M", "Edge of a voxel, 0 for every point  [as the run].")
@options.option("--format", "file_format", "NAME", "ply, pcd, las or laz  [--out's suffix, or as the run].")
@options.option("--attributes", "NAMES", "Of each point: time,scan,ring,range,observations,class  [as the run].")
@options.option("--crop", "BOX", "Keep x_min,x_max,y_min,y_max[,z_min,z_max] of the world, m.")
@options.flag("--clean", "Remove moving objects, such as cars and people.")
@options.flag("--colour", "Colour the points by the images of the recording's cameras.")
@options.flag("--occupancy", "Write occupied and free cells too, and a floor plan.")
@options.flag("--denoise", "Remove points far from their neighbours (Open3D).")
@options.flag("--mesh", "Write a surface too, FILE_mesh.ply (Open3D).")
@options.option("--crs", "EPSG:N[+M]", "Coordinates of las and laz of a georeferenced run, +M of heights.")
@options.option("--geoid", "GRID", "Heights of las and laz above this geoid (.gtx, .tif).")
@options.real("--tiles", "M", "Square tiles with this edge and an index, for maps of any size.")
@options.path("--out", "PATH", "Map file  [RUN/map.FORMAT], or folder of tiles  [RUN/tiles].")
@options.flag("--overwrite", "Replace existing files.")
@options.new_sequence
@options.flag("--score", "scores", "Only compute the crispness of the map of RUN, or of FILE.")
@options.path("--against", "CLOUD|RUN", "Only compare with this cloud or run.")
@options.path("--changes", "DIR", "--against RUN: write there what appeared and vanished.")
@options.path("--against-sequence", "PATH", "--changes: sequence of the other run's raw scans, when it has moved.")
@options.real("--threshold", "M", "--against: largest distance of matching points  [0.2].")
@options.real("--radius", "M", "--score: radius of neighbourhoods  [0.5].")
@options.reading
@options.settings("map.KEY=VALUE", "Set one key of the map; repeatable.")
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
    elif given["scores"] or given["against"] is not None:
        _measure(target, given)
    else:
        _rebuild(target, given)


def _measure(target: Path, given: dict[str, Any]) -> None:
    """Print scores of a map, and its difference to another map."""
    options.require_there(target, given["against"])
    from lslam.maps.crispness import RADIUS, THRESHOLD, compare, crispness
    from lslam.pipeline.stored_map import map_of
    from lslam.reports.evaluations import crispness_document, strict

    stored = map_of(target)
    cloud = stored.read(in_world=False)
    document: dict[str, Any] = {"file": str(stored.path)}
    rows = [("map", str(stored.path))]
    if given["scores"]:
        score = crispness(cloud, given["radius"] or RADIUS)
        document["crispness"] = crispness_document(score)
        rows += crispness_rows(score)
    if given["against"] is not None:
        threshold = THRESHOLD if given["threshold"] is None else given["threshold"]
        match = compare(cloud, map_of(given["against"]).read(in_world=False), threshold)
        document["against"] = strict({"file": str(given["against"]), "recipe": match.recipe, **asdict(match)})
        to, back = match.mean_to_reference, match.mean_from_reference
        rows += [
            ("against", str(given["against"])),
            ("F1", f"{match.f1:.4f} (precision {match.precision:.4f}, recall {match.recall:.4f})"),
            ("Chamfer", f"{match.chamfer:.4f} m (to it {to:.4f}, from it {back:.4f})"),
            ("", match.recipe),
        ]
    _print(rows, document, given["as_json"])


def _rebuild(target: Path, given: dict[str, Any]) -> None:
    """Rebuild the map of a run with the options `given`, into one file or tiles. Raises UsageError for contradicting options."""
    from lslam.pipeline.run_folder import require_run

    for flag, other in (("threshold", "--against"), ("radius", "--score")):
        if given[flag] is not None:
            raise UsageError(f"--{flag} belongs to {other}")
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
    with watch_pass("map", len(run.trajectory)) as watch:
        result = rebuild(run, sequence, out, overwrite=given["overwrite"], crs=crs, watch=watch)
    rows = [("map", f"{result.path}: {result.points} points of {result.scans} scans")]
    document: dict[str, Any] = {"file": str(result.path), "points": result.points, "scans": result.scans}
    if result.colour is not None:
        rows.append(("colour", str(result.colour)))
        document["colour"] = asdict(result.colour)
    if result.crispness is not None:
        document["crispness"] = crispness_document(result.crispness)
    _print([*rows, *crispness_rows(result.crispness)], document, given["as_json"])


def _rebuild_tiles(run: EarlierRun, folder: Path, crs: OutputCrs | None, given: dict[str, Any]) -> None:
    """Rebuild the map of a run in tiles. Raises UsageError with options of one file."""
    from lslam.pipeline.map_tiles import check_tiles, rebuild_in_tiles
    from lslam.pipeline.rebuild import open_scans

    if given["mesh"] or given["occupancy"]:
        raise UsageError("--tiles divides the points alone: leave out --mesh and --occupancy")
    size = given["tiles"]
    check_tiles(folder, size, given["overwrite"])
    sequence = open_scans(run, given["sequence"], **options.reading_of(given))
    with watch_pass("map", len(run.trajectory)) as watch:
        index = rebuild_in_tiles(run, sequence, folder, size, crs=crs, watch=watch)
    rows = [
        ("tiles", f"{folder}: {len(index['tiles'])} of {size:g} m, {index['points']} points"),
        ("index", str(folder / "map.json")),
    ]
    _print(rows, {"folder": str(folder), **index}, given["as_json"])


def _settings(given: dict[str, Any]) -> list[str]:
    """Flags over --set, as settings of the section `map`; raises UsageError for contradicting ones."""
    out: Path | None = given["out"]
    suffix = None if out is None else out.suffix.lower().lstrip(".")
    file_format = given["file_format"]
    if file_format is not None and suffix is not None and file_format != suffix:
        raise UsageError(f"--format {file_format} contradicts --out {out}: leave one out")
    if file_format is None and suffix in ("ply", "pcd", "las", "laz"):
        file_format = suffix
    flags = {
        "map.voxel": given["voxel"],
        "map.attributes": given["attributes"],
        "map.format": file_format,
        "map.crop": None if given["crop"] is None else f"[{given['crop']}]",
        **{f"map.{key}": options.true_if(given[key]) for key in ("clean", "colour", "occupancy", "denoise", "mesh")},
    }
    return options.settings_of(flags, of_the_map(given["settings"]))


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
    """Print rows, or with --json the document."""
    if as_json:
        show_json(document)
    else:
        show_rows(rows)
