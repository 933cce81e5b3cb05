"""Recordings and simulations as cells of a grid, with digests of what is in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lslam.config.input import AS_CONFIGURED, ScanRange
from lslam.errors import UsageError
from lslam.pipeline.identity import imu_digest, input_digest
from lslam.readers import open_sequence
from lslam.studies.grid import Cell
from lslam.studies.scenes import Scene, drive_of, scene_digest, scene_folder
from lslam.studies.subjects import check_range
from lslam.types.trajectory import Trajectory


def recorded_cell(
    label: str,
    path: Path,
    seed: int | None = None,
    *,
    needs_imu: bool,
    truth: Trajectory | None = None,
    data_root: Path | None = None,
    own: ScanRange = AS_CONFIGURED,
) -> Cell:
    """A recording that is there; `own` : which of its scans are used.

    Raises InputError when it cannot be opened, or has no IMU and some run asks for one; UsageError when it ends before `own`.
    """
    sequence = open_sequence(path, data_root=data_root, imu=needs_imu)
    check_range(label, own, len(sequence))
    imu = imu_digest(sequence) if needs_imu else ""
    return Cell(label, path, seed, input_digest(sequence, truth), truth, imu, data_root, range=own)


def scene_cell(scene: Scene, seed: int, parent: Path, own: ScanRange = AS_CONFIGURED) -> Cell:
    """A simulation that may still have to be made, below `parent`; its digest says what it will hold, IMU included.

    Raises UsageError, ConfigError or InputError for a scenario that is none.
    """
    return Cell(scene.name, scene_folder(scene, seed, parent), seed, scene_digest(scene, seed), scene=scene, range=own)


def fitted_scene(scene: Scene, needed: int | None, own: ScanRange, seeds: Sequence[int]) -> Scene:
    """The scene with the scans that are needed, unless it says how many; all of its way where skipping leads beyond it.

    own : which scans are used, over the configurations; seeds : of the simulations, whose ways differ a little
    Raises UsageError when the scenario ends before them.
    """
    if scene.scans is not None:
        check_range(scene.name, own, scene.scans)
        return scene
    fitted = replace(scene, scans=needed)
    if own.own:
        try:
            ways = [drive_of(fitted, seed) for seed in seeds]
        except UsageError:
            fitted = scene
            ways = [drive_of(scene, seed) for seed in seeds]
        check_range(scene.name, own, min(map(len, ways)))
    return fitted
