"""The ground truth of a recording by itself: gaps in its stamps, and jumps where poses are missing or belong elsewhere."""

from __future__ import annotations

import numpy as np

from lslam.doctor.findings import Finding, plural
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory

# m/s2 that nothing which carries a LiDAR is accelerated by; m that a truth from satellites may step by; how many times its steps
# usually differ; and a part of the usual step, to which it grows by one missing pose: positions may be in another unit.
_ACCELERATION, _STEP, _USUAL, _PART = 15.0, 0.6, 8.0, 0.7
# A gap is so many times the usual step, and longer than so many scans.
_GAP, _SCANS = 5.0, 2.5


def examine_jumps(truth: Trajectory | None) -> list[Finding]:
    """A finding where positions jump from one pose to the next as nothing that carries a LiDAR does."""
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
            "truth-jumps", what,
            "rows that go with scans by index belong to other scans behind a missing one; give a row for every scan, or stamps",
        )
    ]  # fmt: skip


def examine_gaps(sequence: Sequence) -> list[Finding]:
    """A finding where truth has no pose for a while during the scans."""
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
