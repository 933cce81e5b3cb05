"""The satellite fixes of a recording: rate, jumps, and where on the Earth they are."""

from __future__ import annotations

import numpy as np

from lslam.doctor.findings import Facts, Finding, plural
from lslam.geometry.geodesy import to_local
from lslam.types.arrays import Floats, Longs
from lslam.types.sequence import Sequence, no_shared_time

# No carrier of a LiDAR accelerates more, m/s2; a fix that does not state its sigma is taken to be so good, m.
_ACCELERATION, _SIGMA = 15.0, 5.0


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
    """Fixes that leave the line through their neighbours by more than acceleration and their sigma explain."""
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
