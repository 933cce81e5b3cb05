"""A town driven twice, recorded and run, for the commands that bring drives together."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from calling import lslam
from numpy.typing import NDArray

from lslam.formats.trajectory_files import read_trajectory
from lslam.geometry import se3
from lslam.geometry.umeyama import align
from lslam.simulation.record import record
from lslam.simulation.routes import FIRST_VISIT, Visit
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
VISITS = {"monday": (FIRST_VISIT, 96), "tuesday": (Visit(1, is_reversed=True, shift=40.0), 50)}


def record_visits(root: Path) -> None:
    """`monday` and `tuesday`, the other way round on the other lane, in `root`, with their true poses in the town as .npy."""
    for name, (visit, count) in VISITS.items():
        drive = simulate("block", seed=7, count=count, visit=visit)
        record(drive, root / name)
        np.save(root / f"{name}.npy", drive.city_poses)


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
    return se3.inverse(align(est, town_poses(root, name)[: len(est), :3, 3])[0])
