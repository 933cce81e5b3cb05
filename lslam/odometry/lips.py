"""Method `lips`: planes as landmarks and a preintegrated IMU in one smoother (Geneva et al. 2018)."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import ClassVar

import numpy as np

from lslam.core.config.config import Config
from lslam.core.errors import UsageError
from lslam.core.geometry import noise, se3
from lslam.core.kernels.transform import transform
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.imu import SweepLink
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Scan
from lslam.core.types.scan_result import ScanResult, StageClock
from lslam.core.types.state import Stateful
from lslam.odometry.base import Traits
from lslam.odometry.inertial.filter import warm_up_solver
from lslam.odometry.inertial.linked_motion import LinkedMotion
from lslam.odometry.plane_factors import SHARED, sighting_residuals
from lslam.odometry.plane_segmentation import PlaneExtractor, Planes, boxes_in
from lslam.odometry.plane_window import PlaneWindow, associate
from lslam.odometry.scan_outcome import to_scan_result
from lslam.registration.acceptance import correction
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points, small_room
from lslam.registration.result import RegistrationResult

# Share of the points on planes that known planes must take; where it is less, the scan is elsewhere.
KNOWN_SHARE = 0.1


def create(config: Config) -> Lips:
    """The method as the configuration wants it."""
    return Lips(config)


create_motion = LinkedMotion


class Lips(Traits, Stateful):
    """Planes of each scan are associated with landmarks, and the window of states and planes is optimised."""

    is_searching = False
    deskew = "by the motion that the smoother and the IMU predict"
    STATE: ClassVar[tuple[str, ...]] = ("window",)

    def __init__(self, config: Config) -> None:
        self.config = config
        self.window: PlaneWindow | None = None
        self._extractor = PlaneExtractor()

    def prepare(self, scan: Scan) -> PreparedPoints:
        """Range gate and down-sampling."""
        config = self.config.preprocess
        return prepare_points(scan.points, config, scan.index, scan.times if config.deskew else None)

    def register(
        self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False
    ) -> RegistrationResult:
        """Optimise the window with the planes of the scan; raises UsageError without the IMU."""
        link = prior.link
        if link is None:
            raise UsageError("lips is a smoother of planes and IMU: run it on a sequence that has one")
        clock = StageClock()
        with clock.stage("deskew"):
            points = deskew_points(prepared.map_points, prepared.map_times, prior)
            centred = np.empty_like(points)
            transform(points, se3.inverse(link.within), centred)
        with clock.stage("planes"):
            planes = self._extractor.extract(centred)
        with clock.stage("register"):
            predicted = self._predict(link)
            matches = associate(predicted, planes, predicted.joint_covariance())
            reason = _refusal(predicted, planes, matches)
            window, steps = predicted, 0
            if not reason:
                solution, steps = _with(predicted, planes, matches).solve()
                reason = (
                    "the window of planes and IMU has no solution: the IMU carries the scan" if solution is None else ""
                )
                window = solution or predicted
        with clock.stage("covariance"):
            result = self._result(link, window, planes, matches)
        off = correction(prior.pose, result.T_world_lidar)
        return replace(
            result,
            ok=not reason,
            reason=reason,
            converged=not reason,
            iterations=steps,
            source_points=len(points),
            prior_error=off,
            stages=clock.seconds,
            detail=(window, predicted, result.detail),
        )

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        """The window goes on with the scan's planes, or without them where its result is rejected."""
        began = time.perf_counter()
        window, predicted, covariance = result.detail
        if not result.is_accepted:
            none = np.zeros((0, 3))
            window = replace(predicted, landmarks=predicted.landmarks.observe(np.zeros(0, np.int64), none, none))
        self.window = window.marginalise()
        record = to_scan_result(scan, result, None if result.is_rejected else covariance, result.covariance)
        return replace(record, stages={**result.stages, "update": time.perf_counter() - began})

    def restart(self) -> None:
        """An empty window."""
        self.window = None

    def warm_up(self) -> None:
        """Extract the planes of a small room, and solve a small window."""
        self._extractor.extract(small_room())
        warm_up_solver()

    def _predict(self, link: SweepLink) -> PlaneWindow:
        """The window with one more state where the IMU leads, or its first."""
        if self.window is None or link.step is None:
            return PlaneWindow.begin(link.state, se3.inverse(link.T_lidar_imu))
        return self.window.extend(link.step)

    def _result(self, link: SweepLink, window: PlaneWindow, planes: Planes, matches: Longs) -> RegistrationResult:
        """The newest pose with its covariance on the planes; the detail is that in the world."""
        pose = se3.normalise(window.T_world_lidar @ se3.inverse(link.within))
        P = window.joint_covariance()
        which = np.flatnonzero(matches >= 0)
        state = slice(SHARED, SHARED + 6)
        step = pose[:3, 3] - window.values.poses[-1, :3, 3]
        on_planes = noise.transport(window.covariance_on_planes(), step)
        n = planes.counts[which]
        rmse = float(np.sqrt(n @ planes.rms[which] ** 2 / max(n.sum(), 1.0)))
        return RegistrationResult(
            pose,
            covariance=on_planes,
            inliers=round(float(n.sum())),
            matched=round(float(n.sum())),
            rmse=rmse,
            degenerate=self._degenerate(window, matches),
            inertial=window.values.newest(P[:27, :27]),
            detail=noise.transport(P[state, state], step),
        )

    def _degenerate(self, window: PlaneWindow, matches: Longs) -> Floats:
        """(D, 6) twists of the LiDAR along which the known planes of the scan say next to nothing."""
        if window.values.states == 1:
            return np.zeros((0, 6))  # the first scan begins the world
        is_of_known_planes = (window.sightings.states == window.values.states - 1) & np.isin(
            window.sightings.planes, matches[matches >= 0]
        )
        sightings = window.sightings.only(is_of_known_planes)
        _, J, _ = sighting_residuals(window.values, sightings, window.landmarks.anchors, window.T_imu_lidar)
        J[:, :, 3:] /= LEVER_M
        values, vectors = np.linalg.eigh(np.einsum("kia,kij,kjb->ab", J, sightings.information, J))
        return np.ascontiguousarray(vectors[:, values <= self.config.registration.weak_share * values.sum()].T)


def _refusal(window: PlaneWindow, planes: Planes, matches: Longs) -> str:
    """Why a scan's planes are rejected; empty where they are not."""
    if len(planes) == 0:
        return "no plane is seen: the IMU carries the scan"
    if len(window.landmarks) == 0:
        return ""
    share = float(planes.counts[matches >= 0].sum() / planes.counts.sum())
    if share < KNOWN_SHARE:
        return f"only {share:.0%} of the points on planes lie on known ones: the IMU carries the scan"
    return ""


def _with(window: PlaneWindow, planes: Planes, matches: Longs) -> PlaneWindow:
    """The window whose newest state saw the planes, known ones and new ones."""
    information: Floats = np.asarray(np.linalg.inv(planes.covariance), np.float64)
    lows, highs = boxes_in(planes, window.T_world_lidar)
    old, new = matches >= 0, matches < 0
    window = window.with_sightings(matches[old], planes.cp[old], information[old], lows[old], highs[old])
    return window.with_planes(planes.cp[new], information[new], lows[new], highs[new])
