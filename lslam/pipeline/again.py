"""An earlier run made once more by its folder alone and compared, or taken for another pose graph."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lslam.core import __version__
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError, UsageError, input_errors
from lslam.core.types.sequence import Sequence, select
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.remote import as_path
from lslam.osm.source import AUTO
from lslam.pipeline.check import open_recording
from lslam.pipeline.manifest import machine_facts
from lslam.pipeline.rebuild import EarlierRun, read_run, recording_of
from lslam.pipeline.resume import INPUTS, input_digest
from lslam.pipeline.run_folder import MANIFEST, OURS, REPLIES, require_odometry, require_run

log = logging.getLogger("lslam")
# Sections that odometry does not look at.
FREE_SECTIONS = ("loops", "graph", "gnss", "osm", "map", "eval", "report")
# Options with which a recording is opened.
READING = ("lidar_topic", "lidar_frame", "imu_topic", "gnss_topic", "point_times", "extrinsics")
# Files that hold times or the names of folders.
_ALWAYS_OTHER = {MANIFEST, "config.toml", "log.txt", "timing.csv", "report.html"}


@dataclass(frozen=True)
class Recipe:
    """What a run was made of.

    path : of its recording; reading : options with which that was opened; truth : file of `--gt`, None without
    identity : digests of its input, as of `run_identity`; is_elsewhere : whether `path` is another than that of the run
    notes : sentences about what cannot be as it was
    """

    folder: Path
    manifest: Mapping[str, Any]
    config: Config
    path: Path
    reading: Mapping[str, str]
    truth: Path | None
    identity: Mapping[str, str]
    is_elsewhere: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ResultComparison:
    """Names of result files that are the same in both runs, that differ, and that one of them lacks."""

    same: list[str] = field(default_factory=list)
    differing: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)

    @property
    def is_same(self) -> bool:
        """Whether there are files, and all are the same."""
        return bool(self.same) and not self.differing and not self.lacking


def read_recipe(folder: Path, recording: Path | None = None) -> Recipe:
    """Read how the run in `folder` was made; `recording` : where its recording is now, None for the same path.

    Raises InputError naming what is missing, damaged or no run of a recording.
    """
    require_run(folder)
    file = folder / MANIFEST
    try:
        with input_errors(file):
            manifest = parse_json(file.read_text(encoding="utf-8"))
        if manifest.get("kind") == "merge":
            raise InputError(
                f"{folder} is a merge of several runs: make it again by its command, {manifest['command']}"
            )
        section = manifest["sequence"]
        path, own = str(section["path"]), section.get("reading", {})
        reading = {name: str(own[name]) for name in READING if name in own}
        truth = None if manifest.get("ground_truth") is None else Path(manifest["ground_truth"])
        identity = {name: str(digest) for name, digest in manifest.get("identity", {}).items()}
    except (AttributeError, *MISFIT) as error:
        raise InputError(
            f"{file} does not say what was run, it is damaged or cut off ({error}): run the sequence again"
        ) from None
    notes = []
    if (status := manifest.get("status")) not in ("done", "degraded", "diverged"):
        notes.append(f"the run in {folder} did not come to its end ({status}): only what it wrote can be compared")
    config = load_config(folder / "config.toml", environ={})
    if config.osm.extract == AUTO:
        # What the server said then stands in the run; today it may say something else.
        replies = (folder / REPLIES).absolute()
        buildings: dict[str, str | None] = {"extract": str(replies)}
        if not any(replies.glob("*.json")):
            notes.append(f"the run in {folder} had no reply of the server of --osm auto: it is made without buildings")
            buildings = {"extract": "", "origin": None, "heading_deg": None}
        config = config.model_copy(update={"osm": config.osm.model_copy(update=buildings)})
    place = as_path(path) if recording is None else recording
    if not place.exists():
        raise InputError(
            f"the recording of {folder} is gone: {place} does not exist; say where it is: lslam run RECORDING --again {folder}"
        )
    is_elsewhere = recording is not None and recording.absolute() != Path(path)
    return Recipe(folder, manifest, config, place, reading, truth, identity, is_elsewhere, tuple(notes))


def other_programs(recipe: Recipe) -> list[str]:
    """A sentence for lslam and each library whose version is another than at the run."""
    then = recipe.manifest.get("machine", {})
    before = {"lslam": recipe.manifest.get("lslam"), **(then if isinstance(then, dict) else {})}
    now = {"lslam": __version__, **machine_facts()}
    other = [name for name in now if name in before and before[name] != now[name]]
    sentences = [
        f"{name} was {before[name] or 'not installed'} at the run and is {now[name] or 'not installed'} now"
        for name in other
        if name != "code"
    ]
    if "code" in other and "lslam" not in other:
        sentences.append(f"lslam's code is another than at the run, with the same version {__version__}")
    return sentences


def other_recording(recipe: Recipe, recording: Sequence, truth: Trajectory | None) -> list[str]:
    """A sentence, or none, where the recording's files differ from those of the run by sizes and times, before all is read.

    For a recording read from another place the sentence says that this is unknown.
    """
    if recipe.is_elsewhere:
        return [
            f"the recording is read from {recipe.path}, not from {recipe.manifest['sequence']['path']}: whether its files are "
            "the same is not known before the results"
        ]
    section = recipe.config.input
    scans = select(recording, section.start, section.count, section.skip_frames)
    is_same = recipe.identity.get("input") in (None, input_digest(scans, truth))
    return [] if is_same else [f"{INPUTS['input']}, since the run in {recipe.folder}"]


def other_inputs(recipe: Recipe, identity: Mapping[str, str]) -> list[str]:
    """A sentence for each differing input besides the recording's files; identity : of the repeated run."""
    # Of `--osm auto` the server is no more; the recording's files are told of before.
    unknown = {"input", "osm"} if recipe.identity.get("osm") == AUTO else {"input"}
    if recipe.is_elsewhere:
        unknown.add("reading")  # which names the place
    return [
        text
        for name, text in INPUTS.items()
        if name not in unknown and recipe.identity.get(name, "") != identity.get(name, "")
    ]


def compare_results(old: Path, new: Path) -> ResultComparison:
    """Compare the result files of two runs, byte by byte, in lists of names: same, differing and lacking files."""
    result = ResultComparison()
    for name in OURS:
        files = [folder / name for folder in (old, new)]
        if name in _ALWAYS_OTHER or not any(file.exists() for file in files):
            continue
        if not all(file.exists() for file in files):
            result.lacking.append(name)
            continue
        first, second = (_content(file) for file in files)
        (result.same if first == second else result.differing).append(name)
    return result


def _content(file: Path) -> bytes:
    """Bytes of a file; of evaluation.json without the place of the ground truth."""
    with input_errors(file):
        content = file.read_bytes()
    if file.suffix != ".json":
        return content
    return b"\n".join(line for line in content.split(b"\n") if not line.lstrip().startswith(b'"ground_truth":'))


def open_again(run: EarlierRun, sequence: Path | None = None, **reading: Any) -> Sequence:
    """Open the recording of the run, with the streams it needs. Raises InputError if the recording is missing.

    sequence : its new place, if it moved; reading : options of `open_sequence` that override the run's
    """
    return open_recording(recording_of(run, sequence), run.config, **reading_of(run, sequence, **reading))


def reading_of(run: EarlierRun, sequence: Path | None = None, **reading: Any) -> dict[str, Any]:
    """Options of `open_sequence` for the recording of the run, or for its new place."""
    own = run.manifest.get("sequence", {}).get("reading", {}) if sequence is None else {}
    return own | {name: value for name, value in reading.items() if value is not None}


def require_another(run: Path, out: Path) -> None:
    """Raise UsageError when both paths are one folder."""
    if out.resolve() == run.resolve():
        raise UsageError(f"--out {out}: the run itself stays as it is, name another folder")


def _require_same_odometry(run: EarlierRun) -> None:
    """Raise UsageError where the run's settings now differ from its config.toml in a key that odometry depends on."""
    before = load_config(run.folder / "config.toml", environ={})
    for section in Config.model_fields:
        then, now = getattr(before, section), getattr(run.config, section)
        differing = [key for key in type(then).model_fields if getattr(then, key) != getattr(now, key)]
        if section not in FREE_SECTIONS and differing:
            raise UsageError(
                f"{section}.{differing[0]} is of the odometry, which is not run again: lslam graph takes "
                f"keys of {', '.join(FREE_SECTIONS)}"
            )


def read_for_graph(folder: Path, settings: list[str]) -> EarlierRun:
    """Read a run like `read_run`, for `pipeline.run` to reuse its odometry as `earlier`.

    Raises InputError for a run that kept no odometry, or was located in a map, UsageError for settings of odometry.
    """
    run = read_run(folder, settings)
    require_odometry(folder)
    if run.config.localize.map:
        raise InputError(f"{folder} was located in a map, which takes the place of a pose graph")
    _require_same_odometry(run)
    return run
