"""Points in the air: what rain, snow, dust and multi-path return, told from surfaces by the company of its pulses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels import voxel

# The band of a spinning scanner, 360 x 45 deg. Others see less of the sphere, and are judged the more mildly.
FIELD_OF_VIEW_SR = 4.8

# m; wide enough for several pulses of one ring at fifty metres, and as the source points' grid begins.
WIDE_CELL = 1.0

# Edges leave short lines too, in up to a fifth of a clear scan's cells: below a quarter hardly anything is in the air.
CLEAR = 0.25

# A clear scan shows in some of its wide cells: one in eight is looked at first, and believed where it leaves no doubt. The
# cells of such a sample, five hundred or more, err by two or three per cent.
ONE_IN = 8
SURELY = 0.8
ENOUGH = 500

# Where more of a scan than this seems to hang in the air, pulses did not make it: it was thinned before.
MOSTLY = 0.5


def on_surfaces(
    centroids: NDArray[np.float32], counts: NDArray[np.int32], leaf: float, least_line: float
) -> NDArray[np.int64]:
    """Indices of the centroids (M, 3), m, LiDAR frame, of cells of edge `leaf`, m, that a surface may lie in.

    A drop fills a cell of its own where a surface puts many returns into one: a tenth of the returns can be two thirds of
    the cells. `counts` (M,) are the returns in each. Pulses part from each other by the root of field of view over
    returns, so a surface at range r that crosses a cell takes a line of edge / (r times that) of them, part of a ring or
    of a column; a drop takes one. Cells with less than `least_line` of such a line are of the air, and so are those with
    less in their surroundings of WIDE_CELL: far away a small cell has one return at most. (The radius in which Charron et
    al. 2018 count neighbours of snow grows with range for the same reason.) All are kept where few cells would go, or most
    returns.
    """
    pulses = int(counts.sum())
    needed = least_line / np.sqrt(FIELD_OF_VIEW_SR / max(pulses, 1))
    asked = (centroids, counts, leaf * needed, WIDE_CELL, WIDE_CELL * needed)
    some, seen = voxel.accompanied(*asked, ONE_IN)
    if seen >= ENOUGH and seen - len(some) < SURELY * CLEAR * seen:
        return np.arange(len(counts))
    kept, _ = voxel.accompanied(*asked, 1)
    is_clear = len(counts) - len(kept) < CLEAR * len(counts)
    return np.arange(len(counts)) if is_clear or int(counts[kept].sum()) < MOSTLY * pulses else kept
