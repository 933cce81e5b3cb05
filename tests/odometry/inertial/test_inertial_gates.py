"""The gates on an IMU: just inside and just outside of each."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import Stub

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.kernels.linearisation import RARE_SIGMAS
from lslam.core.types.imu import ImuStream
from lslam.odometry.frontend.inertial_start import _require_rate
from lslam.odometry.inertial.agreement import check_agreement
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_cleaning import ImuRefusedError, clean
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.initialise import FirstPoses, _fit_velocity_and_gravity, _is_static
from lslam.odometry.kernels import kalman
from lslam.pipeline.doctor import Findings
from lslam.pipeline.doctor.examine_imu import examine_imu

Floats = NDArray[np.float64]
IMU_NS, SCAN_NS = 10_000_000, 100_000_000


@pytest.mark.parametrize(("sigmas", "gain"), [(3.9, 1 / 2), (-3.9, 1 / 2), (8.0, 1 / 5), (40.0, 1 / 101)])
def test_an_outlier_begins_beyond_four_sigmas(sigmas: float, gain: float) -> None:
    """Prior and measurement of one variance each, so that sigma is sqrt(2): at 8 of them the noise is 4 times as large."""
    rest = sigmas * np.sqrt(2.0)
    x, P = kalman.update(np.zeros(1), np.eye(1), np.eye(1), np.array([rest]), np.eye(1), RARE_SIGMAS)
    assert x[0] == pytest.approx(gain * rest)
    assert P[0, 0] == pytest.approx(1 - gain)


def test_without_measurements_gravity_and_bias_walk_as_configured() -> None:
    """2 mm/s2 of the accelerometer's bias and 5 mm/s2 of gravity in a second, as the root of time; speed by shaking."""
    for seconds in (1, 4):
        stamps = np.arange(0, seconds * 1_000_000_000 + 1, IMU_NS)
        imu = ImuStream(stamps, np.tile([0.0, 0.0, 9.8], (len(stamps), 1)), np.zeros((len(stamps), 3)))
        before = ImuEstimate(np.zeros(3), np.array([0, 0, -9.8]), np.zeros(3), Gyroscope(np.zeros(3)), np.zeros((9, 9)))
        after = before.propagate(before.over(imu, stamps[[0, -1]]), np.eye(3))
        sigmas = np.sqrt(np.diag(after.covariance) / seconds)
        np.testing.assert_allclose(sigmas, np.repeat([0.05, 5e-3, 2e-3], 3), rtol=1e-6)


@pytest.mark.parametrize(
    ("rate_hz", "is_refused"), [(50 * (1 - 20e-6), False), (48.0, False), (47.0, True), (10.0, True)]
)
def test_the_least_rate_tolerates_a_slow_clock(rate_hz: float, is_refused: bool) -> None:
    """By 20 ppm here: the method, the note of a run and `info` agree."""
    stamps = np.round(np.arange(120) * 1e9 / rate_hz).astype(np.int64)
    shaken = np.random.default_rng(0).normal(0, 0.01, (2, 120, 3))
    imu = ImuStream(stamps, np.array([0.0, 0.0, 9.8]) + shaken[0], shaken[1])
    sequence, findings = Stub(["no scan"] * 20, imu=imu), Findings()
    if is_refused:
        with pytest.raises(InputError, match=r"an IMU of 50 Hz or more, this one has (47|10)\.0 Hz"):
            _require_rate(sequence, imu, "fast-lio2")
    else:
        _require_rate(sequence, imu, "fast-lio2")
    assert any("degrades" in note for note in clean(imu, 0, 2_000_000_000).notes) is is_refused
    examine_imu(sequence, findings)
    assert ("imu-rate" in {finding.code for finding in findings}) is is_refused


def tumbling(noise_deg: float, turned_deg: float = 0.0, mirrored: int = 1) -> None:
    """Twelve seconds of turns about all axes, least about z, seen with white noise from scan to scan.

    turned_deg : of the axes of the gyroscope about (1, 1, 1); mirrored : -1 when its z points the other way
    """
    rng = np.random.default_rng(4)
    stamps = np.arange(0, 12_100_000_000, IMU_NS)
    t = 1e-9 * stamps
    rates = np.column_stack([np.sin(1.7 * t), np.sin(2.3 * t + 1), 0.4 * np.sin(2.9 * t + 2)]) / 2
    R = [np.eye(3)]
    for w in 0.5 * (rates[1:] + rates[:-1]) * 1e-9 * IMU_NS:
        R.append(R[-1] @ so3.exp(w))
    every = SCAN_NS // IMU_NS
    seen = np.array(R)[::every][:120] @ so3.exp(np.deg2rad(noise_deg) * rng.normal(size=(120, 3)))
    axes = so3.exp(np.deg2rad(turned_deg) * np.ones(3) / np.sqrt(3.0)) @ np.diag([1.0, 1.0, mirrored])
    imu = ImuStream(stamps, np.zeros_like(rates), rates @ axes.T)
    check_agreement(imu, np.eye(4), SCAN_NS * np.arange(120), se3.make(seen, np.zeros((120, 3))), 0.0)


@pytest.mark.parametrize(
    ("noise_deg", "turned_deg", "mirrored", "says"),
    [
        (0.05, 19.0, 1, ""),
        (0.05, 22.0, 1, "turned by 22 deg"),
        (0.2, 25.0, 1, "turned by 25 deg"),
        (0.3, 25.0, 1, ""),
        (0.3, 0.0, -1, "when mirrored"),
        (0.5, 0.0, -1, ""),
    ],
)
def test_wrong_axes_are_refused_when_others_fit_four_times_as_well(
    noise_deg: float, turned_deg: float, mirrored: int, says: str
) -> None:
    """And be 20 deg off. What is left about the given axes is 5.7 and 3.1 times what is left about those turned by 25 deg,
    5.9 and 2.7 times what is left when mirrored: the noise of registration is half of a mounting that is a little askew."""
    if says:
        with pytest.raises(ImuRefusedError, match=says):
            tumbling(noise_deg, turned_deg, mirrored)
    else:
        tumbling(noise_deg, turned_deg, mirrored)


@pytest.mark.parametrize(
    ("moved", "turned", "at", "stands"),
    [
        (0.045, 0.0, 1, True),
        (0.055, 0.0, 1, False),
        (0.0, 0.0045, 9, True),
        (0.0, 0.0055, 9, False),
        (9.0, 1.0, 10, True),
    ],
)
def test_a_static_start_neither_moves_nor_turns_for_a_second(
    moved: float, turned: float, at: int, stands: bool
) -> None:
    """Scan `at` of ten in a second lies so many m and rad off: 5 cm, or what moves a point 10 m away as far."""
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[at] = se3.make(so3.exp(np.array([0.0, 0.0, turned])), np.array([0.0, moved, 0.0]))
    stamps = SCAN_NS * np.arange(20)
    assert _is_static(FirstPoses(stamps, poses, stamps, poses)) == stands


@pytest.mark.parametrize(("first_scan", "stands"), [(0, True), (1, False), (2, False)])
def test_a_static_start_needs_three_scans(first_scan: int, stands: bool) -> None:
    """Within a second of the first one: a scan by itself has not moved."""
    stamps = np.array([0, 600_000_000, 900_000_000, 1_650_000_000])[first_scan:]
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    assert _is_static(FirstPoses(stamps, poses, stamps, poses)) == stands


def test_the_sigma_of_the_first_velocity_follows_the_noise_of_the_scans() -> None:
    """A sensor at rest whose places are seen with white noise of 0.2 m: the speed that they fit errs by as much as is said."""
    stamps = np.arange(0, 3_100_000_000, IMU_NS)
    imu = ImuStream(stamps, np.tile([0.0, 0.0, 9.8], (len(stamps), 1)), np.zeros((len(stamps), 3)))
    known = ImuEstimate(np.zeros(3), np.array([0, 0, -9.8]), np.zeros(3), Gyroscope(np.zeros(3)), np.zeros((9, 9)))
    rng, found = np.random.default_rng(0), []
    for _ in range(200):
        noise = 0.2 * rng.normal(size=(31, 3))
        poses = se3.make(np.tile(np.eye(3), (31, 1, 1)), noise - noise[0])
        velocity, _, sigma = _fit_velocity_and_gravity(imu, poses, SCAN_NS * np.arange(31), known, 3.0)
        # Where the first place lies is taken as known: what it is wrong by is no noise of the path.
        t = 0.1 * np.arange(30)
        found.append((np.linalg.norm(velocity + (t.sum() / (t @ t)) * noise[0]), sigma))
    errors, sigmas = np.sqrt(np.mean(np.square(found), axis=0))
    assert errors == pytest.approx(np.sqrt(3) * 0.2 / np.sqrt(t @ t), rel=0.1)
    assert errors < sigmas < 1.6 * errors


@pytest.mark.parametrize(("scan_ns", "used"), [(SCAN_NS, 8), (3 * SCAN_NS, 4)])
def test_the_first_velocity_is_that_of_the_first_scans_alone(scan_ns: int, used: int) -> None:
    """Of 0.8 s, or of four scans where they are slow; 3 m/s, and whatever becomes of the path from then on."""
    stamps = np.arange(0, 3_100_000_000, IMU_NS)
    imu = ImuStream(stamps, np.tile([0.0, 0.0, 9.8], (len(stamps), 1)), np.zeros((len(stamps), 3)))
    known = ImuEstimate(np.zeros(3), np.array([0, 0, -9.8]), np.zeros(3), Gyroscope(np.zeros(3)), np.zeros((9, 9)))
    scans = scan_ns * np.arange(10)
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = 3e-9 * scans
    for spoilt, is_right in ((used, True), (used - 1, False)):
        poses[spoilt:, 1, 3] = 0.5
        velocity, _, sigma = _fit_velocity_and_gravity(imu, poses, scans, known, 0.8)
        assert (np.abs(velocity - [3.0, 0.0, 0.0]).max() < 1e-6) == is_right
        assert (sigma < 1e-6) == is_right


@pytest.mark.parametrize("seed", range(8))
def test_a_flat_correlation_gives_no_time_offset(seed: int) -> None:
    """A turn that grows evenly, all but, felt 0.3 s too late: the best of a quarter of a second is none.

    About its one axis any rotation fits, which one is a matter of rounding: it says nothing about the mounting.
    """
    stamps = np.arange(0, 13_000_000_000, IMU_NS)
    t, scans = 1e-9 * stamps, SCAN_NS * np.arange(5, 125)
    growth, bias = np.array([0.0, 0.05, 0.2]), np.array([0.01, -0.02, 0.005])
    imu = ImuStream(stamps + 300_000_000, np.zeros((len(t), 3)), np.outer(t + 0.02 * t**2, growth) + bias)
    angles = np.outer(0.5 * (1e-9 * scans) ** 2 + 0.02 / 3 * (1e-9 * scans) ** 3, growth)
    angles += np.random.default_rng(seed).normal(0, 1e-12, angles.shape)
    found = check_agreement(imu, np.eye(4), scans, se3.make(so3.exp(angles), np.zeros((120, 3))), None)
    assert found.is_judged
    assert found.correlation > 0.999
    assert found.offset_s == 0.0


def test_the_sigma_of_gravity_covers_the_earth() -> None:
    """From 9.764 m/s2 on Huascaran to 9.834 at sea in the Arctic: beyond one sigma, within two. Its direction stays free."""
    stamps = np.arange(0, 100_000_001, IMU_NS)
    imu = ImuStream(stamps, np.tile([0.0, 0.0, 9.8], (len(stamps), 1)), np.zeros((len(stamps), 3)))
    unknown = np.diag(np.repeat([0.0, 1.0, 0.0], 3))
    before = ImuEstimate(np.zeros(3), np.array([0, 0, -9.8]), np.zeros(3), Gyroscope(np.zeros(3)), unknown)
    step = before.over(imu, stamps[[0, -1]])
    after = before.correct(imu, step, np.eye(3), np.eye(3), np.zeros(3), before.gyroscope, 1e9 * np.eye(3))
    sigmas = np.sqrt(np.diag(after.covariance)[3:6])
    np.testing.assert_allclose(sigmas[:2], 1.0, rtol=1e-3)
    assert sigmas[2] < 9.80665 - 9.764 < 2 * sigmas[2]
