"""Point clouds that are handed on block by block, because the whole may not fit into memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats

BLOCK = 1 << 18
# Columns beside the points, (N,) each, by name. Those that lslam knows: `time_ns` int64, clock of the recording; `scan` uint16 or
# uint32; `ring` and `class` uint16; `range` float32, m; `observations` uint32; `red`, `green`, `blue` uint8.
TIME_NS = "time_ns"
Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class CloudBlock:
    """Some points of a cloud: points (N, 3) float64, m; intensity (N,) float32 or None; further columns (N,) by name."""

    points: Floats
    intensity: NDArray[np.float32] | None = None
    columns: Columns = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.points)


class Cloud(Protocol):
    """A cloud in one frame: its size is known, its points come in blocks, always the same ones in the same order."""

    @property
    def has_intensity(self) -> bool:
        """Whether every block has intensities."""
        ...

    @property
    def column_types(self) -> Mapping[str, np.dtype[Any]]:
        """Types of the further columns of every block, by name."""
        ...

    def __len__(self) -> int:
        """Number of points."""
        ...

    def blocks(self) -> Iterator[CloudBlock]:
        """All points, in blocks of a size that fits into memory."""
        ...


@dataclass(frozen=True)
class ArrayCloud:
    """A cloud in memory: points (N, 3) float64, m; intensity (N,) float32 or None; further columns (N,) by name.

    >>> ArrayCloud.of([[1, 2, 3]]).points.tolist()
    [[1.0, 2.0, 3.0]]
    """

    points: Floats
    intensity: NDArray[np.float32] | None = None
    columns: Columns = field(default_factory=dict)

    @classmethod
    def of(cls, points: Any, intensity: Any = None) -> ArrayCloud:
        """A cloud of array-likes: points (N, 3), m, and intensity (N,) or None."""
        values = None if intensity is None else np.asarray(intensity, np.float32).reshape(-1)
        return cls(np.asarray(points, np.float64).reshape(-1, 3), values)

    @property
    def has_intensity(self) -> bool:
        """Whether there are intensities."""
        return self.intensity is not None

    @property
    def column_types(self) -> Mapping[str, np.dtype[Any]]:
        """Types of the further columns."""
        return {name: values.dtype for name, values in self.columns.items()}

    def select(self, index: NDArray[Any] | slice) -> ArrayCloud:
        """The points at `index`, with their intensity and further columns."""
        intensity = None if self.intensity is None else self.intensity[index]
        return ArrayCloud(self.points[index], intensity, {name: v[index] for name, v in self.columns.items()})

    def __len__(self) -> int:
        return len(self.points)

    def blocks(self) -> Iterator[CloudBlock]:
        """The cloud in blocks, which are slices of its arrays."""
        for start in range(0, len(self), BLOCK):
            some = self.select(slice(start, start + BLOCK))
            yield CloudBlock(some.points, some.intensity, some.columns)


def in_memory(cloud: Cloud) -> ArrayCloud:
    """The whole cloud as arrays; an `ArrayCloud` is returned as it is."""
    if isinstance(cloud, ArrayCloud):
        return cloud
    parts = list(cloud.blocks())
    points = np.concatenate([part.points for part in parts]) if parts else np.zeros((0, 3))
    columns = {
        name: np.concatenate([np.zeros(0, kind), *(part.columns[name] for part in parts)])
        for name, kind in cloud.column_types.items()
    }
    if not cloud.has_intensity:
        return ArrayCloud(points, columns=columns)
    values = [part.intensity for part in parts if part.intensity is not None]
    return ArrayCloud(points, np.concatenate(values) if values else np.zeros(0, np.float32), columns)


def bounds(cloud: Cloud) -> tuple[Floats, Floats]:
    """Smallest and largest x, y, z, m, of its finite points; NaN when there are none."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for block in cloud.blocks():
        points = block.points[np.isfinite(block.points).all(1)]
        if len(points):
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    return (low, high) if np.isfinite(low).all() else (np.full(3, np.nan), np.full(3, np.nan))


def thin_out(cloud: Cloud, most: int, columns: Sequence[str] = ()) -> ArrayCloud:
    """At most `most` points of a cloud, reproducibly: one random point out of each run of successive ones.

    Every n-th point of a voxel map would form stripes.

    columns : further columns to keep, if it has them
    """
    step = max(1, -(-len(cloud) // most))
    kept = step * np.arange(-(-len(cloud) // step))
    kept = np.minimum(kept + np.random.default_rng(0).integers(0, step, len(kept)), len(cloud) - 1)
    names = [name for name in columns if name in cloud.column_types]
    points, values = [np.zeros((0, 3))], [np.zeros(0, np.float32)]
    found: dict[str, list[NDArray[Any]]] = {name: [np.zeros(0, cloud.column_types[name])] for name in names}
    seen = 0
    for block in cloud.blocks():
        some = kept[np.searchsorted(kept, seen) : np.searchsorted(kept, seen + len(block))] - seen
        points.append(block.points[some])
        if block.intensity is not None:
            values.append(block.intensity[some])
        for name in names:
            found[name].append(block.columns[name][some])
        seen += len(block)
    kept_columns = {name: np.concatenate(parts) for name, parts in found.items()}
    return ArrayCloud(np.concatenate(points), np.concatenate(values) if cloud.has_intensity else None, kept_columns)
