"""Windows of scans, tracked again along the course that they tell where constant velocity displaces their points.

The first scan of a run is registered again, on a map of those that follow; of a run that begins at rest, once they see its
surroundings from elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import noise, se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan_result import ScanResult, sum_stages
from lslam.core.types.state import State, Stateful
from lslam.odometry.base import Deskewing, Resumable
from lslam.odometry.frontend.segments import SegmentTracker, TrackedScan
from lslam.odometry.frontend.tracker import ScanInput, Tracker, apart
from lslam.odometry.inertial.constant_velocity import NEIGHBOUR_SWEEPS, ConstantVelocity, Course
from lslam.odometry.integrity.monitor import IntegrityMonitor
from lslam.registration.history import is_more
from lslam.registration.rest import INLIER_CHI2


def first_pose(
    tracks: list[TrackedScan], initial_scans: int, create: Callable[[], Deskewing]
) -> tuple[Floats, Floats | None]:
    """Pose (4, 4) of the first scan registered on the map of the later ones, without the initial ones, and its covariance.

    The second scan is registered on a map of the first alone. One scan shows surfaces along its rings only: their tilt is
    uncertain, and its error stays between the first pose and all others. A map of many scans is free of it.

    create : makes the method with an empty map
    Without covariance the pose is the original one: fewer than `initial_scans` later scans make a map, the map does not
    constrain all directions, an initial scan was not registered or was taken at rest, or a smoother links the scans.
    """
    stays = tracks[0].result.T_world_lidar
    later = [k for k in range(initial_scans, len(tracks)) if _has_place(tracks[k])]
    is_linked = any(track.sweep.link is not None for track in tracks)
    if is_linked or len(later) < initial_scans or not all(_has_place(track) for track in tracks[:initial_scans]):
        return stays, None
    priors, empty, target = _priors(tracks), create(), create()
    # Backwards, so that a map of the last scans alone has the nearest ones.
    for k in reversed(later):
        # On an empty map a scan is not registered: it enters where it lies.
        scan, prepared = tracks[k].entry.scan, tracks[k].entry.prepared
        assert scan is not None
        target.update(scan, priors[k], empty.register(scan, prepared, priors[k]))
    first = tracks[0].entry
    assert first.scan is not None
    result = target.register(first.scan, first.prepared, priors[0], is_near=True)
    is_better = result.is_accepted and len(result.degenerate) == 0
    return (result.T_world_lidar, result.covariance) if is_better else (stays, None)


def _priors(tracks: list[TrackedScan]) -> list[MotionPrior]:
    """The motion within each sweep about its registered pose, without the IMU's covariance, which has been used already.

    A scan taken before the speed was known gets the motion of the first scan that has one.
    """
    sweeps = [track.sweep for track in tracks]
    usual = next((sweep for sweep in sweeps if len(sweep.times) > 1), sweeps[0])
    out = []
    for track in tracks:
        sweep = track.sweep if len(track.sweep.times) > 1 else usual
        change = track.result.T_world_lidar @ se3.inverse(sweep.pose)
        out.append(replace(sweep, poses=change @ sweep.poses, covariance=None, link=None))
    return out


def _with_start_error(track: TrackedScan, position: Floats, covariance: Floats) -> TrackedScan:
    """The scan with the covariance (6, 6) of the first pose, at `position` (3,), m, world, added to its own, relative one."""
    result = track.result
    spread = noise.transport(covariance, result.T_world_lidar[:3, 3] - position)
    own, by_points = (None if C is None else C + spread for C in (result.covariance, result.points_covariance))
    return replace(track, result=replace(result, covariance=own, points_covariance=by_points))


def _has_place(track: TrackedScan) -> bool:
    """Whether a scan was registered, of a sensor that moved, on the first map of the run."""
    return _has_registration(track) and not track.result.is_stationary


def _has_registration(track: TrackedScan) -> bool:
    """Whether a scan was registered on the first map of the run."""
    result = track.result
    return track.entry.scan is not None and result.status == "ok" and result.segment == 0


# Scans: two seconds, which are held in memory.
WINDOW_SCANS = 20
# Of a run that began at rest, the first scan and the pose (4, 4) of its spot.
StartAtRest = tuple[TrackedScan, Floats]


class WindowTracker(Stateful):
    """Tracks scans window by window where their method follows a course and their sweeps take time, and others as they come.

    A window is tracked with constant velocity first. Where its points are displaced by more than their noise, it is tracked
    again from where it began, along the course through the middles of its sweeps, as long as more points agree. A run goes on
    from where a window began.

    The first scans of a run are a window whatever the method: with it the pose of the first is known, as in `first_pose`.
    Scans from one spot hit the same places, so that a map of them, however many, knows surfaces as one scan does, and draws
    those from near by. Where a run begins at rest they are decided as they come, and a window begins as the sensor leaves. Once
    enough of it lies beyond `beyond_m` the first scan is registered on a map of that. The scans at rest move with it as one.

    monitor : sees the scans that are decided; noise_m : of a point; beyond_m : how far scans from elsewhere are
    """

    STATE = ("_tracker", "_before", "_world", "_monitor", "_rest", "_start")

    def __init__(
        self, tracker: SegmentTracker, monitor: IntegrityMonitor | None, noise_m: float, beyond_m: float
    ) -> None:
        self._tracker, self._monitor, self._noise_m, self._beyond_m = tracker, monitor, noise_m, beyond_m
        self.is_windowed = (
            tracker.odometry.follows_course
            and isinstance(tracker.odometry, Resumable)
            and isinstance(tracker.present.motion, ConstantVelocity)
        )
        # Of the open window, None: the end of the recording.
        self._scans: list[ScanInput | None] = []
        self._decided: list[TrackedScan] = []
        self._begin: State = {}
        # Instants, ns, and poses of the last middles before the window.
        self._before: list[tuple[int, Floats]] = []
        # The tracker's world in that of the first pose as later scans tell it; None until they do.
        self._world: Floats | None = None if self._can_look_back else np.eye(4)
        # Of a run that began at rest, until then.
        self._rest: StartAtRest | None = None
        # From then on, of such a run: the first position (3,), and the covariance (6, 6) of its registration, in that world.
        self._start: tuple[Floats, Floats] | None = None

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
    def is_complete(self) -> bool:
        """Whether `state` is complete."""
        return bool(self._scans) or self._tracker.is_complete

    def open(self, entry: ScanInput | None) -> None:
        """Add the next scan, None at the end, to the open window, or begin a window with it if one is due. Tracking follows."""
        if not self._scans:
            if not self._is_begin(entry):
                return
            self._begin = deepcopy(self._tracker.state())
        self._scans.append(entry)

    def decide(self, entry: ScanInput | None, result: ScanResult | None) -> list[TrackedScan]:
        """Scans decided with the next one (None at the end) and its tracker's `result`: one, none, or all of a window."""
        tracks = self._tracker.decide(entry, result)
        if not self._scans:
            return self._to_world(tracks)
        self._decided += tracks
        return self._close() if entry is None or (self._tracker.is_complete and self._is_full()) else []

    def state(self) -> State:
        """State for a checkpoint, as it was where the open window begins."""
        return {**super().state(), **({"_tracker": self._begin} if self._scans else {})}

    def _is_begin(self, entry: ScanInput | None) -> bool:
        """Whether a window begins with the scan."""
        scan = None if entry is None else entry.scan
        if scan is None or not self._tracker.is_complete:
            return False
        is_looking_back = self._world is None and (
            self._rest is None or self._is_away(self._tracker.middle[1], self._rest)
        )
        return is_looking_back or (self.is_windowed and scan.span.seconds > 0)

    def _is_full(self) -> bool:
        """Whether the window ends with its newest scan: it has all of its scans, or the sensor has left its first position."""
        count, rest = len(self._scans), self._resting()
        if rest is None:
            return count >= WINDOW_SCANS
        begin, end = (self._is_away(self._decided[k].result.T_world_lidar, rest) for k in (0, -1))
        if begin:
            return count >= 2 * WINDOW_SCANS or len(self._elsewhere(self._decided, rest)) >= WINDOW_SCANS
        return end or count >= WINDOW_SCANS

    def _resting(self) -> StartAtRest | None:
        """First scan and position of a run that began at rest, until that scan is registered again; None for other runs.

        The position is that of the last initial scan, since the first is uncertain.
        """
        if self._world is not None or self._rest is not None:
            return self._rest
        initial = self._decided[: self._tracker.initial_scans]
        if len(initial) < self._tracker.initial_scans or not all(_has_registration(track) for track in initial):
            return None
        rest = initial[0], initial[-1].result.T_world_lidar
        if any(self._is_away(track.result.T_world_lidar, rest) for track in initial[1:]):
            return None
        return replace(initial[0], sweep=_priors(initial)[0]), rest[1]

    def _is_away(self, pose: Floats, rest: StartAtRest) -> bool:
        """Whether a pose (4, 4) is farther from the first position than three sigma of a single point."""
        return apart(rest[1], pose) ** 2 > INLIER_CHI2 * self._noise_m**2

    def _elsewhere(self, tracks: list[TrackedScan], rest: StartAtRest) -> list[TrackedScan]:
        """The registered scans that lie beyond the surroundings of the first spot."""
        start = rest[1][:3, 3]
        far = [np.linalg.norm(t.result.T_world_lidar[:3, 3] - start) > self._beyond_m for t in tracks]
        return [t for t, is_far in zip(tracks, far, strict=True) if is_far and _has_place(t)]

    def _close(self) -> list[TrackedScan]:
        """The scans of the window, tracked again along its course if that is better; a run's first at its corrected pose."""
        is_bent = self.is_windowed and self._follow_course()
        out = [replace(track, has_both_sides=is_bent) for track in self._decided]
        self._before = self._middles()[-NEIGHBOUR_SWEEPS:]
        here: list[TrackedScan] = []
        if self._world is None:
            here, out = self._look_back(out)
        self._scans, self._decided = [], []
        return [*here, *self._to_world(out)]

    def _follow_course(self) -> bool:
        """Track the window along its course if it bends, and keep that if more points agree in most scans; whether it does."""
        is_bent, is_better, passes = self._is_bent(), True, 0
        # The first course is told by scans that constant velocity deskewed.
        while is_bent and is_better:
            before, passes = self._inliers(), passes + 1
            self._track_again(self._course())
            is_whole = self._is_whole() and (self._tracker.is_complete or self._scans[-1] is None)
            is_better = is_whole and _is_more(self._inliers(), before)
            is_bent = is_better or (is_whole and passes > 1)
            if not is_bent:
                self._track_again(None)
        self._set_course(None)
        return is_bent

    def _look_back(self, tracks: list[TrackedScan]) -> tuple[list[TrackedScan], list[TrackedScan]]:
        """Register the first scan on the later ones; the window's scans at rest, and all others, in the tracker's world.

        The world is then defined by the corrected first pose. Without enough later scans, ([], tracks).
        """
        begin, began = self._tracker.begin, time.perf_counter()
        assert begin is not None

        def create() -> Deskewing:
            odometry = begin(np.eye(4)).odometry
            assert isinstance(odometry, Deskewing)
            return odometry

        self._rest = self._resting()
        used, initial_scans, here = tracks, self._tracker.initial_scans, 0
        if self._rest is not None:
            later = self._elsewhere(tracks, self._rest)
            if len(later) < initial_scans and tracks[-1].result.segment == 0:
                return [], tracks
            left = [k for k, t in enumerate(tracks) if self._is_away(t.result.T_world_lidar, self._rest)]
            used, initial_scans, here = [self._rest[0], *later], 1, min(left, default=len(tracks))
        pose, covariance = first_pose(used, initial_scans, create)
        before = used[0].result.T_world_lidar
        self._world = se3.normalise(before @ se3.inverse(pose))
        stages = sum_stages([tracks[0].result.stages, {"register": time.perf_counter() - began}])
        out = [replace(tracks[0], result=replace(tracks[0].result, stages=stages)), *tracks[1:]]
        if self._rest is None:
            return [], [out[0].at(pose), *out[1:]]
        if covariance is not None:
            self._start = before[:3, 3], noise.rotate(covariance, self._world[:3, :3])
        self._rest = None
        return out[:here], out[here:]

    def _to_world(self, tracks: list[TrackedScan]) -> list[TrackedScan]:
        """The scans in the world of the run's corrected first pose, whose covariance is added to theirs."""
        world, start = self._world, self._start
        moved = tracks if world is None else [track.transform(world) for track in tracks]
        return moved if start is None else [_with_start_error(track, *start) for track in moved]

    def _inliers(self) -> list[int]:
        """Number of inliers of each decided scan."""
        return [track.result.inliers for track in self._decided]

    def _middles(self) -> list[tuple[int, Floats]]:
        """Instants and poses of the middles of registered sweeps, up to the end of the window."""
        now = [t.middle for t in self._decided if t.result.status == "ok" and not t.result.repeats_pose]
        return [*self._before, *now]

    def _course(self) -> Course:
        """Splines through the middles of the window's sweeps."""
        instants, poses = zip(*self._middles(), strict=True)
        return Course(np.array(instants, np.int64), np.stack(poses))

    def _track_again(self, course: Course | None) -> None:
        """Track the window once more from its begin, by the `course` or by constant velocity (None); costs add up."""
        earlier = [track.result for track in self._decided]
        self._tracker.restore(deepcopy(self._begin))
        self._set_course(course)
        self._decided = []
        for entry in self._scans:
            result = None if entry is None else self.present.track(entry)
            self._decided += self._tracker.decide(entry, result)
        for k, (track, before) in enumerate(zip(self._decided, earlier, strict=False)):
            now = track.result
            stages = sum_stages([now.stages, before.stages])
            work = replace(now, stages=stages, iterations=now.iterations + before.iterations)
            self._decided[k] = replace(track, result=work)

    def _set_course(self, course: Course | None) -> None:
        """Have the motion model predict by a course, or by constant velocity for None."""
        motion = self.present.motion
        assert isinstance(motion, ConstantVelocity)
        motion.course = course

    def _is_whole(self) -> bool:
        """Whether all decided scans belong to one segment."""
        return len({track.result.segment for track in self._decided}) == 1

    def _is_bent(self) -> bool:
        """Whether the window's course displaces the points of most sweeps by more than their noise.

        False where the track broke within the window, or for too few sweeps to tell.
        """
        if not self._is_whole() or len(self._middles()) < 2 * NEIGHBOUR_SWEEPS:
            return False
        course = self._course()
        squares = [square for t in self._decided if (square := _displacement2(t, course)) is not None]
        return len(squares) > 0 and float(np.median(squares)) > self._noise_m**2


def _displacement2(track: TrackedScan, course: Course) -> float | None:
    """Mean square, m2, of the displacement of a scan's points between its sweep and the course; None where either is missing."""
    poses = course.at(track.result.stamp_ns, track.sweep.times)
    if poses is None:
        return None
    middle, source = len(poses) // 2, track.entry.prepared.source
    within, course_within = (se3.relative(sweep[middle], sweep) for sweep in (track.sweep.poses, poses))
    change = (se3.relative(within, course_within) - np.eye(4))[:, :3]
    points = np.column_stack([source, np.ones(len(source))])
    moments = np.einsum("na,nb->ab", points, points) / max(len(points), 1)
    return float(np.einsum("kia,ab,kib->k", change, moments, change).mean())


def _is_more(ours: list[int], others: list[int]) -> bool:
    """Whether more scans have more inliers than have less, at two sigma: points of one scan agree or do not together."""
    won, lost = (sum(sign * (a - b) > 0 for a, b in zip(ours, others, strict=True)) for sign in (1, -1))
    return is_more(won, lost)
