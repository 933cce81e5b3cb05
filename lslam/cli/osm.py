"""`lslam osm`: fetch building extracts, and show their contents."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import console, options

if TYPE_CHECKING:
    from lslam.io.formats.osm_buildings import BuildingExtract
    from lslam.osm.bounds import Bounds
    from lslam.osm.overpass import OverpassReply


@click.group()
def command() -> None:
    """Fetch buildings from OpenStreetMap, or show what is in an extract.

    \b
    Example: lslam osm fetch --around 49.0112,8.4229 --out town.osm
             lslam osm show town.osm --png town.png
    """


FETCH_EPILOG = """\b
Examples:
  lslam osm fetch --along sample_data --out town.osm
  lslam osm fetch --around 49.0112,8.4229 --radius 300 --out town.osm
  lslam osm fetch --bbox 49.00,8.40,49.01,8.42 --out town.json
"""


@command.command(epilog=FETCH_EPILOG)
@click.option("--bbox", metavar="S,W,N,E", help="A box: south, west, north, east in degrees.")
@click.option("--around", metavar="LAT,LON", help="The surroundings of a place.")
@click.option(
    "--along", metavar="PATH", help="The surroundings of a sequence's satellite fixes, a run folder, or a trajectory."
)
@click.option("--radius", type=float, metavar="M", help="Radius about the place or path  [osm.fetch_radius, 120].")
@click.option(
    "--origin", metavar="LAT,LON[,H]", help="With --along TRAJECTORY in metres: where x = y = 0 is, x east, y north."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("map.osm"),
    show_default=True,
    metavar="FILE",
    help="OSM XML (.osm), or the server's own reply (.json).",
)
@click.option("--overwrite", is_flag=True, help="Replace FILE.")
@click.option("--server", metavar="URL", help="Another Overpass server  [osm.server].")
@click.option("--refresh", is_flag=True, help="Ask the server also for areas that are in the cache.")
@click.option("--offline", is_flag=True, help="Use the cache alone.")
@options.data_root
@options.configuration
@options.as_json
@options.verbosity
def fetch(
    bbox: str | None,
    around: str | None,
    along: str | None,
    radius: float | None,
    origin: str | None,
    out: Path,
    overwrite: bool,
    server: str | None,
    refresh: bool,
    offline: bool,
    data_root: Path | None,
    config_file: Path | None,
    settings: tuple[str, ...],
    as_json: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Fetch the buildings of a place from an Overpass server, or from the cache of earlier replies."""
    if sum(given is not None for given in (bbox, around, along)) != 1:
        raise click.UsageError("no place is given: give one of --bbox, --around and --along")
    if refresh and offline:
        raise click.UsageError("--refresh asks the server and --offline never does: give one of them")
    if bbox is not None and radius is not None:
        raise click.UsageError("--radius goes with --around or --along; a --bbox has its size")
    if origin is not None and along is None:
        raise click.UsageError("--origin goes with --along, and says where a trajectory in metres lies")
    if out.suffix.lower() not in (".osm", ".xml", ".json"):
        raise click.UsageError(f"--out {out}: end the name with .osm or .json")
    if bbox is not None:
        _box(bbox)
    if around is not None:
        options.place("--around", around)
    console.setup_logging(verbose, quiet)
    import json

    from lslam.core.config import load_config
    from lslam.core.errors import OutputError, OutputExistsError

    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists: give --overwrite to replace it, or another --out")
    if not out.absolute().parent.is_dir():
        raise OutputError(f"{out} cannot be written: there is no folder {out.absolute().parent}")
    more = [f"osm.server={json.dumps(server)}"] if server is not None else []
    more += ['osm.cache="refresh"'] if refresh else ['osm.cache="only"'] if offline else []
    config = load_config(config_file, [*settings, *more]).osm
    bounds = _bounds(bbox, around, along, config.fetch_radius if radius is None else radius, data_root, origin)
    from lslam.osm.overpass import fetch_buildings, reply_folder

    with console.progress("fetching"):
        reply = fetch_buildings(bounds, config, reply_folder())
    _write(out, reply, as_json)


def _box(text: str) -> list[float]:
    return options.numbers("--bbox", text, (4,), "S,W,N,E, for example 49.00,8.40,49.01,8.42")


def _bounds(
    bbox: str | None, around: str | None, along: str | None, radius: float, data_root: Path | None, origin: str | None
) -> Bounds:
    import numpy as np

    from lslam.osm import bounds
    from lslam.osm.bounds import positions_along

    if bbox is not None:
        return bounds.Bounds(*_box(bbox))
    if around is not None:
        return bounds.around(np.array(options.place("--around", around)[:2]), radius)
    assert along is not None
    at = None if origin is None else np.array([*options.place("--origin", origin), 0.0][:3])
    return bounds.around(positions_along(along, data_root, at), radius)


def _write(out: Path, reply: OverpassReply, as_json: bool) -> None:
    import json

    from lslam.io.formats.atomic import atomic_write
    from lslam.io.formats.osm_buildings import buildings_of, middle_of
    from lslam.io.formats.osm_files import write_osm
    from lslam.osm.overpass import from_overpass

    data = from_overpass(reply)
    if out.suffix.lower() == ".json":
        with atomic_write(out) as stream:
            stream.write(reply.text)
    else:
        write_osm(out, data)
    found = len(buildings_of(data, middle_of(data), str(out)).buildings)
    if not found:
        console.log.warning("there is no building in that place")
    if as_json:
        click.echo(json.dumps({"file": str(out), "buildings": found, "attribution": data.attribution}))
    else:
        click.echo(f"{out}: {found} buildings. {data.attribution}")


@command.command(epilog="Example: lslam osm show town.osm --png town.png")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--png", type=click.Path(path_type=Path), metavar="FILE.png", help="Draw the buildings from above.")
@click.option("--origin", metavar="LAT,LON[,H]", help="Where x = y = 0 is  [the middle of the buildings].")
@click.option("--overwrite", is_flag=True, help="Replace FILE.png.")
@options.as_json
def show(file: Path, png: Path | None, origin: str | None, overwrite: bool, as_json: bool) -> None:
    """Show what is in FILE: OSM XML, a stored Overpass reply, or GeoJSON outlines."""
    if png is not None and png.suffix.lower() != ".png":
        raise click.UsageError(f"--png {png}: end the name with .png")
    at = None if origin is None else [*options.place("--origin", origin), 0.0][:3]
    import numpy as np

    from lslam.core.errors import OutputExistsError
    from lslam.io.formats.osm_buildings import read_buildings

    if png is not None and png.exists() and not overwrite:
        raise OutputExistsError(f"{png} exists: give --overwrite to replace it, or another --png")
    data, extract = read_buildings(file, None if at is None else np.array(at))
    facts = _facts(extract)
    facts["elements"] = {"nodes": len(data.nodes), "ways": len(data.ways), "relations": len(data.relations)}
    if png is not None:
        from lslam.reports.picture import write_buildings_png

        write_buildings_png(png, extract)
    if as_json:
        import json

        click.echo(json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False))
    else:
        _print(facts, png)


def _facts(extract: BuildingExtract) -> dict[str, Any]:
    import numpy as np

    from lslam.core.geometry.geodesy import from_local

    rings = [ring for b in extract.buildings for f in b.footprints for ring in f.rings]
    corners = np.concatenate(rings)
    low, high = corners.min(0), corners.max(0)
    fixes = from_local(np.column_stack([[low, high], [0, 0]]), extract.origin)
    walls = sum(float(np.linalg.norm(ring - np.roll(ring, 1, 0), axis=1).sum()) for ring in rings)
    return {
        "file": extract.source,
        "buildings": len(extract.buildings),
        "footprints": sum(len(b.footprints) for b in extract.buildings),
        "with_height": sum(b.height is not None for b in extract.buildings),
        "corners": len(corners),
        "walls_m": round(walls, 1),
        "ground_covered_m2": round(sum(b.area for b in extract.buildings), 1),
        "origin_lat_lon_alt": [float(v) for v in extract.origin],
        "south_west": [round(float(v), 7) for v in fixes[0, :2]],
        "north_east": [round(float(v), 7) for v in fixes[1, :2]],
        "size_m": [round(float(v), 1) for v in high - low],
        "left_out": dict(extract.omissions),
        "attribution": extract.attribution,
    }


def _print(facts: dict[str, Any], png: Path | None) -> None:
    elements = facts["elements"]
    (south, west), (north, east), (width, depth) = facts["south_west"], facts["north_east"], facts["size_m"]
    left_out = ", ".join(f"{count} x {why}" for why, count in facts["left_out"].items())
    lines = [
        ("extract", facts["file"]),
        ("elements", ", ".join(f"{count} {kind}" for kind, count in elements.items())),
        (
            "buildings",
            f"{facts['buildings']} with {facts['footprints']} outlines, {facts['with_height']} with a height",
        ),
        ("left out", left_out or "nothing"),
        (
            "walls",
            f"{facts['walls_m']:.0f} m between {facts['corners']} corners, {facts['ground_covered_m2']:.0f} m2 inside",
        ),
        ("extent", f"{width:.0f} x {depth:.0f} m, {south:.6f},{west:.6f} to {north:.6f},{east:.6f}"),
        ("origin", ",".join(f"{v:.7g}" if k == 2 else f"{v:.7f}" for k, v in enumerate(facts["origin_lat_lon_alt"]))),
        ("licence", facts["attribution"] or "none is given"),
    ]
    lines += [("picture", str(png))] if png is not None else []
    for label, value in lines:
        click.echo(f"{label:<10} {value}")
