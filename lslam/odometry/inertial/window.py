"""The sliding window of LIO-mapping as a motion model: scans and IMU in one estimate of all that is not long past.

IMU states are estimated jointly from preintegrated increments, scans and a marginalised past. After Ye, Chen and Liu 2019,
section IV; the error states and the noise are those of the filter (`NavigationState`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.geometry import noise, se3, so3
from lslam.core.kernels import linalg
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Span
from lslam.core.types.scan_result import ScanEquations
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.filter import (
    GYRO,
    OWN,
    POSE,
    REST,
    FilterMotion,
    NavigationState,
    Normal,
    cut_noise,
    process_noise,
    transition,
)
from lslam.odometry.inertial.gyroscope import Gyroscope, ImuNoise
from lslam.odometry.inertial.imu_estimate import GRAVITY_SIGMA_M_S2, GRAVITY_WALK, ImuEstimate
from lslam.odometry.inertial.initialise import InertialStart
from lslam.odometry.inertial.integrate import integrate
from lslam.odometry.kernels.rotation import vector_between
from lslam.registration.result import RegistrationResult

# Of the filter's error state what all moments have in common: gravity and the gyroscope's axes.
COMMON = np.r_[9:12, 18:27]
SHARED, EACH = len(COMMON), len(OWN)
DOWN, AXES = slice(0, 3), slice(3, 12)
# m and rad: a step of all poses below ends the iteration; what it leaves is its square.
LEAST_STEP = 1e-3
MOST_STEPS = 5
# Whose poses, velocities and biases are estimated together, the newest included: what is older teaches little.
WINDOW_SCANS = 7


@dataclass(frozen=True)
class Moment:
    """State of the IMU in the middle of a sweep: pose (4, 4), velocity and accelerometer and gyroscope bias (3,).

    T_imu_scan : (4, 4) from it to the LiDAR at the scan's stamp; equations : normal equations of its points, None without
    """

    instant_ns: int
    stamp_ns: int
    T_world_imu: Floats
    velocity: Floats
    accel_bias: Floats
    gyro_bias: Floats
    T_imu_scan: Floats
    equations: ScanEquations | None = None

    @property
    def T_world_lidar(self) -> Floats:
        """(4, 4) at the scan's stamp."""
        return np.asarray(self.T_world_imu @ self.T_imu_scan)

    def retract(self, d: Floats) -> Moment:
        """This state moved by an error d (15,): position, rotation (left), velocity, accelerometer and gyroscope bias."""
        T = se3.make(so3.exp(d[3:6]) @ self.T_world_imu[:3, :3], self.T_world_imu[:3, 3] + d[:3])
        return replace(
            self,
            T_world_imu=T,
            velocity=self.velocity + d[6:9],
            accel_bias=self.accel_bias + d[9:12],
            gyro_bias=self.gyro_bias + d[12:15],
        )

    def away(self, other: Moment) -> Floats:
        """(15,) error of this state relative to `other`: position, rotation, velocity and both biases."""
        return np.concatenate(
            [
                pose_error(other.T_world_imu, self.T_world_imu),
                self.velocity - other.velocity,
                self.accel_bias - other.accel_bias,
                self.gyro_bias - other.gyro_bias,
            ]
        )


@dataclass(frozen=True)
class Past:
    """What all that left the window says of the first moment that is left, and of what all have in common.

    information (27, 27), gradient (27,) : of the common errors, then the moment's, where they are `gravity`, `axes`, `moment`
    """

    information: Floats
    gradient: Floats
    gravity: Floats
    axes: Floats
    moment: Moment


@dataclass(frozen=True)
class Window:
    """States of the window, earliest first; gravity (3,) in the world and gyroscope axes (3, 3), common to all.

    rate_variance : (rad/s)^2 per Hz of the gyroscope; noise : of the device
    """

    moments: tuple[Moment, ...]
    gravity: Floats
    axes: Floats
    rate_variance: float
    noise: ImuNoise
    past: Past

    @classmethod
    def begin(cls, state: NavigationState, instant_ns: int, stamp_ns: int, T_imu_scan: Floats) -> Window:
        """A window of one moment, with the state's covariance as its prior."""
        moment = moment_of(state, instant_ns, stamp_ns, T_imu_scan)
        order = np.concatenate([COMMON, OWN])
        e = state.estimate
        information = linalg.inverse(state.covariance[np.ix_(order, order)])
        past = Past(information, np.zeros(len(order)), e.gravity, e.gyroscope.axes, moment)
        return cls((moment,), e.gravity, e.gyroscope.axes, e.gyroscope.rate_variance, e.gyroscope.noise, past)

    def extend(self, moment: Moment) -> Window:
        """The window with one more moment, the newest."""
        return replace(self, moments=(*self.moments, moment))

    def with_equations(self, equations: dict[int, ScanEquations]) -> Window:
        """The window with new normal equations of some scans, by their stamps."""
        return replace(
            self, moments=tuple(replace(m, equations=equations.get(m.stamp_ns, m.equations)) for m in self.moments)
        )

    def solve(self, imu: ImuStream) -> tuple[Window, Floats]:
        """Joint estimate by Gauss-Newton, and its information (12 + 15 W, 12 + 15 W), common errors first.

        Steps end where the information is not positive definite; the covariance of `newest` is not finite then.
        """
        window, H = self, np.zeros((0, 0))
        for _ in range(MOST_STEPS):
            H, g = window.equations(imu)
            d = -linalg.solve(H, g)
            if not np.isfinite(d).all():
                break
            window = window.retract(d)
            if np.abs(d[SHARED:].reshape(-1, EACH)[:, :6]).max() < LEAST_STEP:
                break
        return window, H

    def retract(self, d: Floats) -> Window:
        """The window moved by an error d (12 + 15 W,), common errors (gravity, axes) first."""
        each = d[SHARED:].reshape(-1, EACH)
        return replace(
            self,
            gravity=self.gravity + d[DOWN],
            axes=self.axes + d[AXES].reshape(3, 3),
            moments=tuple(m.retract(one) for m, one in zip(self.moments, each, strict=True)),
        )

    def equations(self, imu: ImuStream) -> tuple[Floats, Floats]:
        """Normal equations H, g of the prior, the scans, the IMU increments and the magnitude of gravity."""
        size = SHARED + EACH * len(self.moments)
        H, g = np.zeros((size, size)), np.zeros(size)
        self._add_past(H, g)
        norm = float(np.linalg.norm(self.gravity))
        along = self.gravity / norm
        H[DOWN, DOWN] += np.outer(along, along) / GRAVITY_SIGMA_M_S2**2
        g[DOWN] += along * (norm - GRAVITY) / GRAVITY_SIGMA_M_S2**2
        for k in range(len(self.moments)):
            self._add_scan(H, g, k)
            if k > 0:
                self._add_increments(H, g, k, imu)
        return H, g

    def _add_past(self, H: Floats, g: Floats) -> None:
        """Add the prior (marginalised past), linearised at its own values, to H and g."""
        past = self.past
        x = np.concatenate(
            [self.gravity - past.gravity, (self.axes - past.axes).ravel(), self.moments[0].away(past.moment)]
        )
        H[: len(x), : len(x)] += past.information
        g[: len(x)] += past.gradient + past.information @ x

    def _add_scan(self, H: Floats, g: Floats, k: int) -> None:
        """Add the normal equations of scan k, transported from the LiDAR's pose to the IMU's."""
        m = self.moments[k]
        if m.equations is None:
            return
        e, T = m.equations, m.T_world_lidar
        J = np.eye(6)
        J[:3, 3:] = -so3.hat(T[:3, 3] - m.T_world_imu[:3, 3])
        own = slice(SHARED + EACH * k, SHARED + EACH * k + 6)
        H[own, own] += J.T @ e.H @ J
        g[own] += J.T @ (e.g + e.H @ pose_error(e.T_world_lidar, T))

    def _add_increments(self, H: Floats, g: Floats, k: int, imu: ImuStream) -> None:
        """Add the IMU factor between moments k - 1 and k, integrated anew with the present biases."""
        a, b = self.moments[k - 1], self.moments[k]
        rest, J, W = self._increment(a, b, imu)
        begin = SHARED + EACH * (k - 1)
        at = np.r_[0:SHARED, begin : begin + 2 * EACH]
        weighed = J.T @ W
        H[np.ix_(at, at)] += weighed @ J
        g[at] += weighed @ rest

    def residual(self, a: Moment, b: Moment, imu: ImuStream) -> tuple[Floats, Floats]:
        """(15,) by which moment b is away from where the IMU leads from moment a, and (15, 42) its Jacobian.

        The columns are of the common errors and of both moments'. Their rotations are taken for near each other, as those of
        the manifold are.
        """
        return self._increment(a, b, imu)[:2]

    def _increment(self, a: Moment, b: Moment, imu: ImuStream) -> tuple[Floats, Floats, Floats]:
        """Residual (15,) of moment b against its prediction from a, its Jacobian, and its information (15, 15)."""
        step = integrate(imu, np.array([a.instant_ns, b.instant_ns]), a.gyro_bias, a.accel_bias, self.axes)
        R = a.T_world_imu[:3, :3]
        R_end, velocities, moved = step.motion(0, R, a.velocity, self.gravity)
        led = replace(a, T_world_imu=se3.make(R_end[-1], a.T_world_imu[:3, 3] + moved[-1]), velocity=velocities[-1])
        F = transition(step, R, R_end[-1], Gyroscope(a.gyro_bias, self.axes))
        nanoseconds = b.instant_ns - a.instant_ns
        W = imu_information(nanoseconds, self.rate_variance, self.noise)
        if step.hidden is not None:
            Q = process_noise(1e-9 * nanoseconds, self.rate_variance, self.noise) + cut_noise(step.hidden, F)
            W = linalg.inverse(Q[np.ix_(OWN, OWN)])
        J = np.concatenate([-F[OWN][:, COMMON], -F[OWN][:, OWN], np.eye(EACH)], axis=1)
        return b.away(led), J, W

    def without_first(self, imu: ImuStream) -> Window:
        """Marginalise the first moment: its prior, scan and increments become the prior of the next.

        The prior on the direction of gravity is loosened by a random walk, since the world drifts.
        """
        first, second = self.moments[:2]
        size = SHARED + 2 * EACH
        H, g = np.zeros((size, size)), np.zeros(size)
        self._add_past(H, g)
        self._add_scan(H, g, 0)
        self._add_increments(H, g, 1, imu)
        is_first = np.zeros(size, bool)
        is_first[SHARED : SHARED + EACH] = True
        rest = Normal(H, g).without(is_first)
        walk = GRAVITY_WALK**2 * 1e-9 * (second.instant_ns - first.instant_ns)
        information, gradient = add_random_walk(rest.H, rest.g, DOWN, walk)
        past = Past(information, gradient, self.gravity, self.axes, second)
        return replace(self, moments=self.moments[1:], past=past)

    def newest(self, H: Floats, like: NavigationState) -> NavigationState:
        """The newest moment as a filter state with covariance, from the joint information H; `like` supplies the rest."""
        m = self.moments[-1]
        which = np.r_[0:SHARED, len(H) - EACH : len(H)]
        P = np.zeros_like(like.covariance)
        order = np.concatenate([COMMON, OWN])
        P[np.ix_(order, order)] = linalg.inverse(H)[np.ix_(which, which)]
        gyroscope = replace(like.estimate.gyroscope, bias=m.gyro_bias, axes=self.axes, covariance=P[GYRO, GYRO])
        estimate = ImuEstimate(m.velocity, self.gravity, m.accel_bias, gyroscope, P[REST, REST])
        return NavigationState(se3.normalise(m.T_world_imu), estimate, P)


@lru_cache(maxsize=64)
def imu_information(nanoseconds: int, rate_variance: float, noise: ImuNoise) -> Floats:
    """(15, 15) information of an IMU factor over so many nanoseconds: the inverse of its process noise; a read-only array.

    rate_variance : as of `process_noise`
    """
    W = np.linalg.inv(process_noise(1e-9 * nanoseconds, rate_variance, noise)[np.ix_(OWN, OWN)])
    W.flags.writeable = False
    return W


def moment_of(state: NavigationState, instant_ns: int, stamp_ns: int, T_imu_scan: Floats) -> Moment:
    """The moment at `instant_ns` with the pose, velocity and biases of a filter state."""
    e = state.estimate
    return Moment(instant_ns, stamp_ns, state.T_world_imu, e.velocity, e.accel_bias, e.gyroscope.bias, T_imu_scan)


def pose_error(a: Floats, b: Floats) -> Floats:
    """(6,) error, world axes, by which the pose b (4, 4) is away from a (4, 4)."""
    # The copy is one compiled function less.
    R = np.ascontiguousarray(a[:3, :3])
    return np.concatenate([b[:3, 3] - a[:3, 3], R @ vector_between(R, b[:3, :3])])


def add_random_walk(H: Floats, g: Floats, part: slice, variance: float) -> tuple[Floats, Floats]:
    """Normal equations H, g after the variables `part` moved by a random walk of `variance`.

    Their values before it are marginalised by the Schur complement.
    """
    K = np.linalg.inv(np.eye(part.stop - part.start) / variance + H[part, part])
    return H - H[:, part] @ K @ H[part], g - H[:, part] @ K @ g[part]


# m, of a point at `LEVER_M`: a scan whose pose moved farther from where its points were linearised is linearised again.
STALE_M = 0.005


class WindowMotion(FilterMotion):
    """Predicts as the filter does, from the newest state; the joint estimate of the whole window replaces its update."""

    HAS_DEVICE: ClassVar[bool] = False
    STATE: ClassVar[tuple[str, ...]] = (*FilterMotion.STATE, "window")

    def __init__(self, opening: InertialStart, config: Config) -> None:
        super().__init__(opening, config)
        self.window: Window | None = None
        # Of the scan that is being registered: equations that were taken, and the window with it.
        self._equations: dict[int, ScanEquations] = {}
        self._joint: Window | None = None

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Predicted poses over the `span` of the sweep, as by `FilterMotion.sweep`. Drops the equations of the last scan."""
        self._equations, self._joint = {}, None
        return super().sweep(stamp_ns, span)

    def set_equations(self, equations: Iterable[ScanEquations]) -> None:
        """Store the normal equations of some scans for the next joint estimates."""
        self._equations |= {one.stamp_ns: one for one in equations}

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """The result with the pose and covariance of the joint estimate; unchanged where that fails."""
        self._joint = self._posterior = None
        if not result.is_accepted or prior.covariance is None or self._next is None or self.window is None:
            return result
        instant_ns, state = self._next
        middle, _ = middle_of(prior, stamp_ns, result.T_world_lidar)
        T_world_imu = middle @ self.T_lidar_imu
        T_imu_scan = se3.relative(T_world_imu, result.T_world_lidar)
        moment = moment_of(replace(state, T_world_imu=T_world_imu), instant_ns, stamp_ns, T_imu_scan)
        window, H = self.window.extend(moment).with_equations(self._equations).solve(self.imu)
        newest = window.newest(H, state)
        pose = se3.normalise(newest.T_world_imu @ T_imu_scan)
        if not (np.isfinite(pose).all() and np.isfinite(newest.covariance).all()):
            return result
        self._joint, self._posterior = window, (instant_ns, newest)
        lever = pose[:3, 3] - newest.T_world_imu[:3, 3]
        covariance = noise.transport(newest.covariance[POSE, POSE], lever)
        return result.with_pose(pose, covariance)

    def stale(self) -> dict[int, Floats]:
        """Poses (4, 4), by stamps, of the scans that the joint estimate moved away from where they were linearised."""
        moved = {}
        for m in () if self._joint is None else self._joint.moments:
            if m.equations is not None:
                off = pose_error(m.equations.T_world_lidar, m.T_world_lidar)
                if np.linalg.norm(off[:3]) + LEVER_M * np.linalg.norm(off[3:]) > STALE_M:
                    moved[m.stamp_ns] = m.T_world_lidar
        return moved

    def poses(self) -> dict[int, Floats]:
        """Poses (4, 4), by stamps, of the scans in the window as they are estimated now."""
        return {} if self.window is None else {m.stamp_ns: se3.normalise(m.T_world_lidar) for m in self.window.moments}

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update as the filter; the window is extended, or begins anew where the filter does, and drops its oldest moments."""
        joint, posterior, predicted = self._joint, self._posterior, self._next
        super().correct(stamp_ns, pose, prior, has_registration)
        self._joint, self._equations = None, {}
        if self._now is None or self._instant_ns is None:
            self.window = None
            return
        T_imu_scan = se3.relative(self._pose @ self.T_lidar_imu, pose)
        if posterior is not None and self._now is posterior[1]:
            self.window = joint
        elif predicted is not None and self._now is predicted[1] and self.window is not None:
            self.window = self.window.extend(moment_of(self._now, self._instant_ns, stamp_ns, T_imu_scan))
        else:
            self.window = Window.begin(self._now, self._instant_ns, stamp_ns, T_imu_scan)
        while self.window is not None and len(self.window.moments) > WINDOW_SCANS:
            self.window = self.window.without_first(self.imu)
