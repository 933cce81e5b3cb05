"""Pictures drawn with matplotlib: one look, and the same bytes for the same input."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lslam.errors import UsageError, nearest

FORMATS = ("png", "svg", "pdf")
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito: safe for colour blindness


def check_plot_path(path: Path) -> None:
    """UsageError when the suffix of `path` names no picture format we write: asked before the work, not after."""
    kind = path.suffix.lstrip(".").lower()
    if kind not in FORMATS:
        raise UsageError(f"--plot {path}: {nearest(kind, FORMATS) if kind else 'end the name with .png, .svg or .pdf'}")


@contextmanager
def house_style() -> Iterator[None]:
    """The look; a figure is made and turned into a picture inside. Text stays text."""
    from matplotlib import rc_context

    with rc_context({"svg.hashsalt": "lslam", "svg.fonttype": "none", "font.size": 9}):
        yield


def pictures(figure: Any, kinds: Sequence[str]) -> list[bytes]:
    """The files of a matplotlib figure without a layout of its own: found once, it takes longer than drawing."""
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    ConstrainedLayoutEngine().execute(figure)
    return [picture(figure, kind) for kind in kinds]


def picture(figure: Any, kind: str) -> bytes:
    """The file of a matplotlib figure in one of FORMATS, without the time it was made."""
    stamp: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}, "png": {}}[kind]
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=120, metadata=stamp)
    return stream.getvalue()


def label(plot: Any, x: str, y: str) -> None:
    """Name the axes and keep out of the way of what is drawn."""
    plot.set_xlabel(x)
    plot.set_ylabel(y)
    plot.grid(alpha=0.25)
    plot.spines[["top", "right"]].set_visible(False)
