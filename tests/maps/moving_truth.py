"""Simulated scans with the truth about every point: was it on something that moves?"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.types.scan import Scan
from lslam.simulation import lidar
from lslam.simulation.scenarios import SimulatedDrive


class MovingTruth:
    """Watches the simulator's rays: `scan(k)` gives the scan and a mask of the points that hit a moving body."""

    def __init__(self, drive: SimulatedDrive, monkeypatch: pytest.MonkeyPatch) -> None:
        self._drive = drive
        self._met: dict[int, NDArray[np.bool_]] = {}
        self._kept: NDArray[np.bool_] = np.zeros(0, np.bool_)
        meet, detect = lidar._meet_body, lidar._detect

        def meet_and_note(body: Any, which: NDArray[np.intp], rays: Any, hits: Any, *rest: Any) -> None:
            before = hits.distance[which].copy()
            meet(body, which, rays, hits, *rest)
            mask = self._met.setdefault(id(hits), np.zeros(len(hits.distance), np.bool_))
            mask[which[hits.distance[which] != before]] = True

        def detect_and_note(model: Any, hits: Any, *given: Any) -> Any:
            found = detect(model, hits, *given)
            mask = self._met.get(id(hits), np.zeros(len(hits.distance), np.bool_))
            self._kept = mask[model.sequence[found[0][model.sequence]]]
            return found

        monkeypatch.setattr(lidar, "_meet_body", meet_and_note)
        monkeypatch.setattr(lidar, "_detect", detect_and_note)

    def scan(self, index: int) -> tuple[Scan, NDArray[np.bool_]]:
        self._met.clear()
        scan = self._drive.scan(index)
        assert len(self._kept) == len(scan)
        return scan, self._kept
