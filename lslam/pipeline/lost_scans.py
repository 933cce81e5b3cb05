"""Marking of scans that the integrity monitor considers lost, by the poses of odometry and again by the final ones."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.scan_result import MotionCheck, ScanResult, motion_apart
from lslam.odometry.integrity.alerts import LARGE, Alert, alerts, stamp_faults
from lslam.pipeline.manifest import Manifest

log = logging.getLogger("lslam")

MOST_SAID = 6


def mark_lost(results: list[ScanResult], checks: list[MotionCheck], manifest: Manifest) -> list[ScanResult]:
    """Results with the scans of alerts marked lost; the manifest gets a problem for each stretch of them."""
    raised = _alerts(results, checks)
    _report_stamps(results)
    manifest.integrity = {
        "checks": len(checks),
        "conclusive": sum(check.is_conclusive for check in checks),
        "alerts": len(raised),
    }
    return _mark(results, raised, manifest, "")


def mark_lost_finally(
    results: list[ScanResult], checks: list[MotionCheck], manifest: Manifest, cause: str
) -> list[ScanResult]:
    """Results after `cause`, with scans marked lost that only the final poses contradict.

    The monitor's measurements between scans are compared with the motion of the final poses.
    """
    raised = _alerts(results, [_of_final_poses(check, results) for check in checks])
    new = [
        alert for alert in raised if not all(results[k].may_be_elsewhere for k in range(alert.first, alert.last + 1))
    ]
    manifest.integrity["final_alerts"] = len(new)
    return _mark(results, new, manifest, f"after {cause}, ")


def _of_final_poses(check: MotionCheck, results: list[ScanResult]) -> MotionCheck:
    """Motion check with the motion of the final poses."""
    motion = se3.relative(results[check.first].T_world_lidar, results[check.last].T_world_lidar)
    # How many points lie on surfaces at a pose that was moved far was not counted: as good as none.
    is_moved = bool(np.any(np.abs(motion_apart(check.claimed_motion, motion)) > LARGE))
    return replace(check, claimed_motion=motion, claimed_agreement=0.0 if is_moved else check.claimed_agreement)


def _report_stamps(results: list[ScanResult]) -> None:
    """Warn of wrong stamps: poses follow each other steadily, but the stamps do not. No scan is lost."""
    at, off_s = stamp_faults(*_positions(results))
    if at:
        log.warning(
            "the stamps of %d of %d scans, the first is scan %d, are wrong by up to %.0f ms: at the period of the sensor the "
            "poses follow each other steadily, by their stamps they jump; it spoils speeds, deskewing and the use of an IMU",
            len(at),
            len(results),
            results[at[0]].index,
            1e3 * off_s,
        )


def _positions(results: list[ScanResult]) -> tuple[Floats, Longs]:
    positions = np.stack([r.at_stamp.T_world_lidar[:3, 3] for r in results])
    return positions, np.array([r.stamp_ns for r in results])


def _alerts(results: list[ScanResult], checks: list[MotionCheck]) -> list[Alert]:
    return alerts(checks, *_positions(results))


def _mark(results: list[ScanResult], raised: list[Alert], manifest: Manifest, after: str) -> list[ScanResult]:
    sentences = [after + _sentence(results, alert) for alert in raised]
    if len(sentences) > MOST_SAID:
        more = len(sentences) - MOST_SAID
        sentences = [*sentences[:MOST_SAID], f"and {more} more stretches of scans that may be lost: see scans.csv"]
    for sentence in sentences:
        log.warning("%s", sentence)
    manifest.problems += sentences
    lost = {k for alert in raised for k in range(alert.first, alert.last + 1)}
    return [replace(r, may_be_elsewhere=True) if k in lost else r for k, r in enumerate(results)]


def _sentence(results: list[ScanResult], alert: Alert) -> str:
    first, last = results[alert.first].index, results[alert.last].index
    scans = f"scan {first}" if first == last else f"scans {first} to {last}"
    return f"{scans} may be lost: {alert.why}"
