"""When, in which scan and by which beam the points of a map were measured, and what they are of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Longs
from lslam.core.types.cloud import TIME_NS
from lslam.core.types.scan import NO_RING, Scan

# Integers of an observation: see `Observations.tags`.
TAGS = 3
_NO_TAGS = np.zeros((0, TAGS), np.int64)
_TYPES: dict[str, tuple[str, Any]] = {
    "time": (TIME_NS, np.int64),
    "scan": ("scan", np.uint32),
    "ring": ("ring", np.uint16),
    "range": ("range", np.float32),
    "observations": ("observations", np.uint32),
    "class": ("class", np.uint16),
}


@dataclass(frozen=True)
class Observations:
    """The measurements behind the points of one scan.

    scan : its number in the recording; times_ns : (N,) int64, clock of the recording; ranges : (N,) float32, m, as measured
    rings : (N,) uint16, `NO_RING` where a point has none; labels : (N,) uint16, 0 where it has none
    """

    scan: int
    times_ns: Longs
    ranges: NDArray[np.float32]
    rings: NDArray[np.uint16]
    labels: NDArray[np.uint16]

    @classmethod
    def of(cls, scan: Scan) -> Observations:
        """Observations of a scan before it is deskewed."""
        count = len(scan)
        times_ns = np.full(count, scan.stamp_ns, np.int64)
        if scan.times is not None:
            times_ns += np.rint(1e9 * np.nan_to_num(scan.times.astype(np.float64))).astype(np.int64)
        with np.errstate(over="ignore", invalid="ignore"):
            ranges = np.sqrt(np.square(scan.points, dtype=np.float64).sum(axis=1)).astype(np.float32)
        rings = np.full(count, NO_RING, np.uint16) if scan.rings is None else scan.rings
        labels = np.zeros(count, np.uint16) if scan.labels is None else scan.labels
        return cls(scan.index, times_ns, ranges, rings, labels)

    def select(self, mask: NDArray[Any]) -> Observations:
        """The observations that `mask` (bool or indices) keeps."""
        columns = {name: getattr(self, name)[mask] for name in ("times_ns", "ranges", "rings", "labels")}
        return replace(self, **columns)

    @property
    def tags(self) -> Longs:
        """(N, 3) int64: range and scan, time, ring and class.

        The first orders observations: the smaller range first, then the earlier scan. The bits of positive float32 do so.
        """
        near = np.ascontiguousarray(self.ranges).view(np.int32).astype(np.int64) << 32 | self.scan
        return np.column_stack([near, self.times_ns, self.rings.astype(np.int64) << 16 | self.labels])


def tags_of(observations: Observations | None) -> Longs:
    """(N, 3) tags; (0, 3) without observations."""
    return _NO_TAGS if observations is None else observations.tags


def column_types(names: tuple[str, ...], last_scan: int) -> Mapping[str, np.dtype[Any]]:
    """Types of the columns of a map with the attributes `names`; scan numbers are as wide as the largest needs."""
    types = {_TYPES[name][0]: np.dtype(_TYPES[name][1]) for name in names}
    return types | ({"scan": np.dtype(np.uint16)} if "scan" in types and last_scan <= np.iinfo(np.uint16).max else {})


def columns_of(tags: Longs, counts: Longs, types: Mapping[str, np.dtype[Any]]) -> dict[str, NDArray[Any]]:
    """Columns (M,) of `types` from tags (M, 3) and numbers of observations (M,)."""
    values: dict[str, Callable[[], NDArray[Any]]] = {
        TIME_NS: lambda: tags[:, 1],
        "scan": lambda: tags[:, 0] & 0xFFFFFFFF,
        "ring": lambda: tags[:, 2] >> 16,
        "range": lambda: (tags[:, 0] >> 32).astype(np.int32).view(np.float32),
        "observations": lambda: np.minimum(counts, np.iinfo(np.uint32).max),
        "class": lambda: tags[:, 2] & 0xFFFF,
    }
    return {name: values[name]().astype(kind) for name, kind in types.items()}
