"""`lslam run --again`: a run once more by its folder alone, and whether it has the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from lslam.cli.console import log, progress, show
from lslam.cli.one_run import arguments_of, print_result, read_truth
from lslam.core.errors import GateError, UsageError
from lslam.io.remote import RemotePath, as_path

# Options that change no byte of a result, or say where things are; the others are the run's.
_FREE = (
    *("again", "sequence", "out", "overwrite", "resume", "threads", "strict", "profile", "data_root"),
    *("as_json", "verbose", "quiet", "progress"),
)
_MOST_NAMED = 6  # files


def run_again(folder: Path, recording: str | None, given: dict[str, Any]) -> None:
    """Make the run in `folder` again, and print what differs; `recording` is where its scans are now."""
    _refuse_others()
    out = given["out"] or folder.absolute().with_name(f"{folder.absolute().name}-again")
    if isinstance(out, RemotePath):
        raise UsageError(f"--out {out}: --again compares folders of this machine, name one")
    from lslam.core.types.warned import collect_warnings
    from lslam.io.readers import open_sequence
    from lslam.pipeline.again import (
        compare_results,
        other_inputs,
        other_programs,
        other_recording,
        read_recipe,
    )
    from lslam.pipeline.precompile import helped
    from lslam.pipeline.resume import require_another
    from lslam.pipeline.run import run
    from lslam.pipeline.run_folder import check_target
    from lslam.pipeline.watch import RunOutcome

    recipe = read_recipe(folder, None if recording is None else as_path(recording))
    require_another(folder, out)
    if not given["resume"]:
        check_target(out, given["overwrite"])
    flags = {"threads": given["threads"], "strict": given["strict"] or None}
    changed = {name: value for name, value in flags.items() if value is not None}
    config = recipe.config.model_copy(update={"input": recipe.config.input.model_copy(update=changed)})
    told: list[str] = []

    def tell(sentences: list[str]) -> None:
        told.extend(sentences)
        for sentence in sentences:
            log.warning("%s", sentence)

    def finish(outcome: RunOutcome) -> None:
        tell(other_inputs(recipe, outcome.record.manifest.get("identity", {})))
        found = compare_results(folder, out)
        facts = {"run": str(folder), "is_same": found.is_same, "warnings": told, **vars(found)}
        print_result(outcome, out, given["as_json"], again=facts)
        parts = [
            f"{what}: {', '.join(names[:_MOST_NAMED])}{' ...' if len(names) > _MOST_NAMED else ''}"
            for what, names in (("other bytes", found.differing), ("only in one of them", found.lacking))
            if names
        ]
        said = "; ".join([*parts, f"same bytes: {len(found.same)} files"])
        if not given["as_json"]:
            show(f"  {'again':<12} {said}\n")
        if given["strict"] and not found.is_same:
            raise GateError(f"--strict: {out} differs from {folder}: {said}")

    with collect_warnings(), helped():
        tell([*recipe.notes, *other_programs(recipe)])
        with progress("opening"):
            opened = open_sequence(
                recipe.path,
                vertical_correction_deg=config.input.vertical_correction_deg,
                imu=config.imu.use,
                gnss=config.gnss.mode != "off",
                **dict[str, Any](recipe.reading),
            )
            truth = read_truth(recipe.truth, opened)
        tell(other_recording(recipe, opened, truth))
        with arguments_of(out, given, finish) as arguments:
            run(opened, config, ground_truth=truth, reading=recipe.reading, **arguments)


def _refuse_others() -> None:
    """Raise UsageError for an option that the run decides."""
    context = click.get_current_context()
    for option in context.command.params:
        assert option.name is not None
        if option.name not in _FREE and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE:
            raise UsageError(f"{option.opts[0]} is not for --again, which takes all of that from the run: leave it out")
