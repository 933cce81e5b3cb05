"""The map of every point: scans one behind another, in a file, so that memory stays flat."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, OutputError, cause, output_errors
from lslam.core.geometry import se3
from lslam.core.stopping import checking
from lslam.core.types.cloud import BLOCK, CloudBlock
from lslam.core.types.scan import has_return
from lslam.core.types.state import State
from lslam.maps.observations import TAGS, Observations, column_types, columns_of, tags_of
from lslam.maps.sorted_runs import rows_folder


class EveryPointMap:
    """All points in the world frame, in the order of the recording; satisfies `Cloud`.

    They lie in a file, which goes when the map does, unless its folder is kept.
    record : of a point in the file; count : points; types : of the further columns; owner : of the folder
    """

    def __init__(
        self,
        path: Path,
        owner: object,
        record: np.dtype[Any],
        count: int,
        has_intensity: bool,
        types: Mapping[str, np.dtype[Any]],
    ) -> None:
        self._path, self._owner, self._record, self._count = path, owner, record, count
        self.has_intensity, self.column_types = has_intensity, types

    def __len__(self) -> int:
        return self._count

    def blocks(self) -> Iterator[CloudBlock]:
        """The points, `BLOCK` at a time. Raises OutputError when the file cannot be read back."""
        for start in checking(range(0, self._count, BLOCK)):
            some = min(BLOCK, self._count - start)
            try:
                table = np.fromfile(self._path, self._record, some, offset=start * self._record.itemsize)
            except OSError as error:
                raise OutputError(f"{self._path} cannot be read back: {cause(error)}") from None
            tags = table["tags"] if self.column_types else np.zeros((some, TAGS), np.int64)
            yield CloudBlock(
                table["xyz"],
                table["intensity"] if self.has_intensity else None,
                columns_of(tags, np.ones(some, np.int64), self.column_types),
            )


class PointCollector:
    """Collects the points of scans in a file; where points are averaged, `MapMerger` takes its place.

    range_min, range_max, crop, spool, keep, attributes : as of `MapMerger`
    scans : scans added; gated : points left out by range, crop or for being no measurement
    Raises OutputError: the file cannot be written.
    """

    def __init__(
        self,
        range_min: float,
        range_max: float,
        *,
        crop: Any = None,
        spool: Path | None = None,
        keep: Path | None = None,
        attributes: tuple[str, ...] = (),
    ) -> None:
        self._near, self._far = range_min, range_max
        self._crop = None if crop is None else np.asarray(crop, np.float64).reshape(3, 2).T
        folder, self._owner = rows_folder(spool, keep)
        self._path, self._attributes = folder / "points", attributes
        tags = [("tags", np.int64, (TAGS,))] if attributes else []
        self._record = np.dtype([("xyz", np.float64, (3,)), ("intensity", np.float32), *tags])
        self._has_intensity, self._last_scan = True, 0
        self.scans = self.gated = self._count = 0

    def add(
        self,
        points: NDArray[Any],
        T_world_lidar: Floats,
        intensity: NDArray[Any] | None = None,
        observations: Observations | None = None,
    ) -> None:
        """Add one scan: points (N, 3) m in the LiDAR frame, its pose (4, 4), intensity (N,) or None, observations for attributes.

        The map has intensity only when every scan has; an intensity that is not finite counts as 0.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            # As the kernel of voxels does, so that both keep the same points.
            ranges2 = np.square(points, dtype=np.float64).sum(axis=1)
            kept = has_return(points) & (ranges2 >= self._near**2) & (ranges2 <= self._far**2)
            world = se3.apply(T_world_lidar, points[kept].astype(np.float64))
        inside = np.isfinite(world).all(axis=1)
        if self._crop is not None:
            inside &= ((world >= self._crop[0]) & (world <= self._crop[1])).all(axis=1)
        index = np.flatnonzero(kept)[inside]
        table = np.zeros(len(index), self._record)
        table["xyz"] = world[inside]
        if intensity is not None:
            table["intensity"] = np.nan_to_num(intensity[index], posinf=0.0, neginf=0.0)
        elif len(points):
            self._has_intensity = False
        if observations is not None and self._attributes:
            table["tags"] = tags_of(observations.select(index))
            self._last_scan = max(self._last_scan, observations.scan)
        # What a process that was killed may have left goes.
        with output_errors(self._path), self._path.open("ab" if self._count else "wb") as stream:
            stream.write(table.data)
        self.scans += 1
        self.gated += len(points) - len(index)
        self._count += len(index)

    def result(self) -> EveryPointMap:
        """The map of all scans."""
        types = column_types(self._attributes, self._last_scan)
        has_intensity = self._has_intensity and self._count > 0
        return EveryPointMap(self._path, self._owner, self._record, self._count, has_intensity, types)

    def state(self) -> State:
        """What `restore` needs, for a checkpoint: the number of points in the file in `keep`."""
        counts = (self.scans, self.gated, self._count, self._last_scan)
        return {"has_intensity": self._has_intensity, "counts": counts}

    def restore(self, state: State) -> None:
        """Restore `state` in an empty collector of the same kind. Raises InputError when points are missing."""
        self._has_intensity = state["has_intensity"]
        self.scans, self.gated, self._count, self._last_scan = state["counts"]
        size = self._count * self._record.itemsize
        with output_errors(self._path):
            if size > (self._path.stat().st_size if self._path.is_file() else 0):
                raise InputError(f"{self._path} does not hold the {self._count} points that it should")
            if self._path.is_file():
                os.truncate(self._path, size)
