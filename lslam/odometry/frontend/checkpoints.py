"""What a run leaves behind on its way, so that `--resume` goes on there and ends with the same bytes."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from lslam.core.errors import InputError
from lslam.core.types import constraint, imu, motion_prior, scan, scan_result
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import State
from lslam.core.types.warned import warnings_so_far
from lslam.io.formats.state_files import Records, read_state, write_state
from lslam.odometry import feature_map, icp_svd, plane_factors, plane_window
from lslam.odometry.base import Resumable
from lslam.odometry.frontend import segments, tracker
from lslam.odometry.frontend.keyframing import Keyframing
from lslam.odometry.frontend.windows import WindowTracker
from lslam.odometry.inertial import filter as inertial_filter
from lslam.odometry.inertial import gyroscope, imu_estimate, initialise, wheel_calibration, window
from lslam.odometry.integrity import monitor
from lslam.registration.preprocessing import features, prepare

# The dataclasses of these modules, plain values all of them, may be part of a state.
_STATE_MODULES = (
    *(
        constraint,
        imu,
        motion_prior,
        scan,
        scan_result,
        features,
        prepare,
        feature_map,
        icp_svd,
        plane_factors,
        plane_window,
    ),
    *(gyroscope, imu_estimate, inertial_filter, initialise, wheel_calibration, window, monitor, segments, tracker),
)
STATE_CLASSES = tuple(
    value
    for module in _STATE_MODULES
    for value in vars(module).values()
    if isinstance(value, type) and is_dataclass(value) and value.__module__ == module.__name__
)

log = logging.getLogger("lslam")

# The last one may be damaged when the machine itself went down while it was written.
CHECKPOINT_COPIES = 2


class CheckpointSchedule:
    """When a checkpoint is due: after each twentieth of the time so far, but never later than `every_s` after the last.

    So a run that is killed loses a twentieth of what it had done, whatever its length, and a long one `every_s`. What
    checkpoints cost stays below a fiftieth of the time between them.
    """

    SOONEST_S, PART, MOST_SHARE = 1.0, 0.05, 0.02

    def __init__(self, every_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._every_s, self._clock = every_s, clock
        self._began = clock()
        self._next = self._began + min(every_s, self.SOONEST_S)

    @property
    def is_due(self) -> bool:
        """Whether it is time; never when `every_s` is 0."""
        return self._every_s > 0 and self._clock() >= self._next

    def wrote(self, seconds: float) -> None:
        """Set when the next checkpoint is due, after one that took `seconds` to write."""
        now = self._clock()
        wait = min(self._every_s, max(self.SOONEST_S, self.PART * (now - self._began)))
        self._next = now + max(wait, seconds / self.MOST_SHARE)


class Checkpoints:
    """The checkpoints of one stage of a run in a folder, the newest two of them.

    folder : made when it is needed; stage : the beginning of their names
    """

    def __init__(self, folder: Path, stage: str, every_s: float) -> None:
        self.folder, self._stage = folder, stage
        self.schedule = CheckpointSchedule(every_s)

    def write(self, scans: int, content: Callable[[], State]) -> None:
        """Write the state that `content` returns after `scans` scans, with the run's warnings; delete all but the newest two.

        The time this takes is reported to the schedule. Raises OutputError.
        """
        began = time.perf_counter()
        self.folder.mkdir(exist_ok=True)
        record = {**content(), "warned": warnings_so_far().state()}
        write_state(self.folder / f"{self._stage}-{scans:07d}.npz", record)
        for old in self._files()[:-CHECKPOINT_COPIES]:
            with contextlib.suppress(OSError):
                old.unlink()
        self.schedule.wrote(time.perf_counter() - began)

    def latest(self) -> Any:
        """State of the newest readable checkpoint, whose warnings are added to this run's; None without. Deletes damaged ones."""
        for path in reversed(self._files()):
            try:
                record = read_state(path, STATE_CLASSES)
                warnings_so_far().take_over(record.pop("warned", {"texts": [], "places": []}))
                return record
            except InputError as error:
                log.warning("a checkpoint is left out: %s", error)
                with contextlib.suppress(OSError):
                    path.unlink()
        return None

    def clear(self) -> None:
        """Delete all checkpoints, so that a run from the start does not take an older run's for its own."""
        for path in self._files():
            path.unlink(missing_ok=True)

    def _files(self) -> list[Path]:
        """Files of the checkpoints, oldest first."""
        return sorted(self.folder.glob(f"{self._stage}-*.npz"))


class OdometryCheckpoints:
    """Checkpoints of odometry: results so far, keyframes, and all state that the next scan depends on.

    A method that is not `Resumable` has one after the last scan only: an earlier one could not be continued.
    """

    def __init__(self, checkpoints: Checkpoints) -> None:
        self._checkpoints = checkpoints
        self._latest = checkpoints.latest()
        self.resumed_after: list[int] = []
        self._seconds = 0.0
        self._began = time.monotonic()

    @property
    def is_over(self) -> bool:
        """Whether an earlier run came to the end of odometry."""
        return self._latest is not None and bool(self._latest["is_over"])

    @property
    def scans(self) -> int:
        """After how many scans an earlier run left off; 0 when there is nothing to go on from."""
        return len(self.results)

    @property
    def results(self) -> list[ScanResult]:
        """What an earlier run found until there."""
        return [] if self._latest is None else list(self._latest["results"])

    @property
    def folder(self) -> Path:
        """Where they lie."""
        return self._checkpoints.folder

    @property
    def seconds(self) -> float:
        """What earlier runs spent on the results that were taken over, s."""
        return self._seconds

    def begin(self, tracker: WindowTracker, keyframing: Keyframing) -> list[ScanResult]:
        """Restore tracker and keyframes from the newest checkpoint, and return its results; empty without one.

        Where the store of keyframes lacks some of them, the run begins again, with a warning. Raises InputError for a checkpoint
        that does not fit the tracker.
        """
        self._began = time.monotonic()
        latest = self._latest
        if latest is not None:
            try:
                keyframing.restore(latest["keyframes"])
            except InputError as error:
                log.warning("%s: the run begins again", error)
                self._latest = latest = None
        if latest is None:
            self._checkpoints.clear()
            keyframing.store.clear()
            return []
        try:
            tracker.restore(latest["tracker"])
        except (InputError, KeyError, ValueError, TypeError) as error:
            raise InputError(
                f"the checkpoint in {self._checkpoints.folder} is damaged ({error}): --overwrite the run"
            ) from None
        results: list[ScanResult] = latest["results"]
        self._seconds = latest["seconds"]
        self.resumed_after = [*latest["resumed_after"], len(results)]
        log.info("going on after %d scans", len(results))
        return results

    def offer(self, results: list[ScanResult], tracker: WindowTracker, keyframing: Keyframing) -> None:
        """Write a checkpoint when one is due."""
        if self._checkpoints.schedule.is_due and isinstance(tracker.present.odometry, Resumable):
            self._write(results, tracker, keyframing, is_over=False)

    def close(self, results: list[ScanResult], tracker: WindowTracker, keyframing: Keyframing, is_over: bool) -> None:
        """Write the last checkpoint, when odometry is over (`is_over`) or was asked to stop."""
        if (is_over and not self.is_over) or (not is_over and isinstance(tracker.present.odometry, Resumable)):
            self._write(results, tracker, keyframing, is_over)

    def _write(self, results: list[ScanResult], tracker: WindowTracker, keyframing: Keyframing, is_over: bool) -> None:
        """Write a checkpoint, unless all scans were skipped or a result is still pending; is_over : after the last scan."""
        if all(result.status == "skipped" for result in results):
            return  # bad input: nothing to go on with
        if not is_over and (keyframing.is_waiting or not tracker.is_complete):
            return  # the next scan is needed to say what the first one was
        if is_over:
            keyframing.finalise()

        def content() -> State:
            return {
                "results": Records(results),
                "tracker": tracker.state() | ({"odometry": None} if is_over else {}),
                "keyframes": keyframing.state(),
                "is_over": is_over,
                "seconds": self._seconds + time.monotonic() - self._began,
                "resumed_after": self.resumed_after,
            }

        self._checkpoints.write(len(results), content)
