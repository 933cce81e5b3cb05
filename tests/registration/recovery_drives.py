"""Drives that are simulated once, with whichever LiDAR on the roof."""

from __future__ import annotations

from copy import copy
from functools import cache

from perturbed_scans import with_other_noise

from lslam.simulation.lidar_models import find_lidar
from lslam.simulation.scenarios import SimulatedDrive, simulate


@cache
def driven(scenario: str, seed: int) -> SimulatedDrive:
    return simulate(scenario, seed=seed, motion_compensated=True)


def seen_by(lidar: str, scenario: str, seed: int = 0, noise: int = 0) -> SimulatedDrive:
    """The same drive with another LiDAR, and other noise: to build the town takes longer than what is asked here."""
    drive = with_other_noise(driven(scenario, seed), noise) if noise else copy(driven(scenario, seed))
    drive.lidar = find_lidar(lidar)
    return drive
