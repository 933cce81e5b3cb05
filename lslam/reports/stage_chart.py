"""Stage times per scan, stacked, against the real-time limit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.reports import svg

Floats = NDArray[np.float64]

# A limit further away than this many times the usual scan would press the stages flat: an arrow says where it is.
LIMIT_IN_VIEW = 4.0


def stage_chart(index: NDArray[Any], ms: Floats, limit: float, title: str) -> tuple[str, str]:
    """Stacked areas, one step per scan or per bin of scans; ms (N, S) in milliseconds, limit in milliseconds or 0.

    Returns the SVG and a sentence about what the scale hides: bins, peaks cut off, a limit out of view.
    """
    x, layers, highest, remark = _binned(np.asarray(index, np.float64), ms)
    totals = ms.sum(1)
    usual = float(np.percentile(totals, 95))
    top = _scale(totals, usual)
    limit_inside = 0 < limit <= LIMIT_IN_VIEW * top
    if limit_inside:
        top = max(top, 1.08 * limit)
    frame = svg.Frame((x[0], x[-1]), (0.0, top))
    frame.axes("scan", "time, ms", whole_x=True)
    stacked = np.cumsum(np.minimum(layers, 1e9), axis=1)
    below = np.zeros(len(stacked))
    for layer in range(ms.shape[1]):
        above = stacked[:, layer]
        frame.add(f'<path class="area s{layer % 6 + 1}" d="{_steps(frame, x, below, above, top)}"/>')
        below = above
    if highest is not None:
        frame.polyline(np.repeat(x, 2)[1:-1], np.minimum(np.repeat(highest, 2), top), "peak")
    remarks = [remark] if remark else []
    beyond = int((totals > top).sum())
    if beyond:
        worst = int(np.argmax(totals))
        text = f"{totals[worst]:.0f} ms at scan {int(index[worst])}"
        remarks.append(
            f"One scan is cut off: {text}." if beyond == 1 else f"{beyond} scans are cut off, the longest {text}."
        )
    if limit_inside:
        y = float(frame.py(limit))
        frame.add(f'<path class="limit" d="M{frame.left} {y:.1f}H{frame.right}"/>')
        frame.text(frame.right - 4, y - 5, f"real-time limit {limit:.0f} ms", "end", "limit-text")
    elif limit > 0:
        frame.text(frame.right - 4, frame.top - 10, f"real-time limit {limit:.0f} ms lies above ↑", "end", "limit-text")
    return frame.svg(title), " ".join(remarks)


def _scale(totals: Floats, usual: float) -> float:
    """The top of the axis: everything, unless a few peaks (the first scan of a run, say) would hide the rest."""
    highest = float(totals.max())
    top = highest if highest <= 2.5 * usual else 1.4 * usual
    return 1.08 * top if top > 0 else 1.0


def _binned(index: Floats, ms: Floats) -> tuple[Floats, Floats, Floats | None, str]:
    """Edges (B+1,), mean per stage (B, S) and, when a bin holds several scans, the longest total of each bin."""
    if len(ms) <= svg.BINS:
        step = float(np.median(np.diff(index))) if len(index) > 1 else 1.0
        return np.append(index, index[-1] + max(step, 1e-9)), ms, None, ""
    starts = np.linspace(0, len(ms), svg.BINS + 1).astype(int)[:-1]
    size = np.diff(np.append(starts, len(ms)))
    means = np.add.reduceat(ms, starts, axis=0) / size[:, None]
    highest = np.maximum.reduceat(ms.sum(1), starts)
    remark = f"Areas are means of about {round(len(ms) / svg.BINS)} scans, the thin line is the longest of them."
    return np.append(index[starts], index[-1]), means, highest, remark


def _steps(frame: svg.Frame, x: Floats, below: Floats, above: Floats, top: float) -> str:
    """Outline of one layer, a step per bin: along the top from left to right, back along the bottom."""
    edges = np.repeat(x, 2)[1:-1]
    px = frame.px(np.concatenate([edges, edges[::-1]]))
    py = frame.py(np.minimum(np.concatenate([np.repeat(above, 2), np.repeat(below, 2)[::-1]]), top))
    return svg.path(px, py) + "Z"
