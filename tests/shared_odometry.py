"""Odometry of the same scans, once for all runs of a module that differ in what comes after it."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import pytest

from lslam.core.types.scan_result import MotionCheck, ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Keyframe
from lslam.odometry.frontend.keyframing import Keyframing
from lslam.odometry.frontend.register_scans import estimate
from lslam.odometry.integrity.monitor import IntegrityMonitor
from lslam.pipeline import odometry_pass

# Sections of the configuration that no scan is registered by.
LATER = {"graph", "gnss", "osm", "eval", "report"}
Clouds = list[tuple[np.ndarray, np.ndarray | None]]


class SharedOdometry:
    """Stands in for `estimate`: what it made of the scans is handed out again, keyframes and checks among it.

    Runs with an IMU, wheels or given poses are not shared: their motion model learns from the scans.
    """

    def __init__(self) -> None:
        self._held: dict[str, tuple[list[ScanResult], list[Keyframe], Clouds, list[MotionCheck]]] = {}

    def estimate(
        self, sequence: Sequence, *given: Any, keyframing: Keyframing, monitor: IntegrityMonitor | None = None, **more: Any
    ) -> list[ScanResult]:  # fmt: skip
        """As the function of this name."""
        if more.get("motion") is not None or monitor is None:
            return estimate(sequence, *given, keyframing=keyframing, monitor=monitor, **more)
        key = _key(sequence, keyframing)
        if key not in self._held:
            results = estimate(sequence, *given, keyframing=keyframing, monitor=monitor, **more)
            keyframing.finalise()
            store = keyframing.store
            clouds = [(store.points(k.number), store.labels(k.number)) for k in store.keyframes]
            self._held[key] = list(results), list(store.keyframes), clouds, list(monitor.checks)
            return results
        results, keyframes, clouds, checks = self._held[key]
        monitor.checks.extend(checks)
        for keyframe, cloud in zip(keyframes, clouds, strict=True):
            keyframing.store.add(keyframe, *cloud)
        keyframing.finalise()
        for result in results:
            more["on_scan"](result)
        return list(results)


def _key(sequence: Sequence, keyframing: Keyframing) -> str:
    """Of scans by their stamps and the points of the first and the last."""
    ends = [sequence.scan(k).points.tobytes() for k in (0, len(sequence) - 1)]
    scans = hashlib.sha256(b"".join([sequence.stamps_ns.tobytes(), *ends])).hexdigest()
    return scans + keyframing._config.model_dump_json(exclude=LATER)


@pytest.fixture(scope="module")
def held_odometry() -> SharedOdometry:
    return SharedOdometry()


@pytest.fixture
def shared_odometry(held_odometry: SharedOdometry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of whole runs that are not interrupted; tests of a module that do not ask for it register their scans anew."""
    monkeypatch.setattr(odometry_pass, "estimate", held_odometry.estimate)
