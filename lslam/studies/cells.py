"""Recordings and simulations as cells of a grid, with digests of what is in them."""

from __future__ import annotations

from pathlib import Path

from lslam.pipeline.identity import imu_digest, input_digest
from lslam.readers import open_sequence
from lslam.readers.raw_drive import with_imu
from lslam.studies.grid import Cell
from lslam.studies.scenes import Scene, scene_digest, scene_folder
from lslam.types.trajectory import Trajectory


def recorded_cell(
    label: str,
    path: Path,
    seed: int | None = None,
    *,
    needs_imu: bool,
    truth: Trajectory | None = None,
    data_root: Path | None = None,
) -> Cell:
    """A recording that is there. Raises InputError when it cannot be opened, or has no IMU and some run asks for one."""
    sequence = open_sequence(path)
    imu = imu_digest(with_imu(sequence, data_root)) if needs_imu else ""
    return Cell(label, path, seed, input_digest(sequence, truth), truth, imu, data_root)


def scene_cell(scene: Scene, seed: int, parent: Path) -> Cell:
    """A simulation that may still have to be made, below `parent`; its digest says what it will hold, IMU included.

    Raises UsageError, ConfigError or InputError for a scenario that is none.
    """
    return Cell(scene.name, scene_folder(scene, seed, parent), seed, scene_digest(scene, seed), scene=scene)
