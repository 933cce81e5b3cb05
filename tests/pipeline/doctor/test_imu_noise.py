"""The noise of an IMU: of a simulated device that stands and one that moves, against what it was made with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lslam.core.config import load_config
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.gyroscope import USUAL_NOISE, ImuNoise
from lslam.pipeline.doctor.examine_imu import allan_deviation, examine_noise, imu_toml
from lslam.simulation.imu import GRAVITY, Triad, measure

RATE = 100.0
ACCEL = Triad(noise_density=0.003, bias=0.2, bias_walk=1e-3)
GYRO = Triad(noise_density=2e-4, bias=0.05, bias_walk=1e-4)


def device(seconds: float, is_moving: bool = False, seed: int = 0) -> ImuStream:
    """A device that stands, or sways by 40 deg/s and 2 m/s2 at some hertz."""
    count, rng = int(seconds * RATE), np.random.default_rng(seed)
    t = np.arange(count)[:, None] / RATE
    sway = np.sin(2 * np.pi * t * np.array([0.7, 1.1, 1.6])) * is_moving
    accel, _ = measure(ACCEL, np.array([0.0, 0.0, GRAVITY]) + 2.0 * sway, rng.standard_normal((count, 2, 3)), RATE)
    gyro, _ = measure(GYRO, 0.7 * sway, rng.standard_normal((count, 2, 3)), RATE)
    return ImuStream(np.round(t[:, 0] * 1e9).astype(np.int64), accel, gyro)


def test_the_allan_deviation_of_white_noise_and_of_a_random_walk_is_that_of_the_standard() -> None:
    """N / sqrt(tau) and K sqrt(tau / 3), IEEE Std 952."""
    rng = np.random.default_rng(3)
    times, white = allan_deviation(0.5 * np.sqrt(RATE) * rng.standard_normal((40_000, 3)), RATE)
    few = times < 1
    np.testing.assert_allclose(white[few] * np.sqrt(times[few])[:, None], 0.5, rtol=0.1)
    walk = np.cumsum(0.5 / np.sqrt(RATE) * rng.standard_normal((40_000, 3)), axis=0)
    times, drift = allan_deviation(walk, RATE)
    some = (times > 0.1) & (times < 3)
    np.testing.assert_allclose(drift[some] / np.sqrt(times[some] / 3)[:, None], 0.5, rtol=0.15)


def test_a_device_that_stands_for_long_shows_its_noise_and_the_walk_of_its_bias() -> None:
    found = examine_noise(device(400))
    assert found is not None
    assert (found["method"], found["standing_s"]) == ("allan", pytest.approx(400, abs=20))
    assert found["accel_density"] == pytest.approx(ACCEL.noise_density, rel=0.05)
    assert found["gyro_density"] == pytest.approx(GYRO.noise_density, rel=0.05)
    # White noise and walk are least together at sqrt(3) N / K, where the deviation is sqrt(2 N K / sqrt(3)).
    for kind, triad in (("accel", ACCEL), ("gyro", GYRO)):
        least = np.sqrt(2 * triad.noise_density * triad.bias_walk / np.sqrt(3))
        assert found[f"{kind}_instability"] == pytest.approx(least / np.sqrt(2 * np.log(2) / np.pi), rel=0.3)
        assert found[f"{kind}_walk"] == pytest.approx(triad.bias_walk, rel=0.5)


def test_standing_for_some_seconds_shows_white_noise_only_and_motion_no_more_by_differences() -> None:
    shortly, moving = examine_noise(device(20)), examine_noise(device(30, is_moving=True))
    assert shortly is not None
    assert moving is not None
    assert (shortly["method"], shortly["gyro_instability"]) == ("allan", None)
    assert (moving["method"], moving["gyro_walk"]) == ("differences", None)
    for found in (shortly, moving):
        assert found["accel_density"] == pytest.approx(ACCEL.noise_density, rel=0.1)
        assert found["gyro_density"] == pytest.approx(GYRO.noise_density, rel=0.1)


def test_what_is_written_is_a_configuration_that_the_filters_take(tmp_path: Path) -> None:
    found = examine_noise(device(400))
    assert found is not None
    path = tmp_path / "imu.toml"
    path.write_text(imu_toml(found, "drive"))
    noise = ImuNoise.of(load_config(path, [], {}).imu)
    assert noise.force == pytest.approx(found["accel_density"], rel=1e-3)
    assert noise.gyro_walk == pytest.approx(found["gyro_walk"], rel=1e-3)
    moving = examine_noise(device(30, is_moving=True))
    assert moving is not None
    path.write_text(imu_toml(moving, "drive"))
    assert ImuNoise.of(load_config(path, [], {}).imu).accel_walk == USUAL_NOISE.accel_walk, (
        "what is not seen stays as it is"
    )


def test_short_streams_and_streams_of_unknown_unit_have_no_noise_estimate() -> None:
    assert examine_noise(device(0.3)) is None
    whole = device(20)
    assert examine_noise(ImuStream(whole.stamps_ns, whole.accel * 0.3, whole.gyro)) is None, "of unknown unit"


def test_an_implausible_noise_is_not_written() -> None:
    facts = {
        "method": "differences", "standing_s": 0.0, "accel_density": 8e-13, "gyro_density": 2e-4, "accel_walk": None,
        "gyro_walk": None,
    }  # fmt: skip
    assert imu_toml(facts, "drive").splitlines()[1:] == ["[imu]", "gyro_noise = 0.0002"]
