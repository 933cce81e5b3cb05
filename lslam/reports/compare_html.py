"""compare.html: one self-contained page about a comparison. No script, no second file, no network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lslam.formats.atomic import atomic_write
from lslam.reports.compare_figures import crop_figures, error_figure, style_of, time_figure, trajectory_figure
from lslam.reports.compare_table import recipes, tables
from lslam.reports.crops import Crop
from lslam.reports.html import flatten, template
from lslam.reports.plots import Figure
from lslam.types.comparison import Comparison, Drawing
from lslam.version import __version__

WIDEST = 125  # characters of a table that the page shows without scrolling


@dataclass(frozen=True)
class SequenceSection:
    """One sequence on the page: its figures, its map crops by place, links to the pages of its runs."""

    sequence: str
    figures: list[Figure]
    crops: list[list[Figure]]
    links: list[tuple[str, str]]


def write_page(
    path: Path, comparison: Comparison, drawings: Sequence[Drawing], crop: tuple[float, float, float] | None = None
) -> None:
    """Write the page atomically; `crop` (x, y, size), m, shows one place instead of those with most structure.

    Raises OutputError when it cannot be written.
    """
    with atomic_write(path) as stream:
        stream.write(render_page(path.parent, comparison, drawings, crop).encode("utf-8", "replace"))


def render_page(
    folder: Path, comparison: Comparison, drawings: Sequence[Drawing], crop: tuple[float, float, float] | None = None
) -> str:
    """The page as text; links to runs are relative to `folder`."""
    place = None if crop is None else Crop(*crop)
    sections = [_section(folder, comparison, name, drawings, place) for name in comparison.sequences]
    return template("compare.html.j2").render(
        comparison=comparison,
        version=__version__,
        tables=tables(comparison, WIDEST),
        recipes=recipes(comparison),
        sections=sections,
        styles={method: style_of(method, comparison.methods) for method in comparison.methods},
        machine=_machine(comparison),
        configs=_configs(comparison),
    )


def _section(
    folder: Path, comparison: Comparison, sequence: str, drawings: Sequence[Drawing], crop: Crop | None
) -> SequenceSection:
    figures: list[Figure | None] = []
    crops: list[list[Figure]] = []
    for drawing in drawings:
        if drawing.sequence == sequence:
            figures += [trajectory_figure(drawing, comparison.methods), error_figure(drawing, comparison.methods)]
            crops = crop_figures(drawing, crop)
    figures.append(time_figure(comparison, sequence))
    links = [
        (f"{run.method}, seed {run.seed}", quote(page.relative_to(folder).as_posix()))
        for run in comparison.runs
        if run.sequence == sequence and (page := run.folder / "report.html").is_file()
    ]
    return SequenceSection(sequence, [f for f in figures if f is not None], crops, links)


def _machine(comparison: Comparison) -> list[tuple[str, list[str]]]:
    """Versions as (name, values): more than one value means that kept runs were made with other versions."""
    found: dict[str, dict[str, None]] = {}
    for run in comparison.runs:
        for name, value in run.machine.items():
            found.setdefault(name, {})[_text(value)] = None
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


def _text(value: Any) -> str:
    return "absent" if value is None else str(value)
