"""A town driven twice, recorded and run, for the commands that bring drives together."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from calling import lslam
from made_once import MadeOnce
from numpy.typing import NDArray

from lslam.core.geometry import se3
from lslam.core.geometry.se3 import umeyama
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.simulation.record import record
from lslam.simulation.routes import FIRST_VISIT, Visit
from lslam.simulation.scenarios import SimulatedDrive, simulate

Floats = NDArray[np.float64]
VISITS = {"monday": (FIRST_VISIT, 96), "tuesday": (Visit(1, is_reversed=True, shift=40.0), 50)}


def visit_drive(name: str) -> SimulatedDrive:
    visit, count = VISITS[name]
    return simulate("block", seed=7, count=count, visit=visit)


def place_visits(root: Path, made_once: MadeOnce, runs: Mapping[str, str]) -> None:
    """`monday` and `tuesday`, the other way round on the other lane, in `root`, with their true poses in the town as .npy.

    runs : of some of them, and the names of their folders: one run of each serves all modules
    """
    made = made_once.folder
    for name in VISITS:
        made_once(name, lambda name=name: _record(visit_drive(name), made / name))
        (root / name).symlink_to(made / name)
        (root / f"{name}.npy").symlink_to(made / f"{name}.npy")
    for name, folder in runs.items():
        made_once(f"{name}-run", lambda name=name: run(made / name, made / f"{name}-run"))
        shutil.copytree(made / f"{name}-run", root / folder)


def _record(drive: SimulatedDrive, out: Path) -> None:
    record(drive, out)
    np.save(out.with_suffix(".npy"), drive.city_poses)


def run(sequence: Path, out: Path) -> None:
    done = lslam("run", sequence, "--out", out, "-q")
    assert done.returncode == 0, done.stderr


def town_poses(root: Path, name: str) -> Floats:
    """(N, 4, 4)"""
    poses: Floats = np.load(root / f"{name}.npy")
    return poses


def frame_from_town(root: Path, trajectory: Path, name: str) -> Floats:
    """(4, 4) by which the poses of a trajectory lie best on their truth."""
    est = read_trajectory(trajectory, "tum").positions
    return se3.inverse(umeyama(est, town_poses(root, name)[: len(est), :3, 3])[0])
