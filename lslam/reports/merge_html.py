"""The page of merged runs: each session in its colour, as it was tied in and as the graph left it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.formats.atomic import atomic_write
from lslam.maps.floor_plan import TopView
from lslam.printable import metres
from lslam.reports.compare_html import style_of
from lslam.reports.plots import Figure
from lslam.reports.png import data_uri, density_png
from lslam.reports.shell import render
from lslam.reports.svg import Track, plane_chart
from lslam.types.table import Table

Floats = NDArray[np.float64]
RECIPE = "ATE of each session by itself, se3, m rmse; found by keyframes that agree, of those tried."


@dataclass(frozen=True)
class SessionView:
    """Positions (N, 3), m, common world, of one session: as it was tied to the others, and after the pose graph."""

    name: str
    before: Floats
    after: Floats


def write_page(
    path: Path,
    sessions: Sequence[SessionView],
    rows: Sequence[Mapping[str, Any]],
    problems: Sequence[str],
    view: TopView | None,
) -> None:
    """Write the page atomically; raises OutputError when it cannot be written.

    rows : of the manifest's `sessions`; view : of the merged map
    """
    names = [s.name for s in sessions]
    page = render("merge.html.j2", names=names, problems=problems, figures=_figures(sessions, view), table=_table(rows))
    with atomic_write(path) as stream:
        stream.write(page.encode("utf-8", "replace"))


def _figures(sessions: Sequence[SessionView], view: TopView | None) -> list[Figure]:
    names = [s.name for s in sessions]
    backdrop = None if view is None else (data_uri(density_png(view.image)), view.extent)
    figures = []
    for title, caption, positions in (
        ("After the pose graph, from above", "On the map of all sessions.", [s.after for s in sessions]),
        ("Before, from above", "Each session moved as a whole to where it was found.", [s.before for s in sessions]),
    ):
        tracks = [Track(name, p[:, :2], style_of(name, names)) for name, p in zip(names, positions, strict=True)]
        chart = plane_chart(tracks, title.lower(), backdrop=backdrop if "After" in title else None)
        figures.append(Figure(title, chart, tuple((t.style, t.label) for t in tracks), caption))
    return figures


def _table(rows: Sequence[Mapping[str, Any]]) -> Table:
    header = ("session", "scans", "keyframes", "found by", "loops with others", "ATE alone, m", "ATE merged, m")
    texts = []
    for row in rows:
        before, after = row["ate"] or (None, None)
        found = f"{row['votes']} of {row['tried']}" if row["tried"] else "gives the world"
        texts.append(
            (row["name"], str(row["scans"]), str(row["keyframes"]), found, str(row["loops_between"]),
             "" if before is None else metres(before), "" if after is None else metres(after))
        )  # fmt: skip
    return Table(
        "Sessions",
        header,
        tuple(texts),
        RECIPE,
    )
