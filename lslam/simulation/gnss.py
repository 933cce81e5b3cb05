"""A satellite receiver on a moving body: fixes around the true antenna, with noise that wanders, and gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError
from lslam.geometry import geodesy, se3
from lslam.simulation.kinematics import Motion
from lslam.types.gnss import GnssStream

Floats = NDArray[np.float64]

# lat, lon (deg), height (m) of the city's origin unless a scenario has its own: open ground at Karlsruhe.
ORIGIN = np.array([49.0, 8.4, 115.0])

# Of the antenna in the LiDAR frame: on the roof of a car behind the LiDAR's mast, on top of a drone that carries the LiDAR
# below its belly, on a rod above a hand-held LiDAR.
T_CAR_ANTENNA = se3.make(np.eye(3), np.array([-0.9, 0.0, -0.15]))
T_DRONE_ANTENNA = se3.make(np.eye(3), np.array([-0.1, 0.0, 0.35]))
T_WALKER_ANTENNA = se3.make(np.eye(3), np.array([-0.05, 0.0, 0.25]))


@dataclass(frozen=True)
class GnssModel:
    """A receiver of code fixes under an open sky.

    rate_hz : fixes per second, 1 to 10
    white : independent error of each fix; slow : error that wanders with the time constant `memory`, s. Both are one sigma
    of east and of north, m; upwards they are `vertical` times as large
    outages : intervals (from, to), s, in which there is no fix
    """

    rate_hz: float = 1.0
    white: float = 0.3
    slow: float = 0.8
    memory: float = 120.0
    vertical: float = 1.8
    outages: tuple[tuple[float, float], ...] = ()

    @property
    def sigma(self) -> float:
        """The one-sigma error a fix states, of east and of north, m."""
        return float(np.hypot(self.white, self.slow))


@dataclass(frozen=True)
class SimulatedGnss:
    """What was measured, and the truth behind it.

    stream : the fixes; antenna : (M, 3) true positions in the city frame, m; error : (M, 3) east, north, up, m
    T_lidar_gnss : (4, 4) where the antenna sits
    """

    stream: GnssStream
    antenna: Floats
    error: Floats
    T_lidar_gnss: Floats


def simulate_gnss(
    motion: Motion,
    model: GnssModel,
    T_lidar_gnss: NDArray[np.float64],
    origin: NDArray[np.float64],
    end: float,
    rng: np.random.Generator,
) -> SimulatedGnss:
    """Fixes of an antenna at `T_lidar_gnss` (4, 4), from 0 to `end` s of `motion`.

    origin : (3,) lat, lon (deg), height (m) of the city's origin; the city's x, y, z are east, north, up on the transverse
        Mercator projection there (`geometry.geodesy`)

    The same generator state gives the same errors; outages only leave fixes out. Raises UsageError for a rate outside
    1..10 Hz, negative errors or an outage that ends before it starts.
    """
    check_gnss(model)
    count = int(np.floor(end * model.rate_hz + 1e-6)) + 1
    stamps = np.round(np.arange(count) * (1e9 / model.rate_hz)).astype(np.int64)
    times = stamps / 1e9
    antenna = (motion.poses(times) @ T_lidar_gnss)[:, :3, 3]
    error = _errors(model, count, rng)
    seen = np.ones(count, bool)
    for begin, finish in model.outages:
        seen &= (times < begin) | (times > finish)
    fixes = geodesy.from_local(antenna[seen] + error[seen], origin)
    stream = GnssStream(stamps[seen], fixes, np.full(int(seen.sum()), model.sigma))
    return SimulatedGnss(stream, antenna[seen], error[seen], np.asarray(T_lidar_gnss, np.float64))


def check_gnss(model: GnssModel) -> None:
    """Raise UsageError when `model` is out of range."""
    if not 1 <= model.rate_hz <= 10:
        raise UsageError(f"--gnss-rate {model.rate_hz:g} is out of range: 1 to 10 fixes per second")
    if not (min(model.white, model.slow, model.vertical) >= 0 and model.memory > 0):
        raise UsageError("errors of GNSS fixes are at least 0 m, and the time they wander with is above 0 s")
    for begin, finish in model.outages:
        if not finish > begin:
            raise UsageError(f"a GNSS outage from {begin:g} to {finish:g} s is none: it ends after it starts")


def _errors(model: GnssModel, count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) errors east, north, up, m: white, and a first-order Gauss-Markov process in its steady state."""
    from scipy.signal import lfilter

    draws = rng.standard_normal((count, 2, 3))
    keep = float(np.exp(-1 / (model.rate_hz * model.memory)))
    driven = draws[:, 1] * np.sqrt(1 - keep**2)
    driven[:1] = draws[:1, 1]
    slow = np.asarray(lfilter([1.0], [1.0, -keep], driven, axis=0))
    return np.asarray((model.white * draws[:, 0] + model.slow * slow) * [1.0, 1.0, model.vertical])
