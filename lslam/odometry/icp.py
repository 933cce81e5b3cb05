"""Method `icp` and those named after their residual: our registration against a local map."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, ClassVar

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.config.odometry import RecoveryConfig
from lslam.core.errors import UsageError
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import StageClock
from lslam.odometry.base import MapMethod
from lslam.odometry.elastic import ElasticConstraints, SweepPoints, register_elastic
from lslam.registration.optimiser import KERNEL_MIN_M, Annealing
from lslam.registration.preprocessing.deskew import deskew
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points, small_room
from lslam.registration.registration import Registration
from lslam.registration.residuals import RESIDUALS
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS


def create(config: Config) -> Icp:
    """Create `icp` with the configured residual, or the method named after its residual, with or without the prefix `icp-`.

    Raises UsageError when `registration.residual` is another one.
    """
    method, configured = config.odometry.method, config.registration.residual
    name = method.removeprefix("icp-")
    own = name if name in RESIDUALS else None
    if own is not None and configured not in (None, own):
        raise UsageError(
            f"method {method!r} measures by the residual {own!r}, registration.residual asks for {configured!r}: "
            f"choose one of them, or --method icp --residual {configured}"
        )
    return Icp(registration_of(config, own or configured))


def registration_of(
    config: Config, residual: str | None = "plane", recovery: RecoveryConfig | None = None, **keys: Any
) -> Registration:
    """The registration of the configuration with another `residual`, other `keys` of its section, and another `recovery`.

    recovery : None keeps the configured one
    """
    c = config.registration.model_copy(update={"residual": residual, **keys})
    return Registration(c, config.preprocess, recovery or config.recovery)


class Icp(MapMethod):
    """Registers points on the local map."""

    deskew = "by the motion prior, and again by the motion that registration finds"
    TRANSIENT: ClassVar[tuple[str, ...]] = ("_surfaces",)

    def __init__(self, registration: Registration) -> None:
        c = registration.config
        super().__init__(registration, is_scan_to_scan=c.target in ("scan", "sample"))
        # Point to plane, on a map of many scans.
        self.follows_course = registration.preprocess.deskew and c.target == "map" and c.residual in (None, "plane")
        # Of the scan that was registered last.
        self._surfaces: tuple[PreparedPoints, Floats] | None = None

    def prepare(self, scan: Scan) -> PreparedPoints:
        """Range gate and down-sampling."""
        config = self.registration.preprocess
        return prepare_points(scan.points, config, scan.index, scan.times if config.deskew else None)

    def register(
        self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False
    ) -> RegistrationResult:
        """Deskew by the prior and register on the local map; elastically where the motion comes from a window's course."""
        if prior.change is not None and self.is_elastic(prepared, prior):
            return self.register_sweep(prepared, ElasticConstraints.of_course(prior), prior, is_near)
        clock = StageClock()
        with clock.stage("deskew"):
            points = deskew(prepared, prior)
        if points is prepared:
            del clock.seconds["deskew"]
        with clock.stage("register"):
            known = self.with_surfaces(points, prepared)
            result = self.registration.locate(known, prior.pose, is_near, self.information_of(prior))
        return replace(result, map_age=self.map_age, stages=clock.seconds)

    def with_surfaces(self, points: PreparedPoints, prepared: PreparedPoints) -> PreparedPoints:
        """The deskewed points with the covariances of their surfaces, if the residual needs them.

        A sweep that is deskewed again keeps the first covariances: the rest of its motion moves neighbours alike.
        """
        target = self.registration.target
        if not target.kind.needs_covariance:
            return points
        if self._surfaces is None or self._surfaces[0] is not prepared:
            self._surfaces = prepared, target.with_covariance(points).covariance
        return replace(points, covariance=self._surfaces[1])

    def is_elastic(self, prepared: PreparedPoints, prior: MotionPrior) -> bool:
        """True when begin and end pose of a sweep are observable: it has point times and enough points, and there is a map."""
        is_one_pose = prepared.source_times is None or len(prior.times) < 2
        return not is_one_pose and len(self.registration.map) > 0 and len(prepared.source) >= MIN_SOURCE_POINTS

    def register_sweep(
        self, prepared: PreparedPoints, constraints: ElasticConstraints, prior: MotionPrior, is_near: bool
    ) -> RegistrationResult:
        """Register begin and end pose of the sweep (elastic registration), and deskew by them; by the prior if that fails."""
        began, registration = time.perf_counter(), self.registration
        attempt, c = registration.attempt(prepared, prior.pose, is_near), registration.config
        points = SweepPoints(prepared, registration.map.levels, c.sigma)
        width = max(attempt.annealing.start, KERNEL_MIN_M)
        annealing = Annealing(width, c.max_iterations)
        elastic = register_elastic(points, constraints.expected, constraints, annealing, c.weak_share)
        result = attempt.judge(elastic.result)
        sweep = replace(elastic.sweep.prior, change=prior.change) if result.ok else None
        return replace(
            result,
            points=deskew(prepared, sweep or prior),
            detail=(prior, elastic),
            sweep=sweep,
            map_age=self.map_age,
            stages={"register": time.perf_counter() - began},
        )

    def warm_up(self) -> None:
        """Register a small room twice with a throw-away copy: every kernel is compiled or loaded."""
        trial = self.registration.fresh()
        for _ in range(2):
            trial.register(small_room())
