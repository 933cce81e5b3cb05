"""What a run has to do, resolved before it begins: its scans, method, truth and map."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lslam.backend.georeferencing import require_gnss
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.manual import read_manual
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError, InterruptedRunError, UsageError
from lslam.core.geometry import se3
from lslam.core.stopping import asking
from lslam.core.types.camera import cameras_of
from lslam.core.types.constraint import Manual
from lslam.core.types.scan import Span
from lslam.core.types.sequence import Sequence, select
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.frames import main_axis
from lslam.io.readers import open_sequence
from lslam.io.readers.kitti_raw import with_streams
from lslam.io.readers.sequence_on_disk import with_labels
from lslam.odometry import create_odometry
from lslam.odometry.base import Odometry
from lslam.odometry.frontend.checkpoints import Checkpoints, OdometryCheckpoints
from lslam.odometry.frontend.inertial_start import with_imu_settings
from lslam.odometry.frontend.point_times import with_point_times
from lslam.odometry.frontend.register_scans import sweep_of
from lslam.odometry.frontend.scene_scale import LENGTHS, with_ring_gap, with_scene_scale, with_up
from lslam.odometry.given import GivenMotion, GivenPoses
from lslam.odometry.inertial.wheel_motion import Wheels, begin_wheels
from lslam.osm.source import OsmSource, open_osm
from lslam.pipeline.check import check_config
from lslam.pipeline.doctor import Findings
from lslam.pipeline.doctor.examine_positions import examine_jumps, examine_units
from lslam.pipeline.manifest import Manifest, describe_deskew
from lslam.pipeline.map_pass import KEY, needs_labels, with_attributes
from lslam.pipeline.run_folder import RunFolder
from lslam.pipeline.stored_map import map_of
from lslam.pipeline.watch import Watch
from lslam.registration.preprocessing.views import WithoutClasses, with_rings

log = logging.getLogger("lslam")

# What the first scans decide on, unless it is set.
OPEN_KEYS = (
    *(f"{section}.{key}" for section, keys in LENGTHS.items() for key in keys),
    "preprocess.up",
    "preprocess.ring_gap_deg",
)


@dataclass(frozen=True)
class PreparedRun:
    """A run ready to start: the scans that are used, the method, the truth and the map; `poses` are those of --poses.

    store : the keyframes; folder, checkpoints : None for a run that stays in memory
    """

    sequence: Sequence
    odometry: Odometry
    config: Config
    truth: Trajectory | None
    poses: Trajectory | None
    manifest: Manifest
    watch: Watch
    osm: OsmSource | None
    manual: Manual
    store: KeyframeStore
    folder: RunFolder | None = None
    checkpoints: OdometryCheckpoints | None = None
    wheels: Wheels = field(default_factory=Wheels)

    def checkpoints_of(self, stage: str) -> Checkpoints | None:
        """Checkpoints of a later stage beside those of odometry."""
        every_s = self.config.odometry.checkpoint_s
        return None if self.checkpoints is None else Checkpoints(self.checkpoints.folder, stage, every_s)


def prepare(
    sequence: Sequence | str | Path, config: Config, truth: Trajectory | None, command: str, watch: Watch
) -> PreparedRun:
    """Check the configuration, open its inputs (fixes, IMU, wheels, poses, map), choose scans; InputError, UsageError."""
    check_config(config)
    if isinstance(sequence, (str, Path)):
        sequence = open_sequence(sequence)
    sequence = with_streams(sequence, config.imu.use, config.gnss.mode != "off")
    require_gnss(sequence, config.gnss)
    if config.map.colour and config.map.write:
        cameras_of(sequence)
    wheels = begin_wheels(sequence, config.wheels)
    truth = sequence.ground_truth if truth is None else truth
    if truth is not None:
        # Before the odometry and not after it.
        sequence.calibration.T_lidar(config.eval.frame)
    odometry = create_odometry(with_imu_settings(config))
    poses: Trajectory | None = None
    if isinstance(odometry, GivenPoses):
        sequence.notes.extend(bind(odometry, sequence))
        poses = odometry.trajectory
    if config.localize.map:
        stored = map_of(Path(config.localize.map))
        if config.gnss.mode != "off" and stored.georeference is None:
            raise UsageError(
                f"--gnss: {stored.path} is not georeferenced; say where the drive begins with --start X,Y,HEADING"
            )
    scans = choose_scans(sequence, odometry, config)
    if config.map.write:
        with_attributes(scans, config)  # before the odometry and not after it
    osm = open_osm(sequence, config)
    manual = read_manual(config, scans)
    manifest, store = Manifest(command, scans, config), KeyframeStore()
    return PreparedRun(scans, odometry, config, truth, poses, manifest, watch, osm, manual, store, wheels=wheels)


def is_open(config: Config, key: str) -> bool:
    """Whether `section.key` is not set by the user, so that the scene decides on it."""
    section, _, name = key.partition(".")
    return key in OPEN_KEYS and name not in getattr(config, section).model_fields_set


def fit_to_scene(job: PreparedRun, earlier: Config | None = None) -> PreparedRun:
    """The run with lengths and up direction adapted to its first scans, where its configuration leaves them open.

    earlier : configuration of the run to resume, whose values are reused; None without one
    """
    if earlier is None:
        config = with_ring_gap(with_up(job.sequence, with_scene_scale(job.config, job.sequence)), job.sequence)
    else:
        config = _with_scene_of(earlier, job.config)
    if config == job.config:
        return job
    job.manifest.config = config
    has_poses = isinstance(job.odometry, GivenPoses)
    odometry = job.odometry if has_poses else create_odometry(with_imu_settings(config))
    return replace(job, config=config, odometry=odometry)


def _with_scene_of(earlier: Config, config: Config) -> Config:
    """The configuration with its open keys taken from `earlier`."""
    for key in OPEN_KEYS:
        name, _, field = key.partition(".")
        if is_open(config, key):
            section = getattr(config, name).model_copy(update={field: getattr(getattr(earlier, name), field)})
            config = config.model_copy(update={name: section})
    return config


def choose_scans(sequence: Sequence, odometry: Odometry, config: Config) -> Sequence:
    """The scans of --start, --count and --skip-frames, without points of `preprocess.drop_labels`, with point times, and with
    rings where the method needs them.

    Raises UsageError when no scan is left, InputError naming --rings when rings cannot be determined, when stated
    times do not fit, and when needed labels are missing.
    """
    labels = config.preprocess.drop_labels
    needs = {
        "preprocess.drop_labels": labels,
        "osm.labels": config.osm.extract and config.osm.needs_labels,
        KEY: config.map.write and needs_labels(config.map),
    }
    if any(needs.values()):
        sequence = with_labels(sequence, next(key for key, needed in needs.items() if needed))
    sequence = with_point_times(sequence, config.preprocess)
    if odometry.needs_rings:
        sequence = with_rings(sequence, config.input.rings)
    # Rules for times and rings know where in its scan a point stands.
    sequence = WithoutClasses(sequence, labels) if labels else sequence
    return select(sequence, config.input.start, config.input.count, config.input.skip_frames)


def announce(job: PreparedRun) -> None:
    """Log the run's input and the reader's decisions, add problems and deskewing to the manifest."""
    sequence, config = job.sequence, job.config
    log.info("%s: %d scans of %s, method %s", sequence.name, len(sequence), sequence.path, config.odometry.method)
    for note in sequence.notes:
        log.info("%s", note)
    sweep = sweep_of(sequence)
    findings, whole = Findings(), getattr(sequence, "whole", sequence)
    span = None if sequence.motion_compensated else sweep
    examine_units(whole, findings, job.truth, config.imu.use, config.gnss.mode != "off", span)
    examine_jumps(job.truth, findings)
    job.manifest.problems += map(str, findings)
    for problem in [*sequence.problems, *job.manifest.problems]:
        log.warning("%s", problem)
    deskew, distorts = describe_deskew(sequence, config, sweep is not None, job.odometry.deskew)
    job.manifest.deskew = deskew
    job.manifest.pose_time = (sweep or Span()).instant
    if not config.imu.use and (keys := _set_by_hand(config)):
        log.warning("%s: without effect, this run has no IMU; --imu gives it one", ", ".join(keys))
    if distorts:
        log.warning("%s", deskew)
    else:
        log.info("deskew: %s", deskew)


def _set_by_hand(config: Config) -> list[str]:
    """Keys of the IMU that are neither the defaults' nor the preset's."""
    keys, preset = config.imu.changed_keys(), config.odometry.preset
    if keys and preset:
        keys = config.imu.changed_keys(load_config(None, [f"odometry.preset={preset}"], {}).imu)
    return [f"imu.{key}" for key in keys]


@contextmanager
def stoppable(job: PreparedRun, message: str) -> Iterator[None]:
    """Context in which a requested stop ends the block, and the manifest notes the interruption with `message`."""
    try:
        with asking(job.watch.should_stop, message):
            yield
    except InterruptedRunError as error:
        job.manifest.interrupt(str(error))


def bind(odometry: GivenPoses, sequence: Sequence) -> list[str]:
    """Give the poses the stamps of the whole `sequence` when their file has none, and convert them to the LiDAR.

    Returns the decisions, one sentence each. Raises InputError when poses and scans do not belong together.
    """
    notes: list[str] = []
    trajectory = odometry.trajectory
    if not trajectory.has_stamps:
        if len(trajectory) != len(sequence):
            raise InputError(
                f"{trajectory.source} has {len(trajectory)} poses without stamps and {sequence.name} has {len(sequence)} scans: "
                "give a file with stamps, or one pose per scan"
            )
        trajectory = replace(trajectory, stamps_ns=np.asarray(sequence.stamps_ns, np.int64), has_stamps=True)
        notes.append("poses without stamps: line i is scan i")
    trajectory, note = _of_lidar(trajectory, sequence)
    notes += [note] if note else []
    (first, last), (begin, end) = ((1e-9 * s[0], 1e-9 * s[-1]) for s in (trajectory.stamps_ns, sequence.stamps_ns))
    if first > end or last < begin:
        raise InputError(
            f"{trajectory.source} shares no time with {sequence.name}: its poses run from {first:.3f} to {last:.3f} s, the "
            f"scans from {begin:.3f} to {end:.3f} s"
        )
    odometry.trajectory, odometry.motion = trajectory, GivenMotion(trajectory)
    for note in notes:
        log.info("%s", note)
    return notes


def _of_lidar(trajectory: Trajectory, sequence: Sequence) -> tuple[Trajectory, str]:
    """The trajectory of the LiDAR, and a note on a conversion. The file's body frame is used unless the motion contradicts it.

    Raises InputError for poses of a camera or IMU without its extrinsic.
    """
    axis = main_axis(trajectory.poses)
    is_camera = trajectory.frame == "cam0" and axis not in ("+x", "-x")
    T = sequence.calibration.T_cam0_lidar
    if is_camera and T is not None:
        poses = se3.inverse(T) @ trajectory.poses @ T
        return replace(
            trajectory, poses=poses, frame="lidar"
        ), "poses of camera 0 converted to the LiDAR with T_cam0_lidar"
    if trajectory.frame == "imu" and (T_lidar_imu := sequence.calibration.T_lidar_imu) is not None:
        poses = trajectory.poses @ se3.inverse(T_lidar_imu)
        return replace(
            trajectory, poses=poses, frame="lidar"
        ), "poses of the IMU converted to the LiDAR with T_lidar_imu"
    if axis in ("+z", "-z") or is_camera or trajectory.frame == "imu":
        body = {"cam0": "the camera", "imu": "the IMU"}.get(
            trajectory.frame, "a camera (they advance along its z axis)"
        )
        raise InputError(
            f"{trajectory.source} has poses of {body}, and {sequence.name} does not say where that sits on the LiDAR: convert "
            "them with `lslam convert --frame lidar`, or give the calibration (calib.txt, --extrinsics)"
        )
    return trajectory, ""
