"""Checkpoints of the map while it is merged: its voxels are on disk already, so little is to be said."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.errors import InputError
from lslam.maps.merge import MapMerger
from lslam.pipeline.checkpoints import Checkpoints
from lslam.pipeline.run_folder import CHECKPOINT, RunFolder

log = logging.getLogger("lslam")


class MapCheckpoints:
    """What an interrupted map pass leaves to one over the same poses."""

    def __init__(self, checkpoints: Checkpoints) -> None:
        self._checkpoints = checkpoints
        self._poses = ""

    @property
    def spool(self) -> Path:
        """Where the merger keeps its voxels."""
        return self._checkpoints.folder / "map"

    def begin(self, merger: MapMerger, poses: NDArray[np.float64]) -> int:
        """Put an empty merger where an earlier pass over `poses` (N, 4, 4) left off: after how many scans."""
        self._poses = hashlib.sha256(np.ascontiguousarray(poses).tobytes()).hexdigest()
        latest = self._checkpoints.latest()
        try:
            if latest is None or latest["poses"] != self._poses:
                raise InputError("the poses are others")
            merger.restore(latest["merger"])
        except InputError as error:
            if latest is not None:
                log.warning("the map begins again: %s", error)
            self._checkpoints.clear()
            return 0
        log.info("map: going on after %d scans", latest["scans"])
        return int(latest["scans"])

    def offer(self, scans: int, merger: MapMerger, is_last: bool = False) -> None:
        """Write a checkpoint after `scans` scans when one is due, or when it is the last."""
        if scans and (is_last or self._checkpoints.pace.is_due):
            self._checkpoints.write(scans, lambda: {"poses": self._poses, "scans": scans, "merger": merger.state()})


def map_checkpoints(folder: RunFolder, config: Config) -> MapCheckpoints | None:
    """Those of a run folder; None when they are not wanted."""
    every_s = config.odometry.checkpoint_s
    return MapCheckpoints(Checkpoints(folder.path / CHECKPOINT, "map", every_s)) if every_s > 0 else None
