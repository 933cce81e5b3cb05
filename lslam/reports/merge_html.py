"""Page of merged runs: the common map, each session on it in its colour, and the connections between sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lslam.core.printable import metres
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.comparison import Table
from lslam.io.formats.atomic import atomic_write
from lslam.maps.floor_plan import TopView
from lslam.reports.compare_html import style_of
from lslam.reports.page_data import MapFigure, cloud_data, map_figure, packed, ways_data
from lslam.reports.plots import Figure
from lslam.reports.png import VIRIDIS
from lslam.reports.shell import MAP, render
from lslam.reports.svg import Track, plane_chart

RECIPE = "ATE of each session by itself, se3, m rmse; found by keyframes that agree, of those tried."


@dataclass(frozen=True)
class SessionView:
    """One session in the common world.

    Positions (N, 3), m, as it was connected to the others and after the pose graph; numbers (N,) of its scans.
    """

    name: str
    before: Floats
    after: Floats
    scans: Longs


def write_page(
    path: Path,
    sessions: Sequence[SessionView],
    rows: Sequence[Mapping[str, Any]],
    problems: Sequence[str],
    ties: Floats,
    view: TopView | None,
    sample: ArrayCloud | None,
) -> None:
    """Write the page atomically; raises OutputError when it cannot be written.

    rows : of the manifest's `sessions`; view, sample : of the merged map, from above and some of its points
    ties : (K, 2, 3) m, both ends of each loop between two sessions
    """
    shown = None if view is None else _map(sessions, view)
    after = [] if shown else [_figure("After the pose graph, from above", "", sessions, [s.after for s in sessions])]
    found = "Each session moved as a whole to where it was found."
    page = render(
        "merge.html.j2",
        MAP,
        names=[s.name for s in sessions],
        problems=problems,
        figures=[*after, _figure("Before the pose graph, from above", found, sessions, [s.before for s in sessions])],
        styles=[(s.name, style_of(s.name, [s.name for s in sessions])) for s in sessions],
        table=_table(rows),
        sessions_data=_sessions_data(sessions, ties),
        map_figure=shown,
        map_extent=None if view is None else view.extent,
        map_note="",
        cloud_data=cloud_data(sample, sessions=[s.after for s in sessions]),
        colours=VIRIDIS,
    )
    with atomic_write(path) as stream:
        stream.write(page.encode("utf-8", "replace"))


def _tracks(sessions: Sequence[SessionView], positions: Sequence[Floats]) -> list[Track]:
    names = [s.name for s in sessions]
    return [Track(name, p[:, :2], style_of(name, names)) for name, p in zip(names, positions, strict=True)]


def _map(sessions: Sequence[SessionView], view: TopView) -> MapFigure | None:
    tracks = _tracks(sessions, [s.after for s in sessions])
    legend = [(t.style, t.label) for t in tracks]
    return map_figure(view.image, view.heights, view.extent, tracks, legend, f"World of {sessions[0].name}.")


def _figure(title: str, caption: str, sessions: Sequence[SessionView], positions: Sequence[Floats]) -> Figure:
    tracks = _tracks(sessions, positions)
    return Figure(title, plane_chart(tracks, title.lower()), tuple((t.style, t.label) for t in tracks), caption)


def _sessions_data(sessions: Sequence[SessionView], ties: Floats) -> dict[str, Any]:
    """Data for the script: positions after and before, and scan numbers of each session; the loops."""
    names = [s.name for s in sessions]
    ways = [(s.name, style_of(s.name, names), s.after) for s in sessions]
    shown = ways_data(ways, [s.scans for s in sessions], [s.before for s in sessions])
    return {"sessions": shown, "ties": packed(ties, "<f4"), "tied": len(ties)}


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    header = ("session", "scans", "keyframes", "found by", "loops with others", "ATE alone, m", "ATE merged, m")
    texts = []
    for row in rows:
        before, after = row["ate"] or (None, None)
        found = f"{row['votes']} of {row['tried']}" if row["tried"] else "gives the world"
        texts.append(
            (
                row["name"],
                str(row["scans"]),
                str(row["keyframes"]),
                found,
                str(row["loops_between"]),
                "" if before is None else metres(before),
                "" if after is None else metres(after),
            )
        )
    return Table(
        "Sessions",
        header,
        tuple(texts),
        RECIPE,
    )
