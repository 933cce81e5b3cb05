"""Loop closure detection: candidates by odometry's gate and Scan Context, verified by registration."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from copy import copy
from dataclasses import replace
from itertools import islice

import numpy as np

from lslam.backend.loops import PlaceMatch, create_descriptor
from lslam.backend.loops.gating import (
    GATE_SIGMAS,
    LoopThrottle,
    OdometryUncertainty,
    RelativeUncertainty,
    SharedResults,
    WorkingMemory,
    resolve_ambiguity,
)
from lslam.backend.loops.level_submap import find_up, level_keyframes, make_level_submap, move_points
from lslam.backend.loops.verify import Verification, Verifier
from lslam.core.arrays import Floats, Longs, Points
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InterruptedRunError
from lslam.core.geometry import noise, se3, so3
from lslam.core.types.constraint import Constraint, KnownPair, LoopCandidate, LoopStage, Verdict
from lslam.core.types.scan_result import KeyframeClocks, StageClock
from lslam.core.types.trajectory import Keyframe
from lslam.registration.preprocessing.ground import Z

# m; two passes of a street lie so far apart at most.
NEAR_M = 8.0
# m; so far apart the scans of a known pair may have been taken: what a person calls one place.
KNOWN_WITHIN_M = 10.0
# m and rad, least gate of odometry: what two registrations of the same place differ by.
LEAST_REACH, LEAST_TURN = 1.0, np.deg2rad(2.0)
# rad between the headings that are searched; beyond the widest gate they lie about the descriptor's own.
TURN_STEP, WIDEST_TURN = np.deg2rad(2.0), np.deg2rad(20.0)
# Factor on the best descriptor distance within which others are candidates too, and how many; different places of a town
# differ by twice as much.
RIVAL, RIVALS = 1.5, 3
# Level submaps, clouds and gates cached, and how many submaps serve to estimate the vertical.
CACHE_SUBMAPS, CLOUDS, CACHE_GATES, LOOKS = 4, 4, 256, 8


class Detector:
    """Detects loop closures among keyframes.

    keyframes : all of the run, in order
    cloud : gives the submap about a keyframe, (M, 3) m, in its LiDAR frame
    forbidden : pairs of keyframes, the older first, that are no candidates, nor are those around them
    up : (3,) unit vector, up in the world of the keyframes by the mounting of the sensor
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        cloud: Callable[[int], Points],
        config: LoopsConfig,
        registration: RegistrationConfig,
        forbidden: Sequence[tuple[int, int]] = (),
        up: Floats = Z,
    ) -> None:
        self.keyframes, self.cloud, self.config, self.registration = keyframes, cloud, config, registration
        self.forbidden, self._mounted = forbidden, up
        self._is_level = False
        self.uncertainty = OdometryUncertainty(keyframes, config.drift_percent, config.drift_deg)
        self.index = create_descriptor(config)
        self.verifier = Verifier(config, registration)
        self._index_lock = threading.Lock()
        self._described = SharedResults(self._describe)
        self._clouds = SharedResults(self._make_level, CLOUDS)
        self._submaps = SharedResults(
            lambda n: make_level_submap(self._clouds.get(n), self.registration), CACHE_SUBMAPS
        )
        # Submaps overlap: the first keyframe of every few metres represents those after it.
        steps = np.floor(self.uncertainty.distances / (NEAR_M / 2))
        self._is_described = np.diff(steps, prepend=-1.0) > 0
        bound = config.memory_places
        places = np.cumsum(self._is_described) - 1
        self.memory = WorkingMemory(places, self.uncertainty.distances, bound, config.min_travel)

    def find(
        self, clocks: KeyframeClocks | None = None, should_stop: Callable[[], bool] = lambda: False, threads: int = 1
    ) -> list[LoopCandidate]:
        """All candidates in the order of the newer keyframe, with verdicts; arguments and errors of `find_loops`."""
        clocks = KeyframeClocks() if clocks is None else clocks
        candidates: list[LoopCandidate] = []
        throttle = LoopThrottle(self.config.spacing)
        count = len(self.keyframes)
        if any(len(self._gate(b)) for b in range(count)):
            self._level_world()
            if self.config.memory_places is not None and self.config.rehearsal is not None:
                places = self._rehearse(1.0 - self.config.rehearsal, should_stop)
                self.memory = WorkingMemory(
                    places, self.uncertainty.distances, self.config.memory_places, self.config.min_travel
                )
        # Of thousands of keyframes, each has thousands: those of the next few are held.
        gated = SharedResults(self._gate, CACHE_GATES)
        ahead: dict[int, tuple[Longs, Future[list[LoopCandidate]]]] = {}
        with ThreadPoolExecutor(threads, "lslam-loops") as pool:
            try:
                for b, keyframe in enumerate(self.keyframes):
                    _stop_if(should_stop(), b, count)
                    if self.memory.reach(b):
                        gated = SharedResults(self._gate, CACHE_GATES)
                    older = gated.get(b)
                    if len(older) == 0:
                        throttle.reset()
                        continue
                    if not throttle.is_due(keyframe.distance):
                        reason = f"the last one tried was less than {throttle.wait:g} m ago"
                        check = Verification(LoopStage.THINNED, reason)
                        candidates.append(self._candidate(self._nearest(older, b), b, check))
                        continue
                    # A thread that is done goes on with what waits, although an older keyframe is not.
                    for n in (b, *islice(self._due_after(b, gated, throttle), 2 * (threads - 1))):
                        # What was begun with another memory is begun again.
                        if n not in ahead or (n == b and not np.array_equal(ahead[n][0], older)):
                            compared = gated.get(n)
                            task = pool.submit(copy_context().run, self._examine_all, n, compared, clocks[n])
                            ahead[n] = compared, task
                    examined = ahead.pop(b)[1].result()
                    candidates += examined
                    for closed in examined:
                        if closed.is_accepted:
                            self.memory.close(closed.a, b)
                    verdict = Verdict.ACCEPTED if any(c.is_accepted for c in examined) else Verdict.REJECTED
                    if verdict != throttle.last:
                        # Others are due then; what has begun may be among them.
                        ahead = {n: kept for n, kept in ahead.items() if not kept[1].cancel()}
                    throttle.observe(keyframe.distance, verdict)
            finally:
                pool.shutdown(cancel_futures=True)
        return candidates

    def verify_pair(self, pair: KnownPair) -> LoopCandidate:
        """Verify a known pair within its given radius, whatever odometry's position; headings as far as odometry is uncertain."""
        self._level_world()
        a, b = pair.a, pair.b
        turn = self._turn(self.uncertainty.between(b, np.array([a])))
        spread = WIDEST_TURN if turn <= WIDEST_TURN else np.pi
        yaws = np.arange(-spread, spread, TURN_STEP)
        expected = self.keyframes[a].T_world_lidar[:3, :3] @ pair.place
        within = KNOWN_WITHIN_M if pair.within is None else pair.within
        check = self.verifier.verify(self._submaps.get(a), self._submaps.get(b), expected, within, yaws)
        check = check if check.reason else replace(check, stage=LoopStage.MANUAL)
        return self._candidate(a, b, check, is_binding=not check.reason)

    def _due_after(self, b: int, gates: SharedResults[Longs], throttle: LoopThrottle) -> Iterator[int]:
        """Numbers of the keyframes after `b` that would be verified next if all verdicts equal the last one.

        Threads prepare these ahead.
        """
        throttle = copy(throttle)
        throttle.observe(self.keyframes[b].distance, throttle.last or Verdict.ACCEPTED)
        for n in range(b + 1, min(b + CACHE_GATES, len(self.keyframes))):
            if len(gates.get(n)) == 0:
                throttle.reset()
            elif throttle.is_due(self.keyframes[n].distance):
                yield n
                throttle.observe(self.keyframes[n].distance, throttle.last or Verdict.ACCEPTED)

    def _examine_all(self, b: int, older: Longs, clock: StageClock) -> list[LoopCandidate]:
        """Candidates of keyframe `b` with its similar ones among `older`, verified; at most one is accepted."""
        with clock.stage("loops"):
            alike, fallback = self._choose(b, older)
            verified = [self._examine(match, b) for match in alike]
            examined = resolve_ambiguity(verified, self.keyframes, self._reach_between)
            if not any(c.is_accepted or c.stage == LoopStage.AMBIGUITY for c in examined):
                examined += [self._examine(match, b) for match in fallback()]
            return examined

    def _level_world(self) -> None:
        """Rotate the keyframes, once, so that their ground planes are level, as BEV correlation needs; relative poses stay."""
        if self._is_level:
            return
        self._is_level = True
        shown = np.unique(np.linspace(0, len(self.keyframes) - 1, LOOKS).round().astype(int))
        maps = [make_level_submap(self._make_level(int(number)), self.registration).fine for number in shown]
        up = find_up(maps, self._mounted)
        self.keyframes = level_keyframes(self.keyframes, up)
        self.uncertainty = OdometryUncertainty(self.keyframes, self.config.drift_percent, self.config.drift_deg)

    def _rehearse(self, limit: float, should_stop: Callable[[], bool]) -> Longs:
        """(K,) number of the place of each keyframe, where successive similar keyframes are one place.

        A keyframe begins a new place if it is far from the first of the present one, or their descriptors differ by over `limit`.
        """
        place_of, first = np.zeros(len(self.keyframes), np.int64), 0
        for k in range(1, len(self.keyframes)):
            _stop_if(should_stop(), k, len(self.keyframes))
            is_alike = self._away(first, k) <= NEAR_M and self._matches(k, np.array([first]))[0].distance <= limit
            first = first if is_alike else k
            place_of[k] = place_of[k - 1] + (first == k)
        return place_of

    def _gate(self, b: int) -> Longs:
        """Older keyframes in the memory within the gate of odometry about `b`, but not on the way just travelled."""
        among = self._filter_forbidden(b, self.memory.before(b))
        if self.config.radius is None:
            return self.uncertainty.gate(b, among, self.config.min_travel, NEAR_M, GATE_SIGMAS)
        return self.uncertainty.gate(b, among, self.config.min_travel, self.config.radius, 0.0)

    def _filter_forbidden(self, b: int, among: Longs) -> Longs:
        """The keyframes of `among` that are not near a forbidden pair of `b`, along the way.

        Within that distance the same surfaces would be taken for the same place again.
        """
        distances = self.uncertainty.distances
        for older, newer in self.forbidden:
            if abs(distances[b] - distances[newer]) <= NEAR_M:
                among = among[np.abs(distances[among] - distances[older]) > NEAR_M]
        return among

    def _nearest(self, older: Longs, b: int) -> int:
        """Number of the one of `older` that is nearest to keyframe `b` by odometry."""
        away = np.linalg.norm(self.uncertainty.positions[older] - self.uncertainty.positions[b], axis=1)
        return int(older[away.argmin()])

    def _away(self, a: int, b: int) -> float:
        """Distance, m, between two keyframes by odometry."""
        return float(np.linalg.norm(self.uncertainty.positions[b] - self.uncertainty.positions[a]))

    def _choose(self, b: int, older: Longs) -> tuple[list[PlaceMatch], Callable[[], list[PlaceMatch]]]:
        """The candidates of keyframe `b` to verify, and a function that returns those to verify if they are all rejected.

        Where odometry is nearly certain, its nearest is the candidate and the most similar the fallback. Elsewhere it is the
        other way round, and all that are nearly as similar are verified, since an ambiguous one must be rejected.
        """
        near = self._nearest(older, b)
        reach = self._reach_between(near, b)
        nearest = np.array([near])
        if reach < NEAR_M:
            away = np.linalg.norm(self.uncertainty.positions[older] - self.uncertainty.positions[b], axis=1)
            about = older[away <= away.min() + reach]
            chosen = self._matches(b, nearest)
            return chosen, lambda: self._elsewhere(self._alike(b, about)[:1], chosen)
        alike = self._alike(b, older)
        if not alike:
            return self._matches(b, nearest), list
        return alike, lambda: self._elsewhere(self._matches(b, nearest), alike)

    def _elsewhere(self, matches: list[PlaceMatch], others: list[PlaceMatch]) -> list[PlaceMatch]:
        """Those of the `matches` that are far from all `others`."""
        return [m for m in matches if all(self._away(m.number, c.number) > NEAR_M / 2 for c in others)]

    def _alike(self, b: int, older: Longs) -> list[PlaceMatch]:
        """Matches of keyframe `b` among `older`: the most similar keyframe and those that are nearly as similar."""
        near = self._nearest(older, b)
        matches = self._matches(b, older[self._is_described[older] | (older == near)])
        limit = min(self.config.max_descriptor_distance, RIVAL * matches[0].distance)
        return self._apart([m for m in matches if m.distance <= limit])

    def _matches(self, b: int, older: Longs) -> list[PlaceMatch]:
        """The `older` by their similarity to keyframe `b`, the best first."""
        for number in (b, *older):
            self._described.get(int(number))
        with self._index_lock:
            return self.index.nearest(b, older, self._turn(self.uncertainty.between(b, older[:1])))

    def _apart(self, matches: list[PlaceMatch]) -> list[PlaceMatch]:
        """The first few matches, none near another."""
        chosen: list[PlaceMatch] = []
        for match in matches:
            if len(chosen) < RIVALS and all(self._away(match.number, k.number) > NEAR_M for k in chosen):
                chosen.append(match)
        return chosen

    def _examine(self, match: PlaceMatch, b: int) -> LoopCandidate:
        """Verify the loop between keyframe `b` and the older one of the match, by submaps and odometry's gate."""
        a = match.number
        uncertainty = self.uncertainty.between(b, np.array([a]))
        expected = self.uncertainty.positions[b] - self.uncertainty.positions[a]
        yaws = self._yaws(match, self._turn(uncertainty))
        check = self.verifier.verify(
            self._submaps.get(a), self._submaps.get(b), expected, self._reach(uncertainty), yaws
        )
        reason = check.reason or self._beyond(check, expected, uncertainty)
        check = check if reason == check.reason else check.reject(LoopStage.GATE, reason)
        return self._candidate(a, b, check, match.distance)

    def _candidate(
        self, a: int, b: int, check: Verification, descriptor_distance: float = float("nan"), is_binding: bool = False
    ) -> LoopCandidate:
        """The candidate of keyframes a and b with the verdict of a verification.

        is_binding : its loop closure is never an outlier candidate
        """
        verdict = Verdict.REJECTED if check.reason else Verdict.ACCEPTED
        verdict_facts = (verdict, check.stage, check.reason, check.rmse, check.overlap)
        constraint = self._constraint(a, b, check, is_binding)
        return LoopCandidate(a, b, self._away(a, b), descriptor_distance, *verdict_facts, constraint)

    def _reach_between(self, older: int, newer: int) -> float:
        """Gate of odometry on the position between two keyframes, m."""
        return self._reach(self.uncertainty.between(newer, np.array([older])))

    def _reach(self, uncertainty: RelativeUncertainty) -> float:
        """Gate on the position, m: so far off may the newer keyframe be."""
        if self.config.radius is not None:
            return self.config.radius
        return max(GATE_SIGMAS * float(uncertainty.reach[0]), LEAST_REACH)

    def _turn(self, uncertainty: RelativeUncertainty) -> float:
        """Gate on the heading, rad: by so much may it be wrong."""
        return max(GATE_SIGMAS * float(uncertainty.turn[0]), float(LEAST_TURN))

    def _yaws(self, match: PlaceMatch, turn: float) -> Floats:
        """Yaw angles, rad, of the newer submap in the older one to be searched; turn : rad, odometry's gate on the heading."""
        centre, spread = (0.0, turn) if turn <= WIDEST_TURN else (match.yaw, self.index.yaw_error + TURN_STEP)
        count = int(np.ceil(spread / TURN_STEP))
        return np.asarray(centre + TURN_STEP * np.arange(-count, count + 1))

    def _beyond(self, check: Verification, expected: Floats, uncertainty: RelativeUncertainty) -> str:
        """Reason why a verified pose lies outside the gate of odometry, empty where it does not.

        expected : (3,) m, of b relative to a, by odometry
        """
        assert check.T_a_b is not None
        shift = check.T_a_b[:3, 3] - expected
        turn = float(so3.angle(check.T_a_b[:3, :3]))
        if turn > self._turn(uncertainty):
            return f"odometry would be wrong by {np.rad2deg(turn):.1f} deg"
        if self.config.radius is not None:
            sigmas = GATE_SIGMAS * float(np.linalg.norm(shift)) / self.config.radius
        else:
            least = (LEAST_REACH / GATE_SIGMAS) ** 2 * np.eye(3)
            sigmas = float(np.sqrt(shift @ np.linalg.solve(uncertainty.position[0] + least, shift)))
        if sigmas > GATE_SIGMAS:
            return f"odometry would be wrong by {np.linalg.norm(shift):.1f} m"
        return ""

    def _constraint(self, a: int, b: int, check: Verification, is_binding: bool = False) -> Constraint | None:
        """Loop closure: pose of b in a and covariance, from level axes to those of the keyframes; None if undetermined."""
        if check.T_a_b is None or check.covariance is None:
            return None
        R_a, R_b = (self.keyframes[k].T_world_lidar[:3, :3] for k in (a, b))
        T = se3.make(R_a.T @ check.T_a_b[:3, :3] @ R_b, R_a.T @ check.T_a_b[:3, 3])
        return Constraint(a, b, T, noise.rotate(check.covariance, R_a.T), is_binding=is_binding)

    def _make_level(self, number: int) -> Points:
        """The submap about a keyframe in the axes of the world."""
        return move_points(self.cloud(number), se3.make(self.keyframes[number].T_world_lidar[:3, :3], np.zeros(3)))

    def _describe(self, number: int) -> None:
        """Add the descriptor of keyframe `number` to the index."""
        points = self._clouds.get(number)
        with self._index_lock:
            self.index.add(number, points)


def _stop_if(is_stopping: bool, b: int, count: int) -> None:
    """Raise InterruptedRunError if the run is stopping; b, count : keyframe and number of keyframes, for the message."""
    if is_stopping:
        raise InterruptedRunError(f"interrupted during loop closure detection, at keyframe {b} of {count}")
