"""`lslam run`: the main job; with --again a run once more by its folder alone, and whether it has the same bytes."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.cli.console import log, progress, setup_logging, show
from lslam.cli.one_run import arguments_of, print_result, read_truth
from lslam.core.errors import GateError, UsageError
from lslam.core.machine import keeping_objects
from lslam.io.remote import as_path
from lslam.registration.residuals import RESIDUALS, find_residual

if TYPE_CHECKING:
    from lslam.core.config import Config
    from lslam.core.types.sequence import Sequence
    from lslam.pipeline.watch import RunOutcome

# Of --again: options that change no byte of a result, or say where things are; the others are the run's.
_FREE = (
    *("again", "sequence", "out", "overwrite", "resume", "threads", "strict", "profile", "data_root"),
    *("as_json", "verbose", "quiet", "progress"),
)
_MOST_FILES = 6  # named


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
@options.option(
    "--again",
    "RUN",
    "Make this run again, by its folder alone, and compare the results; SEQUENCE says where its recording is now.",
    type=options.Place(path_type=Path),
)
@options.method
@options.preset
@options.option("--residual", "NAME", f"Residual of icp: {', '.join(RESIDUALS)} [default: plane].")
@options.truth
@options.option("--out", "DIR|URL", "Run folder [default: runs/NAME-METHOD-TIME].", type=options.Place(path_type=Path))
@options.resume
@options.overwrite
@options.scan_range
@options.threads
@options.option("--rings", "RULE", "How rings are found: auto, field, order, rows[:N], elevation[:N].")
@options.flag("--save-feature-map", "Write feature_map.ply; for the LOAM family.")
@options.flag("--clean", "Remove moving objects from the map.")
@options.flag("--colour", "Colour the map by the images of the recording's cameras.")
@options.flag("--occupancy", "Write occupied and free cells, and a floor plan.")
@options.imu
@options.wheels
@click.option("--loops/--no-loops", default=None, help="Close loops where a place is seen again [default: yes].")
@options.refine
@options.manual
@options.fixes_as_factors
@options.fixes_at_the_end
@options.option("--osm", "FILE|auto", "Buildings of OpenStreetMap give planar priors; auto fetches them.")
@options.option("--origin", "LAT,LON[,H]", "With --osm: place of the first scan, where there are no fixes.")
@options.real("--heading", "DEG", "With --osm: heading of the first scan, clockwise from north [default: searched].")
@options.coordinates
@options.poses
@options.flag("--strict", "Exit 4 when anything was degraded: a scan skipped or bridged.")
@options.option(
    "--profile",
    "FILE.json",
    "Write a profile of the run's time, for speedscope.",
    type=click.Path(dir_okay=False, path_type=Path),
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
        run_again(given["again"], sequence, given)
        return
    if sequence is None:
        raise click.UsageError("Missing argument 'SEQUENCE'.")
    from lslam.core.types.warned import collect_warnings
    from lslam.pipeline.precompile import helper_process, start_helper

    with collect_warnings(), helper_process():
        _check_folder(given)
        ahead = None if given["dry_run"] else partial(start_helper, if_cold=True)
        with progress("opening"), keeping_objects():
            recording, config = open_with({**given, "sequence": sequence}, ahead)
            from lslam.pipeline.run import plan, run
            from lslam.pipeline.run_folder import default_folder

        truth = read_truth(given["gt"], recording)
        out = given["out"] or default_folder(recording.name, _variant(config))
        if given["dry_run"]:
            _print_plan(plan(recording, config, truth), config, out, given["as_json"])
            return
        reading = {name: text for name, text in options.reading_of(given).items() if text is not None}
        with arguments_of(out, given) as arguments:
            run(recording, config, ground_truth=truth, reading=reading, **arguments)


def open_with(given: dict[str, Any], meanwhile: Callable[[Config], None] | None = None) -> tuple[Sequence, Config]:
    """Sequence and configuration that the options describe. Raises the errors in them.

    Cheap checks come first: words, then the configuration, then the sequence. `meanwhile` begins what takes long beside the last.
    """
    from lslam.io.readers import find_folder

    flags = _flags(given)
    extract = None if given["osm"] in (None, "auto") else Path(given["osm"])
    options.require_there(given["gt"], given["poses"], extract, given["loops_file"], given["control"])
    find_folder(given["sequence"], given["data_root"])
    config = resolve(given, flags)
    if meanwhile is not None:
        meanwhile(config)
    from lslam.pipeline.check import open_recording

    reading = options.reading_of(given)
    return open_recording(given["sequence"], config, data_root=given["data_root"], **reading), config


def resolve(given: dict[str, Any], flags: dict[str, Any] | None = None) -> Config:
    """The checked configuration that the options describe. Precedence: flags, --set, environment, --config, --preset, defaults.

    flags : as of `_flags`. Raises the errors in the options.
    """
    from lslam.core.config import load_config
    from lslam.pipeline.check import check_config

    preset = {"odometry.preset": options.quote(given["preset"])}
    settings = options.settings_of(preset | (_flags(given) if flags is None else flags), given["settings"])
    config = load_config(given["config_file"], settings)
    check_config(config)
    return config


def _variant(config: Config) -> str:
    """Method and sensors as text, for the name of the default folder."""
    parts = {
        "-imu": config.imu.use,
        "-wheels": config.wheels.source,
        "-osm": config.osm.extract,
        "-in-map": config.localize.map,
    }
    return config.odometry.method + "".join(word for word, is_on in parts.items() if is_on)


def _check_folder(given: dict[str, Any]) -> None:
    """Raise UsageError for contradicting flags or a missing folder, OutputExistsError for an earlier result."""
    options.check_resume(given, "run")
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
        "map.write_features": options.true_if(given["save_feature_map"]),
        "map.clean": options.true_if(given["clean"]),
        "map.colour": options.true_if(given["colour"]),
        "graph.refine": options.true_if(given["refine"]),
        "map.occupancy": options.true_if(given["occupancy"]),
        "imu.use": None if given["imu"] is None else str(given["imu"]).lower(),
        "wheels.source": options.quote(given["wheels"]),
        "input.strict": options.true_if(given["strict"]),
        "loops.use": None if given["loops"] is None else str(given["loops"]).lower(),
        "loops.file": options.file_setting(given["loops_file"]),
        "graph.control": options.file_setting(given["control"]),
        "gnss.mode": given["gnss"],
        "osm.extract": given["osm"] if given["osm"] == "auto" else options.file_setting(given["osm"]),
        "osm.origin": None
        if given["origin"] is None
        else json.dumps([*options.place("--origin", given["origin"]), 0.0][:3]),
        "osm.heading_deg": given["heading"],
        **options.crs_settings(given),
    }
    if given["poses"] is not None:
        if given["method"] not in (None, "poses"):
            raise UsageError(f"--poses replaces odometry: drop --method {given['method']}")
        flags |= {"odometry.method": "poses", "odometry.poses": options.file_setting(given["poses"])}
    return flags


def _print_plan(sequence: Sequence, config: Config, out: Path, as_json: bool) -> None:
    """Print what the run would read, its folder and configuration."""
    from lslam.core.config import to_toml

    if as_json:
        facts = {"name": sequence.name, "path": str(sequence.path), "format": sequence.kind, "scans": len(sequence)}
        facts |= {"decisions": sequence.notes, "problems": sequence.problems}
        show(json.dumps({"folder": str(out), "sequence": facts, "config": config.model_dump(mode="json")}) + "\n")
        return
    lines = [f"# {sequence.name}: {len(sequence)} scans, {sequence.kind}, {sequence.path}", f"# output: {out}"]
    lines += [f"# {note}" for note in sequence.notes] + [f"# problem: {problem}" for problem in sequence.problems]
    show("\n".join(lines) + "\n" + to_toml(config))


def run_again(folder: Path, recording: str | None, given: dict[str, Any]) -> None:
    """Repeat the run in `folder` on `recording`, or where it was, and print what differs; UsageError for other options."""
    for name, option in options.typed_options().items():
        if name not in _FREE:
            raise UsageError(f"{option} is not for --again, which takes all of that from the run: leave it out")
    out = given["out"] or folder.absolute().with_name(f"{folder.absolute().name}-again")
    from lslam.core.types.warned import collect_warnings
    from lslam.pipeline.again import (
        compare_results,
        other_inputs,
        other_programs,
        other_recording,
        read_recipe,
        require_another,
    )
    from lslam.pipeline.check import open_recording
    from lslam.pipeline.precompile import helper_process
    from lslam.pipeline.run import run
    from lslam.pipeline.run_folder import check_target

    recipe = read_recipe(folder, None if recording is None else as_path(recording))
    require_another(folder, out)
    if not given["resume"]:
        check_target(out, given["overwrite"])
    flags = {"threads": given["threads"], "strict": given["strict"] or None}
    own = {name: value for name, value in flags.items() if value is not None}
    config = recipe.config.model_copy(update={"input": recipe.config.input.model_copy(update=own)})
    warnings: list[str] = []

    def warn(sentences: list[str]) -> None:
        warnings.extend(sentences)
        for sentence in sentences:
            log.warning("%s", sentence)

    def finish(outcome: RunOutcome) -> None:
        warn(other_inputs(recipe, outcome.record.manifest.get("identity", {})))
        result = compare_results(folder, out)
        facts = {"run": str(folder), "is_same": result.is_same, "warnings": warnings, **vars(result)}
        print_result(outcome, out, given["as_json"], again=facts)
        parts = [
            f"{what}: {', '.join(names[:_MOST_FILES])}{' ...' if len(names) > _MOST_FILES else ''}"
            for what, names in (("other bytes", result.differing), ("only in one of them", result.lacking))
            if names
        ]
        text = "; ".join([*parts, f"same bytes: {len(result.same)} files"])
        if not given["as_json"]:
            show(f"  {'again':<12} {text}\n")
        if given["strict"] and not result.is_same:
            raise GateError(f"--strict: {out} differs from {folder}: {text}")

    with collect_warnings(), helper_process():
        warn([*recipe.notes, *other_programs(recipe)])
        with progress("opening"):
            sequence = open_recording(recipe.path, config, **recipe.reading)
            truth = read_truth(recipe.truth, sequence)
        warn(other_recording(recipe, sequence, truth))
        with arguments_of(out, given, finish) as arguments:
            run(sequence, config, ground_truth=truth, reading=recipe.reading, **arguments)
