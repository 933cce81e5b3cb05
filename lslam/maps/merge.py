"""The merged map: one averaged point per voxel, streamed scan by scan, out of core when it grows large."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import ConfigError, InputError
from lslam.core.stopping import checking
from lslam.core.types.cloud import BLOCK, CloudBlock, in_memory
from lslam.core.types.state import State
from lslam.maps.observations import TAGS, Observations, column_types, columns_of, tags_of
from lslam.maps.sorted_runs import KeyedRows, StoredRows

log = logging.getLogger("lslam")

_MOST_ROWS = 1 << 20  # some 60 MB with the slots, and as much when they are sorted; what is more goes to disk
_NO_INTENSITY = np.zeros(0, np.float32)
_EVERYWHERE = np.array([-np.inf, np.inf] * 3)


class MergedMap:
    """Averaged points in the world frame, sorted by voxel (x, then y, then z); satisfies `Cloud`.

    Large ones lie in a temporary folder that goes when the map does, and are read in blocks; the arrays below read all.
    points : (M, 3) float64, m; intensity : (M,) float32 mean of the voxel's points, or None; counts : (M,) int64 points
        averaged
    column_types : further columns, of the observation nearest to the sensor in each voxel, the earlier of two
    """

    def __init__(
        self,
        rows: Longs | StoredRows,
        origin: Longs,
        voxel: float,
        has_intensity: bool,
        types: Mapping[str, np.dtype[Any]],
    ) -> None:
        self._rows, self._origin, self.voxel = rows, origin, voxel
        self._has_intensity, self.column_types = has_intensity, types

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def has_intensity(self) -> bool:
        """Whether every scan had intensities."""
        return self._has_intensity

    @property
    def points(self) -> Floats:
        """All points, (M, 3)."""
        return in_memory(self).points

    @property
    def intensity(self) -> NDArray[np.float32] | None:
        """All intensities, (M,), or None."""
        return in_memory(self).intensity

    @property
    def counts(self) -> Longs:
        """How many points were averaged, (M,)."""
        return np.concatenate([rows[:, 4] for rows in self._pieces()] or [np.zeros(0, np.int64)])

    def blocks(self) -> Iterator[CloudBlock]:
        """The points, `BLOCK` at a time."""
        from lslam.maps.kernels.cells import INTENSITY_UNITS, SUMS, unpack

        for rows in self._pieces():
            intensity = (
                (rows[:, -1] / (rows[:, 4] * INTENSITY_UNITS)).astype(np.float32) if self._has_intensity else None
            )
            columns = columns_of(rows[:, SUMS : SUMS + TAGS], rows[:, 4], self.column_types)
            yield CloudBlock(unpack(rows, self._origin, self.voxel), intensity, columns)

    def _pieces(self) -> Iterator[Longs]:
        """Rows of the voxels, `BLOCK` at a time."""
        for start in checking(range(0, len(self), BLOCK)):
            stop = min(start + BLOCK, len(self))
            yield self._rows.read(start, stop) if isinstance(self._rows, StoredRows) else self._rows[start:stop]


@dataclass(frozen=True)
class ScanSums:
    """Points of one scan added up where neighbours share a voxel, as `MapMerger` keeps its voxels.

    rows : (R, k), of which the first `count` hold sums, None for a scan that is refused
    has_intensity : None for a scan without points; scan : its number, where it has observations
    beyond_gate, outside : points that are left out, `gated` and `outside` of `MapMerger`
    """

    rows: Longs | None
    count: int = 0
    has_intensity: bool | None = None
    beyond_gate: int = 0
    outside: int = 0
    scan: int = 0


class MapMerger:
    """Averages scans into voxels, in about 60 bytes per voxel and independent of the order of points and scans.

    The sums are kept relative to each voxel's centre, so coordinates far from the origin lose nothing; the voxels reach
    2**20 voxels (210 km at 0.2 m) from the first scan in every direction. Beyond `most` voxels in memory they go to a file
    sorted, and `result` adds up what belongs to one voxel: sums are exact, so the map is the same bytes either way.

    voxel : edge of a voxel, m
    range_min, range_max : m from the sensor; points outside, and NaN, Inf and zero points, are left out
    crop : x_min, x_max, y_min, y_max, z_min, z_max of the world, m; points outside are left out
    spool : folder beside which large maps are kept meanwhile; None: the system's temporary one
    keep : folder in which they stay instead, so that `state` and `restore` work
    attributes : further columns of the map, as `map.attributes`; with some, every scan needs observations
    scans : scans added; gated : points left out by range, crop or for being no measurement; outside : points too far
        from the first scan to have a voxel; refused : scans left out because their pose is not finite
    Raises ConfigError: a voxel or range that makes no sense. OutputError: the spool cannot be written.

    >>> merger = MapMerger(voxel=1.0, range_min=0.0)
    >>> merger.add(np.array([[0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [5.0, 0.5, 0.5]], np.float32), np.eye(4))
    >>> merger.result().points.tolist()
    [[0.5, 0.5, 0.5], [5.0, 0.5, 0.5]]
    """

    def __init__(
        self,
        voxel: float = 0.2,
        range_min: float = 2.0,
        range_max: float = 80.0,
        *,
        crop: Any = None,
        spool: Path | None = None,
        keep: Path | None = None,
        attributes: tuple[str, ...] = (),
        most: int = _MOST_ROWS,
    ) -> None:
        if not (np.isfinite(voxel) and voxel > 0):
            raise ConfigError(f"map.voxel = {voxel}: the voxel must be a positive number of metres, for example 0.2")
        if not 0 <= range_min < range_max:
            raise ConfigError(
                f"map.range_min = {range_min} and map.range_max = {range_max}: no point lies between them, "
                "set range_max above range_min"
            )
        self._voxel, self._range_min = float(voxel), float(range_min)
        self._range_max = min(float(range_max), 1e150)  # squared it must stay finite, or Inf would pass the gate
        self._origin: Longs | None = None
        self._attributes, self._last_scan = attributes, 0
        self._base = 5 + (TAGS if attributes else 0)  # columns without that of the intensity
        self._most, self._table = most, KeyedRows(self._base, most, spool, keep)
        self._crop = _EVERYWHERE if crop is None else np.asarray(crop, np.float64).reshape(6)
        self._with_intensity: bool | None = None
        self._spare: list[Longs] = []
        self.scans = self.gated = self.outside = self.refused = 0

    def add(
        self,
        points: NDArray[Any],
        T_world_lidar: Floats,
        intensity: NDArray[Any] | None = None,
        observations: Observations | None = None,
    ) -> None:
        """Add one scan: points (N, 3) m in the LiDAR frame, its pose (4, 4), intensity (N,) or None, observations for attributes.

        The map has intensity only when every scan has; an intensity that is not finite counts as 0. A scan whose pose
        is not finite is refused, counted and logged. Raises InputError when points and intensities differ in number.
        """
        self.add_sums(self.sum_up(points, T_world_lidar, intensity, observations))

    def sum_up(
        self,
        points: NDArray[Any],
        T_world_lidar: Floats,
        intensity: NDArray[Any] | None = None,
        observations: Observations | None = None,
    ) -> ScanSums:
        """Sum up the points of a scan per voxel, the first half of `add`; one other thread may call it while scans are added."""
        from lslam.maps.kernels.cells import sum_up

        T = np.ascontiguousarray(T_world_lidar, np.float64)
        # Beyond 2**52 voxels the voxel index itself is no longer exact.
        if not np.isfinite(T).all() or np.abs(T[:3, 3]).max() / self._voxel > 2.0**52:
            log.warning("merged map: a scan is left out because its pose is not finite")
            return ScanSums(None)
        cloud = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        values = _NO_INTENSITY if intensity is None else np.ascontiguousarray(intensity, np.float32).reshape(-1)
        if intensity is not None and len(values) != len(cloud):
            raise InputError(f"merged map: a scan has {len(cloud)} points but {len(values)} intensities; leave one out")
        if self._origin is None:
            self._origin = np.floor(T[:3, 3] / self._voxel).astype(np.int64)
        tags = tags_of(observations if self._attributes else None)
        columns = self._base + (intensity is not None)
        rows = self._spare.pop() if self._spare else np.empty((0, columns), np.int64)
        if rows.shape[1] != columns or len(rows) < len(cloud):
            rows = np.empty((len(cloud), columns), np.int64)
        gates = self._range_min, self._range_max, self._voxel, self._crop
        count, gated, outside = sum_up(cloud, values, tags, T, *gates, self._origin, rows)
        has_intensity = None if not len(cloud) else intensity is not None
        scan = 0 if observations is None else observations.scan
        return ScanSums(rows, count, has_intensity, gated, outside, scan)

    def add_sums(self, sums: ScanSums) -> None:
        """Add the sums of a scan to the map, the second half of `add`."""
        from lslam.maps.kernels.cells import add_rows

        if sums.rows is None:
            self.refused += 1
            return
        self.scans += 1
        self.gated += sums.beyond_gate
        self.outside += sums.outside
        if sums.has_intensity is None:
            return
        self._settle_intensity(sums.has_intensity)
        self._last_scan = max(self._last_scan, sums.scan)
        table, more = self._table, sums.rows[: sums.count]
        if table.used + len(more) > self._most and table.used:
            table.spill()
        table.reserve(table.used + len(more))
        more = np.ascontiguousarray(more[:, : table.rows.shape[1]])
        table.used = add_rows(more, bool(self._attributes), table.slots, table.rows, table.used)
        # Filled again: the system takes long to provide so much memory for each scan.
        self._spare.append(sums.rows)

    def result(self) -> MergedMap:
        """The map of all scans, sorted by voxel: the same scans give the same bytes. Afterwards the merger is empty."""
        if self.outside:
            log.warning(
                "merged map: %d points lie more than %.0f km from the first scan and are left out",
                self.outside,
                self._voxel * 2**20 / 1000,
            )
        self._spare.clear()
        origin = np.zeros(3, np.int64) if self._origin is None else self._origin
        rows = self._table.result(partial(_add_up, has_tags=bool(self._attributes)))
        types = column_types(self._attributes, self._last_scan)
        return MergedMap(rows, origin, self._voxel, bool(self._with_intensity), types)

    def state(self) -> State:
        """State for `restore`; voxels that changed since the last time are written to `keep`."""
        counts = (self.scans, self.gated, self.outside, self.refused, self._last_scan)
        runs = self._table.state()
        return {"origin": self._origin, "with_intensity": self._with_intensity, "counts": counts, "runs": runs}

    def restore(self, state: State) -> None:
        """Restore `state` in an empty merger of the same kind. Raises InputError when voxels are missing."""
        self._table.restore(state["runs"])
        self._origin = state["origin"]
        self.scans, self.gated, self.outside, self.refused, self._last_scan = state["counts"]
        if state["with_intensity"] is not None:
            self._with_intensity = bool(state["with_intensity"])
            self._table.set_columns(self._base + self._with_intensity)

    def _settle_intensity(self, has_intensity: bool) -> None:
        """Keep the column of intensity only if every scan so far has it."""
        if self._with_intensity and not has_intensity:
            log.warning("merged map: a scan has no intensity, so the map has none")
        if self._with_intensity is None or (self._with_intensity and not has_intensity):
            self._with_intensity = has_intensity
            self._table.set_columns(self._base + has_intensity)


def _add_up(rows: Longs, has_tags: bool = False) -> Longs:
    """Sum of rows (n, k) by key, sorted by it; with `has_tags`, the tags of the row with the smallest ones."""
    if has_tags:
        rows = rows[np.lexsort((rows[:, 5], rows[:, 0]))]
    first = np.flatnonzero(np.diff(rows[:, 0], prepend=rows[0, 0] - 1))
    summed = np.add.reduceat(rows, first, axis=0)
    summed[:, 0] = rows[first, 0]
    if has_tags:
        summed[:, 5 : 5 + TAGS] = rows[first, 5 : 5 + TAGS]
    return summed


def warm_up() -> None:
    """Compile or load the merger's kernels, so that a caller can do it under the compile lock."""
    merger = MapMerger(1.0, 0.0, most=1)
    merger.add(np.ones((2, 3), np.float32), np.eye(4))
