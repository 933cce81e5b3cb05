"""Consistency of gyroscope and registration: rotations that disagree reveal wrong units, axes or clocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import so3
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.imu_cleaning import ImuFault, ImuRefusedError

# rad/s, rms of rotation rates below which registration's noise dominates and nothing is observable.
LEAST_TURNING = np.deg2rad(0.6)
LEAST_CORRELATION = 0.5
# The part of what scans show as turns that may be noise of their registration; turns over more scans have less of it, and of
# so many stretches there must be left.
MOST_NOISE, FEWEST_STRETCHES = 0.2, 4
# Rates in deg/s are 57.3 times too large; a good gyroscope is right to some per cent.
LIKELY_DEGREES, MOST_SCALE = (30.0, 110.0), 2.0
# About its own axes an IMU leaves no more than twice what it leaves about the best ones, which are three degrees off.
MUCH_WORSE, OTHER_AXES = 4.0, np.deg2rad(20.0)
# s: clocks of one machine differ by less; what differs by more is looked for only to say so.
NEAR_S, FAR_S, STEP_S = 0.25, 10.0, 0.005
# A correlation that is larger by less is the same.
CLEAR_CORRELATION = 0.02
# A smaller clock offset is negligible, and an insignificant one is none.
LEAST_OFFSET_S, SIGNIFICANT = 0.005, 3.0


@dataclass(frozen=True)
class Agreement:
    """How a gyroscope fits registration.

    is_judged : whether the sensor turned enough to tell; correlation : -1..1 at the best offset
    offset_s : s to add to the IMU's stamps, 0 when it is not clearly another; offset_sigma_s : its standard deviation
    gyro_bias : (3,) rad/s in IMU axes, by how much more the gyroscope turns on the mean; None when that is not known
    """

    is_judged: bool
    correlation: float = 0.0
    offset_s: float = 0.0
    offset_sigma_s: float = 0.0
    gyro_bias: Floats | None = None


def check_agreement(
    imu: ImuStream,
    T_lidar_imu: Floats,
    stamps_ns: Longs,
    poses: Floats,
    offset_s: float | None,
    least_offset_s: float = LEAST_OFFSET_S,
) -> Agreement:
    """Compare rotations between the poses (N, 4, 4) of the LiDAR with those of the gyroscope; constant biases cancel.

    offset_s : s to add to the IMU's stamps; None estimates it, and returns 0 for an estimate below `least_offset_s`

    There is no verdict on fewer than 5 poses or hardly any rotation. Raises ImuRefusedError naming the likely fault: unit,
    axes, extrinsics, or stamps.
    """
    if len(stamps_ns) < 5:
        return Agreement(False)
    imu_rates, scan_rates = _GyroRates(imu, T_lidar_imu, stamps_ns), _scan_rates(stamps_ns, poses)
    offsets = np.arange(-NEAR_S, NEAR_S + STEP_S / 2, STEP_S) if offset_s is None else np.array([offset_s])
    width = _width(imu_rates, scan_rates, stamps_ns, poses, offsets)
    if width is None:
        return _hardly_turning(imu_rates.rates(0.0 if offset_s is None else offset_s), scan_rates, T_lidar_imu)
    imu_rates, scan_rates = _GyroRates(imu, T_lidar_imu, stamps_ns, width), _scan_rates(stamps_ns, poses, width)
    scores = np.array([_compare(scan_rates, imu_rates.rates(t))[0] for t in offsets])
    best = int(np.argmax(scores))
    correlation, ratio, turning = _compare(scan_rates, imu_rates.rates(float(offsets[best])))
    if turning < LEAST_TURNING:
        return _hardly_turning(imu_rates.rates(0.0 if offset_s is None else offset_s), scan_rates, T_lidar_imu)
    _refuse_scale(ratio)
    if correlation < LEAST_CORRELATION:
        raise _no_fit(imu_rates, scan_rates, correlation)
    if offset_s is None and best in (0, len(offsets) - 1):
        at_zero = float(scores[len(offsets) // 2])
        if correlation > at_zero + CLEAR_CORRELATION:
            raise _beyond(imu_rates, scan_rates, float(offsets[best]), at_zero, correlation)
        # In long even bends the clock offset is unobservable.
        best = len(offsets) // 2
    _refuse_axes(imu_rates, scan_rates, offsets)
    bias = _mean_excess(imu_rates.rates(float(offsets[best])), scan_rates, T_lidar_imu)
    if offset_s is not None:
        return Agreement(True, correlation, offset_s, gyro_bias=bias)
    offset, sigma = _refine(imu_rates, scan_rates, float(offsets[best]))
    is_sure = abs(offset) > max(least_offset_s, SIGNIFICANT * sigma)
    return Agreement(True, correlation, offset if is_sure else 0.0, sigma, bias)


def turns(
    imu: ImuStream, T_lidar_imu: Floats, stamps_ns: Longs, poses: Floats, offset_s: float
) -> tuple[Floats, Floats]:
    """Rates by registration and by the gyroscope, (M, 3) rad/s in LiDAR axes, each about its mean.

    stamps_ns : (N,) of the poses (N, 4, 4) of the LiDAR; offset_s : s added to the IMU's stamps. M is 0 where the stream
    tells of less than half of the poses.
    """
    return _centre(_scan_rates(stamps_ns, poses), _GyroRates(imu, T_lidar_imu, stamps_ns).rates(offset_s))


def _scan_rates(stamps_ns: Longs, poses: Floats, width: int = 1) -> Floats:
    """(N - width, 3) rad/s in LiDAR axes, each from a scan to the one `width` later."""
    seconds = (stamps_ns[width:] - stamps_ns[:-width])[:, None] * 1e-9
    return np.asarray(so3.log(np.swapaxes(poses[:-width, :3, :3], -1, -2) @ poses[width:, :3, :3]) / seconds)


class _GyroRates:
    """Mean angular rates between scans, `width` scans apart, in LiDAR axes, for any offset of the clocks."""

    def __init__(self, imu: ImuStream, T_lidar_imu: Floats, stamps_ns: Longs, width: int = 1) -> None:
        self.width = width
        self.origin = int(stamps_ns[0])
        self.times = (imu.stamps_ns - self.origin) * 1e-9
        self.query = (stamps_ns - self.origin) * 1e-9
        gyro = imu.gyro @ T_lidar_imu[:3, :3].T
        steps = 0.5 * (gyro[1:] + gyro[:-1]) * np.diff(self.times)[:, None]
        self.turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def rates(self, offset_s: float) -> Floats:
        """(N - width, 3) rad/s, NaN where the stream does not reach."""
        query = self.query - offset_s
        at = np.stack([np.interp(query, self.times, self.turned[:, k], np.nan, np.nan) for k in range(3)], axis=-1)
        w = self.width
        return np.asarray((at[w:] - at[:-w]) / (query[w:] - query[:-w])[:, None])


def _width(imu_rates: _GyroRates, scan_rates: Floats, stamps_ns: Longs, poses: Floats, offsets: Floats) -> int | None:
    """Number of scans to compare rotations over, so that registration's noise is a small part of them; None if none suffices.

    imu_rates, scan_rates : from scan to scan; offsets : of the clocks that are possible, s

    An error of one pose enters two successive rotations with opposite signs, so the noise is estimated from the correlation
    of successive residuals. A faulty gyroscope does not give such alternating residuals.
    """
    best = max(offsets, key=lambda t: _compare(scan_rates, imu_rates.rates(t))[0])
    a, b = _centre(scan_rates, imu_rates.rates(float(best)))
    if not len(a):
        return 1
    rest = a - b * (float(np.sum(a * b)) / max(float(np.sum(b * b)), 1e-12))
    noise = max(-2.0 * float(np.sum(rest[1:] * rest[:-1])) / len(a), 0.0)
    for width in range(1, max(len(stamps_ns) // FEWEST_STRETCHES, 1) + 1):
        power = float(np.sum(np.var(_scan_rates(stamps_ns, poses, width), axis=0)))
        if noise / width**2 <= MOST_NOISE * power:
            return width
    return None


def _centre(scan_rates: Floats, imu_rates: Floats) -> tuple[Floats, Floats]:
    """Both rates (M, 3), rad/s, of the scans that the IMU covers, less their means; M is 0 if it covers too few."""
    is_covered = np.isfinite(imu_rates).all(axis=1)
    if is_covered.sum() < max(5, len(imu_rates) // 2):
        return np.zeros((0, 3)), np.zeros((0, 3))
    a, b = scan_rates[is_covered], imu_rates[is_covered]
    return a - a.mean(axis=0), b - b.mean(axis=0)


def _compare(scan_rates: Floats, imu_rates: Floats) -> tuple[float, float, float]:
    """Correlation of rates about their means, ratio of the gyroscope's to the scans' rates, and rms of the scans'."""
    a, b = _centre(scan_rates, imu_rates)
    if not len(a):
        return 0.0, 1.0, 0.0
    aa, bb, ab = (float(np.sum(x * y)) for x, y in ((a, a), (b, b), (a, b)))
    return ab / max(np.sqrt(aa * bb), 1e-12), float(np.sqrt(bb / max(aa, 1e-12))), float(np.sqrt(aa / len(a)))


def _mean_excess(imu_rates: Floats, scan_rates: Floats, T_lidar_imu: Floats) -> Floats | None:
    """(3,) rad/s in IMU axes: a mean over both, so turns at the start do not count as bias."""
    if not np.isfinite(imu_rates).all(axis=1).any():
        return None
    return np.asarray(np.nanmean(imu_rates - scan_rates, axis=0) @ T_lidar_imu[:3, :3])


def _hardly_turning(imu_rates: Floats, scan_rates: Floats, T_lidar_imu: Floats) -> Agreement:
    """The agreement (without verdict) for scans that hardly rotate; raises ImuRefusedError where the gyroscope rotates a lot."""
    varied = float(np.nanstd(imu_rates, axis=0).max()) if np.isfinite(imu_rates).any() else 0.0
    shown = float(np.std(scan_rates, axis=0).max())
    if varied > max(20 * LEAST_TURNING, MOST_SCALE * shown):
        raise ImuRefusedError(
            f"its rates vary by {np.rad2deg(varied):.1f} deg/s, those of the scans by {np.rad2deg(shown):.1f}",
            "check its unit (rad/s), its axes and its stamps",
        )
    return Agreement(False, gyro_bias=_mean_excess(imu_rates, scan_rates, T_lidar_imu))


def _refuse_scale(ratio: float) -> None:
    """Raise ImuRefusedError for a `ratio` of gyroscope to scan rates far from 1; near 57 the unit is deg/s."""
    if LIKELY_DEGREES[0] < ratio < LIKELY_DEGREES[1]:
        raise ImuRefusedError(
            f"its rates are {ratio:.0f} times those of the scans",
            "they seem to be in deg/s, convert them to rad/s",
            ImuFault.GYRO_IN_DEGREES,
        )
    if not 1 / MOST_SCALE < ratio < MOST_SCALE:
        raise ImuRefusedError(
            f"its rates vary {ratio:.2g} times as much as those of the scans",
            "check its unit (rad/s), axes and stamps",
        )


def _refuse_axes(imu_rates: _GyroRates, scan_rates: Floats, offsets: Floats) -> None:
    """Raise ImuRefusedError where the rotations fit far better about other axes, rotated or mirrored.

    Even wrong axes correlate where one axis rotates most. For each choice of axes the best of the `offsets` (s) counts.
    """

    def residual(axes: Floats, t: float) -> float:
        a, b = _centre(scan_rates, imu_rates.rates(t))
        return float(np.sum((a - b @ axes.T) ** 2)) if len(a) else np.inf

    best = min(offsets, key=lambda t: residual(_best_axes(*_centre(scan_rates, imu_rates.rates(t)))[1], t))
    R, M = _best_axes(*_centre(scan_rates, imu_rates.rates(float(best))))
    as_is, turned, mirrored = min(residual(np.eye(3), t) for t in offsets), residual(R, best), residual(M, best)
    if MUCH_WORSE * mirrored < min(as_is, turned):
        raise ImuRefusedError(
            "its turns fit those of the scans when mirrored: one of its axes has the wrong sign, or two of them are swapped, "
            "which no T_lidar_imu mends",
            "correct its recording",
        )
    angle = float(so3.angle(R))
    if angle > OTHER_AXES and MUCH_WORSE * turned < as_is:
        raise ImuRefusedError(
            f"its turns fit those of the scans far better when turned by {np.rad2deg(angle):.0f} deg",
            "correct T_lidar_imu",
        )


def _best_axes(scan_rates: Floats, imu_rates: Floats) -> tuple[Floats, Floats]:
    """Rotation (3, 3), and orthogonal matrix (3, 3) that may mirror too, by which `imu_rates` (M, 3) fit `scan_rates` best."""
    u, _, vt = np.linalg.svd(scan_rates.T @ imu_rates)
    M = u @ vt
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(M))]) @ vt), np.asarray(M)


def _no_fit(imu_rates: _GyroRates, scan_rates: Floats, correlation: float) -> ImuRefusedError:
    """The ImuRefusedError for rotations that do not correlate, with the likely remedy: stamps, T_lidar_imu or axes."""
    what = f"its turns do not fit those of the scans (correlation {correlation:.2f}, {LEAST_CORRELATION} needed)"
    far, score = _best_far(imu_rates, scan_rates)
    if score > 0.9:
        return ImuRefusedError(what, f"with its stamps moved by {far:.2f} s they would, set imu.time_offset_s")
    a, b = _centre(scan_rates, imu_rates.rates(0.0))
    if len(a):
        R = _best_axes(a, b)[0]
        if _compare(a, b @ R.T)[0] > 0.9:
            turn = np.rad2deg(float(so3.angle(R)))
            return ImuRefusedError(what, f"turned by {turn:.0f} deg they would, correct T_lidar_imu")
    return ImuRefusedError(what, "check its axes, T_lidar_imu and its stamps")


def _beyond(
    imu_rates: _GyroRates, scan_rates: Floats, edge_s: float, at_zero: float, at_edge: float
) -> ImuRefusedError:
    """The ImuRefusedError for rotations whose correlation grows up to the largest tested offset of the stamps.

    edge_s : that offset; at_zero, at_edge : correlation without an offset and with that
    """
    what = (
        f"its turns fit those of the scans the better the farther its stamps are moved (correlation {at_zero:.2f}, moved by "
        f"{edge_s:+.2f} s {at_edge:.2f})"
    )
    far, score = _best_far(imu_rates, scan_rates)
    if score > max(at_edge, 0.9):
        return ImuRefusedError(what, f"best by {far:+.2f} s; set imu.time_offset_s")
    return ImuRefusedError(what, "check its stamps, and set imu.time_offset_s when the clocks are known to differ")


def _best_far(imu_rates: _GyroRates, scan_rates: Floats) -> tuple[float, float]:
    """Offset, s, within `FAR_S` at which the turns agree best, and their correlation there."""
    far = np.arange(-FAR_S, FAR_S, 4 * STEP_S)
    scores = [_compare(scan_rates, imu_rates.rates(float(t)))[0] for t in far]
    best = int(np.argmax(scores))
    return float(far[best]), scores[best]


def _refine(imu_rates: _GyroRates, scan_rates: Floats, near: float) -> tuple[float, float]:
    """The offset, s, at which the rates differ least, and its standard deviation, by a parabola through the squared error.

    near : s, about where it is searched, a step either way; 0 and inf where the error has no minimum there
    """
    costs = []
    for t in (near - STEP_S, near, near + STEP_S):
        a, b = _centre(scan_rates, imu_rates.rates(t))
        costs.append(float(np.sum((a - b) ** 2)) if len(a) else np.inf)
    bend = (costs[0] - 2 * costs[1] + costs[2]) / STEP_S**2
    if not np.isfinite(bend) or bend <= 0:
        return 0.0, np.inf
    shift = float(np.clip(0.5 * (costs[0] - costs[2]) / STEP_S / bend, -STEP_S, STEP_S))
    variance = costs[1] / max(3 * len(scan_rates) / imu_rates.width - 4, 1)
    return near + shift, float(np.sqrt(2 * variance / bend))
