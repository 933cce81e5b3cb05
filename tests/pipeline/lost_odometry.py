"""Odometry that is lost and does not know it: right poses, corrupted after registration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.geometry import se3, so3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.base import Traits
from lslam.odometry.frontend.tracker import ScanInput, Tracker

Floats = NDArray[np.float64]
# What is claimed of a true step (4, 4), and of the seconds that it took.
Corruption = Callable[[Floats, float], Floats]


def freeze(step: Floats, seconds: float) -> Floats:
    return np.eye(4)


def slip(step: Floats, seconds: float) -> Floats:
    """A fifth of the way is missing."""
    return se3.make(step[:3, :3], 0.8 * step[:3, 3])


def yaw_ramp(step: Floats, seconds: float) -> Floats:
    """Half a degree per second too much."""
    return np.asarray(step @ se3.make(so3.exp(np.array([0, 0, np.deg2rad(0.5) * seconds])), np.zeros(3)))


@dataclass
class Lost(Traits):
    """A method that registers well and claims `corruption` of each step from scan `begin` to `end`, as a foreign one might.

    known : what was registered of the same scans before; filled with what was not
    """

    corruption: Corruption
    begin: int
    end: int = 10**9
    known: dict[int, ScanResult] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.inner = create_odometry(Config())
        self.tracker = Tracker(self.inner)
        self.count, self.stamp_ns = 0, 0
        self.true, self.claimed = np.eye(4), np.eye(4)

    def prepare(self, scan: Scan) -> Any:
        return self.inner.prepare(scan)

    def register(self, scan: Scan, prepared: Any, prior: MotionPrior) -> ScanResult:
        if self.count not in self.known:
            self.known[self.count] = self.tracker.track(ScanInput(scan.index, scan.stamp_ns, scan, prepared))
        result = self.known[self.count]
        step = se3.relative(self.true, result.T_world_lidar)
        if self.begin <= self.count < self.end:
            step = self.corruption(step, (scan.stamp_ns - self.stamp_ns) * 1e-9)
        self.true, self.claimed = result.T_world_lidar, se3.normalise(self.claimed @ step)
        self.count, self.stamp_ns = self.count + 1, scan.stamp_ns
        return replace(result, T_world_lidar=self.claimed)

    def warm_up(self) -> None:
        self.inner.warm_up()
