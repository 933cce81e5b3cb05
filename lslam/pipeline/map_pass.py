"""Second pass over the raw scans: the merged map from the final poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.maps.merge import MapMerger, MergedMap
from lslam.maps.top_view import top_view
from lslam.pipeline.front_end import read_ahead
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence


@dataclass(frozen=True)
class BuiltMap:
    """The merged map and its view from above."""

    merged: MergedMap
    image: NDArray[np.float32]
    extent: tuple[float, float, float, float]


def build_map(
    sequence: Sequence, results: list[ScanResult], config: Config, on_step: Callable[[], None],
    should_stop: Callable[[], bool],
) -> BuiltMap | None:  # fmt: skip
    """Merge every scan that was registered; bridged scans would draw their error into the map and stay out.

    None when `should_stop` said so before the last scan.
    """
    merger = MapMerger(config.map.voxel, config.map.range_min, config.map.range_max)
    for loaded, result in zip(read_ahead(sequence, None, config.input.threads), results, strict=False):
        if should_stop():
            return None
        if loaded.scan is not None and result.status == "ok":
            merger.add(loaded.scan.points, result.T_world_lidar, loaded.scan.intensity)
        on_step()
    merged = merger.result()
    image, extent = top_view(merged.points, pixel=max(0.2, config.map.voxel))
    return BuiltMap(merged, image, extent)
