"""Pages about several runs, of a comparison and of merged sessions: each one file, whole without its script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import LslamError
from lslam.core.printable import metres
from lslam.core.types.cloud import ArrayCloud, thin_out
from lslam.core.types.comparison import Comparison, Drawing, DrawnRun, RunScore, Table
from lslam.io.formats.atomic import write_text
from lslam.io.formats.point_files import read_cloud
from lslam.maps.floor_plan import TopView, top_view
from lslam.reports import svg
from lslam.reports.compare_table import TITLES, recipes, stage_times, tables
from lslam.reports.html import flatten
from lslam.reports.page_data import MapFigure, cloud_data, map_figure, pack, ways_data
from lslam.reports.plots import DISTANCE, LIMIT_IN_VIEW, Figure, legend_of, line_figure
from lslam.reports.png import VIRIDIS, Crop, choose_crops, crop_images, data_uri, density_png
from lslam.reports.shell import MAP, RUN, render
from lslam.reports.svg import Track, plane_chart

MAP_POINTS = 100_000  # under the trajectories
WIDEST = 165  # characters of a table that the page shows without scrolling
STYLES = 12
SHADES = 8  # of grey, for stages: colours are those of methods
_ROW, _BAR = 42, 18


@dataclass(frozen=True)
class SequenceSection:
    """One sequence on the page.

    It has figures of errors and trajectories, of times, map crops by place, links to the pages of its runs; and the first
    with a map has this, as `map_section.html.j2` takes it.
    """

    sequence: str
    figures: list[Figure]
    time: Figure | None
    crops: list[list[Figure]]
    links: list[tuple[str, str]]
    map: dict[str, Any] | None


def write_page(
    path: Path, comparison: Comparison, drawings: Sequence[Drawing], crop: tuple[float, float, float] | None = None
) -> None:
    """Write the page atomically; `crop` (x, y, size), m, shows one place instead of those with most structure.

    Raises OutputError when it cannot be written.
    """
    write_text(path, render_page(path.parent, comparison, drawings, crop))


def render_page(
    folder: Path, comparison: Comparison, drawings: Sequence[Drawing], crop: tuple[float, float, float] | None = None
) -> str:
    """Page as text; links to runs are relative to `folder`."""
    place = None if crop is None else Crop(*crop)
    sections: list[SequenceSection] = []
    for name in comparison.sequences:
        has_map = any(section.map for section in sections)
        sections.append(_section(folder, comparison, name, drawings, place, not has_map))
    short, times = stage_times(comparison)
    shown = tables(short, WIDEST)
    is_first = [t.title in ("", *TITLES.values(), *(b.title for b in comparison.beside)) for t in shown]
    return render(
        "compare.html.j2",
        MAP,
        comparison=comparison,
        tables=[t for t, first in zip(shown, is_first, strict=True) if first],
        more=[t for t, first in zip(shown, is_first, strict=True) if not first],
        times=times,
        recipes=recipes(comparison),
        sections=sections,
        styles={method: style_of(method, comparison.methods) for method in comparison.methods},
        colours=VIRIDIS,
        map_note="",
        machine=_machine(comparison),
        configs=_configs(comparison),
    )


def _section(
    folder: Path,
    comparison: Comparison,
    sequence: str,
    drawings: Sequence[Drawing],
    crop: Crop | None,
    may_have_map: bool,
) -> SequenceSection:
    """Section of one sequence: figures, map where there may be one, crops, and links to the pages of its runs."""
    figures: list[Figure] = []
    crops: list[list[Figure]] = []
    map_shown = None
    for drawing in drawings:
        if drawing.sequence == sequence:
            clouds = [_cloud(run) for run in drawing.runs]
            map_shown = method_map(drawing, comparison.methods, clouds) if may_have_map else None
            figures += [] if (errors := error_figure(drawing, comparison.methods)) is None else [errors]
            figures += [] if map_shown else [trajectory_figure(drawing, comparison.methods)]
            crops = crop_figures(drawing, crop, clouds)
    links = [
        (f"{run.method}, seed {run.seed}", quote(page.relative_to(folder).as_posix()))
        for run in comparison.runs
        if run.sequence == sequence and (page := run.folder / "report.html").is_file()
    ]
    return SequenceSection(sequence, figures, time_figure(comparison, sequence), crops, links, map_shown)


def method_map(drawing: Drawing, methods: Sequence[str], clouds: Sequence[Floats | None]) -> dict[str, Any] | None:
    """Values for the template of a map: the first cloud there is, with every trajectory over it; None without a cloud."""
    known = [(run.method, cloud) for run, cloud in zip(drawing.runs, clouds, strict=True) if cloud is not None]
    if not known:
        return None
    method, points = known[0]
    view = top_view(points)
    about = f"{_sentence(f'seed {drawing.seed}, {drawing.recipe}')} Points: map of {method}."
    figure = _tracks_on_map(view, _tracks(drawing, methods), about)
    if figure is None:
        return None
    ways = [(run.method, style_of(run.method, methods), run.positions) for run in drawing.runs]
    ways = ways if drawing.gt_positions is None else [("ground truth", "gt", drawing.gt_positions), *ways]  # underneath
    return {
        "map_figure": figure,
        "map_extent": view.extent,
        "cloud_data": cloud_data(thin_out(ArrayCloud(points), MAP_POINTS)),
        "sessions": {"sessions": ways_data(ways), "ties": "", "tied": 0},
    }


def _machine(comparison: Comparison) -> list[tuple[str, list[str]]]:
    """Versions as (name, values): more than one value means that kept runs were made with other versions."""
    found: dict[str, dict[str, None]] = {}
    for run in comparison.runs:
        for name, value in run.machine.items():
            found.setdefault(name, {})["absent" if value is None else str(value)] = None
    return [(name, list(values)) for name, values in found.items()]


def _configs(comparison: Comparison) -> list[tuple[str, list[str], bool]]:
    """Every key as (name, values, whether methods differ): one value where all have the same, else one per method."""
    flat = {method: dict(flatten(config)) for method, config in comparison.configs.items()}
    rows = []
    for name in dict.fromkeys(name for keys in flat.values() for name in keys):
        said = {method: ", ".join(keys.get(name, ["absent"])) for method, keys in flat.items()}
        differ = len(set(said.values())) > 1
        values = [f"{method}: {value}" for method, value in said.items()] if differ else [next(iter(said.values()))]
        rows.append((name, values, differ))
    return sorted(rows, key=lambda row: not row[2])


def style_of(method: str, methods: Sequence[str]) -> str:
    """Style sheet class of a method, the same everywhere on the page."""
    return f"s{methods.index(method) % STYLES + 1}"


def _tracks(drawing: Drawing, methods: Sequence[str]) -> list[Track]:
    """Trajectories of a drawing, ground truth last, dashed."""
    tracks = _named_tracks([run.method for run in drawing.runs], [run.positions for run in drawing.runs], methods)
    truth = drawing.gt_positions
    return tracks if truth is None else [*tracks, Track("ground truth", truth[:, :2], "gt")]


def _named_tracks(names: Sequence[str], positions: Sequence[Floats], among: Sequence[str]) -> list[Track]:
    """Tracks from above of positions (N, 3), each with its name and the style of that name among `among`."""
    return [Track(name, p[:, :2], style_of(name, among)) for name, p in zip(names, positions, strict=True)]


def _tracks_on_map(view: TopView, tracks: list[Track], about: str) -> MapFigure | None:
    """Figure of tracks over a map from above; about : sentence on the frame."""
    return map_figure(view.image, view.heights, view.extent, tracks, legend_of(tracks), about)


def _plan(title: str, tracks: list[Track], caption: str = "", spoken: str = "") -> Figure:
    """Figure of tracks from above; spoken : title for screen readers, if another."""
    return Figure(title, plane_chart(tracks, spoken or title.lower()), legend_of(tracks), caption)


def trajectory_figure(drawing: Drawing, methods: Sequence[str]) -> Figure:
    """All trajectories of a drawing from above, ground truth dashed."""
    caption, spoken = (
        _sentence(f"Seed {drawing.seed}, {drawing.recipe}"),
        f"trajectories on {drawing.sequence} from above",
    )
    return _plan("Trajectories from above", _tracks(drawing, methods), caption, spoken)


def error_figure(drawing: Drawing, methods: Sequence[str]) -> Figure | None:
    """Position error over distance, one line per method; without ground truth the distance from the reference method."""
    lines = [
        svg.Line(run.method, run.distance, run.errors, style_of(run.method, methods))
        for run in drawing.runs
        if run.distance is not None and run.errors is not None
    ]
    if not lines:
        return None
    if not drawing.reference:
        caption, spoken = _sentence(f"Seed {drawing.seed}, {drawing.recipe}"), f"position error on {drawing.sequence}"
        return line_figure("Position error", lines, DISTANCE, "position error, m", caption, spoken=spoken)
    title, along = f"Distance from {drawing.reference}", f"distance along {drawing.reference}, m"
    caption = (
        f"Seed {drawing.seed}. No ground truth: from the same start, how far each is from {drawing.reference}, which may be "
        "the one that is wrong."
    )
    return line_figure(title, lines, along, "distance, m", caption, spoken=f"{title} on {drawing.sequence}")


def time_figure(comparison: Comparison, sequence: str) -> Figure | None:
    """Mean time per scan of every method, stages stacked, against the real-time limit; None when nothing was timed."""
    runs = [r for r in comparison.runs if r.sequence == sequence and r.is_usable and r.stages]
    stages = list(dict.fromkeys(name for run in comparison.runs for name in run.stages))
    bars = []
    for method in comparison.methods:
        own = [run for run in runs if run.method == method]
        if own:
            means = {name: 1e3 * float(np.mean([run.stages.get(name, 0.0) for run in own])) for name in stages}
            bars.append((_bar_label(method, own), means))
    if not bars:
        return None
    limits = [run.limit for run in runs if run.limit]
    chart = _bars(bars, stages, 1e3 * limits[0] if limits else 0.0, f"mean time per scan on {sequence}")
    caption = (
        "Means over scans, then seeds, as in the table; stages stacked. Reading and preparing may overlap registration."
    )
    if any(run.jobs > 1 for run in runs):
        caption += " Marked ~: several runs shared the machine, so these times cannot be compared."
    legend = tuple((f"t{i % SHADES + 1}", name) for i, name in enumerate(stages))
    return Figure("Mean time per scan", chart, legend, caption, is_area=True)


def crop_figures(drawing: Drawing, crop: Crop | None, clouds: Sequence[Floats | None]) -> list[list[Figure]]:
    """For each place, one figure per method that has a map; places are chosen in the first map of `clouds`."""
    known = [cloud for cloud in clouds if cloud is not None]
    if not known:
        return []
    places = []
    for place in [crop] if crop is not None else choose_crops(known[0]):
        images, top = crop_images(clouds, place)
        row = []
        for run, image in zip(drawing.runs, images, strict=True):
            if image is None:
                continue
            backdrop = (data_uri(density_png(image, top)), place.extent)
            empty = Track("", np.full((1, 2), np.nan), "gt")
            title = f"map of {run.method} on {drawing.sequence} at {place.x:g}, {place.y:g}"
            row.append(Figure(run.method, plane_chart([empty], title, backdrop=backdrop, width=340, tallest=340)))
        places.append(row)
    return places


def _cloud(run: DrawnRun) -> Floats | None:
    """The map's points in the world of the drawing; None when there is no map that can be read."""
    if run.map_file is None:
        return None
    try:
        points = read_cloud(run.map_file).points
    except LslamError:
        return None
    T = run.T_drawing_world
    return points @ T[:3, :3].T + T[:3, 3]


def _bar_label(method: str, runs: Sequence[RunScore]) -> str:
    """Text of a bar: method, mean and 95th percentile of the time per scan."""
    mark = "~" if any(run.jobs > 1 for run in runs) else ""
    keys = ("time.mean", "time.p95")
    mean, p95 = (float(np.mean([run.values[key] for run in runs if key in run.values])) for key in keys)
    return f"{method}: mean {mark}{mean:.1f} ms, p95 {mark}{p95:.1f}"


def _bars(bars: Sequence[tuple[str, dict[str, float]]], stages: Sequence[str], limit: float, title: str) -> str:
    """A horizontal bar per method with its label above; the limit is a line when it is in view, else an arrow says where."""
    longest = max(sum(means.values()) for _, means in bars) or 1.0
    limit_inside = 0 < limit <= LIMIT_IN_VIEW * longest
    right = 1.06 * max(longest, limit if limit_inside else 0.0)
    frame = svg.Frame((0.0, right), (0.0, 1.0), height=svg.MARGIN_TOP + svg.MARGIN_BOTTOM + _ROW * len(bars))
    frame.left = 14
    for value in svg.ticks(0.0, right, 6):
        x = float(frame.px(value))
        frame.add(f'<path class="grid" d="M{x:.1f} {frame.top}V{frame.bottom}"/>')
        frame.text(x, frame.bottom + 16, svg.number(value, right), "middle")
    frame.text((frame.left + frame.right) / 2, frame.height - 6, "mean time per scan, ms", "middle", "label")
    for i, (_, means) in enumerate(bars):
        y = frame.top + _ROW * i
        below = 0.0
        for k, stage in enumerate(stages):
            x0, x1 = float(frame.px(below)), float(frame.px(below + means[stage]))
            said = escape(f"{stage}: {means[stage]:.2f} ms")
            frame.add(
                f'<rect class="area t{k % SHADES + 1}" x="{x0:.1f}" y="{y + 21}" width="{x1 - x0:.1f}" height="{_BAR}">'
                f"<title>{said}</title></rect>"
            )
            below += means[stage]
    frame.add(f'<path class="axis" d="M{frame.left} {frame.top}V{frame.bottom}"/>')
    if limit_inside:
        x = float(frame.px(limit))
        # Not through labels.
        across = "".join(f"M{x:.1f} {frame.top + _ROW * i + 20}v{_BAR + 2}" for i in range(len(bars)))
        frame.add(f'<path class="limit" d="{across}"/>')
        side = "end" if x > (frame.left + frame.right) / 2 else "start"
        frame.text(
            x + (-4 if side == "end" else 4), frame.top - 8, f"real-time limit {limit:.0f} ms", side, "limit-text"
        )
    elif limit > 0:
        frame.text(frame.right, frame.top - 8, f"real-time limit {limit:.0f} ms →", "end", "limit-text")
    for i, (label, _) in enumerate(bars):  # last, so that the limit does not cross them out
        frame.text(frame.left + 4, frame.top + _ROW * i + 15, label, "start", "label over")
    return frame.svg(title)


def _sentence(text: str) -> str:
    """Text as a sentence: with a capital and a full stop."""
    return f"{text[0].upper()}{text[1:]}."


SESSION_RECIPE = "ATE of each session by itself, se3, m rmse; found by keyframes that agree, of those tried."


@dataclass(frozen=True)
class SessionView:
    """A session in the common world: positions (N, 3), m, as connected and after the pose graph; numbers (N,) of scans."""

    name: str
    before: Floats
    after: Floats
    scans: Longs


def write_merge_page(
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
    names = [s.name for s in sessions]
    before, after = ([getattr(s, when) for s in sessions] for when in ("before", "after"))
    tracks, known = _named_tracks(names, after, names), "Each session moved as a whole to where it was found."
    shown = None if view is None else _tracks_on_map(view, tracks, f"World of {names[0]}.")
    figures = [] if shown else [_plan("After the pose graph, from above", tracks)]
    figures.append(_plan("Before the pose graph, from above", _named_tracks(names, before, names), known))
    styles = [(name, style_of(name, names)) for name in names]
    ways = [(*style, positions) for style, positions in zip(styles, after, strict=True)]
    sessions_data = ways_data(ways, [s.scans for s in sessions], before)
    page = render(
        "merge.html.j2",
        RUN,
        names=names,
        problems=problems,
        figures=figures,
        styles=styles,
        table=_session_table(rows),
        sessions_data={"sessions": sessions_data, "ties": pack(ties, "<f4"), "tied": len(ties)},
        map_figure=shown,
        map_extent=None if view is None else view.extent,
        map_note="",
        cloud_data=cloud_data(sample, sessions=after),
        colours=VIRIDIS,
    )
    write_text(path, page)


def _session_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Table of merged sessions: scans, keyframes, localised keyframes, loops with others, errors before and after, m."""
    header = ("session", "scans", "keyframes", "found by", "loops with others", "ATE alone, m", "ATE merged, m")
    texts = []
    for row in rows:
        found = f"{row['votes']} of {row['tried']}" if row["tried"] else "gives the world"
        errors = ("" if error is None else metres(error) for error in row["ate"] or (None, None))
        texts.append((row["name"], str(row["scans"]), str(row["keyframes"]), found, str(row["loops_between"]), *errors))
    return Table("Sessions", header, tuple(texts), SESSION_RECIPE)
