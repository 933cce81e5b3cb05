"""Examination of positions beside the scans, ground truth and satellite fixes, and of the units of stamps and point times."""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats, Longs, Stamps
from lslam.core.geometry.geodesy import to_local
from lslam.core.printable import count_of
from lslam.core.types.scan import Span
from lslam.core.types.sequence import Sequence, no_shared_time
from lslam.core.types.trajectory import Trajectory
from lslam.pipeline.doctor import Facts, Findings

# m/s2 that nothing which carries a LiDAR is accelerated by: of fixes and truths.
_ACCELERATION = 15.0
# m that a truth from satellites may step by; how many times its steps usually differ; and a part of the usual step, to which
# it grows by one missing pose: positions may be in another unit.
_STEP, _USUAL, _PART = 0.6, 8.0, 0.7
# A gap is so many times the usual step, and longer than so many scans.
_GAP, _SCANS = 5.0, 2.5
_SIGMA = 5.0  # m; a fix that does not state its sigma is taken to be so good
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


def examine_jumps(truth: Trajectory | None, findings: Findings) -> None:
    """Add a finding if a step between poses differs from its neighbours by more than an acceleration explains."""
    if truth is None or len(truth) < 4:
        return
    steps, seconds = np.diff(truth.positions, axis=0), np.diff(truth.stamps_ns)[:, None] * 1e-9
    if (seconds <= 0).any() or not np.isfinite(steps).all():
        return
    speed = steps / seconds
    # The first and the last step have a neighbour on one side only.
    around = 0.5 * (np.concatenate([speed[1:2], speed[:-1]]) + np.concatenate([speed[1:], speed[-2:-1]]))
    off = np.linalg.norm(steps - around * seconds, axis=1)
    reach = _STEP + _ACCELERATION * seconds[:, 0] ** 2 + _USUAL * float(np.median(off))
    reach = np.maximum(reach, _PART * np.linalg.norm(around * seconds, axis=1))
    # What jumps spoils the neighbours' expectation by half as much.
    nearby = np.maximum(np.concatenate([[0.0], off[:-1]]), np.concatenate([off[1:], [0.0]]))
    jumps = np.flatnonzero((off > reach) & (off >= nearby))
    if not len(jumps):
        return
    worst = int(jumps[np.argmax(off[jumps])])
    way, usual = float(np.linalg.norm(steps[worst])), float(np.linalg.norm(around[worst] * seconds[worst]))
    missing = round(way / usual) - 1 if usual > 0.05 else 0
    what = (
        f"ground truth: {count_of(len(jumps), 'jump')}, the largest by {way:.1f} m from pose {worst} to the next, where "
        f"{usual:.1f} m would be usual"
    )
    if missing > 0:
        what += f", as if {count_of(missing, 'pose')} were missing"
    findings.add(
        "truth-jumps",
        what,
        "rows that go with scans by index belong to other scans behind a missing one; give a row for every scan, or stamps",
    )


def examine_gaps(sequence: Sequence, findings: Findings) -> None:
    """Add a finding if the ground truth has gaps during the scans."""
    truth, scans = sequence.ground_truth, sequence.stamps_ns
    if truth is None or not truth.has_stamps or len(truth) < 3 or len(scans) < 2:
        return
    stamps = truth.stamps_ns[(truth.stamps_ns >= scans[0]) & (truth.stamps_ns <= scans[-1])]
    stamps = np.concatenate([[scans[0] - 1], stamps, [scans[-1] + 1]])
    steps = np.diff(stamps) * 1e-9
    usual = float(np.median(np.diff(truth.stamps_ns))) * 1e-9
    gaps = np.flatnonzero(steps > max(_GAP * usual, _SCANS * float(np.median(np.diff(scans))) * 1e-9))
    if not len(gaps):
        return
    worst = int(gaps[np.argmax(steps[gaps])])
    without = sum(int(((scans > stamps[k]) & (scans < stamps[k + 1])).sum()) for k in gaps)
    findings.add(
        "truth-gaps",
        f"ground truth: {count_of(len(gaps), 'gap')}, the longest {steps[worst]:.2f} s, "
        f"{(stamps[worst] - scans[0]) * 1e-9:.2f} s after the first scan: {without} of {len(scans)} scans lie in one",
        "these scans are not scored",
    )


def examine_gnss(sequence: Sequence, findings: Findings) -> Facts | None:
    """Facts of the satellite fixes, None without valid ones; invalid fixes, wrong stamps and jumps become findings."""
    gnss = sequence.gnss
    if gnss is None or not len(gnss):
        return None
    known = gnss.is_place
    if not known.all():
        what = f"GNSS: {int((~known).sum())} of {len(gnss)} fixes are 0, not finite or not on the Earth"
        findings.add("gnss-invalid", what, "leave them out; the columns are lat, lon (deg), alt (m)")
    if not known.any():
        return None
    fixes, stamps_ns, sigma = gnss.lat_lon_alt[known], gnss.stamps_ns[known], gnss.sigma[known]
    steps = np.diff(stamps_ns) * 1e-9
    back = int((steps <= 0).sum())
    if back:
        findings.add("gnss-rewinds", f"GNSS: time repeats or goes back {count_of(back, 'time')}", "correct its stamps")
    apart = no_shared_time("GNSS")
    if apart not in sequence.problems and (
        stamps_ns[0] > sequence.stamps_ns[-1] or stamps_ns[-1] < sequence.stamps_ns[0]
    ):
        findings.add("gnss-apart", apart, "correct its stamps")
    finite = sigma[np.isfinite(sigma)]
    median = float(np.median(steps)) if len(steps) else 0.0
    return {
        "fixes": len(fixes),
        "rate_hz": 1 / median if median > 0 else None,
        "jumps": 0 if back else _examine_jumps(fixes, stamps_ns, sigma, findings),
        "first": [float(v) for v in fixes[0]],
        "hemisphere": ("N" if fixes[0, 0] >= 0 else "S") + ("E" if fixes[0, 1] >= 0 else "W"),
        "sigma_m": {"median": float(np.median(finite)), "max": float(finite.max())} if len(finite) else None,
    }


def _examine_jumps(fixes: Floats, stamps_ns: Longs, sigma: Floats, findings: Findings) -> int:
    """Number of fixes (N, 3) farther off their neighbours' line than acceleration and sigma explain; adds a finding."""
    if len(fixes) < 3:
        return 0
    xy = to_local(fixes, fixes[0])[:, :2]
    t = stamps_ns * 1e-9 - stamps_ns[0] * 1e-9
    before, after = np.diff(t)[:-1, None], np.diff(t)[1:, None]
    off = np.linalg.norm(xy[1:-1] - (xy[:-2] * after + xy[2:] * before) / (before + after), axis=1)
    spread = np.where(np.isfinite(sigma), sigma, _SIGMA)
    reach = 0.5 * _ACCELERATION * (before * after)[:, 0] + 5 * np.sqrt(1.5) * np.maximum(spread[1:-1], 0.01)
    far = np.flatnonzero(off > reach)
    if len(far):
        worst, fixes_off = int(far[np.argmax(off[far])]), "1 fix" if len(far) == 1 else f"{len(far)} fixes"
        findings.add(
            "gnss-jumps",
            f"GNSS: {fixes_off} off the line of its neighbours, the worst, number {worst + 1}, by {off[worst]:.1f} m",
            "take it out, or state its true sigma",
        )
    return len(far)


def examine_units(
    sequence: Sequence,
    findings: Findings,
    truth: Trajectory | None = None,
    with_imu: bool = True,
    with_gnss: bool = True,
    sweep: Span | None = None,
) -> None:
    """Add findings about stamps of the scans, IMU, fixes and `truth`, and about per-point times, which span `sweep`.

    with_imu, with_gnss : whether these streams are examined
    """
    stamps = sequence.stamps_ns
    if len(stamps) < 2:
        return
    step, period = _step(stamps), 1.0 / sequence.rate_hz
    factor = _factor_of_scans(step, period)
    if factor:
        period = step / factor
        what = f"scans: {step:.4g} s from one to the next, {len(stamps)} in {_seconds(stamps):.4g} s"
        findings.add("scan-unit", *_suspect(what, factor, f"{1 / period:.4g} Hz"))
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
            findings.add(code, *_suspect(what, factor, rate))
    if sweep is not None and sweep.seconds > 0:
        factor = _unit(sweep.seconds / period, _SWEEP)
        if factor:
            what = f"per-point times: they last {sweep.seconds:.4g} s a scan, and scans come every {period:.4g} s"
            findings.add("point-unit", *_suspect(what, factor, "a sweep's time"))


def _factor_of_scans(step: float, period: float) -> float:
    """Unit factor by which the `step` between scans, s, is too long; 0 when it may be right.

    period : s, as stated, or by the stamps themselves if none is stated
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
    """Unit factor by which the time between `stamps` is too long relative to the scans; 0 when it may be right.

    span : s, of the scans; usual : s, range of plausible times between two stamps of such a sensor
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
    """Ratios of units of time, larger and smaller than 1."""
    return [*UNITS, *(1 / factor for factor in UNITS)]


def _suspect(what: str, factor: float, would_be: str) -> tuple[str, str]:
    """Finding and remedy of stamps in a wrong unit: `what` is `factor` times too slow (> 1) or too fast; `would_be` if mended."""
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
    """Median of the positive steps of stamps, s; 0 without any."""
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if len(steps) else 0.0


def _seconds(stamps: Stamps) -> float:
    """Time from the first to the last stamp, s."""
    return float(stamps.max() - stamps.min()) * 1e-9
