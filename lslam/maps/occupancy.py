"""3D occupancy grid from beams: cells where they end, cells that they pass, and unobserved cells."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Ints, Longs
from lslam.core.errors import ConfigError
from lslam.core.types.state import State
from lslam.maps.sorted_runs import KeyedRows, StoredRows

# Log-odds in hundredths: hit 0.7, miss 0.4, clamped to 0.12 and 0.97 (OctoMap's): what has left is free after some ten scans.
MODEL = np.array([85, -41, -200, 350], np.int64)
_START_ROWS = 1 << 17
_MOST_ROWS = 4_000_000
_MOST_BOX_CELLS = 1 << 26  # cells that a scan's beams are followed through at a time, a byte each


@dataclass(frozen=True)
class OccupancyGrid:
    """Observed cells, sorted by x, then y, then z; all others are unknown.

    cells : (M, 3) int32, cell i covers [i, i + 1) * voxel of the world, m; log_odds : (M,) int16, hundredths
    """

    cells: Ints
    log_odds: NDArray[np.int16]
    voxel: float

    def __len__(self) -> int:
        return len(self.cells)

    @property
    def is_occupied(self) -> Bools:
        """(M,) whether a cell is more likely occupied than free."""
        return np.asarray(self.log_odds > 0)

    @property
    def centres(self) -> Floats:
        """(M, 3) middles of the cells, m."""
        return np.asarray((self.cells + 0.5) * self.voxel)


@dataclass(frozen=True)
class Evidence:
    """Evidence of scans about cells, with keys comparable between mappers of one origin.

    keys : (M,) int64, rising; log_odds : (M,) int16, hundredths, clamped in the order of the scans; sums : (M,) int64, the
    same without clamps, which no order changes; origin : (3,) cell in the middle of the key range
    """

    keys: Longs
    log_odds: NDArray[np.int16]
    sums: Longs
    origin: Longs
    voxel: float

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def has_hits(self) -> Bools:
        """(M,) whether any beam ended in a cell, as foliage that most beams pass.

        A sum is that of hits less what misses take, so it tells the hits modulo a miss: a multiple of that counts as none.
        """
        hit, miss = int(MODEL[0]), -int(MODEL[1])
        return np.asarray(self.sums * pow(hit, -1, miss) % miss != 0)


class OccupancyMapper:
    """Updates cells by rays; a scan updates a cell once, and a hit overrides a miss.

    voxel : edge of a cell, m; range_min, range_max : m; farther points only free the cells up to there
    spool : folder beside which large maps are kept meanwhile; None: the system's temporary one; keep : one that stays
        instead, for `restore`; most : cells in memory
    origin : (3,) int64, cell in the middle of the key range; None: where the first scan is
    Raises ConfigError: a cell or range that makes no sense. OutputError: the spool cannot be written.

    >>> mapper = OccupancyMapper(1.0, range_min=0.0)
    >>> mapper.add(np.array([[2.5, 0.5, 0.5]], np.float32), np.eye(4))
    >>> grid = mapper.result()
    >>> grid.cells.tolist(), grid.is_occupied.tolist()
    ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [False, False, True])
    """

    def __init__(
        self,
        voxel: float = 0.4,
        range_min: float = 1.0,
        range_max: float = 40.0,
        *,
        spool: Path | None = None,
        keep: Path | None = None,
        most: int = _MOST_ROWS,
        origin: Longs | None = None,
    ) -> None:
        if not (np.isfinite([voxel, range_max]).all() and voxel > 0 and 0 <= range_min < range_max):
            raise ConfigError(
                f"map.occupancy_voxel = {voxel}, ranges {range_min} to {range_max}: a cell above 0 m, a range_max above "
                "range_min"
            )
        self._voxel, self._range = float(voxel), (float(range_min), float(range_max))
        self._most, self._table = most, KeyedRows(5, _START_ROWS, spool, keep)
        self._origin = origin
        self.scans = 0

    def add(self, points: NDArray[Any], T_world_lidar: Floats) -> None:
        """Add a deskewed scan: points (N, 3), m, in the LiDAR frame, and its pose (4, 4), which is skipped if not finite."""
        from lslam.maps.kernels.cells import cells_on_beams, mark_ends, mark_misses

        T = np.ascontiguousarray(T_world_lidar, np.float64)
        if not np.isfinite(T).all() or np.abs(T[:3, 3]).max() / self._voxel > 2.0**52:
            return
        cloud = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        start = T[:3, 3] / self._voxel
        if self._origin is None:
            self._origin = np.floor(start).astype(np.int64)
        table = self._table
        if table.used > self._most:
            table.spill()
        table.reserve(table.used + len(cloud))
        stamp = self.scans
        self.scans += 1
        table.used, ends = mark_ends(
            cloud, T, *self._range, self._voxel, self._origin, table.slots, table.rows, table.used, stamp, MODEL
        )
        corners = np.concatenate([ends, start[None]])
        # A cell around: rounding leads a beam past its end.
        low, high = np.floor(corners.min(0)).astype(np.int64) - 1, np.floor(corners.max(0)).astype(np.int64) + 2
        thickness = max(_MOST_BOX_CELLS // int(np.prod(high[1:] - low[1:])), 1)
        for x in range(low[0], high[0], thickness):
            size = high - low
            first, size[0] = np.array([x, *low[1:]]), min(thickness, high[0] - x)
            keys = cells_on_beams(ends, start, first, size, self._origin)
            table.reserve(table.used + len(keys))
            table.used = mark_misses(keys, table.slots, table.rows, table.used, stamp, MODEL)

    def result(self) -> OccupancyGrid:
        """Grid of the observed cells; empties the mapper."""
        from lslam.maps.kernels.cells import unpack_cells

        evidence = self.evidence()
        return OccupancyGrid(
            unpack_cells(evidence.keys, evidence.origin).astype(np.int32), evidence.log_odds, self._voxel
        )

    def evidence(self) -> Evidence:
        """Observed cells with all their evidence; empties the mapper."""
        from lslam.maps.kernels.cells import compose

        rows = self._table.result(compose)
        if isinstance(rows, StoredRows):
            rows = rows.read(0, len(rows))
        origin = np.zeros(3, np.int64) if self._origin is None else self._origin
        log_odds = np.clip(rows[:, 1], rows[:, 2], rows[:, 3]).astype(np.int16)
        return Evidence(rows[:, 0].copy(), log_odds, rows[:, 1].copy(), origin, self._voxel)

    def state(self) -> State:
        """State for `restore`; cells that changed since the last time are written to `keep`."""
        return {"origin": self._origin, "scans": self.scans, "runs": self._table.state()}

    def restore(self, state: State) -> None:
        """Restore `state` in an empty mapper of the same kind. Raises InputError when cells are missing."""
        self._table.restore(state["runs"])
        self._origin, self.scans = state["origin"], state["scans"]
