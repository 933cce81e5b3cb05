"""From speeds of wheels to the LiDAR's motion, and the calibration of the wheels by registered motion.

A step of the LiDAR is linear in what is not known: u, metres that the LiDAR moves along each of its axes per metre of the wheels,
has their scale, and the direction in which the LiDAR is mounted; the arm from their axle to the LiDAR swings with the turn. Scale
and offset of the yaw rate and the offset of the clocks are states as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.wheels import WheelStream
from lslam.odometry.inertial.gyroscope import INNOVATION_SIGMAS, NOISE_MEMORY_SCANS, OFFSET_SIGMA
from lslam.odometry.kernels import kalman

# One sigma: tyres and their pressure, and a vehicle's pitch on its springs; of an axis that nobody states, half of all there is.
SCALE_SIGMA, AXIS_SIGMA, UNKNOWN_AXIS_SIGMA = 0.05, 0.02, 0.5
# m; of a frame whose place is stated, and of one at an unknown place on a vehicle.
ARM_SIGMA, UNKNOWN_ARM_SIGMA = 0.05, 1.0
# rad/s; of a yaw rate at rest.
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
class WheelSteps:
    """Motions of the LiDAR by its wheels from one instant to K others, in its axes at the first.

    moved : (K, 3) m; turn : (K,) rad about `up` (3,); jacobian : (K, 4, 9) of moved and turn by the states
    way : (K,) m of the wheels, without a sign; seconds : (K,)
    """

    moved: Floats
    turn: Floats
    jacobian: Floats
    way: Floats
    seconds: Floats
    up: Floats

    @property
    def poses(self) -> Floats:
        """(K, 4, 4)"""
        return se3.make(so3.exp(self.turn[:, None] * self.up), self.moved)


@dataclass(frozen=True)
class WheelCalibration:
    """States of the wheels and their covariance.

    up : (3,) axis of the yaw rate in LiDAR axes; has_yaw : whether it is measured
    states (9,), covariance (9, 9) : u; arm from the LiDAR to the axle, m; scale and offset, rad/s, of the yaw rate; s to
        add to stamps
    noise : (3,) of what is left, m2 per m along u and across, and rad2 per s
    counts : (3,) steps that it was learnt from, each by what it told
    """

    up: Floats
    has_yaw: bool
    states: Floats
    covariance: Floats = field(repr=False)
    noise: Floats = field(default_factory=STEP_NOISE.copy)
    counts: Floats = field(default_factory=lambda: np.ones(3))

    @classmethod
    def of(cls, wheels: WheelStream) -> WheelCalibration:
        """The prior: as the frame of the wheels says, or forward along x of the LiDAR where nothing places it."""
        T = wheels.T_lidar_base
        if T is None:
            axes, arm, spread, arm_sigma = np.eye(3), np.zeros(3), [UNKNOWN_AXIS_SIGMA] * 3, UNKNOWN_ARM_SIGMA
        else:
            axes, arm, spread, arm_sigma = T[:3, :3], T[:3, 3], [SCALE_SIGMA, AXIS_SIGMA, AXIS_SIGMA], ARM_SIGMA
        states = np.concatenate([axes[:, 0], arm, [1.0, 0.0, 0.0]])
        own = np.repeat([arm_sigma, SCALE_SIGMA, YAW_OFFSET_SIGMA, OFFSET_SIGMA], [3, 1, 1, 1])
        P = np.diag(np.concatenate([np.zeros(3), own**2]))
        P[U, U] = axes @ np.diag(np.square(spread)) @ axes.T
        return cls(axes[:, 2].copy(), wheels.yaw_rate is not None, states, P)

    @property
    def direction(self) -> Floats:
        """(3,) unit vector, forwards in LiDAR axes."""
        u = self.states[U]
        return np.asarray(u / max(float(np.linalg.norm(u)), 1e-9))

    @property
    def scale(self) -> tuple[float, float]:
        """Metres of the LiDAR per metre of the wheels, and its sigma."""
        u = self.states[U]
        length = float(np.linalg.norm(u))
        return length, float(np.sqrt(u @ self.covariance[U, U] @ u)) / max(length, 1e-9)

    def steps(self, wheels: WheelStream, anchor_ns: int, instants_ns: Longs, yaw_rate: float) -> WheelSteps:
        """Motions from an instant to others; `yaw_rate`, rad/s, is for wheels that measure none."""
        u, arm, offset_ns = self.states[U], self.states[ARM], round(1e9 * float(self.states[OFFSET_S]))
        ends = np.append(instants_ns, anchor_ns)
        first, last = np.searchsorted(wheels.stamps_ns, [ends.min() - offset_ns, ends.max() - offset_ns])
        around = slice(max(int(first) - 1, 0), int(last) + 1)
        stamps = wheels.stamps_ns[around] + offset_ns
        instants = np.unique(np.concatenate([stamps[(stamps > ends.min()) & (stamps < ends.max())], ends]))
        times, own = 1e-9 * (instants - anchor_ns), 1e-9 * (stamps - anchor_ns)
        speed = np.interp(times, own, wheels.speed[around])
        raw = np.full(len(times), yaw_rate)
        if wheels.yaw_rate is not None:
            raw = np.interp(times, own, wheels.yaw_rate[around])
        rate = self.states[YAW_SCALE] * raw - self.states[YAW_OFFSET] if self.has_yaw else raw
        here = int(np.searchsorted(instants, anchor_ns))
        at = np.searchsorted(instants, instants_ns)

        def integral(values: Floats) -> Floats:
            grown = np.append(0.0, np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times)))
            return np.asarray(grown - grown[here])

        turn = integral(rate)
        way, ahead, aside = (integral(v)[at] for v in (speed, speed * np.cos(turn), speed * np.sin(turn)))
        up = self.up
        along, plane = np.outer(up, up), np.eye(3) - np.outer(up, up)
        A = way[:, None, None] * along + ahead[:, None, None] * plane + aside[:, None, None] * so3.hat(up)
        swing = so3.exp(turn[at, None] * up) - np.eye(3)
        # The axle is at `arm`: the LiDAR moves by what the axle does less what the arm swings.
        moved = A @ u - swing @ arm
        J = np.zeros((len(at), 4, 9))
        J[:, :3, U], J[:, :3, ARM] = A, -swing
        J[:, :3, OFFSET_S] = (speed[here] - speed[at])[:, None] * u
        if self.has_yaw:
            raw_turn = integral(raw)[at]
            for k, by_state in ((YAW_SCALE, raw_turn), (YAW_OFFSET, -times[at]), (OFFSET_S, rate[here] - rate[at])):
                J[:, 3, k] = by_state
                # A steady turn heads by half of itself on the way, and the arm swings by all of it.
                J[:, :3, k] += by_state[:, None] * np.cross(up, 0.5 * moved - arm)
        return WheelSteps(moved, turn[at], J, np.abs(way), np.abs(times[at]), up)

    def step_noise(self, steps: WheelSteps, k: int) -> Floats:
        """(4, 4) covariance of step `k` that no state explains."""
        u = self.direction
        along, across, turning = self.noise
        out = np.zeros((4, 4))
        out[:3, :3] = steps.way[k] * (across * np.eye(3) + (along - across) * np.outer(u, u))
        out[3, 3] = turning * steps.seconds[k]
        # What changes its speed slips, and one reading is later than another.
        late = steps.jacobian[k, :, OFFSET_S] * JITTER_S
        return np.asarray(out + np.outer(late, late))

    def spread(self, steps: WheelSteps, k: int) -> Floats:
        """(4, 4) covariance of step `k` by that of the states."""
        return np.asarray(steps.jacobian[k] @ self.covariance @ steps.jacobian[k].T)

    def corrected(self, steps: WheelSteps, k: int, rest: Floats, C: Floats) -> WheelCalibration:
        """After registration found step `k` longer by `rest` (4,), m and rad about `up`, with the covariance C (4, 4)."""
        seconds, size = float(steps.seconds[k]), 4 if self.has_yaw else 3
        P = self.covariance.copy()
        P[U, U] += SCALE_WALK**2 * seconds * np.eye(3)
        P[YAW_OFFSET, YAW_OFFSET] += YAW_OFFSET_WALK**2 * seconds
        J, own = steps.jacobian[k], self.step_noise(steps, k)
        told = J @ P @ J.T + C
        states, covariance = kalman.update(
            self.states, P, J[:size], rest[:size], (own + C)[:size, :size], INNOVATION_SIGMAS / size**0.5
        )
        u = self.direction
        across = float(rest[:3] @ rest[:3] - (u @ rest[:3]) ** 2) / 2
        squares = np.array([(u @ rest[:3]) ** 2, across, rest[3] ** 2])
        known = np.array([u @ told[:3, :3] @ u, (np.trace(told[:3, :3]) - u @ told[:3, :3] @ u) / 2, told[3, 3]])
        per = np.array([steps.way[k], steps.way[k], seconds])
        noise, counts = learnt(self.noise, self.counts, squares, known, per, LEAST_NOISE)
        return replace(self, states=states, covariance=covariance, noise=noise, counts=counts)


def learnt(
    noise: Floats, counts: Floats, squares: Floats, known: Floats, per: Floats, least: Floats
) -> tuple[Floats, Floats]:
    """Densities of noise (N,), and the counts behind them, after squared innovations (N,) over so much each, `per` (N,).

    known : (N,) part of the squares that is not this noise's. Half of the squares of a normal error lie below `MEDIAN_SQUARE` of
    its variance: a density grows with each one above, and shrinks with each below, so that slip, however much, counts as one
    innovation. One counts by the share that is not known: along a direction that registration leaves open it tells nothing.
    """
    own = noise * per
    share = np.square(own / np.maximum(own + known, 1e-300))
    counts = np.minimum(counts + share, NOISE_MEMORY_SCANS)
    side = np.where(squares > MEDIAN_SQUARE * (own + known), 1.0, -1.0)
    return np.maximum(noise * np.exp(share / counts * side), least), counts
