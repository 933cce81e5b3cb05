"""Fixes of a satellite receiver: where the antenna is, how they err, and when there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import UsageError
from lslam.core.geometry import geodesy, se3, so3
from lslam.simulation.kinematics import Motion, smooth_motion
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.sensors import ORIGIN, T_CAR_ANTENNA, GnssModel, SimulatedGnss, simulate_gnss

SHARES_TOWNS = True

Floats = NDArray[np.float64]

EXACT = GnssModel(white=0.0, slow=0.0)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("street", seed=1, count=200)


class Parked:
    duration = 20_000.0
    T = se3.make(so3.from_euler_rpy(np.array([0.0, 0.1, 2.0])), np.array([120.0, -80.0, 3.0]))

    def poses(self, times: Floats) -> Floats:
        return np.broadcast_to(self.T, (len(times), 4, 4))


@pytest.fixture(scope="module")
def parked() -> Motion:
    return smooth_motion(Parked(), spacing=50.0)


def fixes(motion: Motion, model: GnssModel, end: float, seed: int = 0, T: Floats = T_CAR_ANTENNA) -> SimulatedGnss:
    return simulate_gnss(motion, model, T, ORIGIN, end, np.random.default_rng(seed))


def test_exact_fixes_are_where_the_antenna_is(drive: SimulatedDrive) -> None:
    """Through WGS84 and back to the city, lever arm included."""
    gnss = fixes(drive.vehicle, replace(EXACT, rate_hz=10.0), 20.0)
    lidar = drive.vehicle.poses(gnss.stream.stamps_ns / 1e9)
    antenna = lidar[:, :3, 3] + lidar[:, :3, :3] @ T_CAR_ANTENNA[:3, 3]
    local = geodesy.to_local(gnss.stream.lat_lon_alt, ORIGIN)
    np.testing.assert_allclose(local, antenna, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(local - lidar[:, :3, 3], axis=1), np.hypot(0.9, 0.15), atol=1e-6)
    assert len(gnss.stream) == 201


def test_city_is_east_north_up_on_the_ellipsoid(parked: Motion) -> None:
    """120 m east and 80 m south of the origin, by the ellipsoid's radii of curvature there."""
    gnss = fixes(parked, EXACT, 1.0, T=np.eye(4))
    a, e2 = 6378137.0, 0.00669437999014
    sin2 = np.sin(np.radians(ORIGIN[0])) ** 2
    east = a / np.sqrt(1 - e2 * sin2) * np.cos(np.radians(ORIGIN[0]))
    north = a * (1 - e2) / (1 - e2 * sin2) ** 1.5
    lat, lon, height = gnss.stream.lat_lon_alt[0]
    assert (lon - ORIGIN[1]) * np.radians(1) * east == pytest.approx(120.0, abs=0.01)
    assert (lat - ORIGIN[0]) * np.radians(1) * north == pytest.approx(-80.0, abs=0.01)
    assert height == pytest.approx(118.0, abs=1e-6)


@pytest.mark.parametrize("rate_hz", [1.0, 4.0, 10.0])
def test_fixes_come_at_their_rate(drive: SimulatedDrive, rate_hz: float) -> None:
    stamps = fixes(drive.vehicle, replace(EXACT, rate_hz=rate_hz), 20.0).stream.stamps_ns
    np.testing.assert_array_equal(stamps, np.arange(20 * rate_hz + 1) * round(1e9 / rate_hz))


def test_white_noise_has_its_sigma_and_no_memory(parked: Motion) -> None:
    gnss = fixes(parked, GnssModel(10.0, white=0.5, slow=0.0, vertical=2.0), 3000.0)
    error = geodesy.to_local(gnss.stream.lat_lon_alt, ORIGIN) - gnss.antenna
    np.testing.assert_allclose(error, gnss.error, atol=1e-6)
    np.testing.assert_allclose(error.std(axis=0), [0.5, 0.5, 1.0], rtol=0.03)
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=0.02)
    assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 0.03
    np.testing.assert_array_equal(gnss.stream.sigma, 0.5)


def test_slow_error_wanders_with_its_time_constant(parked: Motion) -> None:
    """A Gauss-Markov process: its deviation from the first fix on, its correlation exp(-t / memory)."""
    model = GnssModel(1.0, white=0.0, slow=0.8, memory=20.0, vertical=1.0)
    error = fixes(parked, model, 20_000.0).error
    np.testing.assert_allclose(error.std(axis=0), 0.8, rtol=0.1)
    for lag in (5, 20):
        correlation = np.mean(error[lag:] * error[:-lag]) / np.mean(error**2)
        assert correlation == pytest.approx(np.exp(-lag / 20), abs=0.06)
    first = np.array([fixes(parked, model, 1.0, seed).error[0] for seed in range(400)])
    assert first.std() == pytest.approx(0.8, rel=0.08)


def test_the_stated_sigma_is_that_of_the_errors(parked: Motion) -> None:
    gnss = fixes(parked, GnssModel(memory=10.0), 20_000.0)
    assert np.unique(gnss.stream.sigma).tolist() == [pytest.approx(np.hypot(0.3, 0.8))]
    assert gnss.error[:, :2].std() == pytest.approx(gnss.stream.sigma[0], rel=0.05)


def test_outages_are_empty_and_change_nothing_else(drive: SimulatedDrive) -> None:
    model = GnssModel(5.0)
    whole = fixes(drive.vehicle, model, 20.0)
    gaps = fixes(drive.vehicle, replace(model, outages=((3.0, 6.5), (15.0, 99.0))), 20.0)
    times = gaps.stream.stamps_ns / 1e9
    assert not ((times >= 3.0) & (times <= 6.5)).any()
    assert times.max() < 15.0
    kept = np.isin(whole.stream.stamps_ns, gaps.stream.stamps_ns)
    assert (len(gaps.stream), int(kept.sum())) == (57, 57)
    np.testing.assert_array_equal(gaps.stream.lat_lon_alt, whole.stream.lat_lon_alt[kept])
    assert len(fixes(drive.vehicle, replace(model, outages=((0.0, 99.0),)), 20.0).stream) == 0


def test_same_seed_same_fixes(drive: SimulatedDrive) -> None:
    a, b, c = (fixes(drive.vehicle, GnssModel(), 20.0, seed).stream.lat_lon_alt for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert (a != c).all()


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        (GnssModel(0.5), "--gnss-rate 0.5 is out of range: 1 to 10"),
        (GnssModel(20.0), "--gnss-rate 20 is out of range"),
        (GnssModel(float("nan")), "--gnss-rate nan is out of range"),
        (GnssModel(white=-1.0), "at least 0 m"),
        (GnssModel(memory=0.0), "above 0 s"),
        (GnssModel(outages=((5.0, 2.0),)), "from 5 to 2 s is none"),
    ],
)
def test_impossible_receivers_are_refused(drive: SimulatedDrive, model: GnssModel, sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        fixes(drive.vehicle, model, 1.0)


def test_a_drive_carries_it_only_when_asked(drive: SimulatedDrive) -> None:
    assert drive.gnss is None
    assert drive.calibration.T_lidar_gnss is None
    with_gnss = simulate("street", seed=1, count=20, gnss=EXACT)
    assert with_gnss.gnss is not None
    assert with_gnss.calibration.T_lidar_gnss is not None
    antenna = (with_gnss.vehicle.poses(with_gnss.gnss.stamps_ns / 1e9) @ with_gnss.calibration.T_lidar_gnss)[:, :3, 3]
    np.testing.assert_allclose(geodesy.to_local(with_gnss.gnss.lat_lon_alt, ORIGIN), antenna, atol=1e-6)
