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
@options.option("--bbox", "S,W,N,E", "A box: south, west, north, east in degrees.")
@options.option("--around", "LAT,LON", "The surroundings of a place.")
@options.option("--along", "PATH", "The surroundings of a sequence's satellite fixes, a run folder, or a trajectory.")
@options.real("--radius", "M", "Radius about the place or path  [osm.fetch_radius, 120].")
@options.option("--origin", "LAT,LON[,H]", "With --along TRAJECTORY in metres: where x = y = 0 is, x east, y north.")
@options.path(
    "--out", "FILE", "OSM XML (.osm), or the server's own reply (.json).", default=Path("map.osm"), show_default=True
)
@options.flag("--overwrite", "Replace FILE.")
@options.option("--server", "URL", "Another Overpass server  [osm.server].")
@options.flag("--refresh", "Ask the server also for areas that are in the cache.")
@options.flag("--offline", "Use the cache alone.")
@options.data_root
@options.configuration
@options.as_json
@options.verbosity
def fetch(out: Path, **given: Any) -> None:
    """Fetch the buildings of a place from an Overpass server, or from the cache of earlier replies."""
    if sum(given[name] is not None for name in ("bbox", "around", "along")) != 1:
        raise click.UsageError("no place is given: give one of --bbox, --around and --along")
    if given["refresh"] and given["offline"]:
        raise click.UsageError("--refresh asks the server and --offline never does: give one of them")
    if given["bbox"] is not None and given["radius"] is not None:
        raise click.UsageError("--radius goes with --around or --along; a --bbox has its size")
    if given["origin"] is not None and given["along"] is None:
        raise click.UsageError("--origin goes with --along, and says where a trajectory in metres lies")
    if out.suffix.lower() not in (".osm", ".xml", ".json"):
        raise click.UsageError(f"--out {out}: end the name with .osm or .json")
    if given["bbox"] is not None:
        _box(given["bbox"])
    if given["around"] is not None:
        options.place("--around", given["around"])
    console.setup_logging(given["verbose"], given["quiet"])
    from lslam.core.config import load_config
    from lslam.core.errors import OutputError
    from lslam.pipeline.run_folder import require_new

    require_new(out, given["overwrite"])
    if not out.absolute().parent.is_dir():
        raise OutputError(f"{out} cannot be written: there is no folder {out.absolute().parent}")
    flags = {
        "osm.server": options.quote(given["server"]),
        "osm.cache": '"refresh"' if given["refresh"] else '"only"' if given["offline"] else None,
    }
    config = load_config(given["config_file"], options.settings_of(flags, given["settings"])).osm
    bounds = _bounds(given, config.fetch_radius if given["radius"] is None else given["radius"])
    from lslam.osm.overpass import fetch_buildings, reply_folder

    with console.progress("fetching"):
        reply = fetch_buildings(bounds, config, reply_folder())
    _write(out, reply, given["as_json"])


def _box(text: str) -> list[float]:
    """Values of --bbox: south, west, north, east, deg."""
    return options.numbers("--bbox", text, (4,), "S,W,N,E, for example 49.00,8.40,49.01,8.42")


def _bounds(given: dict[str, Any], radius: float) -> Bounds:
    """Bounds, deg, of the box, of a circle round a position, or of the recordings of `--along` with a margin of `radius` m."""
    import numpy as np

    from lslam.osm import bounds

    if given["bbox"] is not None:
        return bounds.Bounds(*_box(given["bbox"]))
    if given["around"] is not None:
        return bounds.around(np.array(options.place("--around", given["around"])[:2]), radius)
    origin = None if given["origin"] is None else np.array([*options.place("--origin", given["origin"]), 0.0][:3])
    return bounds.around(bounds.positions_along(given["along"], given["data_root"], origin), radius)


def _write(out: Path, reply: OverpassReply, as_json: bool) -> None:
    """Write a reply of Overpass as JSON or OSM XML by the suffix of `out`, and print the number of buildings."""
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
    count = len(buildings_of(data, middle_of(data), str(out)).buildings)
    if not count:
        console.log.warning("there is no building in that place")
    if as_json:
        console.show_json({"file": str(out), "buildings": count, "attribution": data.attribution})
    else:
        console.show(f"{out}: {count} buildings. {data.attribution}\n")


@command.command(epilog="Example: lslam osm show town.osm --png town.png")
@click.argument("file", type=click.Path(path_type=Path))
@options.path("--png", "FILE.png", "Draw the buildings from above.")
@options.option("--origin", "LAT,LON[,H]", "Where x = y = 0 is  [the middle of the buildings].")
@options.flag("--overwrite", "Replace FILE.png.")
@options.as_json
def show(file: Path, png: Path | None, origin: str | None, overwrite: bool, as_json: bool) -> None:
    """Show what is in FILE: OSM XML, a stored Overpass reply, or GeoJSON outlines."""
    if png is not None and png.suffix.lower() != ".png":
        raise click.UsageError(f"--png {png}: end the name with .png")
    at = None if origin is None else [*options.place("--origin", origin), 0.0][:3]
    import numpy as np

    from lslam.io.formats.osm_buildings import read_buildings
    from lslam.pipeline.run_folder import require_new

    if png is not None:
        require_new(png, overwrite, "--png")
    data, extract = read_buildings(file, None if at is None else np.array(at))
    facts = _facts(extract)
    facts["elements"] = {"nodes": len(data.nodes), "ways": len(data.ways), "relations": len(data.relations)}
    if png is not None:
        from lslam.reports.picture import write_buildings_png

        write_buildings_png(png, extract)
    if as_json:
        console.show_json(facts, indent=1, ensure_ascii=False)
    else:
        _print(facts, png)


def _facts(extract: BuildingExtract) -> dict[str, Any]:
    """JSON document of an extract: numbers, lengths, m, areas, m2, and corners, deg."""
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
    """Print the facts of an extract."""
    elements = facts["elements"]
    (south, west), (north, east), (width, depth) = facts["south_west"], facts["north_east"], facts["size_m"]
    left_out = ", ".join(f"{count} x {why}" for why, count in facts["left_out"].items())
    rows = [
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
    console.show_rows([*rows, *([("picture", str(png))] if png is not None else [])])
