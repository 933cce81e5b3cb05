"""The IMU's physics: it integrates back to the path, feels gravity, and errs as its data sheet says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import ImuStream
from lslam.simulation.imu import (
    GRAVITY,
    IMUS,
    T_CAR_IMU,
    T_OUSTER_IMU,
    ImuModel,
    SimulatedImu,
    Triad,
    find_imu,
    measure,
    simulate_imu,
)
from lslam.simulation.kinematics import Motion, smooth_motion, standing_start
from lslam.simulation.scenarios import SimulatedDrive, simulate

SHARES_TOWNS = True

Floats = NDArray[np.float64]

IDEAL = ImuModel("ideal")
ICM = IMUS["icm20948"]


@pytest.fixture(scope="module")
def laps() -> SimulatedDrive:
    """A minute of laps round the block: sharp bends, braking, suspension, uneven ground."""
    return simulate("block", seed=2, count=600)


def read(motion: Motion, model: ImuModel, end: float, seed: int = 0) -> SimulatedImu:
    return simulate_imu(motion, model, T_CAR_IMU, end, np.random.default_rng(seed))


def integrate(imu: SimulatedImu) -> tuple[Floats, Floats]:
    """Rotations (M, 3, 3) and positions (M, 3) by the trapezoid rule, from the first true pose and velocity."""
    h = np.diff(imu.stream.stamps_ns)[:, None] * 1e-9
    w, f = imu.stream.gyro, imu.stream.accel
    steps = so3.exp((w[:-1] + w[1:]) / 2 * h)
    R = np.empty((len(imu.stream), 3, 3))
    R[0] = imu.truth.poses[0, :3, :3]
    for k, step in enumerate(steps):
        R[k + 1] = R[k] @ step
    a = np.einsum("nij,nj->ni", R, f) - [0, 0, GRAVITY]
    v = imu.truth.velocity[0] + np.concatenate([np.zeros((1, 3)), np.cumsum((a[:-1] + a[1:]) / 2 * h, axis=0)])
    # The second-order term keeps positions as exact as velocities.
    dp = v[:-1] * h + (2 * a[:-1] + a[1:]) / 6 * h**2
    return R, imu.truth.poses[0, :3, 3] + np.concatenate([np.zeros((1, 3)), np.cumsum(dp, axis=0)])


def drift(motion: Motion, rate_hz: float, end: float = 60.0) -> tuple[float, float]:
    """Largest position error, m, and rotation error, deg, of the integrated noise-free IMU."""
    imu = read(motion, replace(IDEAL, rate_hz=rate_hz), end)
    R, p = integrate(imu)
    turned = np.swapaxes(R, 1, 2) @ imu.truth.poses[:, :3, :3]
    return float(np.linalg.norm(p - imu.truth.poses[:, :3, 3], axis=1).max()), float(
        np.degrees(so3.angle(turned).max())
    )


def test_integrated_at_1_khz_it_reproduces_a_minute_of_the_path(laps: SimulatedDrive) -> None:
    metres, degrees = drift(laps.vehicle, 1000)
    assert metres < 0.02
    assert degrees < 0.01


@pytest.mark.parametrize("scenario", ["quadrotor", "stairs"])
def test_it_reproduces_violent_and_narrow_ways(scenario: str) -> None:
    metres, degrees = drift(simulate(scenario, lidar="vlp16").vehicle, 1000, 14.0)
    assert metres < 0.02
    assert degrees < 0.02


def test_error_falls_by_four_when_the_step_halves(laps: SimulatedDrive) -> None:
    errors = np.array([drift(laps.vehicle, rate) for rate in (50, 100, 200, 400)])
    ratios = errors[:-1] / errors[1:]
    assert (errors[0] > 10 * errors[-1]).all(), "steps that are too fine would measure rounding"
    np.testing.assert_allclose(ratios, 4.0, rtol=0.2)


def test_a_wrong_lever_arm_would_show(laps: SimulatedDrive) -> None:
    """The readings are those at the IMU's place: taken for the LiDAR's they miss the path by far."""
    imu = read(laps.vehicle, replace(IDEAL, rate_hz=1000), 20.0)
    lidar = laps.vehicle.at(imu.stream.stamps_ns / 1e9)
    at_lidar = replace(imu, truth=lidar)
    assert np.linalg.norm(integrate(at_lidar)[1] - lidar.poses[:, :3, 3], axis=1).max() > 1.0


class Tilted:
    """A sensor that stands still, tilted."""

    duration = 4000.0
    T = se3.make(so3.from_euler_rpy(np.array([0.4, -0.2, 2.0])), np.array([3.0, 4.0, 5.0]))

    def poses(self, times: Floats) -> Floats:
        return np.broadcast_to(self.T, (len(times), 4, 4))


@pytest.fixture(scope="module")
def still() -> Motion:
    return smooth_motion(Tilted(), spacing=10.0)


def test_at_rest_it_reads_g_upwards(still: Motion) -> None:
    imu = simulate_imu(still, IDEAL, np.eye(4), 10.0, np.random.default_rng(0))
    np.testing.assert_allclose(imu.stream.accel, np.tile(GRAVITY * Tilted.T[2, :3], (1001, 1)), atol=1e-6)
    np.testing.assert_allclose(imu.stream.gyro, 0, atol=1e-9)
    level = simulate_imu(still, IDEAL, se3.inverse(Tilted.T), 1.0, np.random.default_rng(0))
    np.testing.assert_allclose(level.stream.accel, np.tile([0, 0, GRAVITY], (101, 1)), atol=1e-6)


def test_a_standing_start_reads_gravity_and_then_moves() -> None:
    path = simulate("street", count=1).vehicle
    motion = smooth_motion(standing_start(path, 3.0))
    imu = read(motion, IDEAL, 10.0)
    quiet = imu.stream.stamps_ns < 2.9e9
    np.testing.assert_allclose(np.linalg.norm(imu.stream.accel[quiet], axis=1), GRAVITY, atol=1e-4)
    assert np.abs(imu.stream.gyro[quiet]).max() < 1e-4
    assert np.abs(imu.stream.accel[~quiet] - imu.stream.accel[0]).max() > 0.5


def test_sign_of_the_specific_force_when_braking_and_turning(laps: SimulatedDrive) -> None:
    """Speeding up pushes along +x, a bend to the left along +y, as on an accelerometer (REP 145)."""
    imu = simulate_imu(laps.vehicle, IDEAL, np.eye(4), 30.0, np.random.default_rng(0))
    speed = np.linalg.norm(imu.truth.velocity, axis=1)
    gained = np.gradient(speed, 0.01)
    assert np.corrcoef(gained, imu.stream.accel[:, 0])[0, 1] > 0.9
    assert np.corrcoef(speed * imu.truth.rate[:, 2], imu.stream.accel[:, 1])[0, 1] > 0.95
    assert imu.stream.accel[:, 1].mean() > 3.0, "the block is driven counter-clockwise"


def allan(values: Floats, rate_hz: float, tau: float) -> Floats:
    """Overlapping Allan deviation (3,) of (M, 3) readings at averaging time `tau`, s."""
    m = round(tau * rate_hz)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(values - values.mean(axis=0), axis=0)]) / m
    mean = total[m:] - total[:-m]
    return np.asarray(np.sqrt(0.5 * np.mean((mean[m:] - mean[:-m]) ** 2, axis=0)))


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
def test_noise_density_is_recovered_from_static_data(still: Motion, rate_hz: float) -> None:
    """White noise alone: N is the Allan deviation at one second, and falls with the root of the time."""
    imu = simulate_imu(still, replace(ICM, rate_hz=rate_hz), np.eye(4), 600.0, np.random.default_rng(4))
    for triad, readings in ((ICM.accel, imu.stream.accel), (ICM.gyro, imu.stream.gyro)):
        for tau, tolerance in ((0.2, 0.05), (1.0, 0.1)):
            np.testing.assert_allclose(
                allan(readings, rate_hz, tau) * np.sqrt(tau), triad.noise_density, rtol=tolerance
            )


def test_bias_walk_is_recovered_from_long_static_data(still: Motion) -> None:
    """K sqrt(tau / 3) where the walk outweighs the noise; and the truth file's bias is that of the readings."""
    walking = Triad(bias=0.5, noise_density=1e-3, bias_walk=2e-3)
    model = ImuModel("walking", walking, walking)
    imu = simulate_imu(still, model, np.eye(4), 4000.0, np.random.default_rng(5))
    tau = 20.0
    deviations = np.concatenate([allan(v, 100.0, tau) for v in (imu.stream.accel, imu.stream.gyro)])
    np.testing.assert_allclose(deviations / np.sqrt(tau / 3), walking.bias_walk, rtol=0.2)
    for stream, bias, exact in (
        (imu.stream.accel, imu.accel_bias, GRAVITY * Tilted.T[2, :3]),
        (imu.stream.gyro, imu.gyro_bias, np.zeros(3)),
    ):
        np.testing.assert_array_equal(bias[0], 0.5)
        left = stream - bias - exact
        assert np.std(left) == pytest.approx(walking.noise_density * 10, rel=0.02)
        # The steps of a walk of K per root second are K sqrt(dt) apart.
        assert np.std(np.diff(bias, axis=0)) == pytest.approx(walking.bias_walk / 10, rel=0.02)


def test_constant_bias_and_misalignment_are_those_of_the_table() -> None:
    """Thesis, table 2.3: 0.4905 m/s2 and 0.0873 rad/s on each axis, 2 % of each other axis."""
    n = 40_000
    noise = np.random.default_rng(6).standard_normal((n, 2, 3))
    for triad, push in ((ICM.accel, 10.0), (ICM.gyro, 2.0)):
        steady = replace(triad, bias_walk=0.0)
        for axis in range(3):
            exact = np.zeros((n, 3))
            exact[:, axis] = push
            mean = measure(steady, exact, noise, 100.0)[0].mean(axis=0)
            expected = np.full(3, triad.bias + 0.02 * push)
            expected[axis] = triad.bias + push
            np.testing.assert_allclose(mean, expected, atol=5 * triad.noise_density * 10 / np.sqrt(n))
    assert (ICM.accel.bias, round(ICM.gyro.bias, 4)) == (0.4905, 0.0873)
    assert (ICM.accel.limit, round(ICM.gyro.limit, 4)) == (19.62, 4.3633)
    assert (ICM.accel.misalignment, ICM.gyro.misalignment) == (2.0, 2.0)
    assert ICM.accel.step == pytest.approx(19.62 / 2**15, rel=1e-4)
    assert ICM.gyro.step == pytest.approx(np.radians(1 / 131), rel=1e-4)
    assert (ICM.accel.noise_density, ICM.gyro.noise_density) == (0.0022563, 0.000261799)


def test_readings_are_clipped_and_come_in_steps() -> None:
    triad = Triad(limit=2.0, step=0.25)
    exact = np.array([[5.0, -5.0, 0.1], [1.99, -1.13, 0.13], [0.0, 0.374, 0.376]])
    reading, _ = measure(triad, exact, np.zeros((3, 2, 3)), 100.0)
    np.testing.assert_array_equal(reading, [[2.0, -2.0, 0.0], [2.0, -1.25, 0.25], [0.0, 0.25, 0.5]])


def test_the_icm_keeps_to_its_range_and_bits(laps: SimulatedDrive) -> None:
    imu = read(laps.vehicle, ICM, 30.0).stream
    for triad, readings in ((ICM.accel, imu.accel), (ICM.gyro, imu.gyro)):
        assert np.abs(readings).max() <= triad.limit
        inside = readings[np.abs(readings) < triad.limit] / triad.step
        np.testing.assert_allclose(inside, np.round(inside), atol=1e-6)


def test_a_phone_has_ten_times_the_biases_and_takes_its_readings_late() -> None:
    """A reading at the wrong time is off by the jerk, and by that of the turn, times how late it is."""
    for name, calibrated in (("phone", False), ("phone-calibrated", True)):
        phone = IMUS[name]
        for triad, icm in ((phone.accel, ICM.accel), (phone.gyro, ICM.gyro)):
            assert triad.bias == (0.0 if calibrated else pytest.approx(10 * icm.bias))
            assert triad.bias_walk == pytest.approx(10 * icm.bias_walk)
            assert triad.noise_density == icm.noise_density
        assert phone.accel.limit == pytest.approx(8 * GRAVITY)
        assert np.degrees(phone.gyro.limit) == pytest.approx(500)
    motion = simulate("quadrotor", lidar="vlp16").vehicle
    exact, late = (read(motion, replace(IDEAL, late=seconds), 14.0) for seconds in (0.0, 0.005))
    np.testing.assert_array_equal(late.stream.stamps_ns, exact.stream.stamps_ns)
    np.testing.assert_array_equal(late.truth.poses, exact.truth.poses)
    off = late.stream.gyro - exact.stream.gyro
    assert np.std(off[500:]) == pytest.approx(0.005 * np.std(exact.truth.rate_change[500:]), rel=0.1)
    assert np.abs(np.mean(off)) < 0.1 * np.std(off)
    longer = read(motion, replace(ICM, late=0.005), 14.0).stream
    np.testing.assert_array_equal(read(motion, replace(ICM, late=0.005), 9.0).stream.gyro[:1], longer.gyro[:1])


def test_what_is_beyond_the_range_reads_as_its_end() -> None:
    """The flight feels 5 g and turns at 400 deg/s: an ICM-20948 stops at 2 g and 250, a phone reaches."""
    motion = simulate("quadrotor", lidar="vlp16").vehicle
    stuck = {}
    for model in (ICM, IMUS["phone"]):
        felt = simulate_imu(motion, model, T_OUSTER_IMU, 14.0, np.random.default_rng(0))
        assert np.abs(felt.stream.accel).max() <= model.accel.limit
        stuck[model.name] = [
            np.mean(np.abs(values[500:]).max(axis=1) >= triad.limit)
            for values, triad in ((felt.stream.accel, model.accel), (felt.stream.gyro, model.gyro))
        ]
    assert stuck["icm20948"][0] > 0.5
    assert stuck["icm20948"][1] > 0.05
    assert stuck["phone"][0] == 0.0


def test_same_seed_same_readings_and_more_time_only_adds(laps: SimulatedDrive) -> None:
    short, long, other = (read(laps.vehicle, ICM, *arguments).stream for arguments in ((5.0, 7), (9.0, 7), (5.0, 8)))
    assert (len(short), len(long)) == (501, 901)
    np.testing.assert_array_equal(short.stamps_ns, np.arange(501) * 10_000_000)
    for name in ("accel", "gyro"):
        np.testing.assert_array_equal(getattr(short, name), getattr(long, name)[:501])
        assert (getattr(short, name) != getattr(other, name)).mean() > 0.9


def test_models_by_name() -> None:
    assert find_imu("icm20948") is ICM
    assert ICM.rate_hz == 100
    with pytest.raises(UsageError, match="did you mean 'icm20948'"):
        find_imu("icm20984")


def test_a_drive_carries_it_only_when_asked(laps: SimulatedDrive) -> None:
    assert laps.imu is None
    assert laps.calibration.T_lidar_imu is None
    drive = simulate("block", count=20, imu="icm20948", lidar="os1-32")
    assert isinstance(drive.imu, ImuStream)
    assert drive.calibration.T_lidar_imu is not None
    assert 0.5 < np.linalg.norm(drive.calibration.T_lidar_imu[:3, 3]) < 2.0, "a car has its IMU below the roof"
    assert drive.imu.stamps_ns[-1] == 2_000_000_000, "to the end of the last scan"
