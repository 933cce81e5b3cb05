"""A small town driven twice: the map of one drive, the keyframes of another, and the truth that joins them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.config import Config
from lslam.core.geometry import se3
from lslam.core.types.scan_result import ScanResult
from lslam.maps.merge import MapMerger
from lslam.odometry import create_odometry
from lslam.odometry.frontend.keyframing import Keyframing
from lslam.odometry.frontend.register_scans import estimate
from lslam.simulation.routes import Visit
from lslam.simulation.scenarios import SimulatedDrive, simulate

Floats = NDArray[np.float64]
CONFIG = Config.model_validate({"loops": {"use": False}, "input": {"threads": 1}})


@dataclass(frozen=True)
class Revisited:
    """`points` (N, 3) of the true map in the town's frame; `drive` is another visit, with odometry's results and keyframes."""

    points: Floats
    drive: SimulatedDrive
    results: list[ScanResult]
    store: KeyframeStore

    @property
    def true_poses(self) -> Floats:
        """(N, 4, 4) of the visit's scans in the town's frame."""
        return self.drive.city_poses


def town_map(scenario: str, seed: int, count: int | None = None, every: int = 1) -> Floats:
    """(N, 3) m, town frame: the scans of the first visit, or every so many-th, merged at true poses."""
    drive = simulate(scenario, seed=seed, count=count, motion_compensated=True)
    merger = MapMerger(0.2, 2.0, 80.0)
    for k in range(0, len(drive), every):
        merger.add(drive.scan(k).points, drive.city_poses[k], None)
    return np.concatenate([block.points for block in merger.result().blocks()])


def revisit(scenario: str, seed: int, visit: Visit, count: int) -> Revisited:
    drive = simulate(scenario, seed=seed, count=count, visit=visit, motion_compensated=True)
    store = KeyframeStore()
    with Keyframing(store, CONFIG) as keyframing:
        results = estimate(drive, create_odometry(CONFIG), threads=1, keyframing=keyframing)
        keyframing.finalise()
    return Revisited(town_map(scenario, seed), drive, results, store)


def error_of(T: Floats, truth: Floats) -> tuple[float, float]:
    """m and deg."""
    from lslam.core.geometry import so3

    d = se3.relative(truth, T)
    return float(np.linalg.norm(d[:3, 3])), float(np.rad2deg(so3.angle(d[:3, :3])))
