"""report.html: one self-contained page about one run. No second file, no network; whole without its script."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.printable import count_of
from lslam.core.types.comparison import Table
from lslam.core.types.imu import XYZ
from lslam.core.types.run_record import RunRecord
from lslam.evaluation.evaluate import shown_metrics
from lslam.io.formats.atomic import write_text
from lslam.reports import plots, svg
from lslam.reports.back_end import (
    WORDS,
    back_end_figures,
    back_end_rows,
    changed_dots,
    localization_figures,
    localization_tracks,
)
from lslam.reports.buildings import building_pages
from lslam.reports.facts import map_cards, run_cards, run_facts
from lslam.reports.page_data import MapFigure, candidate_data, cloud_data, feature_figures, map_figure, scan_data
from lslam.reports.plots import Figure, line_figure, numbered_lines
from lslam.reports.png import VIRIDIS
from lslam.reports.shell import RUN, render, template
from lslam.reports.svg import Track
from lslam.reports.text import imu_rows, localization_rows

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation


TIME = "s since the first scan"
BAND_SIGMAS = 3.0


@dataclass(frozen=True)
class _Course:
    """A figure of the `IMU_STATES` columns `begin` to `end` (exclusive), times `factor`."""

    title: str
    y_label: str
    begin: int
    end: int
    factor: float = 1.0
    names: tuple[str, ...] = XYZ
    recipe: str = "IMU axes."


_COURSES = (
    _Course("Accelerometer bias", "bias, m/s²", 0, 3),
    _Course("Gyroscope bias", "bias, deg/s", 3, 6, 180 / np.pi),
    _Course("Gravity", "gravity, m/s²", 6, 9, recipe="World axes: what moves is a world that registration turned."),
    _Course(
        "Mounting", "rotation vector, deg", 9, 12, 180 / np.pi, recipe="From the IMU's axes to those that were given."
    ),
    _Course("Clock offset", "to add to the IMU's stamps, ms", 12, 13, 1e3, ("offset",), ""),
)


def imu_figures(record: RunRecord) -> list[Figure]:
    """States of the IMU after each scan with their bands, then its readings; empty without an IMU."""
    known = [(r.stamp_ns, r.imu.state) for r in record.results if r.imu.state is not None]
    figures = []
    if known:
        seconds = _seconds(np.array([stamp for stamp, _ in known], np.int64), record)
        values, sigmas = (np.stack([getattr(state, what) for _, state in known]) for what in ("values", "sigmas"))
        for course in _COURSES:
            part = slice(course.begin, course.end)
            figures.append(_course(course, seconds, course.factor * values[:, part], course.factor * sigmas[:, part]))
    return [figure for figure in [*figures, *_readings(record)] if figure.svg]


def _course(course: _Course, seconds: Floats, values: Floats, sigmas: Floats) -> Figure:
    """Figure of IMU states over time, with bands; values, sigmas : (N, states) at `seconds` (N,)."""
    lines, reach = numbered_lines(course.names, seconds, values.T), BAND_SIGMAS * sigmas.T
    bands = [svg.Band(line.x, line.y - r, line.y + r, line.style) for line, r in zip(lines, reach, strict=True)]
    caption, legend = f"{course.recipe} Band: {BAND_SIGMAS:g} sigma.".strip(), None if len(lines) > 1 else ()
    chart: dict[str, Any] = {"zero": False, "bands": bands, "by": "time"}
    return line_figure(course.title, lines, TIME, course.y_label, caption, legend=legend, **chart)


def _readings(record: RunRecord) -> list[Figure]:
    """Raw IMU readings during the recording's scans."""
    imu = record.imu
    if imu is None or not record.results:
        return []
    first, last = record.results[0].stamp_ns, record.results[-1].stamp_ns
    during = (imu.stamps_ns >= first) & (imu.stamps_ns <= last)
    seconds = _seconds(imu.stamps_ns[during], record)
    recipe = "As recorded, in IMU axes; of a long recording the least and the largest of each stretch."
    return [
        line_figure(title, numbered_lines(XYZ, seconds, values.T), TIME, y_label, recipe, by="time")
        for title, y_label, values in (
            ("Specific force", "as recorded (m/s² if it is right)", imu.accel[during]),
            ("Angular rate", "as recorded (rad/s if it is right)", imu.gyro[during]),
        )
    ]


def _seconds(stamps_ns: Longs, record: RunRecord) -> Floats:
    """Time since the run's first scan, s."""
    return np.asarray((stamps_ns - record.results[0].stamp_ns) * 1e-9)


MOST_ROWS = 100
# Parts of the page, between marks of these names, that another map changes.
MAP_PARTS = {"cards": "map_cards.html.j2", "map": "map_section.html.j2", "manifest": "manifest_table.html.j2"}


def write_report(path: Path, record: RunRecord, evaluation: Evaluation | None) -> None:
    """Write the HTML report of a run, atomically.

    path : the file, usually `report.html` in the run folder
    evaluation : the run's score against ground truth; None without: the error parts then say so in one line
    Raises OutputError: the file cannot be written.
    """
    write_text(path, render_report(record, evaluation))


def render_report(record: RunRecord, evaluation: Evaluation | None) -> str:
    """Report page as text."""
    facts, tables = run_facts(record), list[Table]()
    if evaluation is not None:
        tables = [table for metric in shown_metrics(evaluation) for table in metric.tables(evaluation)]
    return render(
        "report.html.j2",
        RUN,
        record=record,
        facts=facts,
        scan_data=scan_data(record, evaluation),
        candidate_data=candidate_data(record),
        cards=run_cards(record, facts, evaluation),
        failures=facts.failures[:MOST_ROWS],
        degenerate=facts.degenerate[:MOST_ROWS],
        evaluation=evaluation,
        has_truth=record.ground_truth is not None,
        trajectory=plots.trajectory_figures(record, evaluation),
        back_end=back_end_figures(record, evaluation),
        localization=localization_figures(record),
        back_end_title="In the map" if record.map_fixes else "Pose graph",
        back_end_said=localization_rows(record, evaluation) + back_end_rows(record, evaluation),
        errors=plots.error_figures(evaluation) if evaluation is not None else [],
        tables=[table for table in tables if table.rows],
        buildings=building_pages(record),
        time=plots.time_figure(record, facts) if facts.stages else None,
        share_bar=plots.share_bar(facts) if facts.stages else "",
        registration=plots.registration_figures(record),
        features=feature_figures(record.features),
        imu=[said for _, said in imu_rows(record)],
        imu_figures=imu_figures(record),
        uncertainty=plots.uncertainty_figures(record),
        config_text=_config_text(record.folder),
        **map_context(record),
    )


def map_context(record: RunRecord) -> dict[str, Any]:
    """Values for the templates `MAP_PARTS`."""
    return {
        "map_cards": map_cards(record),
        "map_figure": _map_figure(record),
        "map_note": _map_note(record.manifest),
        "cloud_data": cloud_data(record.map_sample, record.trajectory),
        "map_extent": record.map_extent,
        "colours": VIRIDIS,
        # Digests, which the machine compares, after what people read.
        "facts_of_input": sorted(flatten(record.manifest), key=lambda row: row[0].startswith("identity.")),
    }


def _map_figure(record: RunRecord) -> MapFigure | None:
    """Figure of the map with trajectory, localised keyframes and changes; None without a map image."""
    if record.map_image is None:
        return None
    tracks, legend = [Track("trajectory", record.trajectory.positions[:, :2], "s2", ends=True)], [("s2", "trajectory")]
    about, score = "World of the estimate.", record.crispness
    if score is not None and score.entropy is not None:
        about += f" Map entropy {score.entropy:.2f}: lower is crisper."
    if record.map_fixes:
        tracks, legend = localization_tracks(record)
        tracks.append(Track("ends", record.trajectory.positions[:, :2], "none", ends=True))
        about = f"World and points of {record.manifest.get('localization', {}).get('map', 'the map')}, which holds the drive."
    legend += [("start", "start"), ("end", "end")]
    dots = changed_dots(record.map_sample)
    legend += [(style, WORDS[style]) for style, _ in dots]
    return map_figure(
        record.map_image, record.map_heights, record.map_extent, tracks, legend, about, by="own", dots=dots
    )


def flatten(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, list[str]]]:
    """Rows (dotted key, texts) of the manifest, in its order; status and problems are shown elsewhere on the page.

    >>> flatten({"input": {"kind": "bin"}, "notes": ["a", "b"], "status": "ok"})
    [('input.kind', ['bin']), ('notes', ['a', 'b'])]
    """
    rows: list[tuple[str, list[str]]] = []
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if not prefix and key in ("problems", "status", "why"):
            continue
        if isinstance(value, Mapping):
            rows += flatten(value, f"{name}.")
        elif isinstance(value, (list, tuple)):
            if value:
                rows.append((name, [_plain(v) for v in value]))
        elif value is not None and value != "":
            rows.append((name, [_plain(value)]))
    return rows


def _plain(value: Any) -> str:
    """Value as text for the page."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _map_note(manifest: Mapping[str, Any]) -> str:
    """Remark on a map that was built after the run, or what differs in an old one; empty for the run's own."""
    built, found = manifest.get("map"), manifest.get("localization", {}).get("differences")
    if not isinstance(built, Mapping):
        return "" if found is None else _differences_note(found)
    done = built.get("done")
    said = "".join(f"; {text}" for text in done) if isinstance(done, list) else ""
    points = f"voxels of {_plain(built.get('voxel'))} m" if built.get("voxel") else "every point"
    return f"{built.get('file')}, built anew after the run with {points}{said}"


def _differences_note(differences: Mapping[str, Any]) -> str:
    """Sentence on the differences between drive and map."""
    new, gone = count_of(differences["not_in_the_map"], "thing"), count_of(differences["gone"], "thing")
    return (
        f"Against the map: {gone} gone, that beams passed through, and {new} not in it, new or hidden when it was made; by "
        f"the scans that the map holds, in cells of {differences['voxel_m']:g} m. lslam map --changes compares both drives by "
        "all their beams."
    )


def _config_text(folder: Path | None) -> str:
    """Resolved configuration stored in the run folder; empty when there is none."""
    if folder is None:
        return ""
    try:
        return (folder / "config.toml").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


def with_new_map(page: str, record: RunRecord) -> str:
    """Page of a run with the map's figures, picture and manifest replaced by those of `record`.

    Raises ValueError when the marks of these parts are missing in the page.
    """
    for name, file in MAP_PARTS.items():
        begin, end = (f"<!-- {word} {name} -->\n" for word in ("begin", "end"))
        before, found, rest = page.partition(begin)
        _, found_too, after = rest.partition(end)
        if not (found and found_too):
            raise ValueError(f"the page has no part {name}")
        page = before + begin + template(file).render(map_context(record)) + end + after
    return page
