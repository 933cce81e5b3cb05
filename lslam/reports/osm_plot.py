"""The buildings of an extract as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.formats.atomic import atomic_write
from lslam.formats.osm_buildings import BuildingExtract

UNKNOWN = "#bbbbbb"


def write_buildings_png(path: Path, extract: BuildingExtract, along: NDArray[Any] | None = None) -> None:
    """Draw the outlines of `extract` from above in its local frame into a PNG, coloured by height; atomically.

    along : (N, 2) a path in the same frame, m. Raises OutputError when the file cannot be written.
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
    if along is not None:
        axes.plot(along[:, 0], along[:, 1], color="#d55e00", lw=1.5)
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


def _outline(rings: tuple[NDArray[np.float64], ...]) -> Any:
    from matplotlib.path import Path as Outline

    return Outline.make_compound_path(*(Outline(np.concatenate([r, r[:1]]), closed=True) for r in rings))
