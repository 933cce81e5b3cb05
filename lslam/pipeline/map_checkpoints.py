"""Checkpoints of a map while it is merged: its voxels are on disk already, so little is to be said."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.errors import InputError
from lslam.frontend.checkpoints import Checkpoints
from lslam.pipeline.run_folder import CHECKPOINT, RunFolder
from lslam.types.state import State

log = logging.getLogger("lslam")


class Maker(Protocol):
    """What makes a map of scans, one after the other."""

    def state(self) -> State:
        """What `restore` needs to go on from here."""

    def restore(self, state: State) -> None:
        """Go on where `state` was taken, in an empty maker of the same kind; raises InputError when voxels are missing."""


M = TypeVar("M", bound=Maker)


class MapCheckpoints:
    """What an interrupted pass over the scans leaves to one over the same poses."""

    def __init__(self, checkpoints: Checkpoints, what: str) -> None:
        self._checkpoints, self._what = checkpoints, what
        self._poses = ""

    @property
    def folder(self) -> Path:
        """Where voxels are kept, in folders of their own."""
        return self._checkpoints.folder

    def begin(self, make: Callable[[], M], poses: NDArray[np.float64]) -> tuple[M, int]:
        """A maker that is where an earlier pass over `poses` (N, 4, 4) left off, and after how many scans that was."""
        self._poses = hashlib.sha256(np.ascontiguousarray(poses).tobytes()).hexdigest()
        latest, maker = self._checkpoints.latest(), make()
        try:
            if latest is None or latest["poses"] != self._poses:
                raise InputError("the poses are others")
            maker.restore(latest["maker"])
        except InputError as error:
            if latest is not None:
                log.warning("the %s begins again: %s", self._what, error)
            self._checkpoints.clear()
            return make(), 0
        log.info("%s: going on after %d scans", self._what, latest["scans"])
        return maker, int(latest["scans"])

    def offer(self, scans: int, maker: Maker, is_last: bool = False) -> None:
        """Write a checkpoint after `scans` scans when one is due, or when it is the last."""
        if scans and (is_last or self._checkpoints.schedule.is_due):
            self._checkpoints.write(scans, lambda: {"poses": self._poses, "scans": scans, "maker": maker.state()})


def map_checkpoints(folder: RunFolder, config: Config, what: str = "map") -> MapCheckpoints | None:
    """Those of a run folder; None when they are not wanted."""
    every_s = config.odometry.checkpoint_s
    if every_s == 0:
        return None
    return MapCheckpoints(Checkpoints(folder.path / CHECKPOINT, what.replace(" ", "-"), every_s), what)
