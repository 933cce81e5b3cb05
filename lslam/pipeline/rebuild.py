"""Building the map of an earlier run again, from its raw scans and poses, without odometry."""

from __future__ import annotations

import csv
import logging
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config import Config, load_config
from lslam.core.errors import (
    InputError,
    InterruptedRunError,
    OutputError,
    OutputExistsError,
    UsageError,
    cause,
    output_errors,
)
from lslam.core.types.gnss import Georeference, OutputCrs
from lslam.core.types.run_record import Crispness, RunRecord
from lslam.core.types.scan_result import ScanResult, Status
from lslam.core.types.sequence import Sequence, select
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import write_text
from lslam.io.formats.point_files import MAP_SUFFIXES
from lslam.io.formats.state_files import read_npz
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.io.readers.sequence_on_disk import with_labels
from lslam.io.remote import as_path
from lslam.maps.colour import ColourCounts
from lslam.maps.crispness import crispness
from lslam.maps.georeference import in_crs
from lslam.maps.mesh import require_open3d
from lslam.pipeline.further_passes import build_finished_map
from lslam.pipeline.map_files import (
    BuiltMap,
    drop_note,
    georeference_of,
    is_note,
    note_of,
    note_with,
    read_json,
    write_json,
    write_run_map,
)
from lslam.pipeline.map_pass import INTERRUPTED, KEY, needs_labels
from lslam.pipeline.run_folder import MANIFEST, SPOOL, lock_folder, require_new, require_run
from lslam.pipeline.watch import SILENT, Watch
from lslam.registration.preprocessing.sweep_clock import SweepClock
from lslam.registration.preprocessing.views import ClockView, WithoutClasses
from lslam.reports.evaluations import run_document
from lslam.reports.html import with_new_map

log = logging.getLogger("lslam")
EVALUATION, REPORT = "evaluation.json", "report.html"
_STALE = "%s keeps the figures of the map before: it %s"


@dataclass(frozen=True)
class EarlierRun:
    """Content of a run folder: configuration with new settings applied, poses, and which scans were registered."""

    folder: Path
    manifest: dict[str, Any]
    config: Config
    trajectory: Trajectory
    statuses: tuple[Status, ...]
    georeference: Georeference | None

    @property
    def name(self) -> str:
        """Name of its sequence."""
        return str(self.manifest.get("sequence", {}).get("name", self.folder.name))

    @property
    def sequence_path(self) -> str:
        """Path of the raw scans at the time of the run."""
        return str(self.manifest.get("sequence", {}).get("path", ""))

    @property
    def topics(self) -> dict[str, str]:
        """Topics and LiDARs of a bag that the run used; a map needs no extrinsics."""
        reading = self.manifest.get("sequence", {}).get("reading", {})
        return {name: str(text) for name, text in reading.items() if name.endswith(("_topic", "_frame"))}

    @property
    def world(self) -> str:
        """Description of the world: its origin, and whether z is up."""
        return str(self.manifest.get("frames", {}).get("world", "LiDAR at the first scan"))


@dataclass(frozen=True)
class RebuiltMap:
    """Result of `rebuild`; only maps of voxels are scored."""

    path: Path
    points: int
    scans: int
    crispness: Crispness | None
    colour: ColourCounts | None = None


def read_run(folder: Path, settings: Iterable[str] = ()) -> EarlierRun:
    """Read a run folder; `settings` ("map.voxel=0.1") override its configuration.

    Raises InputError naming the file that is missing or damaged, ConfigError for invalid settings.
    """
    require_run(folder)
    try:
        manifest = parse_json((folder / MANIFEST).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{folder} is no folder of a run: {MANIFEST} cannot be read: {cause(error)}") from None
    except ValueError as error:
        raise InputError(f"{folder / MANIFEST}: {error}; run the sequence again") from None
    if not isinstance(manifest, dict):
        raise InputError(f"{folder / MANIFEST} holds no manifest; run the sequence again")
    config = load_config(folder / "config.toml", settings)
    if manifest.get("kind") == "merge":
        raise InputError(f"{folder} is a merge of several runs: name one of them")
    if not (folder / "trajectory.tum").is_file():
        raise InputError(f"{folder} has no trajectory.tum: the run ended before it; run the sequence again")
    trajectory = read_trajectory(folder / "trajectory.tum", "tum")
    statuses = _statuses(folder / "scans.csv", len(trajectory))
    return EarlierRun(folder, manifest, config, trajectory, statuses, georeference_of(manifest.get("georeference")))


def is_missing(run: EarlierRun) -> bool:
    """Whether the recording is missing at its old path."""
    return not as_path(run.sequence_path).exists()


def recording_of(run: EarlierRun, sequence: Path | None = None, flag: str = "--sequence") -> Path:
    """Path of the run's recording, or its new place. Raises InputError naming the `flag` when it is missing."""
    if sequence is None and is_missing(run):
        raise InputError(
            f"the raw scans of {run.folder} are gone: {run.sequence_path} does not exist; say where they are with {flag}"
        )
    return as_path(run.sequence_path) if sequence is None else sequence


def open_scans(run: EarlierRun, sequence: Path | None = None, *, flag: str = "--sequence", **reading: Any) -> Sequence:
    """Open the scans of the run; `sequence` is their path if they have moved.

    flag : option to suggest for that in messages; reading : for `open_sequence`, overriding the topics of the run

    Raises InputError naming the path when the raw scans are missing, or differ from those of the run.
    """
    path = recording_of(run, sequence, flag)
    section = run.config.input
    options: dict[str, Any] = run.topics if sequence is None else {}
    options |= {name: value for name, value in reading.items() if value is not None}
    recording = open_sequence(path, vertical_correction_deg=section.vertical_correction_deg, **options)
    labels = run.config.preprocess.drop_labels
    if labels or needs_labels(run.config.map):
        recording = with_labels(recording, "preprocess.drop_labels" if labels else KEY)
    recording = _with_clock(run, recording)
    recording = WithoutClasses(recording, labels) if labels else recording
    scans = select(recording, section.start, section.count, section.skip_frames)
    count = len(run.trajectory)
    if len(scans) < count or np.any(np.abs(scans.stamps_ns[:count] - run.trajectory.stamps_ns) > 1000):
        raise InputError(
            f"{path} does not fit {run.folder}: its {len(scans)} scans have other stamps than the {count} poses"
        )
    return scans


def _with_clock(run: EarlierRun, recording: Sequence) -> Sequence:
    """The recording with the clock of its points that the run chose; raises InputError for a damaged manifest."""
    facts = run.manifest.get("sequence", {}).get("point_times")
    if facts is None:
        return recording
    try:
        clock, *later = (
            None if part["clock"] is None else SweepClock(**part["clock"]) for part in (facts, *facts.get("later", ()))
        )
        firsts = [int(part["scan"]) for part in facts.get("later", ())]
        has_verdict = facts["verdict"] == "stated"
    except MISFIT as error:
        raise InputError(f"{run.folder / MANIFEST}: point_times: {error}; run the sequence again") from None
    return (
        recording if clock is None and not has_verdict else ClockView(recording, clock, zip(firsts, later, strict=True))
    )


def rebuild(
    run: EarlierRun,
    sequence: Sequence,
    out: Path | None = None,
    *,
    overwrite: bool = False,
    crs: OutputCrs | None = None,
    watch: Watch = SILENT,
) -> RebuiltMap:
    """Build the map with the run's configuration and write it to `out`, by default map.<format> in the run folder.

    Maps of other names and formats remain. For a map of the run folder itself, its figures in evaluation.json, report.html and
    manifest.json are updated. All files are written elsewhere first and then renamed, so that nothing changes before everything
    is complete.

    Raises OutputExistsError when the file exists, or a run is active in the folder, OutputError when it cannot be written,
    UsageError for a `crs` without a georeference or that no map can be written in, InterruptedRunError when `watch`
    says so.
    """
    path = run.folder / f"map.{run.config.map.format}" if out is None else out
    check_output(path, overwrite)
    if run.config.map.denoise or run.config.map.mesh:
        require_open3d()
    georeference = place_of(run, crs)
    is_own = path.stem == "map" and path.resolve().parent == run.folder.resolve()
    with lock_folder(run.folder) if is_own else nullcontext():
        built = build_finished_map(sequence, results_of(run), run.config, watch, path.parent)
        if watch.should_stop():
            raise InterruptedRunError(INTERRUPTED)
        score = crispness(built.cloud) if run.config.map.voxel else None
        with _stage(path.parent) as stage:
            write_run_map(
                stage / path.name, built, run.config.map, sequence.name, run.trajectory, run.world, georeference
            )
            if is_own:
                renew_files(stage, run.folder, _record(run, built, path.name, score))
            _publish(stage, path)
    log.info("%d points in %s", len(built.cloud), path)
    return RebuiltMap(path, len(built.cloud), sum(s == "ok" for s in run.statuses), score, built.colour)


def check_output(path: Path, overwrite: bool) -> None:
    """Raise UsageError, OutputExistsError or OutputError for an impossible output file, before any work is done."""
    if path.suffix.lower() not in MAP_SUFFIXES:
        raise UsageError(f"{path}: no map file lslam writes; known suffixes: {', '.join(MAP_SUFFIXES)}")
    if not path.parent.is_dir():
        raise OutputError(f"{path} cannot be written: the folder {path.parent} does not exist")
    require_new(path, overwrite)
    beside = path.with_suffix(".json")
    if not is_note(beside):
        raise OutputExistsError(f"{beside}, where the note of {path.name} goes, is something else: name another --out")


def place_of(run: EarlierRun, crs: OutputCrs | None) -> Georeference | None:
    """Georeference of the run, in the CRS `crs` if that is given; raises UsageError for a CRS without a georeference."""
    georeference = run.georeference
    if crs is None:
        return georeference
    if georeference is None:
        flag = "--geoid" if crs.epsg is None else "--crs"
        raise UsageError(f"{flag}: {run.folder} is not georeferenced; run the sequence with --georeference or --gnss")
    return in_crs(georeference, crs)


def _record(run: EarlierRun, built: BuiltMap, name: str, score: Crispness | None) -> RunRecord:
    """Record for the run's report about its map, and the manifest with the new map."""
    points = len(built.cloud)
    about = {"file": name, "points": points, "voxel": run.config.map.voxel, "done": list(built.steps)}
    manifest = {**run.manifest, "map_points": points, "map": about}
    return RunRecord(
        name="",
        method=run.config.odometry.method,
        folder=run.folder,
        results=[],
        trajectory=run.trajectory,
        ground_truth=None,
        real_time_limit=0.0,
        manifest=manifest,
        map_file=name,
        map_image=built.view.image,
        map_heights=built.view.heights,
        map_extent=built.view.extent,
        map_sample=built.sample,
        crispness=score,
    )


@contextmanager
def _stage(folder: Path) -> Iterator[Path]:
    """Temporary folder within `folder`."""
    with output_errors(folder):
        stage = tempfile.TemporaryDirectory(prefix=SPOOL, dir=folder, ignore_cleanup_errors=True)
    with stage as path:
        yield Path(path)


def _publish(stage: Path, path: Path) -> None:
    """Rename all files in `stage` to the folder of `path`; the note never describes another map than the one on disk."""
    note = stage / path.with_suffix(".json").name
    write_json(note, note_with(path, note_of(stage / path.name)))
    drop_note(path)
    first = [stage / path.name, note]
    for file in [*first, *sorted(file for file in stage.iterdir() if file not in first)]:
        with output_errors(path.with_name(file.name)):
            os.replace(file, path.with_name(file.name))


def results_of(run: EarlierRun) -> list[ScanResult]:
    """Poses and results of the scans for building a map; scans keep their numbers in the recording."""
    section = run.config.input
    return [
        ScanResult(section.start + section.skip_frames * k, int(stamp), T, status)
        for k, (stamp, T, status) in enumerate(
            zip(run.trajectory.stamps_ns, run.trajectory.poses, run.statuses, strict=True)
        )
    ]


def covariances_of(run: EarlierRun) -> Floats | None:
    """(N, 6, 6) of the poses, as `Trajectory` has them, NaN all over where one is not known; None where none are kept.

    Raises InputError when the file is damaged.
    """
    path = run.folder / "covariances.npz"
    C = read_npz(path).get("covariances") if path.is_file() else None
    if C is None or C.shape != (len(run.trajectory), 6, 6):
        return None
    return np.where(np.isfinite(C).all((1, 2), keepdims=True), C, np.nan)


def _statuses(path: Path, count: int) -> tuple[Status, ...]:
    """Status of each scan by scans.csv, `bridged` for other frames, all `ok` without the file; InputError if damaged."""
    known: dict[str, Status] = {"ok": "ok", "bridged": "bridged", "skipped": "skipped"}
    try:
        with path.open(newline="", encoding="utf-8", errors="replace") as stream:
            header, *rows = [row for row in csv.reader(stream) if row] or [[""]]
    except OSError:
        log.warning("%s cannot be read: every scan counts as registered", path)
        return tuple(known["ok"] for _ in range(count))
    except csv.Error as error:
        raise InputError(f"{path} is no table of scans: {error}; run the sequence again") from None
    column = header.index("status") if "status" in header else len(header)
    words = ["".join(row[column : column + 1]) for row in rows]
    if "frame" in header:
        frame = header.index("frame")
        words = [word if row[frame : frame + 1] == ["0"] else "bridged" for word, row in zip(words, rows, strict=True)]
    if len(words) != count or not set(words) <= set(known):
        raise InputError(f"{path} does not list the {count} scans of trajectory.tum; run the sequence again")
    return tuple(known[word] for word in words)


def renew_files(target: Path, folder: Path, record: RunRecord) -> None:
    """Write into `target` the files of the run folder `folder`, with the parts about its map updated.

    record : of the new map, for the drawings, and the new manifest
    A report that the run did not write is not made; unreadable files are left unchanged, with a warning. Raises OutputError.
    """
    before, new = read_json(folder / EVALUATION), run_document(record, None) or {}
    if before or not (folder / EVALUATION).exists():
        before.pop("map", None)
        if document := {**new, **before}:
            write_json(target / EVALUATION, document)
    else:
        log.warning(_STALE, folder / EVALUATION, "cannot be read")
    try:
        page = with_new_map((folder / REPORT).read_text(encoding="utf-8"), record)
        write_text(target / REPORT, page)
    except FileNotFoundError:
        pass
    except OSError as error:
        log.warning(_STALE, folder / REPORT, f"cannot be read ({error})")
    except ValueError:
        log.warning(_STALE, folder / REPORT, "was not written by this version of lslam: run the sequence again")
    write_json(target / MANIFEST, record.manifest)
