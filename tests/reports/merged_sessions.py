"""Two sessions over one floor, for the page of merged runs to be written from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.cloud import ArrayCloud
from lslam.maps.floor_plan import top_view
from lslam.reports.compare_html import SessionView, write_merge_page


def sessions(scans: int = 50) -> list[SessionView]:
    """One along x at y = 0, one 10 m beside it; its scans are numbered from 200."""

    def way(y: float) -> NDArray[np.float64]:
        return np.stack([np.linspace(0, 60, scans), np.full(scans, y), np.zeros(scans)], 1)

    numbers = np.arange(scans)
    return [
        SessionView("monday", way(1.0), way(0.0), numbers),
        SessionView("tuesday", way(11.0), way(10.0), 200 + numbers),
    ]


def ties() -> NDArray[np.float64]:
    return np.array([[[30.0, 0, 0], [30.0, 10, 0]]])


def write(path: Path, scans: int = 50, has_map: bool = True, problems: Sequence[str] = ()) -> Path:
    views = sessions(scans)
    x, y = np.meshgrid(np.arange(-10, 70, 0.2), np.arange(-15, 25, 0.2))
    floor = ArrayCloud.of(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1))
    rows = [
        {"name": v.name, "scans": scans, "keyframes": scans, "votes": 2, "tried": 3, "loops_between": 1, "ate": None}
        for v in views
    ]
    shown = (top_view(floor), floor) if has_map else (None, None)
    write_merge_page(path, views, rows, problems, ties(), *shown)
    return path
