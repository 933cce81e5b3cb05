"""osm_matches.csv: matches of walls with keyframes and buildings, accepted ones and why the rest is rejected."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.formats.atomic import write_text
from lslam.types.building_match import BuildingMatch, KeyframeMatch, OsmMatches
from lslam.types.keyframe import Keyframe

# x, y, yaw: of the keyframe in the map frame, or of the displacement of the building about its middle.
COLUMNS = (
    "keyframe", "scan", "building", "verdict", "kind", "rank", "walls", "fitness", "coverage", "rms_m", "x_m", "y_m", "yaw_deg",
    "reason",
)  # fmt: skip


def write_osm_matches(
    path: Path, matches: OsmMatches, keyframes: Sequence[Keyframe], poses: NDArray[np.float64]
) -> None:
    """One row per keyframe, `building` empty, then one per building seen from one, with its OpenStreetMap number.

    poses : (K, 3) final planar poses of the keyframes in the map frame. Raises OutputError when it cannot be written.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for match in matches.keyframes:
        table.writerow(_row(match, keyframes, "", match.pose))
    for one in matches.local:
        building = matches.buildings[one.building]
        moved = one.displacement(poses[one.keyframe], building.middle)
        table.writerow(_row(one, keyframes, building.osm_id, moved))
    write_text(path, text.getvalue())


def _row(
    match: KeyframeMatch | BuildingMatch, keyframes: Sequence[Keyframe], building: str, pose: NDArray[np.float64]
) -> tuple[Any, ...]:
    x, y, yaw = (pose[0], pose[1], np.degrees(pose[2])) if match.rank else (np.nan, np.nan, np.nan)
    numbers = (match.fitness, match.coverage, match.rms, x, y, yaw)
    return (
        match.keyframe, keyframes[match.keyframe].scan, building, match.verdict, match.kind, match.rank, len(match.pairs),
        *(f"{value:.4f}" if np.isfinite(value) else "" for value in numbers), match.reason,
    )  # fmt: skip
