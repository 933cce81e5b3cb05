"""Detection of stamps and per-point times in the wrong unit: rates that are impossible, and plausible in another unit.

Nothing is converted, since only the owner knows what a file means.
"""

from __future__ import annotations

import numpy as np

from lslam.core.types.arrays import Stamps
from lslam.core.types.scan import Span
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.pipeline.doctor import Finding

# So many times too long is what was taken for s, and too short what was taken for ns.
UNITS = {1e3: ("ms", "us"), 1e6: ("us", "ms"), 1e9: ("ns", "s")}
# s between two scans: of a LiDAR that turns, with room; and of any recording of one.
_TURN, _POSSIBLE = (0.045, 0.22), (0.005, 5.0)
# s between two samples, poses or fixes of a sensor.
_IMU, _TRUTH, _FIXES = (0.0002, 0.2), (0.0005, 2.5), (0.01, 30.0)
# What lasts so many times longer or shorter than the scans was not recorded beside them, or in another unit; and how far units
# may then be from it, since one may have been switched on before the other.
_OTHERWISE, _ALIKE = 100.0, 3.0
# Sweeps last nearly as long as it is from one scan to the next, where they are not cut to pieces.
_SWEEP = 4.0


def examine_units(
    sequence: Sequence,
    truth: Trajectory | None = None,
    with_imu: bool = True,
    with_gnss: bool = True,
    sweep: Span | None = None,
) -> list[Finding]:
    """Findings about stamps of the scans, IMU, fixes and `truth`, and about per-point times, which span `sweep`."""
    stamps = sequence.stamps_ns
    if len(stamps) < 2:
        return []
    found = []
    step, period = _step(stamps), 1.0 / sequence.rate_hz
    factor = _factor_of_scans(step, period)
    if factor:
        period = step / factor
        what = f"scans: {step:.4g} s from one to the next, {len(stamps)} in {_seconds(stamps):.4g} s"
        found.append(Finding("scan-unit", *_suspect(what, factor, f"{1 / period:.4g} Hz")))
    span = period * (len(stamps) - 1)
    imu = sequence.imu.stamps_ns if with_imu and sequence.imu is not None else None
    fixes = sequence.gnss.stamps_ns if with_gnss and sequence.gnss is not None else None
    poses = truth.stamps_ns if truth is not None and truth.has_stamps else None
    if poses is not None and np.isin(poses, stamps).all():
        poses = None  # theirs are those of the scans
    for code, who, other, usual in (
        ("imu-unit", "IMU", imu, _IMU),
        ("gnss-unit", "GNSS", fixes, _FIXES),
        ("truth-unit", "ground truth", poses, _TRUTH),
    ):
        factor = 0.0 if other is None else _factor_beside(other, span, usual)
        if factor and other is not None:
            rate = f"{factor / _step(other):.4g} Hz"
            what = f"{who}: its stamps are {_step(other):.4g} s apart and span {_seconds(other):.4g} s, the scans' {span:.4g} s"
            found.append(Finding(code, *_suspect(what, factor, rate)))
    if sweep is not None and sweep.seconds > 0:
        factor = _unit(sweep.seconds / period, _SWEEP)
        if factor:
            what = f"per-point times: they last {sweep.seconds:.4g} s a scan, and scans come every {period:.4g} s"
            found.append(Finding("point-unit", *_suspect(what, factor, "a sweep's time")))
    return found


def _factor_of_scans(step: float, period: float) -> float:
    """Unit factor by which the `step` between scans, s, is too long; 0 when it may be right.

    period : s, as stated, or of the stamps themselves where nothing is
    """
    if _POSSIBLE[0] <= step <= _POSSIBLE[1]:
        return 0.0
    is_stated = not 0.5 < step / period < 2.0
    if is_stated:
        return _unit(step / period, 1.5)
    for factor in _factors():
        if _TURN[0] <= step / factor <= _TURN[1]:
            return factor
    return 0.0


def _factor_beside(stamps: Stamps, span: float, usual: tuple[float, float]) -> float:
    """Unit factor by which the time between `stamps` is too long; 0 when it may be right.

    span : s, of the scans; usual : s between two stamps of such a sensor
    """
    if len(stamps) < 2 or span <= 0:
        return 0.0
    ratio = _seconds(stamps) / span
    if ratio <= 0 or 1 / _OTHERWISE < ratio < _OTHERWISE:
        return 0.0
    factor = _unit(ratio, _ALIKE)
    return factor if factor and usual[0] <= _step(stamps) / factor <= usual[1] else 0.0


def _unit(ratio: float, within: float) -> float:
    """Unit factor near `ratio`, up to `within` times; 0 when there is none."""
    return next((f for f in _factors() if 1 / within <= ratio / f <= within), 0.0)


def _factors() -> list[float]:
    return [*UNITS, *(1 / factor for factor in UNITS)]


def _suspect(what: str, factor: float, would_be: str) -> tuple[str, str]:
    if factor > 1:
        is_so, way = f"slow, as {UNITS[factor][0]} taken for s are", f"divide them by {factor:,.0f}"
    else:
        factor = next(f for f in UNITS if f * factor > 0.5)
        is_so, way = f"fast, as {UNITS[factor][1]} taken for ns are", f"multiply them by {factor:,.0f}"
    return (
        f"{what}, {factor:,.0f} times too {is_so}",
        f"{way} if so, which makes {would_be} of it; they are used as they stand",
    )


def _step(stamps: Stamps) -> float:
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if len(steps) else 0.0


def _seconds(stamps: Stamps) -> float:
    return float(stamps.max() - stamps.min()) * 1e-9
