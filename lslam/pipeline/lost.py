"""Where a run may be lost: the alerts of its integrity monitor, in the words of the manifest and beside each scan."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lslam.integrity.alerts import Alert, alerts
from lslam.integrity.monitor import IntegrityMonitor
from lslam.pipeline.manifest import Manifest
from lslam.types.scan_result import ScanResult

log = logging.getLogger("lslam")

# Sentences of one run; the scans beyond are marked all the same.
MOST_SAID = 6


def mark_lost(results: list[ScanResult], monitor: IntegrityMonitor, manifest: Manifest) -> list[ScanResult]:
    """The results, those that an alert speaks of marked so; the manifest has a problem for each stretch of them."""
    positions = np.stack([r.T_world_lidar[:3, 3] for r in results])
    found = alerts(monitor.checks, positions, np.array([r.stamp_ns for r in results]))
    said = [_sentence(results, alert) for alert in found]
    if len(said) > MOST_SAID:
        said = [
            *said[:MOST_SAID],
            f"and {len(said) - MOST_SAID} more stretches of scans that may be lost: see scans.csv",
        ]
    for sentence in said:
        log.warning("%s", sentence)
    manifest.problems += said
    manifest.integrity = {
        "checks": len(monitor.checks),
        "conclusive": sum(check.is_conclusive for check in monitor.checks),
        "alerts": len(found),
    }
    lost = {k for alert in found for k in range(alert.first, alert.last + 1)}
    return [replace(r, is_lost=True) if k in lost else r for k, r in enumerate(results)]


def _sentence(results: list[ScanResult], alert: Alert) -> str:
    first, last = results[alert.first].index, results[alert.last].index
    scans = f"scan {first}" if first == last else f"scans {first} to {last}"
    return f"{scans} may be lost: {alert.why}"
