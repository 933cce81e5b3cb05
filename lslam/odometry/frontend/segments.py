"""A run that never stops: where the local map holds no more, the scans begin another, a segment of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from lslam.core.arrays import Floats
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import State, Stateful
from lslam.odometry.base import Odometry
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.registration.history import UsualAgreement

# Begins an empty map: the tracker of a scan that is expected at a pose (4, 4).
Begin = Callable[[Floats], Tracker]


@dataclass(frozen=True)
class TrackedScan:
    """A scan with its result; sweep, middle : of the tracker, as of this scan.

    has_both_sides : the motion within the sweep is smoothed with later scans
    """

    entry: ScanInput
    result: ScanResult
    sweep: MotionPrior
    middle: tuple[int, Floats]
    has_both_sides: bool = False

    def transform(self, T: Floats) -> TrackedScan:
        """The scan in another world, all poses multiplied by `T` (4, 4) from the left."""
        instant_ns, middle = self.middle
        sweep = replace(self.sweep, poses=T @ self.sweep.poses)
        return replace(self, result=self.result.in_world(T), sweep=sweep, middle=(instant_ns, T @ middle))

    def at(self, pose: Floats) -> TrackedScan:
        """The scan moved as a whole to `pose` (4, 4), T_world_lidar."""
        return self.transform(pose @ se3.inverse(self.result.T_world_lidar))


class SegmentTracker(Stateful):
    """Tracks the scans of a run, each segment of them in a local map of its own.

    A scan that is not registered is a bad one, or the map ends before it. Both hypotheses are followed: a second tracker begins
    an empty map with the scan. Where the first registers a scan again, and as many of its points agree with the old map as with
    the new one, the map holds, and the scans since were bad ones. Where they do not, or where the second registers more scans in
    a row than initialise a map, the scans since are a new segment. Scans that agree far less than those before do not count.

    present : the tracker of the present segment
    begin : None for a method that has one map only; initial_scans : that initialise a map
    """

    STATE = ("present", "_segment", "_usual")

    def __init__(self, tracker: Tracker, begin: Begin | None = None, initial_scans: int = 5) -> None:
        self.present, self.begin, self.initial_scans = tracker, begin, initial_scans
        self._segment = 0
        # What scans agreed with their maps: by less than a share of that, scans of nothing agree as well.
        self._usual = UsualAgreement(RegistrationConfig().min_agreement)
        # The hypothesis of a new map, and the scans since, as each of the two has them.
        self._other: Tracker | None = None
        self._open: list[tuple[TrackedScan, TrackedScan]] = []

    @property
    def odometry(self) -> Odometry:
        """The method with the map of the present segment."""
        return self.present.odometry

    @property
    def middle(self) -> tuple[int, Floats]:
        """Instant, ns, and pose of the middle of the newest sweep."""
        return self.present.middle

    @property
    def has_middles(self) -> bool:
        """Whether poses hold at the middle of a sweep: those of a method that deskews by constant velocity."""
        return isinstance(self.present.motion, ConstantVelocity) and self.present.is_deskewing

    def decide(self, entry: ScanInput | None, result: ScanResult | None) -> list[TrackedScan]:
        """The scans whose segment is decided with the next one, in order; none while both hypotheses are open.

        entry : None after the last scan, which decides all; result : of the present tracker for the scan
        """
        if entry is None or result is None:
            return self._finish()
        first = self._scan_by(self.present, entry, result, self._segment)
        other = None if self._other is None else self._trial(self._other, entry)
        has_registration = first.result.status == "ok"
        if has_registration:
            self._usual.observe(_share(first.result))
        is_new = other is not None and other.result.status == "ok" and not self._usual.is_collapse(_share(other.result))
        if other is not None and is_new:
            self._open.append((first, other))
            if has_registration and not _is_less(first.result, other.result):
                return self._finish()
            return self._new_segment() if has_registration or len(self._open) > self.initial_scans else []
        decided = self._finish()
        if has_registration or self.begin is None or entry.scan is None:
            return [*decided, first]
        self._other = self.begin(first.result.T_world_lidar)
        other = self._trial(self._other, entry)
        self._open = [(first, other)]
        return decided if other.result.status == "ok" else [*decided, *self._finish()]

    def _finish(self) -> list[TrackedScan]:
        """Decide for the old map: returns the undecided scans as its tracker registered them, and drops the new map."""
        bridged = [first for first, _ in self._open]
        self._other, self._open = None, []
        return bridged

    @property
    def is_complete(self) -> bool:
        """Whether nothing waits for the next scan, so that `state` is complete."""
        return self._other is None and self.present.is_complete

    def restore(self, state: State) -> None:
        """Replace the trackers and undecided scans by those of `state`."""
        super().restore(state)
        self._other, self._open = None, []

    def _new_segment(self) -> list[TrackedScan]:
        """Continue with the tracker of the new map. Returns the undecided scans as that tracker registered them."""
        assert self._other is not None
        registered = [other for _, other in self._open]
        # The motion model is known to others by its first object.
        motion = self.present.motion
        motion.restore(self._other.motion.state())
        self._other.motion = motion
        self.present, self._other, self._open = self._other, None, []
        self._segment += 1
        return registered

    def _trial(self, other: Tracker, entry: ScanInput) -> TrackedScan:
        """Track the scan by the `other` tracker, on the new map, as one of the next segment."""
        return self._scan_by(other, entry, other.track(entry), self._segment + 1)

    @staticmethod
    def _scan_by(tracker: Tracker, entry: ScanInput, result: ScanResult, segment: int) -> TrackedScan:
        """The scan with its result by a tracker, labelled with its segment."""
        return TrackedScan(entry, replace(result, segment=segment), tracker.sweep, tracker.middle)


def _is_less(result: ScanResult, other: ScanResult) -> bool:
    """True if much fewer points of a scan agree with a map than with the other: its pose there may be wrong."""
    return _share(result) < UsualAgreement.LESS * _share(other)


def _share(result: ScanResult) -> float:
    """Share of a scan's points that are inliers, 0 to 1."""
    return result.inliers / max(result.source_points, 1)
