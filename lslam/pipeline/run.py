"""The whole program on one page: a sequence goes in; a trajectory, a map and an honest report come out."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from lslam.backend.georeferencing import require_gnss
from lslam.backend.loop_view import view_loop
from lslam.backend.outcome import BackEnd
from lslam.config import Config
from lslam.doctor.examine_truth import examine_jumps
from lslam.doctor.examine_units import examine_units
from lslam.errors import GateError, InterruptedRunError, LslamError, OutputError, RunFailedError
from lslam.evaluation.evaluate import Evaluation, evaluate
from lslam.frontend.checkpoints import Checkpoints, OdometryCheckpoints
from lslam.frontend.inertial_start import with_imu_settings
from lslam.frontend.register_scans import sweep_of
from lslam.keyframes.store import KeyframeStore
from lslam.maps.crispness import crispness
from lslam.odometry import create_odometry
from lslam.odometry.base import FeatureSource, Odometry
from lslam.odometry.given import GivenPoses
from lslam.osm.corrections import write_buildings
from lslam.osm.source import OsmSource, open_osm
from lslam.pipeline import outputs
from lslam.pipeline.back_end_pass import level_world, optimise_poses, write_back_end
from lslam.pipeline.check import check_config
from lslam.pipeline.choose import choose_scans
from lslam.pipeline.feature_pass import build_feature_map
from lslam.pipeline.feature_view import view_features
from lslam.pipeline.given_poses import bind
from lslam.pipeline.manifest import Manifest, describe_deskew
from lslam.pipeline.map_checkpoints import map_checkpoints
from lslam.pipeline.map_pass import build_map
from lslam.pipeline.odometry_pass import estimate_poses, odometry_checkpoints
from lslam.pipeline.resume import may_go_on, run_identity
from lslam.pipeline.run_folder import KEYFRAMES, REPLIES, RunFolder
from lslam.pipeline.watch import RunOutcome, Watch
from lslam.readers import open_sequence
from lslam.readers.raw_drive import with_streams
from lslam.stopping import asking
from lslam.types.run_record import RunRecord
from lslam.types.scan import Span
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory
from lslam.warned import hearing

log = logging.getLogger("lslam")


def run(
    sequence: Sequence | str | Path,
    config: Config | None = None,
    *,
    out: Path | str | None = None,
    ground_truth: Trajectory | None = None,
    overwrite: bool = False,
    resume: bool = False,
    command: str = "",
    reading: Mapping[str, str] | None = None,
    watch: Watch | None = None,
) -> RunOutcome:
    """Estimate the trajectory of a sequence, build its map, score it when truth is known, and write the run folder.

    Parameters
    ----------
    sequence : an open sequence, or what `open_sequence` takes
    out : the run folder; None writes nothing and builds no map
    ground_truth : replaces the sequence's own
    reading : what `open_sequence` was told beside the path (topics, extrinsics), for the manifest: `lslam map` needs it
    overwrite : replace an earlier run in `out`; resume : go on where it was killed or interrupted, if there is one

    Raises
    ------
    RunFinishedError : `resume`, and nothing is left to do. RunFailedError : diverged. InterruptedRunError :
        `watch.should_stop` said so. GateError : `input.strict` and the run is degraded. In these three, everything up to
        there is written. InputError, OutputError, UsageError : as named.
    """
    watch = watch or Watch()
    with hearing() as heard:
        job = _prepare(sequence, config or Config(), ground_truth, command, watch)
        job.manifest.reading, job.manifest.warnings = dict(reading or {}), heard
        outcome = _perform(job, None if out is None else Path(out), overwrite, resume)
    watch.on_end(outcome)
    _raise_outcome(job.manifest, job.config, "" if out is None else ", and --resume goes on")
    return outcome


def plan(sequence: Sequence, config: Config, ground_truth: Trajectory | None = None) -> Sequence:
    """The scans that `run` would take, after a look at everything else that it would read; nothing is written or fetched.

    Raises InputError and UsageError as `run` does before it begins.
    """
    return _prepare(sequence, config, ground_truth, "", Watch()).sequence


@dataclass(frozen=True)
class _Job:
    """What is to be done, resolved: the chosen scans, the method, the truth and the map; `given` are the poses of --poses."""

    sequence: Sequence
    odometry: Odometry
    config: Config
    truth: Trajectory | None
    given: Trajectory | None
    manifest: Manifest
    watch: Watch
    osm: OsmSource | None = None


def _prepare(
    sequence: Sequence | str | Path, config: Config, truth: Trajectory | None, command: str, watch: Watch
) -> _Job:
    """Find what the configuration asks for beside the scans: fixes, an IMU, poses, a map; and choose the scans."""
    check_config(config)
    if isinstance(sequence, (str, Path)):
        sequence = open_sequence(sequence)
    sequence = with_streams(sequence, config.imu.use, config.gnss.mode != "off")
    require_gnss(sequence, config.gnss)
    truth = sequence.ground_truth if truth is None else truth
    odometry = create_odometry(with_imu_settings(config))
    given: Trajectory | None = None
    if isinstance(odometry, GivenPoses):
        sequence.notes.extend(bind(odometry, sequence))
        given = odometry.trajectory
    chosen = choose_scans(sequence, odometry, config)
    osm = open_osm(sequence, config)
    return _Job(chosen, odometry, config, truth, given, Manifest(command, chosen, config), watch, osm)


def _perform(job: _Job, out: Path | None, overwrite: bool, resume: bool) -> RunOutcome:
    """The run, into its folder when there is one."""
    manifest = job.manifest
    if out is None:
        record, _, evaluation = _solve(job, KeyframeStore(deflate=job.config.keyframes.deflate))
        manifest.problems += record.problems
        record.manifest = manifest.as_dict(manifest.outcome)
        return RunOutcome(record, evaluation)
    manifest.identity = run_identity(job.sequence, job.truth, job.config, job.given)
    goes_on = resume and may_go_on(out, manifest.identity, job.config)
    with RunFolder(out, overwrite or resume, goes_on) as folder:
        try:
            record, evaluation = _fill(folder, job, goes_on)
        except BaseException as error:
            status = manifest.word_for(error)
            _write_last(folder, manifest.as_dict(status, str(error) or type(error).__name__))
            raise
        folder.write_manifest(record.manifest)
        if manifest.outcome != "interrupted":
            folder.drop_checkpoint()
        log.info("%s; results in %s", manifest.outcome, folder.path)
    return RunOutcome(record, evaluation)


def _solve(
    job: _Job, store: KeyframeStore, folder: Path | None = None, checkpoints: OdometryCheckpoints | None = None
) -> tuple[RunRecord, BackEnd, Evaluation | None]:
    """The poses of all scans, made consistent and level, and their score."""
    _announce(job)
    if job.osm is not None:
        job.osm.begin(None if folder is None else folder / REPLIES)
    record = estimate_poses(
        job.sequence, job.odometry, job.config, job.manifest, folder, job.truth, job.watch, store, checkpoints, job.osm
    )
    loops = None if checkpoints is None else Checkpoints(checkpoints.folder, "loops", job.config.odometry.checkpoint_s)
    done = optimise_poses(job.sequence, record, store, job.config, job.manifest, job.osm, loops, job.watch.should_stop)
    level_world(record, job.sequence, job.config, job.manifest)
    record.loop_view = view_loop(record, done, store)
    return record, done, _score(record, job.sequence, job.config)


def _fill(folder: RunFolder, job: _Job, goes_on: bool) -> tuple[RunRecord, Evaluation | None]:
    """The whole result in a run folder, the last word of its manifest aside."""
    folder.require_space(outputs.least_bytes(len(job.sequence)), "the result without its map")
    folder.write_text("config.toml", outputs.config_text(job.config))
    folder.write_manifest(job.manifest.as_dict("running"))
    store = KeyframeStore(folder.path / KEYFRAMES, deflate=job.config.keyframes.deflate)
    checkpoints = odometry_checkpoints(folder, job.odometry, job.config, goes_on)
    record, done, evaluation = _solve(job, store, folder.path, checkpoints)
    write_back_end(folder.path, record, store, done)
    if job.osm is not None and record.buildings is not None:
        write_buildings(folder.path, record.buildings, job.osm.data)
    outputs.write_trajectories(folder, record, job.sequence.calibration)
    outputs.write_scans(folder, record)
    try:
        _map(folder, job, record)
    finally:  # with the map's crispness, and whatever becomes of the map
        outputs.write_evaluation(folder, record, evaluation)
    _feature_map(folder, job, record)
    _report(folder, job, record, evaluation)
    return record, evaluation


def _announce(job: _Job) -> None:
    """Say what is about to be run and what the reader decided, once: the log keeps it beside the results."""
    sequence, config = job.sequence, job.config
    log.info("%s: %d scans of %s, method %s", sequence.name, len(sequence), sequence.path, config.odometry.method)
    for note in sequence.notes:
        log.info("%s", note)
    sweep = sweep_of(sequence)
    units = examine_units(
        getattr(sequence, "whole", sequence), job.truth, config.imu.use, config.gnss.mode != "off",
        None if sequence.motion_compensated else sweep,
    )  # fmt: skip
    job.manifest.problems += map(str, [*units, *examine_jumps(job.truth)])
    for problem in [*sequence.problems, *job.manifest.problems]:
        log.warning("%s", problem)
    deskew = describe_deskew(sequence, config, sweep is not None, getattr(job.odometry, "deskew", ""))
    job.manifest.deskew = deskew
    job.manifest.pose_time = (sweep or Span()).instant
    if deskew.startswith("no deskew"):
        log.warning("%s", deskew)
    else:
        log.info("deskew: %s", deskew)


def _score(record: RunRecord, sequence: Sequence, config: Config) -> Evaluation | None:
    """The evaluation, or None with the reason among the record's problems."""
    if record.ground_truth is None:
        return None
    try:
        score = evaluate(record.trajectory, record.ground_truth, config.eval, calibration=sequence.calibration)
        if record.odometry is not None and record.odometry is not record.trajectory:
            before = evaluate(record.odometry, record.ground_truth, config.eval, calibration=sequence.calibration)
            score = replace(score, odometry=before)
    except LslamError as error:
        record.problems.append(f"not scored: {error}")
        log.warning("not scored: %s", error)
        if record.folder is not None:
            log.info("score it with other recipes: lslam eval %s GT", record.folder / "trajectory.tum")
        return None
    record.problems += [note for note in score.notes if "WRONG" in note]
    return score


def _map(folder: RunFolder, job: _Job, record: RunRecord) -> None:
    """The merged map, from the raw scans and the final poses."""
    config, watch, manifest = job.config, job.watch, job.manifest
    if not config.map.write or manifest.outcome == "interrupted":
        return
    watch.on_start("map", len(record.results))
    with manifest.timed("map_s"), _stoppable(job, "interrupted while the map was written"):
        built = build_map(
            job.sequence, record.results, config, watch.on_step, watch.should_stop, folder.path,
            map_checkpoints(folder, config),
        )  # fmt: skip
        if built is None:
            raise InterruptedRunError("interrupted while the map was built: there is no map")
        score = crispness(built.merged)
        outputs.write_map(folder, built, config.map, record)
        record.map_file, record.map_image, record.map_extent = f"map.{config.map.format}", built.image, built.extent
        record.crispness = score
        manifest.map_points = len(built.merged)


def _feature_map(folder: RunFolder, job: _Job, record: RunRecord) -> None:
    """The feature map, likewise, when it was asked for."""
    config, watch, manifest, odometry = job.config, job.watch, job.manifest, job.odometry
    if not config.map.write_features or manifest.outcome == "interrupted" or not isinstance(odometry, FeatureSource):
        return
    watch.on_start("feature map", len(record.results))
    with manifest.timed("feature_map_s"), _stoppable(job, "interrupted while the feature map was written"):
        built = build_feature_map(
            job.sequence, odometry, record.results, config, watch.on_step, watch.should_stop,
            map_checkpoints(folder, config, "feature map"),
        )  # fmt: skip
        if built is None:
            raise InterruptedRunError("interrupted while the feature map was built: there is none")
        outputs.write_feature_map(folder, built)
        log.info("feature map: %d points in %s", len(built), folder.path / "feature_map.ply")


@contextmanager
def _stoppable(job: _Job, said: str) -> Iterator[None]:
    """What is asked to stop in the block ends it, and the run is interrupted with the sentence `said`."""
    try:
        with asking(job.watch.should_stop, said):
            yield
    except InterruptedRunError as error:
        job.manifest.interrupt(str(error))


def _report(folder: RunFolder, job: _Job, record: RunRecord, evaluation: Evaluation | None) -> None:
    """report.html; the record's manifest is the run's last word, with the report's own time."""
    manifest = job.manifest
    manifest.problems += record.problems
    record.manifest = manifest.as_dict(manifest.outcome)
    with manifest.timed("report_s"):
        if job.config.report.html:
            if isinstance(job.odometry, FeatureSource):
                record.features = view_features(job.sequence, job.odometry, record.results)
            outputs.write_html(folder, record, evaluation)
    if job.watch.should_stop() and manifest.outcome not in ("interrupted", "diverged"):
        manifest.interrupt("interrupted before the report was whole")
    record.manifest = manifest.as_dict(manifest.outcome)


def _write_last(folder: RunFolder, manifest: dict[str, object]) -> None:
    """The status, after everything else; a disk too full even for this must not hide the first error."""
    try:
        folder.write_manifest(manifest)
    except OutputError as error:
        log.error("%s", error)


def _raise_outcome(manifest: Manifest, config: Config, way_out: str) -> None:
    why = "; ".join(manifest.problems)
    if manifest.outcome == "interrupted":
        raise InterruptedRunError(f"{why}; what was done is written{way_out}")
    if manifest.outcome == "diverged":
        raise RunFailedError(f"the run diverged: {why}")
    if manifest.outcome == "degraded" and config.input.strict:
        raise GateError(
            f"--strict: the run is degraded: {'; '.join([*manifest.sequence.problems, *manifest.problems])}"
        )
