"""Method `lips`: planes as landmarks and a preintegrated IMU in one smoother (Geneva et al. 2018)."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import ClassVar

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.config.config import Config
from lslam.core.errors import UsageError
from lslam.core.geometry import noise, se3
from lslam.core.kernels.transform import transform
from lslam.core.types.imu import MotionState, PreintegratedStep, SweepLink
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Scan, Span
from lslam.core.types.scan_result import ScanResult, StageClock
from lslam.core.types.state import Stateful
from lslam.odometry.base import Traits
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.filter import (
    GYRO,
    OWN,
    REST,
    FilterMotion,
    NavigationState,
    cut_noise,
    process_noise,
    transition,
    warm_up_solver,
)
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.integrate import Increments
from lslam.odometry.plane_factors import SHARED, sighting_residuals
from lslam.odometry.plane_segmentation import PlaneExtractor, Planes, boxes_in
from lslam.odometry.plane_window import PlaneWindow, associate
from lslam.odometry.scan_outcome import to_scan_result
from lslam.registration.acceptance import PRIOR_COVARIANCE, correction
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points, small_room
from lslam.registration.result import RegistrationResult

# Share of the points on planes that known planes must take; where it is less, the scan is elsewhere.
KNOWN_SHARE = 0.1


# m/s2, change of velocity over a gap of the IMU, one sigma: a car brakes.
BRAKING_M_S2 = 3.0


class LinkedMotion(FilterMotion):
    """Predicts and deskews as the filter does; its states come from the smoother of the method, through `fuse`."""

    HAS_DEVICE: ClassVar[bool] = False
    STATE: ClassVar[tuple[str, ...]] = (*FilterMotion.STATE, "_last_link")
    # Instant, ns, and pose of the LiDAR of the newest state in the smoother: a scan that nobody could read has none.
    _last_link: tuple[int, Floats] | None = None

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Predicted poses over the `span` of the sweep, with the IMU factor that links them to the last scan's state."""
        prior = super().sweep(stamp_ns, span)
        return replace(prior, link=self._link(prior, stamp_ns))

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The prior refined as by the filter, with the IMU factor to the last state computed again for the refined pose."""
        refined = super().refine(prior, stamp_ns, pose)
        if refined is prior or prior.link is None:
            return prior
        within = se3.relative(refined.pose, middle_of(refined, stamp_ns, refined.pose)[0])
        return replace(refined, link=replace(prior.link, within=within))

    def needs_comparison(self, stamp_ns: int, span: Span) -> bool:
        """Never: without the IMU there is nothing to estimate the states from."""
        return False

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """Return the result without `inertial`, the smoother's state, which is stored for `correct`."""
        self._posterior = None
        if result.inertial is not None and prior.link is not None:
            middle, instant_ns = middle_of(prior, stamp_ns, result.T_world_lidar)
            self._posterior = instant_ns, self._state_of(result.inertial)
            self._last_link = instant_ns, middle
        return replace(result, inertial=None)

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update as the filter; of a scan rejected by the IMU, the smoother's state is at the pose where the scan entered."""
        super().correct(stamp_ns, pose, prior, has_registration)
        if self._last_link is not None and self._last_link[0] == self._instant_ns:
            self._last_link = self._last_link[0], self._pose.copy()

    def rewind(self, stamp_ns: int, pose: Floats, span: Span) -> MotionPrior:
        """Forget all scans but the first, as `InertialMotion.rewind`; the returned motion begins a new smoother."""
        self._now = self._next = self._posterior = None
        prior = super().rewind(stamp_ns, pose, span)
        assert self._instant_ns is not None
        self._last_link = self._instant_ns, self._pose.copy()
        state = NavigationState.begin(self._pose @ self.T_lidar_imu, self.estimate)
        return replace(prior, link=SweepLink(self.T_lidar_imu, se3.relative(pose, self._pose), _plain(state)))

    def _link(self, prior: MotionPrior, stamp_ns: int) -> SweepLink:
        """The link of the sweep to the state before, by the IMU or, in gaps and after standstill, by the predicted motion."""
        middle, instant_ns = middle_of(prior, stamp_ns, prior.pose)
        T_world_imu = middle @ self.T_lidar_imu
        # Where a smoother begins; no filter had a state there.
        state = NavigationState.begin(T_world_imu, self.estimate) if self._next is None else self._next[1]
        link = SweepLink(self.T_lidar_imu, se3.relative(prior.pose, middle), _plain(state))
        if self._last_link is None or self._instant_ns is None or self._last_link[0] >= instant_ns:
            return link
        before_ns, before = self._last_link
        # Since then it stood, in no state of the smoother: its pose is known, forces over minutes lead anywhere.
        has_stood = self._instant_ns != before_ns and not self._was_bridged
        if not self.refusal and not has_stood and self._covers(before_ns, instant_ns):
            increments = self.estimate.over(self.imu, np.array([before_ns, instant_ns]))
            return replace(link, step=_from_imu(self.estimate, increments, (before @ self.T_lidar_imu)[:3, :3]))
        motion = se3.relative(before @ self.T_lidar_imu, T_world_imu)
        return replace(link, step=_coast(self.estimate, motion, 1e-9 * (instant_ns - before_ns)))

    def _state_of(self, state: MotionState) -> NavigationState:
        """The smoother's state as a state of the filter; the noise of the gyroscope remains."""
        P, before = state.covariance, self.estimate.gyroscope
        gyroscope = Gyroscope(state.gyro_bias, state.gyro_axes, P[GYRO, GYRO], before.rate_variance, before.noise)
        estimate = ImuEstimate(state.velocity, state.gravity, state.accel_bias, gyroscope, P[REST, REST])
        return NavigationState(state.T_world_imu, estimate, P)


def _plain(state: NavigationState) -> MotionState:
    """A filter's state as the smoother takes it."""
    e = state.estimate
    return MotionState(
        state.T_world_imu, e.velocity, e.gravity, e.accel_bias, e.gyroscope.bias, e.gyroscope.axes, state.covariance
    )


def _from_imu(e: ImuEstimate, step: Increments, R: Floats) -> PreintegratedStep:
    """The preintegrated IMU readings of `step` with covariance; R : (3, 3) of the IMU in the world at its first instant."""
    t = step.duration
    C = process_noise(t, e.gyroscope.rate_variance, e.gyroscope.noise)
    if step.hidden is not None:
        C += cut_noise(step.hidden, transition(step, R, R @ step.rotations[-1], e.gyroscope))
    return PreintegratedStep(
        t,
        step.rotations[-1],
        step.velocities[-1],
        step.positions[-1],
        step.velocity_arms[-1],
        step.position_arms[-1],
        e.gyroscope.columns(step),
        e.accel_bias,
        e.gyroscope.bias,
        e.gyroscope.axes,
        C[np.ix_(OWN, OWN)],
    )


def _coast(e: ImuEstimate, motion: Floats, seconds: float) -> PreintegratedStep:
    """A step by the predicted motion (4, 4) of the IMU over `seconds`, for gaps, after standstill or refusal of the IMU."""
    walk = e.gyroscope.noise
    sigmas = BRAKING_M_S2 * seconds, walk.accel_walk * seconds**0.5, walk.gyro_walk * seconds**0.5
    C = np.diag(np.repeat([0.0, 0.0, *np.square(sigmas)], 3))
    C[:6, :6] = PRIOR_COVARIANCE
    none = np.zeros((3, 3))
    return PreintegratedStep(
        0.0,
        motion[:3, :3],
        np.zeros(3),
        motion[:3, 3],
        none,
        none,
        np.zeros((3, 12)),
        e.accel_bias,
        e.gyroscope.bias,
        e.gyroscope.axes,
        C,
    )


def create(config: Config) -> Lips:
    """Create the method from the configuration."""
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
        """Adopt the window with the scan's planes, or without them where the result is rejected."""
        began = time.perf_counter()
        window, predicted, covariance = result.detail
        if not result.is_accepted:
            none = np.zeros((0, 3))
            window = replace(predicted, landmarks=predicted.landmarks.observe(np.zeros(0, np.int64), none, none))
        self.window = window.marginalise()
        record = to_scan_result(scan, result, None if result.is_rejected else covariance, result.covariance)
        return replace(record, stages={**result.stages, "update": time.perf_counter() - began})

    def restart(self) -> None:
        """Begin again without a window."""
        self.window = None

    def warm_up(self) -> None:
        """Extract the planes of a small room, and solve a small window."""
        self._extractor.extract(small_room())
        warm_up_solver()

    def _predict(self, link: SweepLink) -> PlaneWindow:
        """The window with one more state, predicted by the IMU; a new window of one state if the link has no step."""
        if self.window is None or link.step is None:
            return PlaneWindow.begin(link.state, se3.inverse(link.T_lidar_imu))
        return self.window.extend(link.step)

    def _result(self, link: SweepLink, window: PlaneWindow, planes: Planes, matches: Longs) -> RegistrationResult:
        """The registration result: the newest pose with its covariance relative to the planes; `detail` is that in the world."""
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
        """(D, 6) twists of the LiDAR that the scan's known planes hardly constrain."""
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
    """Reason to reject a scan's planes: none, or few points on known planes (`matches` (P,), -1 unknown); else empty."""
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
