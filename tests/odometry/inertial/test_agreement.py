"""The comparison of rotations of gyroscope and registration under registration's noise: a car in gentle bends."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.geometry import se3, so3
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.agreement import Agreement, _hardly_turning, check_agreement, turns
from lslam.odometry.inertial.imu_cleaning import ImuRefusedError

IMU_NS, SCAN_NS = 10_000_000, 100_000_000


def compared(
    noise_deg: float,
    seed: int,
    factor: float = 1.0,
    weave_deg_s: float = 4.0,
    late_s: float = 0.0,
    weave_hz: float = 0.4,
) -> Agreement:
    """Five seconds at 10 Hz of bends of so many deg/s about z, seen with white noise, felt `factor` times."""
    rng = np.random.default_rng(seed)
    stamps = np.arange(0, 52 * SCAN_NS, IMU_NS)
    gyro = np.zeros((len(stamps), 3))
    gyro[:, 2] = np.deg2rad(weave_deg_s) * np.sin(2 * np.pi * weave_hz * 1e-9 * stamps)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (gyro[1:, 2] + gyro[:-1, 2])) * 1e-9 * IMU_NS])[:: SCAN_NS // IMU_NS][
        :50
    ]
    R = so3.exp(yaw[:, None] * [0.0, 0, 1]) @ so3.exp(np.deg2rad(noise_deg) * rng.normal(size=(50, 3)))
    gyro = factor * gyro + rng.normal(0, 1e-3, gyro.shape) + [0.01, -0.02, 0.005]
    imu = ImuStream(stamps + round(1e9 * late_s), np.zeros((len(stamps), 3)), gyro)
    return check_agreement(imu, np.eye(4), SCAN_NS * np.arange(50), se3.make(R, np.zeros((50, 3))), None)


@pytest.mark.parametrize("noise_deg", [0.0, 0.05, 0.2, 0.3])
def test_a_correct_gyroscope_correlates_with_noisy_registration(noise_deg: float) -> None:
    """From scan to scan 0.2 deg are 5 deg/s of noise beside turns of 3: over a few scans the turns stand out."""
    for seed in range(5):
        found = compared(noise_deg, seed)
        assert found.is_judged
        assert found.correlation > 0.85
        assert found.offset_s == 0.0
        assert found.gyro_bias is not None
        np.testing.assert_allclose(found.gyro_bias, [0.01, -0.02, 0.005], atol=3e-3)


@pytest.mark.parametrize(
    ("factor", "says"),
    [(57.3, "deg/s"), (3.0, r"vary 2\.[5-9] times"), (0.3, r"vary 0\.2[3-9] times"), (-1.0, "do not fit")],
)
def test_a_wrong_gyroscope_is_refused_with_noisy_registration(factor: float, says: str) -> None:
    for seed in range(5):
        with pytest.raises(ImuRefusedError, match=says):
            compared(0.2, seed, factor)


def test_a_time_offset_is_estimated_with_noisy_registration() -> None:
    for seed in range(5):
        found = compared(0.1, seed, weave_deg_s=20.0, late_s=0.1)
        assert found.offset_s == pytest.approx(-0.1, abs=4 * found.offset_sigma_s)
        assert found.offset_sigma_s < 0.02


@pytest.mark.parametrize("late_s", [0.0165, 0.0175, -0.021])
def test_a_time_offset_is_interpolated_between_the_offsets_tried(late_s: float) -> None:
    """Those are 5 ms apart."""
    found = compared(0.0, 0, weave_deg_s=20.0, late_s=late_s)
    assert found.offset_s == pytest.approx(-late_s, abs=4e-4)


def test_rotations_below_the_noise_are_not_judged() -> None:
    """They would pass for an IMU whose rates are too small; quick ones, for turns that no scan shows. Degrees are too many."""
    for seed in range(5):
        assert not compared(0.2, seed, weave_deg_s=0.5).is_judged
        assert not compared(1.5, seed, weave_deg_s=25.0, weave_hz=3.3).is_judged
        with pytest.raises(ImuRefusedError, match=r"check its unit"):
            compared(0.2, seed, 57.3, weave_deg_s=0.8)


@pytest.mark.parametrize(
    ("felt", "shown", "is_refused"), [(11.5, 0.5, False), (12.5, 0.5, True), (19.0, 10.0, False), (21.0, 10.0, True)]
)
def test_a_gyroscope_with_twice_the_rate_variation_of_the_scans_is_refused(
    felt: float, shown: float, is_refused: bool
) -> None:
    """Deg/s about one axis; of less than twelve nothing is told. Scans need not have turned about the others."""
    side = np.where(np.arange(40) % 2, 1.0, -1.0)[:, None] * [0.0, 0.0, 1.0]
    rates = np.deg2rad(felt) * side + [0.01, 0.0, 0.0], np.deg2rad(shown) * side
    if is_refused:
        with pytest.raises(ImuRefusedError, match=f"vary by {felt:.1f} deg/s, those of the scans by {shown:.1f}"):
            _hardly_turning(*rates, np.eye(4))
    else:
        found = _hardly_turning(*rates, np.eye(4))
        assert not found.is_judged
        np.testing.assert_allclose(found.gyro_bias, [0.01, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(("scans", "heard", "is_told"), [(41, 19, False), (41, 20, True), (7, 5, True), (7, 4, False)])
def test_rotations_are_compared_when_samples_cover_half_of_them_and_at_least_five(
    scans: int, heard: int, is_told: bool
) -> None:
    """Turns from scan to scan at 10 Hz, of which the stream reaches over so many."""
    stamps, yaw = SCAN_NS * np.arange(scans), 0.02 * np.arange(scans) ** 2
    samples = np.arange(0, heard * SCAN_NS + 1, IMU_NS)
    gyro = np.zeros((len(samples), 3))
    gyro[:, 2] = 4e-9 * samples
    poses = se3.make(so3.exp(yaw[:, None] * [0.0, 0, 1]), np.zeros((scans, 3)))
    seen, felt = turns(ImuStream(samples, np.zeros_like(gyro), gyro), np.eye(4), stamps, poses, 0.0)
    assert len(seen) == len(felt) == (heard if is_told else 0)
    np.testing.assert_allclose(felt, seen, atol=1e-9)
