"""Keyframes made while the run goes on: chosen at once, their clouds made and written in the background."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass

from lslam.backend.keyframes.select import KeyframeSelector, keyframe_cloud, keyframe_labels
from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.config import Config
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import State, Stateful
from lslam.core.types.trajectory import Keyframe

# Scans that wait for their cloud at most, so that a slow disk does not fill the memory.
QUEUE_SCANS = 3


@dataclass(frozen=True)
class _Due:
    keyframe: Keyframe
    scan: Scan


class Keyframing(Stateful):
    """Feeds the store with the scans that become keyframes, whatever the method.

    A scan registered before the speed was known takes the motion within its sweep from the first scan after.
    `threads` below 2 does everything at once. Use it in a `with` block, whose end waits for pending work.
    """

    STATE = ("store", "_selector")

    def __init__(self, store: KeyframeStore, config: Config) -> None:
        self.store = store
        self._config = config
        self._selector = KeyframeSelector(config.keyframes)
        self._pool = ThreadPoolExecutor(1, "lslam-keyframe") if config.input.workers > 1 else None
        self._pending: list[Future[None]] = []
        self._unknown: list[_Due] = []

    def see(self, position: int, scan: Scan | None, result: ScanResult, motion: MotionPrior) -> None:
        """Process the next scan of the run (None when unreadable); motion : of the sensor within its sweep.

        Raises OutputError when the store cannot be written, by this scan or one before.
        """
        keyframe = self._selector.consider(position, result)
        has_motion = len(motion.times) > 1
        if self._unknown and has_motion:
            self._make_unknown(motion)
        if keyframe is None or scan is None:
            return
        if not has_motion and scan.span.seconds > 0 and self._config.preprocess.deskew:
            self._unknown.append(_Due(keyframe, scan))
        else:
            self._make(keyframe, scan, motion)

    def settle(self) -> None:
        """Wait until every keyframe so far is in the store, whose index is then written."""
        self._make_unknown(None)
        self._wait(0)
        self.store.save()

    @property
    def is_waiting(self) -> bool:
        """Whether a keyframe still waits for the motion within its sweep."""
        return bool(self._unknown)

    def state(self) -> State:
        """What `restore` needs to go on from here; waits for the clouds on their way."""
        self._wait(0)
        return super().state()

    def __enter__(self) -> Keyframing:
        """Nothing to begin."""
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """Wait for pending work; an exception of the block takes precedence over one of writing."""
        try:
            with suppress(*([Exception] if error is not None else [])):
                self._wait(0)
        finally:
            if self._pool is not None:
                self._pool.shutdown()

    def _make_unknown(self, motion: MotionPrior | None) -> None:
        due, self._unknown = self._unknown, []
        for one in due:
            at_once = MotionPrior.at_once(one.keyframe.T_world_lidar)
            self._make(one.keyframe, one.scan, at_once if motion is None else motion)

    def _make(self, keyframe: Keyframe, scan: Scan, motion: MotionPrior) -> None:
        if self._pool is None:
            self._write(keyframe, scan, motion)
            return
        self._wait(QUEUE_SCANS - 1)
        self._pending.append(self._pool.submit(copy_context().run, self._write, keyframe, scan, motion))

    def _write(self, keyframe: Keyframe, scan: Scan, motion: MotionPrior) -> None:
        given = scan, motion, self._config.preprocess, self._config.keyframes
        self.store.add(keyframe, keyframe_cloud(*given), keyframe_labels(*given))

    def _wait(self, most: int) -> None:
        while len(self._pending) > most:
            self._pending.pop(0).result()
