"""Laws of total time as a figure: points, law, confidence band and residuals (Girolimetto, figures 5.19, 5.27a, 5.28)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lslam.evaluation.laws import band
from lslam.reports.picture import COLOURS, label
from lslam.types.sensitivity import CurveResult, Law, StudyResult

SAMPLES = 200


def draw_laws(figure: Any, result: StudyResult, shown: Sequence[CurveResult]) -> bool:
    """The law of each curve, or of each series over both parameters; False where there is none."""
    colours = {r.curve.label: colour for r, colour in zip(result.results, COLOURS, strict=False)}
    singles = [(r.curve.label, r.law) for r in shown if r.law is not None and r.curve.label in colours]
    laws = list(result.products.items()) or singles
    if not laws:
        return False
    columns = len(laws) if result.products else 1
    grid = figure.add_gridspec(2, columns, height_ratios=[3, 1])
    for k, (name, law) in enumerate(laws):
        if k < columns:
            upper = figure.add_subplot(grid[0, k])
            lower = figure.add_subplot(grid[1, k], sharex=upper)
        if law.kind == "product":
            _product(upper, lower, law, name)
        else:
            _single(upper, lower, law, f"{name}: {law.text} s, R2 {law.r2:.3f}", colours[name])
        lower.axhline(0, color="0.5", lw=0.8)
        label(upper, "", "total time, s")
        label(lower, law.names[0], "residual, %")
        upper.legend(frameon=False, fontsize=8)
        upper.tick_params(labelbottom=False)
    for upper in figure.axes[::2]:
        upper.set_ylim(bottom=0)
    return True


def _single(upper: Any, lower: Any, law: Law, name: str, colour: str) -> None:
    x = law.points[:, 0]
    line = np.linspace(x.min(), x.max(), SAMPLES)
    fitted, half = band(law, line)
    upper.plot(x, law.observed, "o", ms=3.5, color=colour)
    upper.plot(line, fitted, color=colour, lw=1.2, label=name)
    upper.fill_between(line, fitted - half, fitted + half, color=colour, alpha=0.2, lw=0)
    lower.plot(x, 100 * law.residuals, "o", ms=3, color=colour)


def _product(upper: Any, lower: Any, law: Law, name: str) -> None:
    """A line per value of the second parameter: one law over all of them."""
    from matplotlib import colormaps

    seconds = np.unique(law.points[:, 1])
    for second, colour in zip(seconds, colormaps["viridis"](np.linspace(0.0, 0.88, len(seconds))), strict=True):
        own = law.points[:, 1] == second
        x = law.points[own, 0]
        line = np.linspace(x.min(), x.max(), SAMPLES)
        fitted, half = band(law, np.stack([line, np.full(SAMPLES, second)], 1))
        upper.plot(x, law.observed[own], "o", ms=3, color=colour)
        upper.plot(line, fitted, lw=1.1, color=colour, label=f"{law.names[1].rpartition('.')[2]} {second:g}")
        upper.fill_between(line, fitted - half, fitted + half, color=colour, alpha=0.2, lw=0)
        lower.plot(x, 100 * law.residuals[own], "o", ms=2.5, color=colour)
    upper.set_title(f"{name}: {law.text} s, R2 {law.r2:.3f}", fontsize=9)
