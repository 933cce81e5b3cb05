"""Wheels of a simulated car: speed and yaw rate with errors of scale and offset, noise, latency and slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.geometry import portable, se3
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import WheelStream
from lslam.simulation.kinematics import Motion

# Middle of the rear axle below the LiDAR on KITTI's car: it hardly moves sideways.
T_CAR_BASE = se3.make(np.eye(3), np.array([-0.76, 0.0, -1.73]))


@dataclass(frozen=True)
class WheelModel:
    """Speed and yaw rate as a car's bus tells them.

    scale : largest error of the scale, drawn evenly; yaw_scale : likewise of the yaw rate; yaw_offset : one sigma, rad/s
    noise, yaw_noise : one sigma of a reading, m/s and rad/s; step : of a speed, m/s, as pulses are counted
    latency_s : by which a reading is stamped too late
    slip : largest share of the speed by which wheels spin or lock, slip_s : the longest it lasts, every : mean s between
    """

    rate_hz: float = 50.0
    scale: float = 0.02
    yaw_scale: float = 0.02
    yaw_offset: float = 0.003
    noise: float = 0.02
    yaw_noise: float = 0.003
    step: float = 0.01
    latency_s: float = 0.03
    slip: float = 0.2
    slip_s: float = 0.8
    every: float = 20.0


@dataclass(frozen=True)
class SimulatedWheels:
    """Readings, and the truth behind them: scale, yaw_scale and yaw_offset as drawn; slip : (M,) share of each reading."""

    stream: WheelStream
    scale: float
    yaw_scale: float
    yaw_offset: float
    slip: Floats


def simulate_wheels(
    motion: Motion, model: WheelModel, T_lidar_base: Floats, end: float, rng: np.random.Generator
) -> SimulatedWheels:
    """Readings of wheels at `T_lidar_base` (4, 4), from 0 to `end` s of `motion`; the same generator gives the same."""
    count = int(np.floor(end * model.rate_hz + 1e-6)) + 1
    stamps = np.round(np.arange(count) * (1e9 / model.rate_hz)).astype(np.int64)
    scale, yaw_scale = rng.uniform(-1, 1, 2) * [model.scale, model.yaw_scale]
    yaw_offset = model.yaw_offset * rng.standard_normal()
    slip = _slip(model, stamps / 1e9, end, rng)
    noise = rng.standard_normal((count, 2))
    taken = np.clip(stamps / 1e9 - model.latency_s, 0.0, motion.duration)
    exact = motion.at(taken).carried(T_lidar_base)
    forward = portable.dot(exact.velocity, exact.poses[:, :3, 0])
    speed = (1 + scale) * (1 + slip) * forward + model.noise * noise[:, 0] * (np.abs(forward) > model.step)
    if model.step > 0:
        speed = np.round(speed / model.step) * model.step
    yaw_rate = (1 + yaw_scale) * exact.rate[:, 2] + yaw_offset + model.yaw_noise * noise[:, 1]
    stream = WheelStream(stamps, speed, yaw_rate, T_lidar_base)
    return SimulatedWheels(stream, float(scale), float(yaw_scale), float(yaw_offset), slip)


def _slip(model: WheelModel, times: Floats, end: float, rng: np.random.Generator) -> Floats:
    """(M,) share of the speed by which wheels turn faster than they roll, at `times` (M,), s: half sines now and then."""
    slip = np.zeros(len(times))
    begin = float(rng.exponential(model.every))
    while begin < end:
        lasts, size = rng.uniform(0.3, 1.0) * model.slip_s, rng.uniform(-1, 1) * model.slip
        phase = (times - begin) / lasts
        slip += np.where((phase > 0) & (phase < 1), size * portable.sin(np.pi * np.clip(phase, 0, 1)), 0.0)
        begin += lasts + float(rng.exponential(model.every))
    return slip
