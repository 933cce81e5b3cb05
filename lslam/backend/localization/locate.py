"""Where a drive lies in a map that does not change.

Submaps of its start are searched in the whole map, registered, and agreed on by several. Then scans are registered on it one
after the other, with odometry as the prior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.drift import drift_covariance
from lslam.backend.graph.odometry_constraints import growth
from lslam.backend.keyframes.store import KeyframeStore, mounted_up, submap
from lslam.backend.localization.prior_map import (
    GUESSES_APART_M,
    MAP_MIN_INLIERS,
    MAP_MIN_OVERLAP,
    LocalView,
    PlaceSearch,
    Region,
)
from lslam.backend.loops.gating import GATE_SIGMAS, LoopThrottle
from lslam.backend.loops.level_submap import find_up, level_rotation, make_level_submap, move_points
from lslam.backend.loops.verify import LEAST_COVARIANCE, SubmapRegistration
from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.geometry import noise, se3, so3
from lslam.core.geometry.noise import quantile
from lslam.core.types.constraint import FixStatus, MapFix, Verdict
from lslam.core.types.scan import LEVER_M
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import Stateful
from lslam.registration.acceptance import Acceptance, correction
from lslam.registration.alignment import MapAlignment
from lslam.registration.attempt import RECOVER_M
from lslam.registration.history import UsualAgreement
from lslam.registration.optimiser import COARSE_KERNEL_M, optimise
from lslam.registration.preprocessing.ground import ahead_of
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

# m between two keyframes that are tried, at least.
SPACING_M = 6.0
# Keyframes that must agree on the start, so that one look-alike does not decide.
AGREEING_STARTS = 2
# Of what a keyframe sees, this part must lie where the map has it, when no other of its drive agrees.
MAJORITY = 0.5
# m and deg by which two keyframes' answers may differ beside the drift of odometry between them.
SAME_M, SAME_DEG = 0.5, 2.0
# m at which an error of the heading is as large as one of the position.
NEAR_M = 20.0


@dataclass(frozen=True)
class StartPrior:
    """Prior of the first scan's pose, level axes of the map.

    position : (2,) m; heading : rad, None when unknown; radius, turn : m and rad, by which both may be wrong
    """

    position: Floats
    heading: float | None = None
    radius: float = 10.0
    turn: float = float(np.deg2rad(30.0))


@dataclass(frozen=True)
class Vote:
    """A keyframe found in the map.

    T_level_odometry : (4, 4) that it implies; covariance : (6, 6) of the keyframe's pose, level axes
    support : inlier share of its upright points
    """

    keyframe: int
    T_level_odometry: Floats
    covariance: Floats
    support: float


@dataclass(frozen=True)
class Start:
    """The start that keyframes agree on: the first of them, how many they are, and how many were tried."""

    vote: Vote
    votes: int
    tried: int

    @property
    def has_agreement(self) -> bool:
        """True when several keyframes vote for the start."""
        return self.votes >= AGREEING_STARTS

    @property
    def has_majority(self) -> bool:
        """Whether most of what the keyframe sees is there."""
        return self.vote.support > MAJORITY


class PlaceFinder:
    """Finds the start of a drive in the map.

    store : the drive's keyframes at odometry's poses; config : also of how its sensor is mounted
    reasons : why keyframes were not located
    """

    def __init__(self, search: PlaceSearch, store: KeyframeStore, config: Config) -> None:
        self.search, self.store, self.config = search, store, config
        self._in_map = SubmapRegistration(search.whole, config.loops, config.registration)
        self._poses = np.array([k.T_world_lidar for k in store.keyframes]).reshape(-1, 4, 4)
        self._distances = np.array([k.distance for k in store.keyframes])
        self._R_level = self._level()
        self.reasons: list[str] = []

    def find(self, prior: StartPrior | None = None, should_stop: Callable[[], bool] = lambda: False) -> Start | None:
        """Start; None, with `reasons`, when no keyframe is located or they do not agree, or when `should_stop` returns True."""
        votes: list[Vote] = []
        tried = 0
        throttle = LoopThrottle(SPACING_M)
        for b, way in enumerate(self._distances):
            if not throttle.is_due(way):
                continue
            if should_stop():
                return None
            tried += 1
            vote = self.vote(b, self._region(b, prior))
            throttle.observe(way, Verdict.REJECTED if vote is None else Verdict.ACCEPTED)
            if vote is not None:
                votes.append(vote)
            agreed = self._agree(votes, AGREEING_STARTS)
            if agreed is not None:
                return replace(agreed, tried=tried)
        # A drive too short for two keyframes has the word of one.
        agreed = self._agree(votes, 1) if tried == 1 else None
        return None if agreed is None else replace(agreed, tried=tried)

    def vote(self, b: int, region: Region | None) -> Vote | None:
        """The pose of keyframe `b` in the map; None, with one more of the `reasons`, when no pose or more than one fits.

        region : where to search, None for the whole map
        """
        c, query = self.config.loops, make_level_submap(self._cloud(b), self.config.registration)
        guesses = self.search.guesses(query, region)
        if not guesses:
            self.reasons.append("nothing stands up there")
            return None
        best, rival = self._in_map.try_guesses(query, guesses, self.search.cells)
        if rival is not None and rival.support > c.max_ambiguity * best.support:
            self.reasons.append(f"another place fits {rival.support / best.support:.0%} as well")
            return None
        result = self._in_map.refine(query, best.T_a_b)
        limits = Acceptance(c.min_overlap, MAP_MIN_INLIERS, needs_covariance=True, needs_all_directions=True)
        rejection = limits.rejection(result)
        if rejection is not None:
            self.reasons.append(rejection.reason)
            return None
        assert result.covariance is not None
        R = self._R_level @ self._poses[b, :3, :3]
        T = result.T_world_lidar @ se3.make(R, np.zeros(3)) @ se3.inverse(self._poses[b])
        return Vote(b, T, result.covariance, best.support)

    def _level(self) -> Floats:
        """(3, 3) the rotation that makes odometry's world level, by its first submap."""
        cloud = submap(self.store, self._poses, 0, self.config.keyframes.submap_size, T_world_frame=np.eye(4))
        mounted = mounted_up(self.store, self._poses, self.config.preprocess)
        return level_rotation(find_up([make_level_submap(cloud, self.config.registration).fine], mounted))

    def _cloud(self, b: int) -> NDArray[np.float32]:
        """The submap about a keyframe in level axes, origin at the keyframe."""
        points = submap(self.store, self._poses, b, self.config.keyframes.submap_size)
        return move_points(points, se3.make(self._R_level @ self._poses[b, :3, :3], np.zeros(3)))

    def _region(self, b: int, prior: StartPrior | None) -> Region | None:
        """Where keyframe `b` may be by the prior of the first scan and odometry; None without a prior."""
        if prior is None:
            return None
        step = self._R_level @ (self._poses[b, :3, 3] - self._poses[0, :3, 3])
        if prior.heading is None:
            return Region(prior.position, prior.radius + float(np.linalg.norm(step[:2])))
        first = self._poses[0, :3, :3]
        forward = self._R_level @ (first @ ahead_of(self._R_level[2] @ first))
        yaw = prior.heading - float(np.arctan2(forward[1], forward[0]))
        turned = so3.exp(np.array([0.0, 0.0, yaw])) @ step
        away = prior.radius + prior.turn * float(np.linalg.norm(step[:2]))
        return Region(prior.position + turned[:2], away, yaw, prior.turn)

    def region_about(self, b: int, T: Floats, radius: float) -> Region:
        """Where keyframe `b` may be when it is expected at a pose T (4, 4), level axes, within `radius` m."""
        turn = T[:3, :3] @ (self._R_level @ self._poses[b, :3, :3]).T
        return Region(T[:2, 3], radius, float(np.arctan2(turn[1, 0], turn[0, 0])), min(radius / NEAR_M, float(np.pi)))

    def _drift(self, a: int, b: int) -> tuple[float, float]:
        """Largest plausible error of odometry between keyframes `a` and `b`, m and rad."""
        c, way = self.config.loops, abs(float(self._distances[b] - self._distances[a]))
        turn = GATE_SIGMAS * np.deg2rad(c.drift_deg) / 100 * way
        return GATE_SIGMAS * 0.01 * c.drift_percent * way + 0.5 * turn * way, float(turn)

    def _same(self, one: Vote, other: Vote) -> bool:
        """Whether two votes imply the same start of the drive, within odometry's uncertainty.

        False where odometry drifts by more than two guesses are apart: agreement would be no evidence.
        """
        b = other.keyframe
        gap = se3.relative(one.T_level_odometry @ self._poses[b], other.T_level_odometry @ self._poses[b])
        move, turn = self._drift(one.keyframe, b)
        is_near = float(np.linalg.norm(gap[:3, 3])) < SAME_M + move
        return is_near and move < GUESSES_APART_M and float(so3.angle(gap[:3, :3])) < np.deg2rad(SAME_DEG) + turn

    def _agree(self, votes: list[Vote], least: int) -> Start | None:
        """The start that at least `least` keyframes agree on, and more than twice as many as on any other; None without one."""
        groups: list[list[Vote]] = []
        for vote in votes:
            home = next((g for g in groups if self._same(g[-1], vote)), None)
            if home is None:
                groups.append([vote])
            else:
                home.append(vote)
        groups.sort(key=lambda g: -len(g))
        if not groups or len(groups[0]) < least or (len(groups) > 1 and 2 * len(groups[1]) >= len(groups[0])):
            return None
        return Start(groups[0][-1], len(groups[0]), 0)


# Sigmas that the kernel spans, and the chance that the innovation of a scan that the map holds lies beyond its gate.
SIGMAS, CHANCE = 3.0, 1e-4
# Finds the pose (4, 4) of a scan of that position anew within a radius, m, of the prior; None where it does not.
Search = Callable[[int, Floats, float], Floats | None]


class MapFollower(Stateful):
    """An error-state Kalman filter over SE(3): odometry predicts, registration on the map corrects.

    The prior's information enters the normal equations, so that the map corrects where its surfaces constrain a pose and odometry
    decides along unobservable directions. The map itself is never changed.

    T, P : pose (4, 4) in level axes of the map and its covariance (6, 6), of the last scan, by independent steps
    way : m since the last accepted scan, over which odometry drifts steadily
    R_level_odometry : (3, 3) axes of odometry's world in those of the map
    """

    STATE = ("T", "P", "way", "usual")

    def __init__(self, view: LocalView, T: Floats, P: Floats, config: Config, search: Search | None = None) -> None:
        self.view, self.T, self.P, self.config, self.search = view, T, P, config, search
        self.way = 0.0
        self.usual = UsualAgreement(config.registration.min_agreement)
        self._gate = quantile(1.0 - CHANCE, 6)

    def predict(self, before: ScanResult, result: ScanResult) -> None:
        """Predict pose and covariance by odometry's motion from scan `before` to scan `result`."""
        step = se3.relative(before.T_world_lidar, result.T_world_lidar)
        T = se3.normalise(self.T @ step)
        way = float(np.linalg.norm(step[:3, 3]))
        grown = noise.rotate(growth(before, result, way, self.config.graph), T[:3, :3] @ result.T_world_lidar[:3, :3].T)
        self.P = noise.transport(self.P, T[:3, 3] - self.T[:3, 3]) + grown + drift_covariance(way, self.config.graph)
        self.T = T
        self.way += way

    @property
    def covariance(self) -> Floats:
        """(6, 6) covariance of the pose: that of independent steps, and of steady drift since the last accepted scan.

        The drift's sigma grows with the way in rotation, and in translation also with its square.
        """
        c = self.config.loops
        turn = np.deg2rad(c.drift_deg) / 100 * self.way
        move = 0.01 * c.drift_percent * self.way + 0.5 * turn * self.way
        return self.P + np.diag(np.repeat([move**2, turn**2], 3))

    def correct(self, position: int, points: PreparedPoints | None) -> MapFix:
        """Register scan number `position` of the run on the map and correct by it, if it is accepted.

        points : of the scan, deskewed; None where it has none
        """
        if points is None or len(points.source) < MIN_SOURCE_POINTS:
            return self._propagate("unread", "no usable points")
        alignment = self.view.at(self.T[:3, 3])
        result = self._align(alignment, points, self.T)
        status, reason = self._judge(result)
        if reason and self.search is not None and self._uncertainty_m() > COARSE_KERNEL_M:
            T = self.search(position, self.T, self._uncertainty_m())
            if T is not None:
                result = self._align(self.view.at(T[:3, 3]), points, T)
                status, reason = self._judge(result)
        move, turn = correction(self.T, result.T_world_lidar)
        if reason:
            if status == "changed":
                self.usual.relax()
            return self._propagate(status, reason, result)
        assert result.covariance is not None
        self.usual.observe(result.inlier_share)
        self.T, self.P, self.way = result.T_world_lidar, result.covariance + LEAST_COVARIANCE, 0.0
        return MapFix(self.T, self.P, "held", result.overlap, result.inlier_share, (move, turn))

    def _align(self, alignment: MapAlignment, points: PreparedPoints, start: Floats) -> RegistrationResult:
        """Register the points on the map from `start` (4, 4).

        From the predicted pose `self.T` the prediction's information is a prior, and the kernel is as wide as it is uncertain.
        If that exceeds the widest kernel, the prediction is only the start. So is any other `start`.
        """
        c = self.config.registration
        width = max(self._uncertainty_m(), RECOVER_M)
        if start is self.T and width <= c.kernel_max:
            information = np.asarray(np.linalg.inv(self.covariance), np.float64)
            return optimise(alignment.problem(points, start, width, c.max_iterations, information=information))
        if start is self.T:
            start = alignment.coarse_to_fine(points, start, width).T_world_lidar
        return optimise(alignment.problem(points, start, c.kernel_max, c.max_iterations))

    def _judge(self, result: RegistrationResult) -> tuple[FixStatus, str]:
        """Status of a registered scan (held, changed or beyond the map) and the reason of the latter two."""
        limits = Acceptance(
            MAP_MIN_OVERLAP, MAP_MIN_INLIERS, needs_covariance=True, usual=self.usual, is_usual_of_matches=True
        )
        rejection = limits.rejection(result)
        if rejection is not None:
            return "beyond" if rejection.test in ("solution", "overlap") else "changed", rejection.reason
        d = noise.changes(self.T, result.T_world_lidar)
        # A scan that fits as well as those before has found its place, and odometry is worse than its covariance.
        is_outlier = float(d @ np.linalg.solve(self.covariance + LEAST_COVARIANCE, d)) > self._gate
        if is_outlier and self.usual.is_less(result.inlier_share):
            move, turn = correction(self.T, result.T_world_lidar)
            return "changed", f"the map would move it by {move:.2f} m and {np.rad2deg(turn):.1f} deg"
        return "held", ""

    def _uncertainty_m(self) -> float:
        """m, `SIGMAS` standard deviations of a point at `LEVER_M`, where they are largest."""
        P = self.covariance
        position, turn = (float(np.linalg.eigvalsh(part)[-1]) for part in (P[:3, :3], P[3:, 3:]))
        return SIGMAS * float(np.sqrt(position + LEVER_M**2 * turn))

    def _propagate(self, status: FixStatus, reason: str, result: RegistrationResult | None = None) -> MapFix:
        """The fix of a scan that is not registered on the map: odometry's predicted pose and covariance, and the `reason`."""
        overlap, share = (0.0, 0.0) if result is None else (result.overlap, result.inlier_share)
        return MapFix(self.T, self.covariance, status, overlap, share, reason=reason)


def mark_doubts(fixes: list[MapFix]) -> list[MapFix]:
    """The fixes of a run, marked as doubtful where fewer points agree with the map than scans of one place differ by."""
    usual = float(np.median([fix.inlier_share for fix in fixes if fix.is_binding] or [0.0]))
    return [replace(f, is_doubtful=f.is_binding and f.inlier_share < UsualAgreement.LESS * usual) for f in fixes]
