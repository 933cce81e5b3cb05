"""Pictures drawn with matplotlib: one style, and the same bytes for the same input, on paper and in a notebook."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.core.errors import UsageError
from lslam.core.printable import printable
from lslam.io.formats.atomic import atomic_write

if TYPE_CHECKING:
    from lslam.core.arrays import Floats
    from lslam.evaluation.metric import AbsoluteError, Evaluation
    from lslam.io.formats.osm_buildings import BuildingExtract


FORMATS = ("png", "svg", "pdf")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito: safe for colour blindness
UNKNOWN = "#bbbbbb"


def check_plot_path(path: Path) -> None:
    """Raise UsageError if the suffix of `path` names no supported picture format; called before the work."""
    kind = path.suffix.lstrip(".").lower()
    if kind not in FORMATS:
        raise UsageError(f"{path}: a picture ends with .png, .svg or .pdf")


@contextmanager
def house_style(font: float = 9.0) -> Iterator[None]:
    """Context with the common style; figures are made and saved inside. Text stays text, of `font` points."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "lslam", "svg.fonttype": "none", "font.size": font}):
        yield


def pictures(figure: Any, kinds: Sequence[str]) -> list[bytes]:
    """Files of a matplotlib figure in several formats; the layout is computed only once, since it is slow."""
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    ConstrainedLayoutEngine().execute(figure)
    return [picture(figure, kind) for kind in kinds]


def picture(figure: Any, kind: str, dpi: int = 120) -> bytes:
    """File of a matplotlib figure in one of FORMATS, without a creation time."""
    stamp: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}[kind]
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=dpi, metadata=stamp)
    return stream.getvalue()


@cache
def shown_figure() -> type[Any]:
    """matplotlib figure that a notebook shows without pyplot."""
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        """A figure that is its own picture."""

        def _repr_png_(self) -> bytes:
            return picture(self, "png")

    return ShownFigure


def label(plot: Any, x: str, y: str) -> None:
    """Label the axes and remove the upper and right frame."""
    plot.set_xlabel(x)
    plot.set_ylabel(y)
    plot.grid(alpha=0.25)
    plot.spines[["top", "right"]].set_visible(False)


def write_plot(path: str | Path, evaluations: Sequence[Evaluation]) -> None:
    """Draw evaluations against one ground truth into `path` (.png, .svg, .pdf), atomically.

    Raises UsageError for another suffix, OutputError when the file cannot be written.
    """
    from lslam.reports.evaluations import short_names

    path = Path(path)
    check_plot_path(path)
    with house_style():
        labels = [printable(label) for label in short_names([e.estimate for e in evaluations])]
        figure = _draw(evaluations, labels)
        with atomic_write(path) as stream:
            stream.write(picture(figure, path.suffix.lstrip(".").lower()))


def _draw(evaluations: Sequence[Evaluation], names: Sequence[str]) -> Any:
    """Figure of one or more evaluations: trajectories, errors over distance, errors per axis of the first, and drift."""
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 9), layout="constrained")
    grid = figure.add_gridspec(4, 2, width_ratios=[1.15, 1])
    above, height = figure.add_subplot(grid[:3, 0]), figure.add_subplot(grid[3, 0])
    position, rotation = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    axes, drift = figure.add_subplot(grid[2, 1]), figure.add_subplot(grid[3, 1])
    shown = [_best_alignment(e) for e in evaluations]
    _trajectories(above, height, evaluations, names, shown)
    for e, name, error, colour in zip(evaluations, names, shown, _colours(len(names)), strict=True):
        position.plot(e.distance, np.linalg.norm(error.errors, axis=1), color=colour, lw=1.1, label=name)
        rotation.plot(e.distance, error.rotation_errors_deg, color=colour, lw=1.1)
    rmse = ", ".join(f"{error.translation.rmse:.3f} m" for error in shown if error.translation)
    position.set_title(f"position error, alignment {shown[0].alignment}: rmse {rmse}", fontsize=9)
    rotation.set_title("rotation error, same alignment", fontsize=9)
    label(position, "", "m")
    label(rotation, "distance along ground truth, m", "deg")
    _axis_errors(axes, evaluations[0], names[0])
    _drift_axes(drift, evaluations, names)
    return figure


def _trajectories(
    above: Any, height: Any, evaluations: Sequence[Evaluation], names: Sequence[str], errors: Sequence[AbsoluteError]
) -> None:
    """Draw aligned estimates and ground truth from above (`above`), and their height over distance (`height`)."""
    first = evaluations[0]
    above.plot(*first.gt_positions[:, :2].T, color="black", lw=2.5, alpha=0.35, label="ground truth")
    height.plot(first.distance, first.gt_positions[:, 2], color="black", lw=2.5, alpha=0.35)
    for e, name, error, colour in zip(evaluations, names, errors, _colours(len(names)), strict=True):
        above.plot(*error.aligned_positions[:, :2].T, color=colour, lw=1.2, label=f"{name} ({error.alignment})")
        height.plot(e.distance, error.aligned_positions[:, 2], color=colour, lw=1.1)
    above.plot(*first.gt_positions[0, :2], "o", color="black", ms=5)
    above.annotate("start", first.gt_positions[0, :2], textcoords="offset points", xytext=(6, 6))
    above.set_aspect("equal", adjustable="datalim")
    above.legend(loc="best", frameon=False)
    above.set_title(f"seen from above; {first.matched} poses, {first.path_length:.1f} m", fontsize=9)
    label(above, "x, m", "y, m")
    label(height, "distance along ground truth, m", "z, m")


def _axis_errors(plot: Any, evaluation: Evaluation, name: str) -> None:
    """Plot the errors per axis over distance."""
    for k, axis in enumerate("xyz"):
        plot.plot(evaluation.distance, evaluation.scores["thesis1"].xyz[:, k], lw=1.0, color=COLOURS[k], label=axis)
    plot.legend(loc="best", ncol=3, frameon=False)
    plot.set_title(f"error per axis, alignment origin: {name}", fontsize=9)
    label(plot, "distance along ground truth, m", "m")


def _drift_axes(plot: Any, evaluations: Sequence[Evaluation], names: Sequence[str]) -> None:
    """Plot drift over segment length, a line per estimate; a text where no estimate has two lengths."""
    drifts = [e.scores["kitti_drift"] for e in evaluations]
    if any(len(drift.by_length) > 1 for drift in drifts):
        for drift, colour in zip(drifts, _colours(len(names)), strict=True):
            lengths = sorted(drift.by_length)
            plot.plot(lengths, [drift.by_length[n][0] for n in lengths], "o-", ms=3, color=colour)
        plot.set_title("KITTI drift over segment length", fontsize=9)
        plot.set_ylim(bottom=0)
        label(plot, "segment, m", "%")
        return
    said = [
        " ".join(f"{percent:.3g} % over segments of {length} m" for length, (percent, _, _) in drift.by_length.items())
        or drift.note
        for drift in drifts
    ]
    lines = said[:1] if len(set(said)) == 1 else [f"{name}: {words}" for name, words in zip(names, said, strict=True)]
    plot.set_axis_off()
    plot.text(0.5, 0.5, "\n".join(["KITTI drift", *lines]), ha="center", va="center")


def _best_alignment(evaluation: Evaluation) -> AbsoluteError:
    """Errors by the first requested alignment that is determined; else those by the origin."""
    for error in evaluation.ate.values():
        if error.available:
            return error
    raise UsageError(f"--plot: no alignment of {evaluation.estimate} is determined; add --align origin")


def _colours(count: int) -> list[str]:
    """Colours of so many lines."""
    return [COLOURS[k % len(COLOURS)] for k in range(count)]


def write_buildings_png(path: Path, extract: BuildingExtract) -> None:
    """Draw the outlines of `extract` from above in its local frame into a PNG, coloured by height; atomically.

    Raises OutputError when the file cannot be written.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import PathCollection
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 10), layout="constrained")
    axes = figure.add_subplot()
    heights = [b.height for b in extract.buildings if b.height is not None]
    scale = Normalize(0.0, max([10.0, *heights]))
    colours = colormaps["viridis"]
    shapes = [
        (_outline(footprint.rings), UNKNOWN if b.height is None else colours(scale(b.height)))
        for b in extract.buildings
        for footprint in b.footprints
    ]
    axes.add_collection(
        PathCollection([s for s, _ in shapes], facecolors=[c for _, c in shapes], edgecolors="black", linewidths=0.5)
    )
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.grid(visible=True, lw=0.3)
    axes.set_xlabel(f"m east of {extract.origin[0]:.6f}, {extract.origin[1]:.6f}")
    axes.set_ylabel("m north")
    if heights:
        figure.colorbar(ScalarMappable(scale, colours), ax=axes, label="height, m (grey: unknown)", shrink=0.6)
    if extract.attribution:
        axes.set_title(extract.attribution, fontsize=8, loc="right")
    with atomic_write(path) as stream:
        figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})


def _outline(rings: tuple[Floats, ...]) -> Any:
    """matplotlib path of a polygon with its holes."""
    import numpy as np
    from matplotlib.path import Path as Outline

    return Outline.make_compound_path(*(Outline(np.concatenate([r, r[:1]]), closed=True) for r in rings))


# mm
WIDTH = 150.0


def as_html(text: str, picture_svg: bytes | None = None) -> str:
    """Preformatted text with a picture below."""
    shown = f"<pre>{html.escape(text)}</pre>"
    if picture_svg is None:
        return shown
    return f'{shown}<img alt="" src="data:image/svg+xml;base64,{base64.b64encode(picture_svg).decode()}">'


def draw_svg(make: Any) -> bytes:
    """SVG of the matplotlib figure that `make` returns, in the common style."""
    with house_style():
        return picture(make(), "svg")
