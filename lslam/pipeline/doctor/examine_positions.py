"""Examination of positions beside the scans: ground truth and satellite fixes."""

from __future__ import annotations

import numpy as np

from lslam.core.geometry.geodesy import to_local
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.sequence import Sequence, no_shared_time
from lslam.core.types.trajectory import Trajectory
from lslam.pipeline.doctor import Facts, Finding, plural

# m/s2 that nothing which carries a LiDAR is accelerated by: of fixes and truths.
_ACCELERATION = 15.0
# m that a truth from satellites may step by; how many times its steps usually differ; and a part of the usual step, to which
# it grows by one missing pose: positions may be in another unit.
_STEP, _USUAL, _PART = 0.6, 8.0, 0.7
# A gap is so many times the usual step, and longer than so many scans.
_GAP, _SCANS = 5.0, 2.5


def examine_jumps(truth: Trajectory | None) -> list[Finding]:
    """A finding, in a list, if a step between poses differs from its neighbours by more than an acceleration explains."""
    if truth is None or len(truth) < 4:
        return []
    steps, seconds = np.diff(truth.positions, axis=0), np.diff(truth.stamps_ns)[:, None] * 1e-9
    if (seconds <= 0).any() or not np.isfinite(steps).all():
        return []
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
        return []
    worst = int(jumps[np.argmax(off[jumps])])
    way, usual = float(np.linalg.norm(steps[worst])), float(np.linalg.norm(around[worst] * seconds[worst]))
    missing = round(way / usual) - 1 if usual > 0.05 else 0
    what = (
        f"ground truth: {plural(len(jumps), 'jump')}, the largest by {way:.1f} m from pose {worst} to the next, where "
        f"{usual:.1f} m would be usual"
    )
    if missing > 0:
        what += f", as if {plural(missing, 'pose')} were missing"
    return [
        Finding(
            "truth-jumps",
            what,
            "rows that go with scans by index belong to other scans behind a missing one; give a row for every scan, or stamps",
        )
    ]


def examine_gaps(sequence: Sequence) -> list[Finding]:
    """A finding, in a list, if the ground truth has gaps during the scans."""
    truth, scans = sequence.ground_truth, sequence.stamps_ns
    if truth is None or not truth.has_stamps or len(truth) < 3 or len(scans) < 2:
        return []
    known = truth.stamps_ns[(truth.stamps_ns >= scans[0]) & (truth.stamps_ns <= scans[-1])]
    known = np.concatenate([[scans[0] - 1], known, [scans[-1] + 1]])
    steps = np.diff(known) * 1e-9
    usual = float(np.median(np.diff(truth.stamps_ns))) * 1e-9
    gaps = np.flatnonzero(steps > max(_GAP * usual, _SCANS * float(np.median(np.diff(scans))) * 1e-9))
    if not len(gaps):
        return []
    worst = int(gaps[np.argmax(steps[gaps])])
    without = sum(int(((scans > known[k]) & (scans < known[k + 1])).sum()) for k in gaps)
    return [
        Finding(
            "truth-gaps",
            f"ground truth: {plural(len(gaps), 'gap')}, the longest {steps[worst]:.2f} s, "
            f"{(known[worst] - scans[0]) * 1e-9:.2f} s after the first scan: {without} of {len(scans)} scans lie in one",
            "these scans are not scored",
        )
    ]


_SIGMA = 5.0  # m; a fix that does not state its sigma is taken to be so good


def examine_gnss(sequence: Sequence, findings: list[Finding]) -> Facts | None:
    """Facts of the fixes, None when there are none."""
    gnss = sequence.gnss
    if gnss is None or not len(gnss):
        return None
    known = gnss.is_place
    if not known.all():
        what = f"GNSS: {int((~known).sum())} of {len(gnss)} fixes are 0, not finite or not on the Earth"
        findings.append(Finding("gnss-invalid", what, "leave them out; the columns are lat, lon (deg), alt (m)"))
    if not known.any():
        return None
    fixes, stamps_ns, sigma = gnss.lat_lon_alt[known], gnss.stamps_ns[known], gnss.sigma[known]
    steps = np.diff(stamps_ns) * 1e-9
    back = int((steps <= 0).sum())
    if back:
        findings.append(
            Finding("gnss-rewinds", f"GNSS: time repeats or goes back {plural(back, 'time')}", "correct its stamps")
        )
    apart = no_shared_time("GNSS")
    if apart not in sequence.problems and (
        stamps_ns[0] > sequence.stamps_ns[-1] or stamps_ns[-1] < sequence.stamps_ns[0]
    ):
        findings.append(Finding("gnss-apart", apart, "correct its stamps"))
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


def _examine_jumps(fixes: Floats, stamps_ns: Longs, sigma: Floats, findings: list[Finding]) -> int:
    """Number of fixes farther off the line through their neighbours than acceleration and sigma explain; adds a finding."""
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
        worst = int(far[np.argmax(off[far])])
        findings.append(
            Finding(
                "gnss-jumps",
                f"GNSS: {plural(len(far), 'fix', 'fixes')} off the line of its neighbours, the worst, number {worst + 1}, by "
                f"{off[worst]:.1f} m",
                "take it out, or state its true sigma",
            )
        )
    return len(far)
