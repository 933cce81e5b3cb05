"""What is in a sequence, in numbers: the facts behind `lslam info`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.types.imu import ImuStream
from lslam.types.scan import Scan
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory

GRAVITY = 9.80665  # m/s2
SCHEMA = 1

Facts = dict[str, Any]


def inspect(sequence: Sequence, samples: int | None = 50) -> Facts:
    """JSON-ready facts about `sequence`; point statistics come from `samples` scans spread evenly, all when None.

    Scans that cannot be read do not stop it: they are counted and named among the problems.
    """
    problems = list(sequence.problems)
    n = len(sequence)
    wanted = n if samples is None else min(n, samples)
    indices = np.unique(np.linspace(0, n - 1, wanted).round().astype(int)) if n else np.zeros(0, int)
    facts: Facts = {
        "schema": SCHEMA,
        "name": sequence.name,
        "path": str(sequence.path),
        "format": sequence.kind,
        "sensor": getattr(sequence, "sensor", None),
        "scans": n,
        "time": _time(sequence, problems),
        "points": _points(sequence, indices, problems),
        "motion_compensated": sequence.motion_compensated,
        "vertical_correction_deg": float(getattr(sequence, "correction_deg", 0.0)),
        "extrinsics": {
            key: None if T is None else np.asarray(T).tolist() for key, T in vars(sequence.calibration).items()
        },
        "imu": _imu(sequence, problems),
        "gnss": _gnss(sequence),
        "ground_truth": _ground_truth(sequence.ground_truth, sequence.stamps_ns),
    }
    if sequence.motion_compensated is not True and not facts["points"]["per_point_times"]:
        problems.append(
            "no per-point times and not known to be motion compensated: scans cannot be deskewed (state "
            "motion_compensated, or per_point, in sequence.toml)"
        )
    notes = list(sequence.notes)
    count = facts["points"]["count"]
    if count and count["min"] == count["max"] > 0 and facts["scans"] > 1 and not facts["points"]["rings"]:
        notes.append(
            f"every scan has {count['max']} points, as organised clouds do: rows and cols in sequence.toml give the rings"
        )
    return {**facts, "notes": notes, "problems": problems}


def _time(sequence: Sequence, problems: list[str]) -> Facts:
    stamps = sequence.stamps_ns
    steps = np.diff(stamps) * 1e-9
    median = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > 1.5 * median) if median > 0 else np.zeros(0, int)
    if len(gaps):
        worst = int(gaps[np.argmax(steps[gaps])])
        plural = "s" if len(gaps) > 1 else ""
        problems.append(f"{len(gaps)} gap{plural} in the scans, the longest {steps[worst]:.3f} s after scan {worst}")
    return {
        "start_ns": int(stamps[0]) if len(stamps) else None,
        "end_ns": int(stamps[-1]) if len(stamps) else None,
        "duration_s": float((stamps[-1] - stamps[0]) * 1e-9) if len(stamps) else 0.0,
        "rate_hz": float(sequence.rate_hz),
        "period_s": {"min": float(steps.min()), "median": median, "max": float(steps.max())} if len(steps) else None,
        "gaps": [{"after_scan": int(k), "seconds": float(steps[k])} for k in gaps],
    }


def _points(sequence: Sequence, indices: NDArray[Any], problems: list[str]) -> Facts:
    scans: list[Facts] = []
    unreadable: list[str] = []
    for index in indices:
        try:
            scans.append(_scan_facts(sequence.scan(int(index))))
        except InputError as error:
            unreadable.append(str(error))
    problems += [f"scan cannot be read: {sentence}" for sentence in unreadable[:3]]
    if len(unreadable) > 3:
        problems.append(f"{len(unreadable) - 3} more of the {len(indices)} scans looked at cannot be read")
    empty = sum(1 for s in scans if s["count"] == 0)
    if empty:
        problems.append(f"{empty} of the {len(indices)} scans looked at hold no points")
    full = [s for s in scans if s["count"]]
    total = sum(s["count"] for s in full)
    measured = [s for s in full if s["valid"]]
    return {
        "scans_read": len(scans),
        "scans_unreadable": len(unreadable),
        "scans_empty": empty,
        "count": _spread([s["count"] for s in scans]),
        "range_m": _ranges(measured),
        "share_nan": sum(s["nan"] for s in full) / total if total else 0.0,
        "share_zero": sum(s["zero"] for s in full) / total if total else 0.0,
        "elevation_deg": [min(s["low"] for s in measured), max(s["high"] for s in measured)] if measured else None,
        "intensity": _limits([s["intensity"] for s in full]),
        "per_point_times": _limits([s["times"] for s in full]),
        "rings": _limits([s["rings"] for s in full]),
    }


def _scan_facts(scan: Scan) -> Facts:
    points = scan.points
    finite = np.isfinite(points).all(axis=1)
    zero = (points == 0).all(axis=1)
    good = points[finite & ~zero].astype(np.float64)
    ranges = np.linalg.norm(good, axis=1)
    elevation = np.degrees(np.arctan2(good[:, 2], np.hypot(good[:, 0], good[:, 1])))
    facts: Facts = {"count": len(scan), "valid": len(good), "nan": int((~finite).sum()), "zero": int(zero.sum())}
    if len(good):
        facts["ranges"] = [float(v) for v in np.percentile(ranges, [0, 5, 50, 95, 100])]
        # One per cent on either side: single points close by have wild elevations.
        facts["low"], facts["high"] = (float(v) for v in np.percentile(elevation, [1, 99]))
    for name, values in (("intensity", scan.intensity), ("times", scan.times), ("rings", scan.rings)):
        known = None if values is None else values[np.isfinite(values)]
        facts[name] = None if known is None or not len(known) else [float(known.min()), float(known.max())]
    return facts


def _spread(values: list[int]) -> Facts | None:
    return {"min": min(values), "median": float(np.median(values)), "max": max(values)} if values else None


def _ranges(scans: list[Facts]) -> Facts | None:
    if not scans:
        return None
    table = np.array([s["ranges"] for s in scans])
    p5, median, p95 = (float(v) for v in np.median(table[:, 1:4], axis=0))
    return {"min": float(table[:, 0].min()), "p5": p5, "median": median, "p95": p95, "max": float(table[:, 4].max())}


def _limits(pairs: list[list[float] | None]) -> list[float] | None:
    """Smallest and largest value over scans; None when any of them lacks the field."""
    known = [p for p in pairs if p is not None]
    if not known or len(known) < len(pairs):
        return None
    return [min(p[0] for p in known), max(p[1] for p in known)]


def _imu(sequence: Sequence, problems: list[str]) -> Facts | None:
    imu = sequence.imu
    if imu is None or not len(imu):
        return None
    steps = np.diff(imu.stamps_ns) * 1e-9
    norm, units = _gravity(imu)
    turning = np.degrees(np.linalg.norm(imu.gyro[np.isfinite(imu.gyro).all(axis=1)], axis=1))
    bad = int((~np.isfinite(np.hstack([imu.accel, imu.gyro])).all(axis=1)).sum())
    if bad:
        problems.append(f"IMU: {bad} of {len(imu)} samples are not finite")
    if units != "m/s2":
        problems.append(
            f"IMU: the mean specific force is {norm:.2f}, not about 9.81 (m/s2), and not usable as it is: "
            + ("it seems to be in g, multiply by 9.80665" if units == "g" else "check its unit and its gravity")
        )
    if (steps <= 0).any():
        problems.append(f"IMU: time repeats or goes back {int((steps <= 0).sum())} times")
    gaps = int((steps > 0.1 + 0.5 * float(np.median(steps))).sum()) if len(steps) else 0
    if gaps:
        problems.append(f"IMU: {gaps} gaps, the longest {steps.max():.3f} s")
    apart = "IMU: it shares no time with the scans"
    if apart not in problems and (
        imu.stamps_ns[0] > sequence.stamps_ns[-1] or imu.stamps_ns[-1] < sequence.stamps_ns[0]
    ):
        problems.append(apart)
    median_step = float(np.median(steps)) if len(steps) else 0.0
    return {
        "samples": len(imu),
        "rate_hz": 1 / median_step if median_step > 0 else None,
        "gravity_norm": norm,
        "gravity_unit": units,
        "gyro_median_deg_s": float(np.median(turning)) if len(turning) else 0.0,
        "gaps": gaps,
        "longest_step_s": float(steps.max()) if len(steps) else None,
    }


def _gravity(imu: ImuStream) -> tuple[float, str | None]:
    """Norm of the mean specific force over the whole stream, and the unit gravity speaks for (CONVENTIONS: 0.8..1.2 g).

    Half seconds are averaged and the calmest twentieth decides: long bends add up to more than gravity's tolerance.
    """
    finite = imu.accel[np.isfinite(imu.accel).all(axis=1)]
    if not len(finite):
        return 0.0, None
    step = float(np.median(np.diff(imu.stamps_ns))) * 1e-9 if len(imu) > 1 else 0.0
    width = min(max(round(0.5 / step), 1) if step > 0 else 1, len(finite))
    whole = len(finite) // width * width
    means = np.linalg.norm(finite[:whole].reshape(-1, width, 3).mean(axis=1), axis=1)
    calm = float(np.percentile(means, 5))
    unit = "m/s2" if 0.8 <= calm / GRAVITY <= 1.2 else "g" if 0.8 <= calm <= 1.2 else None
    return float(np.linalg.norm(finite.mean(axis=0))), unit


def _gnss(sequence: Sequence) -> Facts | None:
    gnss = sequence.gnss
    if gnss is None or not len(gnss):
        return None
    sigma = gnss.sigma[np.isfinite(gnss.sigma)]
    fixes = gnss.lat_lon_alt[np.isfinite(gnss.lat_lon_alt).all(axis=1)]
    if not len(fixes):
        return None
    return {
        "fixes": len(fixes),
        "first": [float(v) for v in fixes[0]],
        "sigma_m": {"median": float(np.median(sigma)), "max": float(sigma.max())} if len(sigma) else None,
    }


def _ground_truth(truth: Trajectory | None, stamps_ns: NDArray[np.int64]) -> Facts | None:
    if truth is None or not len(truth):
        return None
    inside = (truth.stamps_ns >= stamps_ns[0]) & (truth.stamps_ns <= stamps_ns[-1])
    part = truth.select(inside)
    positions = part.positions
    extent = np.ptp(positions, axis=0).tolist() if len(part) else [0.0, 0.0, 0.0]
    return {
        "poses": len(truth),
        "poses_during_scans": len(part),
        "frame": truth.frame,
        "source": truth.source,
        "path_length_m": float(part.path_lengths[-1]) if len(part) else 0.0,
        "extent_m": [float(v) for v in extent],
    }
