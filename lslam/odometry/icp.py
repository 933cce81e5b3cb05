"""Method `icp` and those named after their residual: our registration against a local map."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from lslam.config.config import Config
from lslam.errors import UsageError
from lslam.odometry.base import Registered
from lslam.odometry.scan_outcome import of_registration
from lslam.preprocessing.deskew import deskew
from lslam.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.recovery.policies import policies_of
from lslam.registration.registration import Registration
from lslam.registration.residuals import RESIDUALS
from lslam.registration.solver import RegistrationResult
from lslam.registration.uncertainty import PoseUncertainty
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult
from lslam.types.state import Stateful


def create(config: Config) -> Icp:
    """The method as the configuration wants it.

    `icp` takes any residual; the others are named after theirs, with or without `icp-` before it. Raises UsageError when
    one is asked for another.
    """
    method, chosen = config.odometry.method, config.registration.residual
    name = method.removeprefix("icp-")
    own = name if name in RESIDUALS else None
    if own is not None and chosen not in (None, own):
        raise UsageError(
            f"method {method!r} measures by the residual {own!r}, registration.residual asks for {chosen!r}: "
            f"choose one of them, or --method icp --residual {chosen}"
        )
    section = config.registration.model_copy(update={"residual": own or chosen})
    return Icp(Registration(section, config.preprocess, policies_of(config.recovery)))


class Icp(Stateful):
    """Adapter from scans and motion priors to `Registration`.

    The detail of a scan that was registered: its points, deskewed, and what the registration found.
    """

    deskew = "by the motion prior, and again by the motion that registration finds"
    STATE: ClassVar[tuple[str, ...]] = ("registration", "_uncertainty")

    def __init__(self, registration: Registration) -> None:
        self.registration = registration
        self._uncertainty = self._fresh_uncertainty()

    def prepare(self, scan: Scan) -> PreparedPoints:
        """Range gate and down-sampling."""
        config = self.registration.preprocess
        return prepare_points(scan.points, config, scan.index, scan.times if config.deskew else None)

    def register(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior) -> Registered:
        """Align with the local map."""
        return self._align(scan, prepared, prior)

    def register_near(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, found: Registered) -> Registered:
        """Local registration about the prior: narrow kernel, no recovery."""
        near = self._align(scan, prepared, prior, is_near=True)
        points, located, *rest = near.detail
        return near if located.ok else replace(near, detail=(points, found.detail[1], *rest))

    def _align(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False) -> Registered:
        began = time.perf_counter()
        points = deskew(prepared, prior)
        deskewed = time.perf_counter()
        located = self.registration.locate(points, prior.pose, is_near, self.information_of(prior))
        stages = {"register": time.perf_counter() - deskewed}
        if points is not prepared:
            stages = {"deskew": deskewed - began, **stages}
        return Registered(of_registration(scan, located, self.map_age, stages), (points, located))

    @property
    def map_age(self) -> float:
        """Mean age, in scans, of the points of the map."""
        return self._uncertainty.map_age

    def information_of(self, prior: MotionPrior) -> NDArray[np.float64] | None:
        """(6, 6) information of the prior for the normal equations; None, since it is the initial guess only."""
        return None

    def update(self, prior: MotionPrior, found: Registered) -> ScanResult:
        """Enter the scan into the local map where its result puts it."""
        began = time.perf_counter()
        points, located, *_ = found.detail
        located = located.decided(found.result)
        self.insert(prior, found.result.stamp_ns, points, located)
        result = self._uncertainty.stamped(found.result, located, prior)
        return replace(result, stages={**result.stages, "update": time.perf_counter() - began})

    def insert(self, prior: MotionPrior, stamp_ns: int, points: PreparedPoints, located: RegistrationResult) -> None:
        """Enter a scan that was registered from `prior` into the map."""
        self.registration.update(points, located)

    def restart(self) -> None:
        """An empty map."""
        self.registration = Registration(
            self.registration.config, self.registration.preprocess, self.registration.recovery
        )
        self._uncertainty = self._fresh_uncertainty()

    def _fresh_uncertainty(self) -> PoseUncertainty:
        return PoseUncertainty(is_scan_to_scan=self.registration.config.target == "scan")

    def warm_up(self) -> None:
        """Register a small room twice with a throw-away copy: every kernel is compiled or loaded."""
        rng = np.random.default_rng(0)
        room = rng.uniform(-8, 8, (3000, 3)).astype(np.float32)
        room[np.arange(3000), rng.integers(0, 3, 3000)] = 8.0
        trial = Registration(self.registration.config, self.registration.preprocess, self.registration.recovery)
        for _ in range(2):
            trial.register(room)
