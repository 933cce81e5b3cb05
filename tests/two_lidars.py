"""A simulated vehicle with two LiDARs, the rear one tilted and looking back from the other end of the roof."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.convert_sequence import convert_sequence
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive, simulate

LIDAR = replace(LIDARS["vlp16"], columns=600)
PLACE = 'name = "rear", place = [-1.6, 0.4, -0.2], rpy_deg = [0, 3, 172]'
WAYS = ("folders", "topics", "frames")


def two_lidars(
    scenario: str = "block", count: int = 12, offset_ms: float = 0.0, seed: int = 3, **more: Any
) -> SimulatedDrive:
    """Distorted scans of both; the rear one begins its sweeps `offset_ms` later."""
    mounts = f"lidars=[{{{PLACE}, offset_ms = {offset_ms}}}]"
    return simulate(scenario, lidar=LIDAR, seed=seed, count=count, motion_compensated=False, settings=[mounts], **more)


def merged(drive: SimulatedDrive, folder: Path, way: str = "folders", kind: str = "mcap") -> Sequence:
    """The drive as it is read from its folders, or from a bag with a topic for each LiDAR or with one for both."""
    record(drive, folder / "drive")
    sequence = open_sequence(folder / "drive")
    if way == "folders":
        return sequence
    path = folder / f"drive.{kind}"
    convert_sequence(sequence, kind, path, lidars=way)
    return open_sequence(path)
