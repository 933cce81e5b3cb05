"""Method `icp`: our scan-to-map registration."""

from __future__ import annotations

import time

import numpy as np

from lslam.config.config import Config
from lslam.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.registration import Registration
from lslam.registration.uncertainty import PoseUncertainty
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


def create(config: Config) -> Icp:
    """The method as the configuration wants it."""
    return Icp(Registration(config.registration, config.preprocess))


class Icp:
    """Adapter from scans and motion priors to `Registration`."""

    def __init__(self, registration: Registration) -> None:
        self.registration = registration
        self._uncertainty = PoseUncertainty()

    def prepare(self, scan: Scan) -> PreparedPoints:
        """Range gate and down-sampling."""
        return prepare_points(scan.points, self.registration.preprocess, scan.index)

    def register(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior) -> ScanResult:
        """Align, then update the local map."""
        began = time.perf_counter()
        result = self.registration.locate(prepared, prior.start)
        aligned = time.perf_counter()
        self.registration.update(prepared, result)
        return ScanResult(
            index=scan.index,
            stamp_ns=scan.stamp_ns,
            T_world_lidar=result.T_world_lidar,
            status="ok" if result.ok else "bridged",
            reason=result.reason,
            covariance=self._uncertainty.add(result),
            registration_covariance=result.covariance,
            converged=result.converged,
            iterations=result.iterations,
            source_points=result.source_points,
            inliers=result.inliers,
            rmse=result.rmse,
            overlap=result.overlap,
            degenerate=result.degenerate,
            prior_error=result.prior_error,
            stages={"register": aligned - began, "update": time.perf_counter() - aligned},
        )

    def warm_up(self) -> None:
        """Register a small room twice with a throw-away copy: every kernel is compiled or loaded."""
        rng = np.random.default_rng(0)
        room = rng.uniform(-8, 8, (3000, 3)).astype(np.float32)
        room[np.arange(3000), rng.integers(0, 3, 3000)] = 8.0
        trial = Registration(self.registration.config, self.registration.preprocess)
        for _ in range(2):
            trial.register(room)
