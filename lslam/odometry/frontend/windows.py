"""Windows of scans, tracked again along the course that they tell where constant velocity displaces their points.

The first scan of a run is registered again, on a map of those that follow.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np

from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import State, Stateful
from lslam.odometry.base import Deskewing, Resumable
from lslam.odometry.frontend.segments import SegmentTracker, Tracked
from lslam.odometry.frontend.tracker import Loaded, Tracker
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.odometry.inertial.course import NEIGHBOUR_SWEEPS, Course
from lslam.odometry.integrity.monitor import IntegrityMonitor
from lslam.registration.robust import is_more


def first_pose(decided: list[Tracked], initial_scans: int, create: Callable[[], Deskewing]) -> Floats:
    """(4, 4) pose of the first scan on the map of the later ones, the initial ones left out.

    The second scan is registered on a map of the first alone. One scan shows surfaces along its rings only: their tilt is known
    badly, and its error stays between the first pose and all others. A map of many scans has none of it.

    create : makes the method with an empty map
    The pose stays where fewer than `initial_scans` later ones make a map, that does not hold the first in all directions, or an
    initial one was not registered, or taken at rest: their poses are one. So it does where a smoother links each scan to the one
    before.
    """
    first, later = decided[0], [k for k in range(initial_scans, len(decided)) if _is_placed(decided[k])]
    is_linked = any(tracked.sweep.link is not None for tracked in decided)
    if is_linked or len(later) < initial_scans or not all(_is_placed(tracked) for tracked in decided[:initial_scans]):
        return first.result.T_world_lidar
    priors, empty, target = _priors(decided), create(), create()
    # Backwards, so that a map of the last scans alone has the nearest ones.
    for k in reversed(later):
        # On an empty map a scan is not registered: it enters where it lies.
        scan, prepared = decided[k].loaded.scan, decided[k].loaded.prepared
        assert scan is not None
        target.update(scan, priors[k], empty.register(scan, prepared, priors[k]))
    assert first.loaded.scan is not None
    result = target.register(first.loaded.scan, first.loaded.prepared, priors[0], is_near=True)
    return result.T_world_lidar if result.is_accepted and len(result.degenerate) == 0 else first.result.T_world_lidar


def _priors(decided: list[Tracked]) -> list[MotionPrior]:
    """The motion within each sweep about its pose, without what an IMU says of that: it has had its say.

    A scan that was taken before the speed was known moved as the first one that knows it.
    """
    sweeps = [tracked.sweep for tracked in decided]
    usual = next((sweep for sweep in sweeps if len(sweep.times) > 1), sweeps[0])
    out = []
    for tracked in decided:
        sweep = tracked.sweep if len(tracked.sweep.times) > 1 else usual
        change = tracked.result.T_world_lidar @ se3.inverse(sweep.pose)
        out.append(replace(sweep, poses=change @ sweep.poses, covariance=None, link=None))
    return out


def _is_placed(tracked: Tracked) -> bool:
    """Whether a scan was registered, of a sensor that moved, on the first map of the run."""
    result = tracked.result
    return (
        tracked.loaded.scan is not None and result.status == "ok" and result.segment == 0 and not result.is_stationary
    )


# Scans: two seconds, which are held in memory.
WINDOW_SCANS = 20


class WindowTracker(Stateful):
    """Tracks scans window by window where their method follows a course and their sweeps take time, and others as they come.

    A window is tracked with constant velocity first. Where its points are displaced by more than their noise, it is tracked
    again from where it began, along the course through the middles of its sweeps, as long as more points agree. A run goes on
    from where a window began.

    The first scans of a run are a window whatever the method: with it the pose of the first is known, as in `first_pose`.

    monitor : sees the scans that are decided; noise_m : of a point
    """

    STATE = ("_tracker", "_before", "_world", "_monitor")

    def __init__(self, tracker: SegmentTracker, monitor: IntegrityMonitor | None, noise_m: float) -> None:
        self._tracker, self._monitor, self._noise_m = tracker, monitor, noise_m
        self.is_windowed = (
            tracker.odometry.follows_course
            and isinstance(tracker.odometry, Resumable)
            and isinstance(tracker.present.motion, ConstantVelocity)
        )
        # Of the open window, None: the end of the recording.
        self._scans: list[Loaded | None] = []
        self._decided: list[Tracked] = []
        self._start: State = {}
        # Instants, ns, and poses of the last middles before the window.
        self._before: list[tuple[int, Floats]] = []
        # The tracker's world in that of the first pose as later scans tell it; None until they do.
        self._world: Floats | None = None if self._can_look_back else np.eye(4)

    @property
    def middle(self) -> tuple[int, Floats]:
        """Instant, ns, and pose of the middle of the newest sweep."""
        instant_ns, pose = self._tracker.middle
        return instant_ns, pose if self._world is None else self._world @ pose

    @property
    def _can_look_back(self) -> bool:
        """Whether the first scans can be registered again on a map of later ones."""
        tracker = self._tracker
        return tracker.begin is not None and tracker.initial_scans > 1 and isinstance(tracker.odometry, Resumable)

    @property
    def present(self) -> Tracker:
        """Tracks the scans of the present segment."""
        return self._tracker.present

    @property
    def is_settled(self) -> bool:
        """Whether `state` is complete."""
        return bool(self._scans) or self._tracker.is_settled

    def open(self, loaded: Loaded | None) -> None:
        """Take the next scan, None at the end, into the window that is open or begins with it, before it is tracked."""
        if not self._scans:
            if not self._is_begin(loaded):
                return
            self._start = deepcopy(self._tracker.state())
        self._scans.append(loaded)

    def decide(self, loaded: Loaded | None, result: ScanResult | None) -> list[Tracked]:
        """The scans that are decided with the next one, None at the end: one, none, or all of a window.

        result : of the present tracker
        """
        decided = self._tracker.decide(loaded, result)
        if not self._scans:
            return self._moved(decided)
        self._decided += decided
        is_full = len(self._scans) >= WINDOW_SCANS and self._tracker.is_settled
        return self._close() if is_full or loaded is None else []

    def state(self) -> State:
        """What `restore` needs to go on from where the open window begins."""
        return {**super().state(), **({"_tracker": self._start} if self._scans else {})}

    def _is_begin(self, loaded: Loaded | None) -> bool:
        """Whether a window begins with the scan."""
        scan = None if loaded is None else loaded.scan
        if scan is None or not self._tracker.is_settled:
            return False
        return self._world is None or (self.is_windowed and scan.span.seconds > 0)

    def _close(self) -> list[Tracked]:
        """The scans of the window, the first of a run where the later ones put it."""
        is_bent = self.is_windowed and self._follow_course()
        out = [replace(tracked, is_two_sided=is_bent) for tracked in self._decided]
        self._before = self._middles()[-NEIGHBOUR_SWEEPS:]
        if self._world is None:
            out[0] = self._look_back(out)
        self._scans, self._decided = [], []
        return self._moved(out)

    def _follow_course(self) -> bool:
        """Track the window along its course where it bends and more points agree along it in most scans; whether it does."""
        is_bent, is_better, passes = self._is_bent(), True, 0
        # The first course is told by scans that constant velocity deskewed.
        while is_bent and is_better:
            before, passes = self._inliers(), passes + 1
            self._track_again(self._course())
            is_whole = self._is_whole() and (self._tracker.is_settled or self._scans[-1] is None)
            is_better = is_whole and _is_more(self._inliers(), before)
            is_bent = is_better or (is_whole and passes > 1)
            if not is_bent:
                self._track_again(None)
        self._set_course(None)
        return is_bent

    def _look_back(self, decided: list[Tracked]) -> Tracked:
        """The first scan on the map of the later ones, in the tracker's world, which turns with its pose."""
        begin, first, began = self._tracker.begin, decided[0], time.perf_counter()
        assert begin is not None

        def create() -> Deskewing:
            odometry = begin(np.eye(4)).odometry
            assert isinstance(odometry, Deskewing)
            return odometry

        pose = first_pose(decided, self._tracker.initial_scans, create)
        self._world = se3.normalise(first.result.T_world_lidar @ se3.inverse(pose))
        stages = _sum(first.result.stages, {"register": time.perf_counter() - began})
        return replace(first, result=replace(first.result, stages=stages)).at(pose)

    def _moved(self, decided: list[Tracked]) -> list[Tracked]:
        """In the world of the first pose."""
        world = self._world
        return decided if world is None else [tracked.moved(world) for tracked in decided]

    def _inliers(self) -> list[int]:
        return [tracked.result.inliers for tracked in self._decided]

    def _middles(self) -> list[tuple[int, Floats]]:
        """Instants and poses of the middles of registered sweeps, up to the end of the window."""
        now = [t.middle for t in self._decided if t.result.status == "ok" and not t.result.is_repeated]
        return [*self._before, *now]

    def _course(self) -> Course:
        instants, poses = zip(*self._middles(), strict=True)
        return Course(np.array(instants, np.int64), np.stack(poses))

    def _track_again(self, course: Course | None) -> None:
        earlier = [tracked.result for tracked in self._decided]
        self._tracker.restore(deepcopy(self._start))
        self._set_course(course)
        self._decided = []
        for loaded in self._scans:
            result = None if loaded is None else self.present.track(loaded)
            self._decided += self._tracker.decide(loaded, result)
        for k, (tracked, before) in enumerate(zip(self._decided, earlier, strict=False)):
            now = tracked.result
            work = replace(now, stages=_sum(now.stages, before.stages), iterations=now.iterations + before.iterations)
            self._decided[k] = replace(tracked, result=work)

    def _set_course(self, course: Course | None) -> None:
        motion = self.present.motion
        assert isinstance(motion, ConstantVelocity)
        motion.course = course

    def _is_whole(self) -> bool:
        return len({tracked.result.segment for tracked in self._decided}) == 1

    def _is_bent(self) -> bool:
        """Whether the window's course, in one segment, displaces the points of most sweeps by more than their noise."""
        if not self._is_whole() or len(self._middles()) < 2 * NEIGHBOUR_SWEEPS:
            return False
        course = self._course()
        squares = [square for t in self._decided if (square := _displacement2(t, course)) is not None]
        return len(squares) > 0 and float(np.median(squares)) > self._noise_m**2


def _displacement2(tracked: Tracked, course: Course) -> float | None:
    """Mean square, m2, of the displacement of a scan's points between its sweep and the course; None where either is unknown."""
    poses = course.at(tracked.result.stamp_ns, tracked.sweep.times)
    if poses is None:
        return None
    middle, source = len(poses) // 2, tracked.loaded.prepared.source
    within, course_within = (se3.relative(sweep[middle], sweep) for sweep in (tracked.sweep.poses, poses))
    change = (se3.relative(within, course_within) - np.eye(4))[:, :3]
    points = np.column_stack([source, np.ones(len(source))])
    moments = np.einsum("na,nb->ab", points, points) / max(len(points), 1)
    return float(np.einsum("kia,ab,kib->k", change, moments, change).mean())


def _is_more(ours: list[int], others: list[int]) -> bool:
    """Whether more scans have more inliers than have less, at two sigma: points of one scan agree or do not together."""
    won, lost = (sum(sign * (a - b) > 0 for a, b in zip(ours, others, strict=True)) for sign in (1, -1))
    return is_more(won, lost)


def _sum(a: dict[str, float], b: dict[str, float]) -> dict[str, float]:
    return {name: a.get(name, 0.0) + b.get(name, 0.0) for name in a | b}
