"""What a run has to do, resolved before it begins: its scans, method, truth and map."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lslam.backend.georeferencing import require_gnss
from lslam.config import Config
from lslam.doctor.examine_truth import examine_jumps
from lslam.doctor.examine_units import examine_units
from lslam.errors import InterruptedRunError
from lslam.frontend.inertial_start import with_imu_settings
from lslam.frontend.register_scans import sweep_of
from lslam.odometry import create_odometry
from lslam.odometry.base import Odometry
from lslam.odometry.given import GivenPoses
from lslam.osm.source import OsmSource, open_osm
from lslam.pipeline.check import check_config
from lslam.pipeline.given_poses import bind
from lslam.pipeline.manifest import Manifest, describe_deskew
from lslam.pipeline.watch import Watch
from lslam.readers import open_sequence
from lslam.readers.raw_drive import with_streams
from lslam.readers.ringed import with_rings
from lslam.readers.selection import select
from lslam.stopping import asking
from lslam.types.scan import Span
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")


@dataclass(frozen=True)
class PreparedRun:
    """What is to be done, resolved: the chosen scans, the method, the truth and the map; `given` are the poses of --poses."""

    sequence: Sequence
    odometry: Odometry
    config: Config
    truth: Trajectory | None
    given: Trajectory | None
    manifest: Manifest
    watch: Watch
    osm: OsmSource | None = None


def prepare(
    sequence: Sequence | str | Path, config: Config, truth: Trajectory | None, command: str, watch: Watch
) -> PreparedRun:
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
    return PreparedRun(chosen, odometry, config, truth, given, Manifest(command, chosen, config), watch, osm)


def choose_scans(sequence: Sequence, odometry: Odometry, config: Config) -> Sequence:
    """What --start, --count and --skip-frames leave, with rings where the method needs them.

    Raises UsageError when nothing is left, InputError naming --rings when there are no rings to be found.
    """
    if getattr(odometry, "needs_rings", False):
        sequence = with_rings(sequence, config.input.rings)
    return select(sequence, config.input.start, config.input.count, config.input.skip_frames)


def announce(job: PreparedRun) -> None:
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
    deskew, is_distorted = describe_deskew(sequence, config, sweep is not None, getattr(job.odometry, "deskew", ""))
    job.manifest.deskew = deskew
    job.manifest.pose_time = (sweep or Span()).instant
    if is_distorted:
        log.warning("%s", deskew)
    else:
        log.info("deskew: %s", deskew)


@contextmanager
def stoppable(job: PreparedRun, said: str) -> Iterator[None]:
    """What is asked to stop in the block ends it, and the run is interrupted with the sentence `said`."""
    try:
        with asking(job.watch.should_stop, said):
            yield
    except InterruptedRunError as error:
        job.manifest.interrupt(str(error))
