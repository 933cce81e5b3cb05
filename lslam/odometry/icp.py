"""Method `icp`: our scan-to-map registration."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from lslam.config.config import Config
from lslam.preprocessing.deskew import deskew
from lslam.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.registration import Registration
from lslam.registration.solver import RegistrationResult
from lslam.registration.uncertainty import PoseUncertainty
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


def create(config: Config) -> Icp:
    """The method as the configuration wants it."""
    return Icp(Registration(config.registration, config.preprocess))


class Icp:
    """Adapter from scans and motion priors to `Registration`."""

    deskew = "by the motion prior, and again by the motion that registration finds"

    def __init__(self, registration: Registration) -> None:
        self.registration = registration
        self._uncertainty = PoseUncertainty()
        # What `register` saw and found last, for `update`.
        self._points: PreparedPoints
        self._located: RegistrationResult

    def prepare(self, scan: Scan) -> PreparedPoints:
        """Range gate and down-sampling."""
        config = self.registration.preprocess
        return prepare_points(scan.points, config, scan.index, scan.times if config.deskew else None)

    def register(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior) -> ScanResult:
        """Align with the local map."""
        began = time.perf_counter()
        self._points = deskew(prepared, prior)
        deskewed = time.perf_counter()
        self._located = result = self.registration.locate(self._points, prior.start)
        stages = {"register": time.perf_counter() - deskewed}
        if self._points is not prepared:
            stages = {"deskew": deskewed - began, **stages}
        return ScanResult(
            index=scan.index,
            stamp_ns=scan.stamp_ns,
            T_world_lidar=result.T_world_lidar,
            status="ok" if result.ok else "bridged",
            reason=result.reason,
            registration_covariance=result.covariance,
            converged=result.converged,
            iterations=result.iterations,
            source_points=result.source_points,
            inliers=result.inliers,
            rmse=result.rmse,
            overlap=result.overlap,
            degenerate=result.degenerate,
            prior_error=result.prior_error,
            stages=stages,
        )

    def update(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, result: ScanResult) -> ScanResult:
        """Enter the scan into the local map where `register` put it."""
        began = time.perf_counter()
        self.registration.update(self._points, self._located)
        covariance = self._uncertainty.add(self._located)
        stages = {**result.stages, "update": time.perf_counter() - began}
        return replace(result, covariance=covariance, stages=stages)

    def restart(self) -> None:
        """An empty map."""
        self.registration = Registration(self.registration.config, self.registration.preprocess)
        self._uncertainty = PoseUncertainty()

    def warm_up(self) -> None:
        """Register a small room twice with a throw-away copy: every kernel is compiled or loaded."""
        rng = np.random.default_rng(0)
        room = rng.uniform(-8, 8, (3000, 3)).astype(np.float32)
        room[np.arange(3000), rng.integers(0, 3, 3000)] = 8.0
        trial = Registration(self.registration.config, self.registration.preprocess)
        for _ in range(2):
            trial.register(room)
