"""`lslam run`: the main job."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.cli.console import progress, setup_logging, show
from lslam.cli.one_run import arguments_of, read_truth
from lslam.core.errors import UsageError
from lslam.core.machine import rarely_collecting
from lslam.registration.residuals import RESIDUALS, find_residual

if TYPE_CHECKING:
    from lslam.core.config import Config
    from lslam.core.types.sequence import Sequence


@click.command(
    epilog="\b\nExamples: lslam run sample_data --out runs/first\n"
    "          lslam run seq07 --data-root ~/kitti --method kiss-icp\n"
    "          lslam run sample_data --gnss --crs EPSG:25832 --set map.format=laz\n"
    "          lslam run my_scans --poses theirs.tum --out runs/theirs\n"
    "          lslam run my_scans --osm town.osm --origin 49.0112,8.4229\n"
    "          lslam run sample_data --method loam --metrics thesis\n"
    "          lslam run --again runs/first --out runs/again\n"
    "          lslam run 2011_09_26_drive_0005_sync --set map.voxel=0.1 --json"
)
@click.argument("sequence", required=False)
@click.option(
    "--again",
    type=click.Path(path_type=Path),
    metavar="RUN",
    help="Make this run again, by its folder alone, and compare the results; SEQUENCE says where its recording is now.",
)
@options.method
@options.preset
@click.option("--residual", metavar="NAME", help=f"Residual of icp: {', '.join(RESIDUALS)} [default: plane].")
@options.truth
@click.option(
    "--out", type=options.Place(path_type=Path), metavar="DIR|URL", help="Run folder [default: runs/NAME-METHOD-TIME]."
)
@options.resumed
@options.replaced
@options.scan_range
@options.threads
@click.option("--rings", metavar="RULE", help="How rings are found: auto, field, order, rows[:N], elevation[:N].")
@click.option("--save-feature-map", is_flag=True, help="Write feature_map.ply; for the LOAM family.")
@click.option("--clean", is_flag=True, help="Remove moving objects from the map.")
@click.option("--colour", is_flag=True, help="Colour the map by the images of the recording's cameras.")
@click.option("--occupancy", is_flag=True, help="Write occupied and free cells, and a floor plan.")
@options.imu
@options.wheels
@click.option("--loops/--no-loops", default=None, help="Close loops where a place is seen again [default: yes].")
@options.refine
@options.manual
@options.fixes_as_factors
@options.fixes_at_the_end
@click.option("--osm", metavar="FILE|auto", help="Buildings of OpenStreetMap give planar priors; auto fetches them.")
@click.option("--origin", metavar="LAT,LON[,H]", help="With --osm: place of the first scan, where there are no fixes.")
@click.option(
    "--heading",
    type=float,
    metavar="DEG",
    help="With --osm: heading of the first scan, clockwise from north [default: searched].",
)
@options.coordinates
@options.poses
@click.option("--strict", is_flag=True, help="Exit 4 when anything was degraded: a scan skipped or bridged.")
@click.option(
    "--profile",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE.json",
    help="Write a profile of the run's time, for speedscope.",
)
@options.dry_run
@options.metrics
@options.reading
@options.data_root
@options.configuration
@options.as_json
@options.verbosity
def command(sequence: str | None, **given: Any) -> None:
    """Estimate a trajectory and build a map.

    SEQUENCE is a path (a folder or a bag), a name under --data-root: seq07, 07, kitti/07, 2011_09_26_drive_0005_sync, or
    a URL of storage: s3://bucket/drive7.bag.
    """
    setup_logging(given["verbose"], given["quiet"])
    if given["again"] is not None:
        from lslam.cli.again import run_again

        run_again(given["again"], sequence, given)
        return
    if sequence is None:
        raise click.UsageError("Missing argument 'SEQUENCE'.")
    from lslam.core.types.warned import collect_warnings
    from lslam.pipeline.precompile import helped, start_helper

    with collect_warnings(), helped():
        _check_folder(given)
        ahead = None if given["dry_run"] else partial(start_helper, if_cold=True)
        with progress("opening"), rarely_collecting():
            opened, config = opened_with({**given, "sequence": sequence}, ahead)
            from lslam.pipeline.run import plan, run
            from lslam.pipeline.run_folder import default_folder

        truth = read_truth(given["gt"], opened)
        out = given["out"] or default_folder(opened.name, _variant(config))
        if given["dry_run"]:
            _print_plan(plan(opened, config, truth), config, out, given["as_json"])
            return
        reading = {name: text for name, text in options.reading_of(given).items() if text is not None}
        with arguments_of(out, given) as arguments:
            run(opened, config, ground_truth=truth, reading=reading, **arguments)


def opened_with(given: dict[str, Any], meanwhile: Callable[[Config], None] | None = None) -> tuple[Sequence, Config]:
    """Sequence and configuration that the options describe. Raises the errors in them.

    Cheap checks come first: words, then the configuration, then the sequence. `meanwhile` begins what takes long beside the last.
    """
    from lslam.io.readers import find_folder

    flags = _flags(given)
    extract = None if given["osm"] in (None, "auto") else Path(given["osm"])
    options.require_there(given["gt"], given["poses"], extract, given["loops_file"], given["control"])
    find_folder(given["sequence"], given["data_root"])
    config = _resolve(given, flags)
    if meanwhile is not None:
        meanwhile(config)
    from lslam.io.readers import open_sequence

    opened = open_sequence(
        given["sequence"],
        data_root=given["data_root"],
        vertical_correction_deg=config.input.vertical_correction_deg,
        imu=config.imu.use,
        gnss=config.gnss.mode != "off",
        **options.reading_of(given),
    )
    return opened, config


def resolved(given: dict[str, Any]) -> Config:
    """Configuration that the options describe. Raises the errors in it."""
    return _resolve(given, _flags(given))


def _variant(config: Config) -> str:
    """Method and sensors as text, for the name of the default folder."""
    parts = {
        "-imu": config.imu.use,
        "-wheels": config.wheels.source,
        "-osm": config.osm.extract,
        "-in-map": config.localize.map,
    }
    return config.odometry.method + "".join(word for word, is_used in parts.items() if is_used)


def _check_folder(given: dict[str, Any]) -> None:
    """Raise UsageError for flags about folders that contradict each other or name a folder that does not exist."""
    if given["overwrite"] and given["resume"]:
        raise UsageError("--overwrite runs everything anew and --resume keeps finished parts: give one of them")
    if given["resume"] and given["out"] is None:
        raise UsageError("--resume needs --out: the folder of the interrupted run")
    if given["profile"] is not None and not given["profile"].absolute().parent.is_dir():
        raise UsageError(f"--profile: {given['profile'].absolute().parent} is not a folder")
    if given["out"] is not None and not given["resume"] and not given["dry_run"]:
        from lslam.pipeline.run_folder import check_target

        check_target(given["out"], given["overwrite"])


def _flags(given: dict[str, Any]) -> dict[str, Any]:
    """Values of the flags by configuration key, None for flags that are not given. Raises UsageError for unknown words."""
    from lslam.evaluation import check_words
    from lslam.odometry import require_method

    check_words(options.metrics_of(given["metrics"]))
    if given["method"] is not None:
        require_method(given["method"])
    if given["residual"] is not None:
        find_residual(given["residual"])
    flags = {
        "odometry.method": given["method"],
        "eval.metrics": json.dumps(options.metrics_of(given["metrics"])) if given["metrics"] else None,
        "registration.residual": given["residual"],
        "input.start": given["start"],
        "input.count": given["count"],
        "input.skip_frames": given["skip_frames"],
        "input.threads": given["threads"],
        "input.rings": given["rings"],
        "map.write_features": "true" if given["save_feature_map"] else None,
        "map.clean": "true" if given["clean"] else None,
        "map.colour": "true" if given["colour"] else None,
        "graph.refine": "true" if given["refine"] else None,
        "map.occupancy": "true" if given["occupancy"] else None,
        "imu.use": None if given["imu"] is None else str(given["imu"]).lower(),
        "wheels.source": None if given["wheels"] is None else json.dumps(given["wheels"], ensure_ascii=False),
        "input.strict": "true" if given["strict"] else None,
        "loops.use": None if given["loops"] is None else str(given["loops"]).lower(),
        **options.manual_settings(given["loops_file"], given["control"]),
        "gnss.mode": given["gnss"],
        "osm.extract": _place_of(None if given["osm"] == "auto" else given["osm"]) or given["osm"],
        "osm.origin": None
        if given["origin"] is None
        else json.dumps([*options.place("--origin", given["origin"]), 0.0][:3]),
        "osm.heading_deg": given["heading"],
        **options.crs_settings(given["crs"], given["geoid"]),
    }
    if given["poses"] is not None:
        if given["method"] not in (None, "poses"):
            raise UsageError(f"--poses replaces odometry: drop --method {given['method']}")
        flags |= {"odometry.method": "poses", "odometry.poses": _place_of(given["poses"])}
    return flags


def _place_of(path: str | Path | None) -> str | None:
    """Absolute path as a setting, so that the run's copy of the configuration is valid anywhere."""
    return None if path is None else json.dumps(str(Path(path).expanduser().absolute()), ensure_ascii=False)


def _resolve(given: dict[str, Any], flags: dict[str, Any]) -> Config:
    """The checked configuration. Precedence: flags, --set, environment, --config, --preset, defaults."""
    from lslam.core.config import load_config
    from lslam.pipeline.check import check_config

    settings = options.with_preset(given["settings"], given["preset"])
    config = load_config(given["config_file"], [*settings, *(f"{k}={v}" for k, v in flags.items() if v is not None)])
    check_config(config)
    return config


def _print_plan(sequence: Sequence, config: Config, out: Path, as_json: bool) -> None:
    from lslam.core.config import to_toml

    if as_json:
        facts = {"name": sequence.name, "path": str(sequence.path), "format": sequence.kind, "scans": len(sequence)}
        facts |= {"decisions": sequence.notes, "problems": sequence.problems}
        show(json.dumps({"folder": str(out), "sequence": facts, "config": config.model_dump(mode="json")}) + "\n")
        return
    lines = [f"# {sequence.name}: {len(sequence)} scans, {sequence.kind}, {sequence.path}", f"# output: {out}"]
    lines += [f"# {note}" for note in sequence.notes] + [f"# problem: {problem}" for problem in sequence.problems]
    show("\n".join(lines) + "\n" + to_toml(config))
