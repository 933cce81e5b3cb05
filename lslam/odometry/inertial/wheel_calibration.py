"""From speeds of wheels to the LiDAR's motion, and the calibration of the wheels by registered motion.

A step of the LiDAR is linear in what is not known: u, metres that the LiDAR moves along each of its axes per metre of the wheels,
has their scale and the direction in which the LiDAR is mounted; the arm from the LiDAR to their axle swings with the turn. Scale
and offset of the yaw rate and the offset of the clocks are states as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import se3, so3
from lslam.core.kernels.linearisation import RARE_SIGMAS
from lslam.core.types.imu import WheelStream
from lslam.odometry.inertial.gyroscope import NOISE_MEMORY_SCANS, OFFSET_SIGMA
from lslam.odometry.kernels import kalman

# One sigma of u: along, tyres and their pressure; across, a vehicle's pitch on its springs; of an axis that nobody states.
SCALE_SIGMA, AXIS_SIGMA, UNKNOWN_AXIS_SIGMA = 0.05, 0.02, 0.5
# m; of a frame whose place is stated, and of one at an unknown place on a vehicle.
ARM_SIGMA, UNKNOWN_ARM_SIGMA = 0.05, 1.0
# rad/s; of the yaw rate at rest.
YAW_OFFSET_SIGMA = 0.02
# Random walks per sqrt(s): of the scale, as tyres warm up and loads shift, and of the yaw rate's offset, rad/s.
SCALE_WALK, YAW_OFFSET_WALK = 1e-4, 1e-5
# Of a step before any was seen: m2 per m, along and across, and rad2 per s; and the least of each.
STEP_NOISE = np.array([1e-4, 1e-3, 1e-4])
LEAST_NOISE = np.array([1e-6, 1e-6, 1e-8])
# s; of a reading's time, beside the offset of all.
JITTER_S = 0.02
# Median of chi2 with one degree of freedom.
MEDIAN_SQUARE = 0.4549
U, ARM, YAW_SCALE, YAW_OFFSET, OFFSET_S = slice(0, 3), slice(3, 6), 6, 7, 8


@dataclass(frozen=True)
class WheelStep:
    """Motion of the LiDAR by its wheels from one instant to a later one, in its axes at the first.

    pose : (4, 4); jacobian : (4, 9) of translation (m) and rotation about `up` (rad) by the calibration's states
    way : m, path length; seconds : s, duration
    """

    pose: Floats
    jacobian: Floats
    way: float
    seconds: float


@dataclass(frozen=True)
class WheelCalibration:
    """States of the wheels and their covariance.

    up : (3,) axis of the yaw rate in LiDAR axes; has_yaw : whether it is measured
    states (9,), covariance (9, 9) : u, the driving direction times the scale; arm from the LiDAR to the axle, m; scale and
        offset, rad/s, of the yaw rate; s to add to stamps
    noise : (3,) densities of the residual, m2 per m along u and across, and rad2 per s; counts : (3,) steps used for it
    """

    up: Floats
    has_yaw: bool
    states: Floats
    covariance: Floats = field(repr=False)
    noise: Floats = field(default_factory=STEP_NOISE.copy)
    counts: Floats = field(default_factory=lambda: np.ones(3))

    @classmethod
    def of(cls, wheels: WheelStream) -> WheelCalibration:
        """The prior: by the frame of the wheels, or forward along x of the LiDAR with wide sigmas where that is unknown."""
        T = np.eye(4) if wheels.T_lidar_base is None else wheels.T_lidar_base
        spread, arm_sigma = [SCALE_SIGMA, AXIS_SIGMA, AXIS_SIGMA], ARM_SIGMA
        if wheels.T_lidar_base is None:
            spread, arm_sigma = [UNKNOWN_AXIS_SIGMA] * 3, UNKNOWN_ARM_SIGMA
        own = np.repeat([arm_sigma, SCALE_SIGMA, YAW_OFFSET_SIGMA, OFFSET_SIGMA], [3, 1, 1, 1])
        P = np.diag(np.square(np.concatenate([spread, own])))
        P[U, U] = T[:3, :3] @ P[U, U] @ T[:3, :3].T
        states = np.concatenate([T[:3, 0], T[:3, 3], [1.0, 0.0, 0.0]])
        return cls(T[:3, 2].copy(), wheels.yaw_rate is not None, states, P)

    @property
    def direction(self) -> Floats:
        """(3,) unit vector, forwards in LiDAR axes."""
        u = self.states[U]
        return np.asarray(u / max(float(np.linalg.norm(u)), 1e-9))

    @property
    def scale(self) -> tuple[float, float]:
        """Metres of the LiDAR per metre of the wheels, and its sigma."""
        u = self.direction
        return float(np.linalg.norm(self.states[U])), float(np.sqrt(u @ self.covariance[U, U] @ u))

    def step(self, wheels: WheelStream, begin_ns: int, end_ns: int, yaw_rate: float) -> WheelStep:
        """Motion from `begin_ns` to `end_ns`; `yaw_rate`, rad/s, is used for wheels that measure none."""
        offset_ns, up = round(1e9 * float(self.states[OFFSET_S])), self.up
        first, last = np.searchsorted(wheels.stamps_ns, [begin_ns - offset_ns, end_ns - offset_ns])
        around = slice(max(int(first) - 1, 0), int(last) + 1)
        own = 1e-9 * (wheels.stamps_ns[around] + offset_ns - begin_ns)
        seconds = 1e-9 * (end_ns - begin_ns)
        times = np.concatenate([[0.0], own[(own > 0) & (own < seconds)], [seconds]])
        speed, raw = np.interp(times, own, wheels.speed[around]), np.full(len(times), yaw_rate)
        rate = raw
        if wheels.yaw_rate is not None:
            raw = np.interp(times, own, wheels.yaw_rate[around])
            rate = self.states[YAW_SCALE] * raw - self.states[YAW_OFFSET]

        def integral(values: Floats) -> Floats:
            return np.append(0.0, np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times)))

        turns = integral(rate)
        turn = float(turns[-1])
        way, ahead, aside = (float(integral(v)[-1]) for v in (speed, speed * np.cos(turns), speed * np.sin(turns)))
        along = np.outer(up, up)
        A = way * along + ahead * (np.eye(3) - along) + aside * so3.hat(up)
        R = so3.exp(turn * up)
        swing, arm = R - np.eye(3), self.states[ARM]
        moved = A @ self.states[U] - swing @ arm
        J = np.zeros((4, 9))
        J[:3, U], J[:3, ARM], J[:3, OFFSET_S] = A, -swing, (speed[0] - speed[-1]) * self.states[U]
        if self.has_yaw:
            J[3, [YAW_SCALE, YAW_OFFSET, OFFSET_S]] = integral(raw)[-1], -seconds, rate[0] - rate[-1]
            # A steady turn heads by half of itself on the way; the arm swings by all of it.
            J[:3] += np.outer(np.cross(up, 0.5 * moved - arm), J[3])
        return WheelStep(se3.make(R, moved), J, abs(way), seconds)

    def step_noise(self, step: WheelStep) -> Floats:
        """(4, 4) covariance of a step's translation (m) and rotation about `up` (rad) that the states do not explain."""
        along, across, turning = self.noise
        out = np.zeros((4, 4))
        out[:3, :3] = step.way * by_axis(along, across, self.direction)
        out[3, 3] = turning * step.seconds
        # What changes its speed slips, and one reading is later than another.
        late = step.jacobian[:, OFFSET_S] * JITTER_S
        return np.asarray(out + np.outer(late, late))

    def state_covariance(self, step: WheelStep) -> Floats:
        """(4, 4) covariance of a step by that of the states."""
        return np.asarray(step.jacobian @ self.covariance @ step.jacobian.T)

    def correct(self, step: WheelStep, rest: Floats, C: Floats) -> WheelCalibration:
        """Update by a registered step that is longer by `rest` (4,), m and rad about `up`, with covariance C (4, 4)."""
        P, J, size = self.covariance.copy(), step.jacobian.copy(), 4 if self.has_yaw else 3
        # By the registered turn: the noise of the measured one would be taken for a scale that is too large.
        J[3, YAW_SCALE] += self.has_yaw * rest[3] / self.states[YAW_SCALE]
        P[U, U] += SCALE_WALK**2 * step.seconds * np.eye(3)
        P[YAW_OFFSET, YAW_OFFSET] += YAW_OFFSET_WALK**2 * step.seconds
        noise = (self.step_noise(step) + C)[:size, :size]
        # Slip has no usual size: what is larger than expected counts accordingly less.
        states, covariance = kalman.update(self.states, P, J[:size], rest[:size], noise, 1.0)
        squares, others = squares_along(rest, J @ P @ J.T + C, self.direction)
        per = np.array([step.way, step.way, step.seconds])
        left, counts = learn_noise(self.noise, self.counts, squares, others, per, LEAST_NOISE)
        return replace(self, states=states, covariance=covariance, noise=left, counts=counts)


def by_axis(along: float, across: float, direction: Floats) -> Floats:
    """(3, 3) covariance with the variance `along` a unit vector (3,) and the variance `across` it."""
    return np.asarray(across * np.eye(3) + (along - across) * np.outer(direction, direction))


def squares_along(rest: Floats, C: Floats, direction: Floats) -> tuple[Floats, Floats]:
    """Squares (3,) of an innovation `rest` (4,): along a unit vector, mean across, and of the turn; and those that C expects."""

    def parts(S: Floats) -> Floats:
        along = float(direction @ S[:3, :3] @ direction)
        return np.array([along, (float(np.trace(S[:3, :3])) - along) / 2, S[3, 3]])

    return parts(np.outer(rest, rest)), parts(C)


def learn_noise(
    noise: Floats, counts: Floats, squares: Floats, others: Floats, per: Floats, least: Floats
) -> tuple[Floats, Floats]:
    """Noise densities (N,) and their counts, updated by squared innovations (N,); per : (N,) m or s of each.

    others : (N,) part of the squares that is other noise. Half of the squares of a normal error lie below `MEDIAN_SQUARE` of
    its variance: a density grows with each one above, and shrinks with each below, so that slip of any size counts as one
    innovation. Each is weighted by the share of this noise in it: along a direction that registration does not observe it is
    zero. Innovations beyond `RARE_SIGMAS` count in full.
    """
    own = noise * per
    is_beyond = squares > RARE_SIGMAS**2 * (own + others)
    share = np.where(is_beyond, 1.0, np.square(own / np.maximum(own + others, 1e-300)))
    counts = np.minimum(counts + share, NOISE_MEMORY_SCANS)
    side = np.where(squares > MEDIAN_SQUARE * (own + others), 1.0, -1.0)
    return np.maximum(noise * np.exp(share / counts * side), least), counts
