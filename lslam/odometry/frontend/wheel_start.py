"""From the wheels that a run asks for to its motion model, and what the manifest says of them."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

from lslam.core.config.odometry import WheelsConfig
from lslam.core.types.sequence import Sequence
from lslam.io.readers.wheels import read_wheels
from lslam.odometry.inertial.wheel_calibration import OFFSET_S, YAW_OFFSET, YAW_SCALE, U
from lslam.odometry.inertial.wheel_motion import WheelMotion

log = logging.getLogger("lslam")


@dataclass
class Wheels:
    """The wheels' part in a run: its motion model, None without wheels."""

    motion: WheelMotion | None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def begin_wheels(sequence: Sequence, config: WheelsConfig) -> Wheels:
    """Read the wheels that the configuration names. Raises InputError and UsageError as `read_wheels`."""
    if not config.source:
        return Wheels()
    part = Wheels()
    stream = getattr(sequence, "wheels", None)  # of a simulated drive, which has no files
    if stream is None:
        stream = read_wheels(sequence, config.source, config.frame, config.wheelbase_m, part.notes, part.problems)
    part.motion = WheelMotion(stream)
    what = "speed and yaw rate" if stream.yaw_rate is not None else "speed"
    part.notes.append(f"wheels from {config.source}: {what}, {len(stream)} readings")
    for note in part.notes:
        log.info("%s", note)
    for problem in part.problems:
        log.warning("%s", problem)
    return part


def close_wheels(part: Wheels, ignores_prior: bool) -> dict[str, Any]:
    """What the manifest says of the wheels when the run is over, nothing without; `part` gets the problems on the way.

    ignores_prior : of the method
    """
    motion = part.motion
    if motion is None:
        return {}
    if ignores_prior:
        part.problems.append("wheels: the method predicts by itself, they only bridge scans that fail")
    last = motion.calibration
    scale, sigma = last.scale
    if motion.gap_scans:
        part.problems.append(f"wheels: {motion.gap_scans} scans fell into gaps and were predicted by constant velocity")
    if motion.refusal:
        part.problems.append(f"the wheels were refused on the way, the run went on without them: {motion.refusal}")
    facts = {
        "used": not (motion.refusal or ignores_prior),
        "decisions": part.notes,
        "readings": len(motion.wheels),
        "scale": round(scale, 5),
        "scale_sigma": round(sigma, 5),
        "forward_in_lidar": [round(float(v), 5) for v in last.states[U]],
        "time_offset_s": round(float(last.states[OFFSET_S]), 5),
        "scans_in_gaps": motion.gap_scans,
        "scans_with_slip": motion.slip_scans,
        **motion.errors.facts,
    }
    if last.has_yaw:
        facts["yaw_scale"], facts["yaw_offset_rad_s"] = (
            round(float(last.states[k]), 5) for k in (YAW_SCALE, YAW_OFFSET)
        )
    return facts
