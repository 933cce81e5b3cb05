"""A drive in a map that exists, as the page shows it: where the map holds its scans, and where odometry carries them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.printable import count_of
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import MapFix
from lslam.core.types.run_record import RunRecord
from lslam.reports import svg
from lslam.reports.plots import Figure
from lslam.reports.svg import MOST_POINTS, Track

# What became of a scan, for people, in the order of the codes that the page's script gets; the style of its line.
STATES = {
    "held": ("held by the map", "s2"),
    "doubted": ("held, the map has changed there", "s4"),
    "changed": ("carried by odometry: the map has changed", "carried"),
    "beyond": ("carried by odometry: beyond the map", "carried"),
    "unread": ("carried by odometry: without points", "carried"),
}
WORDS = {"gone": "gone", "appeared": "not in the map"}


def state_of(fix: MapFix) -> str:
    """Key of `STATES` of a scan."""
    return "doubted" if fix.is_binding and fix.is_doubtful else fix.status


def state_codes(record: RunRecord) -> NDArray[np.uint8]:
    """(N,) place in `STATES` of each scan against the map."""
    names = list(STATES)
    return np.array([names.index(state_of(fix)) for fix in record.map_fixes], np.uint8)


def localization_tracks(record: RunRecord) -> tuple[list[Track], list[tuple[str, str]]]:
    """Parts of the trajectory by state with their legend: held, held in doubt, carried; each reaches to the next scan."""
    xy, codes = record.trajectory.positions[:, :2], state_codes(record)
    styles = np.array([style for _, style in STATES.values()])[codes]
    words = {"s2": "held by the map", "s4": "held, the map has changed there", "carried": "carried by odometry"}
    tracks, legend = [], []
    for style, word in words.items():
        own = styles == style
        if own.any():
            reach = own | np.append(False, own[:-1])
            tracks.append(Track(word, np.where(reach[:, None], xy, np.nan), style))
            legend.append((style, f"{word}, {count_of(int(own.sum()), 'scan')}"))
    return tracks, legend


def changed_dots(sample: ArrayCloud | None) -> list[tuple[str, NDArray[Any]]]:
    """Places (K, 2), m, of what is gone and what is not in the map, by style, some of each; empty where nothing is known."""
    if sample is None or "change" not in sample.columns:
        return []
    dots = []
    for style, code in (("gone", -1), ("appeared", 1)):
        own = sample.points[sample.columns["change"] == code, :2]
        if len(own):
            dots.append((style, own[:: -(-len(own) // MOST_POINTS)]))
    return dots


def localization_figures(record: RunRecord) -> list[Figure]:
    """Agreement with the map and correction by it over the distance travelled; scans that odometry carries are marked."""
    fixes = record.map_fixes
    if not fixes:
        return []
    way, is_binding = record.trajectory.path_lengths, np.array([fix.is_binding for fix in fixes])
    carried = way[~is_binding]
    share = np.array([fix.inlier_share for fix in fixes])
    moved = np.array([fix.innovation[0] for fix in fixes])
    legend = (("failed", f"carried by odometry, {count_of(len(carried), 'scan')}"),) if len(carried) else ()

    def figure(title: str, label: str, values: NDArray[Any], caption: str) -> Figure:
        line = svg.Line(label, way, np.where(is_binding, values, np.nan), "s1")
        chart = svg.line_chart([line], "distance travelled, m", label, title.lower(), marks=carried, by="way")
        return Figure(title, chart, (("s1", "held by the map"), *legend), caption)

    return [
        figure(
            "Agreement with the map", "share of points", share, "Points within the kernel, of those that find the map."
        ),
        figure("Correction by the map", "m", moved, "How far the map moved each scan from where odometry carried it."),
    ]
