"""The merged map: one averaged point per voxel, streamed scan by scan."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import ConfigError, InputError

log = logging.getLogger("lslam")

_START_ROWS = 1 << 17
_NO_INTENSITY = np.zeros(0, np.float32)
_NO_SUMS = np.zeros(0)


@dataclass(frozen=True)
class MergedMap:
    """Averaged points in the world frame, sorted by voxel (x, then y, then z).

    points : (M, 3) float64, m; intensity : (M,) float32 mean of the voxel's points, or None; counts : (M,) int64 points
    averaged
    """

    points: NDArray[np.float64]
    intensity: NDArray[np.float32] | None
    counts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.points)


class MapMerger:
    """Averages scans into voxels, in about 50 bytes per voxel and independent of the order of points and scans.

    The sums are kept relative to each voxel's centre, so coordinates far from the origin lose nothing; the voxels reach
    2**20 voxels (210 km at 0.2 m) from the first scan in every direction.

    Parameters
    ----------
    voxel : edge of a voxel, m
    range_min, range_max : m from the sensor; points outside, and NaN, Inf and zero points, are left out

    Attributes
    ----------
    scans : scans added; gated : points left out by range or for being no measurement; outside : points too far
        from the first scan to have a voxel; refused : scans left out because their pose is not finite

    Raises
    ------
    ConfigError : a voxel or range that makes no sense

    Examples
    --------
    >>> merger = MapMerger(voxel=1.0, range_min=0.0)
    >>> merger.add(np.array([[0.25, 0.5, 0.5], [0.75, 0.5, 0.5], [5.0, 0.5, 0.5]], np.float32), np.eye(4))
    >>> merger.result().points.tolist()
    [[0.5, 0.5, 0.5], [5.0, 0.5, 0.5]]
    """

    def __init__(self, voxel: float = 0.2, range_min: float = 2.0, range_max: float = 80.0) -> None:
        if not (np.isfinite(voxel) and voxel > 0):
            raise ConfigError(f"map.voxel = {voxel}: the voxel must be a positive number of metres, for example 0.2")
        if not 0 <= range_min < range_max:
            raise ConfigError(
                f"map.range_min = {range_min} and map.range_max = {range_max}: no point lies between them, "
                "set range_max above range_min"
            )
        self._voxel, self._range_min = float(voxel), float(range_min)
        self._range_max = min(float(range_max), 1e150)  # squared it must stay finite, or Inf would pass the gate
        self._origin: NDArray[np.int64] | None = None
        self._rows = np.empty((_START_ROWS, 5), np.int64)
        self._slots = np.full(2 * _START_ROWS, -1, np.int32)
        self._intensity = _NO_SUMS
        self._with_intensity: bool | None = None
        self._used = 0
        self.scans = self.gated = self.outside = self.refused = 0

    def __len__(self) -> int:
        return self._used

    def add(
        self, points: NDArray[Any], T_world_lidar: NDArray[np.float64], intensity: NDArray[Any] | None = None
    ) -> None:
        """Add one scan: points (N, 3) m in the LiDAR frame, its pose (4, 4), intensity (N,) or None.

        The map has intensity only when every scan has; an intensity that is not finite counts as 0. A scan whose pose
        is not finite is refused, counted and logged. Raises InputError when points and intensities differ in number.
        """
        from lslam.kernels.voxel_average import accumulate

        T = np.ascontiguousarray(T_world_lidar, np.float64)
        # Beyond 2**52 voxels the voxel index itself is no longer exact.
        if not np.isfinite(T).all() or np.abs(T[:3, 3]).max() / self._voxel > 2.0**52:
            self.refused += 1
            log.warning("merged map: a scan is left out because its pose is not finite")
            return
        cloud = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        values = _NO_INTENSITY if intensity is None else np.ascontiguousarray(intensity, np.float32).reshape(-1)
        if intensity is not None and len(values) != len(cloud):
            raise InputError(f"merged map: a scan has {len(cloud)} points but {len(values)} intensities; leave one out")
        if self._origin is None:
            self._origin = np.floor(T[:3, 3] / self._voxel).astype(np.int64)
        if not len(cloud):
            self.scans += 1
            return
        self._settle_intensity(intensity is not None)
        self._reserve(self._used + len(cloud))
        self._used, gated, outside = accumulate(
            cloud,
            values if self._with_intensity else _NO_INTENSITY,
            T,
            self._range_min,
            self._range_max,
            self._voxel,
            self._origin,
            self._slots,
            self._rows,
            self._intensity,
            self._used,
        )
        self.scans += 1
        self.gated += int(gated)
        self.outside += int(outside)

    def result(self) -> MergedMap:
        """The map so far, sorted by voxel: the same scans give the same bytes."""
        from lslam.kernels.voxel_average import unpack

        if self.outside:
            log.warning(
                "merged map: %d points lie more than %.0f km from the first scan and are left out",
                self.outside,
                self._voxel * 2**20 / 1000,
            )
        order = np.argsort(self._rows[: self._used, 0])
        rows = self._rows[order]
        origin = np.zeros(3, np.int64) if self._origin is None else self._origin
        counts = np.ascontiguousarray(rows[:, 4])
        intensity = (self._intensity[order] / counts).astype(np.float32) if self._with_intensity else None
        return MergedMap(unpack(rows, origin, self._voxel), intensity, counts)

    def _settle_intensity(self, given: bool) -> None:
        if self._with_intensity is None:
            self._with_intensity = given
            self._intensity = np.zeros(len(self._rows)) if given else _NO_SUMS
        elif self._with_intensity and not given:
            log.warning("merged map: a scan has no intensity, so the map has none")
            self._with_intensity, self._intensity = False, _NO_SUMS

    def _reserve(self, rows: int) -> None:
        """Room for `rows` rows; the slots stay at most two thirds full."""
        from lslam.kernels.voxel_average import rebuild

        if rows > len(self._rows):
            more = max(rows, len(self._rows) * 3 // 2) - len(self._rows)
            self._rows = np.concatenate([self._rows, np.empty((more, 5), np.int64)])
            if self._with_intensity:
                self._intensity = np.concatenate([self._intensity, np.zeros(more)])
        if rows * 3 > len(self._slots) * 2:
            size = 1 << int(np.ceil(np.log2(rows * 2)))
            self._slots = np.full(size, -1, np.int32)
            rebuild(self._slots, self._rows, self._used)


def warm_up() -> None:
    """Compile or load the merger's kernels, so that a caller can do it under the compile lock."""
    merger = MapMerger(1.0, 0.0)
    merger.add(np.ones((1, 3), np.float32), np.eye(4))
    merger._reserve(_START_ROWS * 2)
