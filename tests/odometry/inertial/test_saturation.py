"""Readings at the end of the range: found in the data, filled in with their sigma, and followed in a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config import load_config
from lslam.core.types.imu import GRAVITY, ImuStream
from lslam.odometry.inertial.filter import PLACE, SPEED, TURN, NavigationState
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_cleaning import clean, fill_saturation
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.pipeline.run import run
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
LIMIT = np.deg2rad(250)


def turning(peak_deg: float, limit: float = LIMIT, noise: float = 1e-4) -> tuple[ImuStream, ImuStream]:
    """Six seconds of turns to and fro, as they are and as an IMU of a limited range reads them."""
    rng, t = np.random.default_rng(0), np.arange(600) * 0.01
    gyro = np.zeros((600, 3))
    gyro[:, 1] = np.deg2rad(peak_deg) * np.sin(2 * np.pi * 0.9 * t)
    accel = np.tile([0.0, 0.0, GRAVITY], (600, 1)) + rng.normal(0, 0.02, (600, 3))
    whole = ImuStream((t * 1e9).astype(np.int64), accel, gyro + rng.normal(0, noise, gyro.shape))
    return whole, ImuStream(whole.stamps_ns, accel, np.clip(whole.gyro, -limit, limit))


@pytest.mark.parametrize("peak_deg", [300.0, 360.0])
def test_saturated_readings_are_filled_in_within_their_sigma(peak_deg: float) -> None:
    whole, read = turning(peak_deg)
    notes: list[str] = []
    filled = fill_saturation(read, notes)
    assert filled.clipping_sigma is not None
    cut = np.abs(read.gyro[:, 1]) >= LIMIT
    np.testing.assert_array_equal(filled.clipping_sigma[:, 4] > 0, cut)
    np.testing.assert_array_equal(filled.gyro[~cut], read.gyro[~cut])
    np.testing.assert_array_equal(filled.accel, read.accel)
    before, after = (np.sqrt(np.mean((s.gyro[cut, 1] - whole.gyro[cut, 1]) ** 2)) for s in (read, filled))
    assert after < 0.5 * before
    assert np.mean(np.abs(filled.gyro[cut, 1] - whole.gyro[cut, 1]) < 2 * filled.clipping_sigma[cut, 4]) > 0.9
    assert len(notes) == 1
    assert f"{int(cut.sum())} at the 4.363 rad/s of its gyroscope" in notes[0]


def test_an_extreme_of_noise_is_not_the_end_of_the_range() -> None:
    whole, _ = turning(360.0)
    notes: list[str] = []
    assert fill_saturation(whole, notes) is whole
    assert not notes


BIT = LIMIT / 2**15


def of_16_bits(rates: Floats, scales: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Floats:
    """Rates (M, 3) as whole numbers from -32768 to +32767 give them, by a scale of each axis."""
    return np.asarray(np.clip(np.round(rates / BIT), -(2**15), 2**15 - 1) * BIT * np.array(scales))


def test_both_ends_of_an_asymmetric_range_are_filled_in() -> None:
    whole, _ = turning(360.0)
    read = replace(whole, gyro=of_16_bits(whole.gyro))
    filled = fill_saturation(read, [])
    assert filled.clipping_sigma is not None
    upper, lower = read.gyro[:, 1] >= LIMIT - BIT, read.gyro[:, 1] <= -LIMIT
    np.testing.assert_array_equal(filled.clipping_sigma[:, 4] > 0, upper | lower)
    means = [float(np.mean(s.gyro[:, 1])) for s in (whole, read, filled)]
    assert abs(means[2] - means[0]) < abs(means[1] - means[0]), "one half alone turns the heading"


def test_every_axis_has_its_own_range() -> None:
    """The third comes to its end for a sample at a time only: that the others stay there tells what it is."""
    rates = np.tile(turning(360.0)[0].gyro[:, 1:2], 3)
    rates[:, 2] = 0.0
    rates[7::50, 2] = 2 * LIMIT
    read = replace(turning(360.0)[0], gyro=of_16_bits(rates, (1.0, 0.99, 1.0)))
    filled = fill_saturation(read, [])
    assert filled.clipping_sigma is not None
    np.testing.assert_array_equal(filled.clipping_sigma[:, 3:] > 0, (rates >= LIMIT - BIT) | (rates <= -LIMIT))


def resting(coarse: float) -> Floats:
    """The first axis at its end, the second at rest in steps of `coarse`, the third without a sensor."""
    rng, gyro = np.random.default_rng(1), np.zeros((600, 3))
    gyro[:, 0] = turning(360.0)[1].gyro[:, 1]
    gyro[:, 1] = np.round(rng.normal(0, 0.6 * coarse, 600) / coarse) * coarse
    return gyro


@pytest.mark.parametrize("coarse", [BIT, np.deg2rad(1.0), np.deg2rad(20.0)])
def test_an_axis_at_rest_and_one_of_nothing_are_at_no_end(coarse: float) -> None:
    whole, _ = turning(360.0)
    filled = fill_saturation(replace(whole, gyro=resting(coarse)), [])
    assert filled.clipping_sigma is not None
    assert filled.clipping_sigma[:, 3].any()
    assert not filled.clipping_sigma[:, 4:].any()
    alone = replace(whole, gyro=resting(coarse) * np.array([0.0, 1.0, 1.0]))
    assert fill_saturation(alone, []) is alone


def test_a_steady_turn_is_no_end_where_another_axis_reads_more() -> None:
    whole, read = turning(360.0)
    gyro = read.gyro.copy()
    gyro[:, 2] = np.clip(np.arange(600) * BIT * 100, 0.0, 0.7 * LIMIT)
    filled = fill_saturation(replace(whole, gyro=gyro), [])
    assert filled.clipping_sigma is not None
    assert filled.clipping_sigma[:, 4].any()
    assert not filled.clipping_sigma[:, 5].any()


def test_the_smooth_top_of_a_coarse_reading_is_no_end_of_the_range() -> None:
    """At 1 kHz and half a degree per second a turn stays on its highest bit for many samples; on the next for less."""
    t = np.arange(5000) * 1e-3
    step = np.deg2rad(0.5)
    rates = np.deg2rad(200.3) * np.sin(2 * np.pi * np.outer(t, [0.7, 0.9, 1.1]))
    accel = np.tile([0.0, 0.0, GRAVITY], (5000, 1))
    smooth = ImuStream(np.round(1e9 * t).astype(np.int64), accel, np.round(rates / step) * step)
    assert np.count_nonzero(smooth.gyro == smooth.gyro.max()) > 50
    assert fill_saturation(smooth, []) is smooth


def test_filled_in_readings_do_not_define_a_range() -> None:
    _, read = turning(400.0)
    once = clean(read, 0, int(5e9))
    again = clean(once.imu, 0, int(5e9))
    assert once.imu.clipping_sigma is not None
    assert again.imu.clipping_sigma is not None
    np.testing.assert_array_equal(again.imu.clipping_sigma, once.imu.clipping_sigma)
    np.testing.assert_array_equal(again.imu.gyro, once.imu.gyro)


def test_only_a_step_over_saturated_readings_has_a_larger_covariance() -> None:
    _, read = turning(400.0)
    filled = fill_saturation(read, [])
    none = np.zeros(3)
    estimate = ImuEstimate(none, np.array([0, 0, -GRAVITY]), none, Gyroscope.of_bias(none, 1e-3), 1e-4 * np.eye(9))
    state = NavigationState.begin(np.eye(4), estimate)
    at = np.abs(read.gyro[:, 1]) >= LIMIT
    cut = int(np.flatnonzero(at[1:] & ~at[:-1])[1]) + 1
    calm, blind = ((int(read.stamps_ns[k]), int(read.stamps_ns[k + 10])) for k in (cut - 20, cut))
    sigmas = []
    for stream, span in ((read, calm), (filled, calm), (read, blind), (filled, blind)):
        P = state.propagate(estimate.over(stream, np.array(span))).covariance
        sigmas.append([np.sqrt(np.diag(P[part, part])) for part in (PLACE, TURN, SPEED)])
    np.testing.assert_array_equal(sigmas[0], sigmas[1])
    assert filled.clipping_sigma is not None
    hidden = filled.clipping_sigma[cut - 1 : cut + 11, 4].mean()
    assert sigmas[3][1][1] == pytest.approx(np.hypot(sigmas[2][1][1], 0.1 * hidden), rel=0.05)
    assert sigmas[3][2][0] > 2 * sigmas[2][2][0], "a force that is turned wrongly leads astray"


def test_one_wrong_position_rings_in_no_later_velocity() -> None:
    """While forces are cut off, the velocity is that of the positions found: it forgets one that was wrong by a centimetre."""
    stamps, none = np.arange(200, dtype=np.int64) * 10_000_000, np.zeros(3)
    accel = np.tile([0.0, 0.0, GRAVITY], (200, 1))
    blind = ImuStream(stamps, accel, np.zeros((200, 3)), np.tile([5.0, 5.0, 5.0, 0.0, 0.0, 0.0], (200, 1)))
    estimate = ImuEstimate(none, np.array([0, 0, -GRAVITY]), none, Gyroscope.of_bias(none, 1e-3), 1e-4 * np.eye(9))
    state, sure, speeds = NavigationState.begin(np.eye(4), estimate), 1e-6 * np.eye(6), []
    for k in range(18):
        T = np.eye(4)
        T[0, 3] = 0.01 if k == 5 else 0.0
        step = state.estimate.over(blind, stamps[[10 * k, 10 * k + 10]])
        state = state.propagate(step).moved_to(T, sure)
        speeds.append(float(np.linalg.norm(state.estimate.velocity)))
    assert speeds[5] > 0.1
    assert speeds[-1] < 0.01 * speeds[5]


def test_white_noise_of_a_cut_is_that_of_many_short_steps() -> None:
    """A rate that is hidden over a tenth of a second, as one step and as a hundred of them with errors of their own."""
    stamps, none, n = np.arange(101, dtype=np.int64) * 1_000_000, np.zeros(3), 100
    accel = np.tile([2.0, -1.0, GRAVITY], (101, 1))
    estimate = ImuEstimate(none, np.array([0, 0, -GRAVITY]), none, Gyroscope.of_bias(none, 1e-9), 1e-18 * np.eye(9))
    sigma = np.array([3.0, 2.0, 1.0, 0.3, 0.2, 0.1])
    found = []
    for parts in (1, n):
        hidden = np.tile(sigma * np.sqrt(parts), (101, 1))
        states = [NavigationState.begin(np.eye(4), estimate) for _ in range(2)]
        for k in range(parts):
            at = stamps[[k * n // parts, (k + 1) * n // parts]]
            states = [
                state.propagate(state.estimate.over(ImuStream(stamps, accel, np.zeros((101, 3)), lacks), at))
                for state, lacks in zip(states, (None, hidden), strict=True)
            ]
        found.append((states[1].covariance - states[0].covariance)[:9, :9])
    scale = np.sqrt(np.diag(found[1]))
    np.testing.assert_allclose(found[0] / np.outer(scale, scale), found[1] / np.outer(scale, scale), atol=0.03)


def test_saturation_adds_its_sigma_to_velocity_and_rotation() -> None:
    """A force and a rate hidden all the time lead as far astray as a constant error of one sigma."""
    stamps, none = np.arange(11, dtype=np.int64) * 10_000_000, np.zeros(3)
    accel = np.tile([0.0, 0.0, GRAVITY], (11, 1))
    seen = ImuStream(stamps, accel, np.zeros((11, 3)))
    blind = replace(seen, clipping_sigma=np.tile([0.0, 3.0, 0.0, 0.0, 0.0, 0.5], (11, 1)))
    estimate = ImuEstimate(none, np.array([0, 0, -GRAVITY]), none, Gyroscope.of_bias(none, 1e-3), 1e-4 * np.eye(9))
    steps = [estimate.over(stream, stamps[[0, -1]]) for stream in (seen, blind)]
    speeds = [estimate.propagate(step, np.eye(3)).covariance[:3, :3] for step in steps]
    turns = [estimate.gyroscope.turn_covariance(step) for step in steps]
    np.testing.assert_allclose(speeds[1] - speeds[0], (0.1 * 3.0) ** 2 * np.eye(3), atol=1e-9)
    np.testing.assert_allclose(turns[1] - turns[0], (0.1 * 0.5) ** 2 * np.eye(3), atol=1e-9)
    np.testing.assert_allclose([step.hidden_density for step in steps], [(0.0, 0.0), (0.9, 0.025)])


def test_a_flight_with_saturated_readings_is_followed_and_reported() -> None:
    """Two thirds of its readings sit at 2 g and a tenth at 250 deg/s from the third second on."""
    drive = simulate("quadrotor", lidar="vlp16", count=60, imu="icm20948", motion_compensated=False)
    settings = ["odometry.method=fast-lio2", "loops.use=false", "map.write=false"]
    outcome = run(drive, load_config(None, settings, {}))
    assert all(r.status == "ok" for r in outcome.record.results)
    assert outcome.evaluation is not None
    ate = outcome.evaluation.ate["se3"].translation
    assert ate is not None
    assert ate.rmse < 0.15
    assert "the end of the range" in str(outcome.record.manifest["imu"]["decisions"])
