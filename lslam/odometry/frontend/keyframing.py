"""Keyframes made while the run goes on: scans are chosen at once, their clouds made and written in the background."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.config.backend import KeyframesConfig
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3
from lslam.core.kernels import voxel
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import State, Stateful
from lslam.core.types.trajectory import Keyframe
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.prepare import NO_TIMES, as_cloud, gate_points


class KeyframeSelector(Stateful):
    """Takes a registered scan when the sensor has travelled `distance`, or turned by `angle_deg`, since the last taken.

    The first registered scan of each segment is one. Scans that were bridged or skipped never are: their poses are unknown.
    """

    STATE = ("_count", "_travelled", "_here", "_last", "_segment")

    def __init__(self, config: KeyframesConfig) -> None:
        self._distance, self._angle = config.distance, float(np.deg2rad(config.angle_deg))
        self._count = 0
        self._travelled = 0.0
        self._here: Floats | None = None
        self._last: Floats | None = None
        self._segment = 0

    def consider(self, scan: int, result: ScanResult) -> Keyframe | None:
        """The keyframe that scan number `scan` becomes, or None. Must be called for every scan of the run, in order."""
        pose = result.T_world_lidar
        if self._here is not None:
            self._travelled += float(np.linalg.norm(pose[:3, 3] - self._here[:3, 3]))
        self._here = pose
        if result.status != "ok" or not (result.segment != self._segment or self._is_due(pose)):
            return None
        self._last, self._segment = pose, result.segment
        self._count += 1
        return Keyframe(self._count - 1, scan, result.stamp_ns, pose, result.covariance, self._travelled)

    def _is_due(self, pose: Floats) -> bool:
        """Whether the pose (4, 4) is far enough from the last keyframe's."""
        if self._last is None:
            return True
        move, turn = se3.magnitude(se3.relative(self._last, pose))
        return move >= self._distance or turn >= self._angle


# m; centroids are rounded to it. A power of two, so that rounded numbers end in zeros and compress to half; its error,
# 0.6 mm rms, is a fiftieth of a point's noise.
GRAIN = 2.0**-9
# m; one averaged point per voxel is kept of a keyframe's scan.
KEYFRAME_VOXEL_M = 0.3


def keyframe_cloud(scan: Scan, motion: MotionPrior, preprocess: PreprocessConfig) -> NDArray[np.float32]:
    """Centroids (M, 3), m, of the scan's points in voxels of `KEYFRAME_VOXEL_M`, LiDAR frame at the scan's stamp.

    motion : of the sensor within the sweep; points are deskewed by it before they are averaged

    Range gate and ego box are odometry's. The ground stays in and nothing is denoised, whatever odometry prefers: what
    looks at keyframes wants to see the place.
    """
    centroids = voxel.means(_within_gate(scan, motion, preprocess)[0], NO_TIMES, KEYFRAME_VOXEL_M)[0]
    return np.asarray(np.round(centroids / np.float32(GRAIN)) * np.float32(GRAIN), np.float32)


def keyframe_labels(scan: Scan, motion: MotionPrior, preprocess: PreprocessConfig) -> NDArray[np.uint16] | None:
    """Classes (M,) of the points of `keyframe_cloud`, each that of the first point in its voxel; None where none are known."""
    if scan.labels is None:
        return None
    points, index = _within_gate(scan, motion, preprocess)
    return np.asarray(scan.labels[index[voxel.first_points(points, KEYFRAME_VOXEL_M)]])


def _within_gate(scan: Scan, motion: MotionPrior, preprocess: PreprocessConfig) -> tuple[NDArray[np.float32], Longs]:
    """Points (N, 3), m, of the scan, deskewed, and their indices in it."""
    plain = preprocess.model_copy(update={"remove_ground": False, "denoise": False})
    raw = as_cloud(scan.points)
    index = gate_points(raw, plain)
    times = scan.times[index] if scan.times is not None and preprocess.deskew else None
    return deskew_points(voxel.take(raw, index), times, motion), index


# Scans that wait for their cloud at most, so that a slow disk does not fill the memory.
QUEUE_SCANS = 3


@dataclass(frozen=True)
class _Due:
    """A keyframe whose cloud waits for the motion within its sweep."""

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
        """Make the next scan of the run a keyframe if one is due (scan: None when unreadable); motion : within its sweep.

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

    def finalise(self) -> None:
        """Write all pending keyframes to the store, wait for them, and save its index."""
        self._make_unknown(None)
        self._wait(0)
        self.store.save()

    @property
    def is_waiting(self) -> bool:
        """Whether a keyframe still waits for the motion within its sweep."""
        return bool(self._unknown)

    def state(self) -> State:
        """State for a checkpoint, after waiting for the pending clouds."""
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
        """Make the keyframes that wait for the motion within a sweep, by this one, or without deskewing for None."""
        due, self._unknown = self._unknown, []
        for one in due:
            at_once = MotionPrior.at_once(one.keyframe.T_world_lidar)
            self._make(one.keyframe, one.scan, at_once if motion is None else motion)

    def _make(self, keyframe: Keyframe, scan: Scan, motion: MotionPrior) -> None:
        """Make a keyframe's cloud and write it, in the background if there are threads."""
        if self._pool is None:
            self._write(keyframe, scan, motion)
            return
        self._wait(QUEUE_SCANS - 1)
        self._pending.append(self._pool.submit(copy_context().run, self._write, keyframe, scan, motion))

    def _write(self, keyframe: Keyframe, scan: Scan, motion: MotionPrior) -> None:
        """Make a keyframe's cloud and labels, and add them to the store."""
        given = scan, motion, self._config.preprocess
        self.store.add(keyframe, keyframe_cloud(*given), keyframe_labels(*given))

    def _wait(self, most: int) -> None:
        """Wait until at most `most` keyframes are pending. Raises their errors."""
        while len(self._pending) > most:
            self._pending.pop(0).result()
