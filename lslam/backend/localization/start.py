"""Where a drive begins in a map: its submaps searched in the whole of it, registered, and agreed on by several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.keyframes.submaps import mounted_up, submap
from lslam.backend.localization.place_search import GUESSES_APART_M, PlaceSearch, Region
from lslam.backend.localization.prior_map import MAP_MIN_INLIERS
from lslam.backend.loops.gating import GATE_SIGMAS, LoopThrottle
from lslam.backend.loops.level_submap import LevelSubmap, find_up, level_rotation, make_level_submap
from lslam.core.config.config import Config
from lslam.core.geometry import se3, so3
from lslam.core.kernels.transform import transform
from lslam.core.types.arrays import Floats
from lslam.core.types.constraint import Verdict
from lslam.registration.acceptance import Acceptance
from lslam.registration.alignment import solve
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import COARSE_DECAY, KERNEL_DECAY, KERNEL_MIN_M, Annealing
from lslam.registration.preprocessing.ground import ahead_of
from lslam.registration.preprocessing.prepare import PreparedPoints, thin
from lslam.registration.result import RegistrationResult

# m between two keyframes that are tried, at least.
SPACING_M = 6.0
# Keyframes that must agree on the start, so that one look-alike does not decide.
AGREEING_STARTS = 2
# Of what a keyframe sees, this part must lie where the map has it, when no other of its drive agrees.
MAJORITY = 0.5
# Every so many-th source point serves to rank the guesses, and the kernel they are caught with, m.
FEW, CATCH = 4, 2.5
# m and deg by which two keyframes' answers may differ beside the drift of odometry between them.
SAME_M, SAME_DEG = 0.5, 2.0
# m at which an error of the heading is as large as one of the position.
NEAR_M = 20.0
# m and rad from which on a place is another.
ELSEWHERE_M, ELSEWHERE_RAD = 1.0, np.deg2rad(5.0)


@dataclass(frozen=True)
class StartPrior:
    """What is known of the first scan beforehand, level axes of the map.

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
        """Whether several keyframes say so."""
        return self.votes >= AGREEING_STARTS

    @property
    def has_majority(self) -> bool:
        """Whether most of what the keyframe sees is there."""
        return self.vote.support > MAJORITY


class PlaceFinder:
    """Finds the start of a drive in the map.

    store : the drive's keyframes at odometry's poses; config : also of how its sensor is mounted
    reasons : why keyframes found no place
    """

    def __init__(self, search: PlaceSearch, store: KeyframeStore, config: Config) -> None:
        self.search, self.store, self.config = search, store, config
        self._poses = np.array([k.T_world_lidar for k in store.keyframes]).reshape(-1, 4, 4)
        self._distances = np.array([k.distance for k in store.keyframes])
        self._R_level = self._level()
        self.reasons: list[str] = []

    def find(self, prior: StartPrior | None = None, should_stop: Callable[[], bool] = lambda: False) -> Start | None:
        """The start; None, with `reasons`, when no keyframe finds a place or they do not agree."""
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
            agreed = self._agreed(votes, AGREEING_STARTS)
            if agreed is not None:
                return replace(agreed, tried=tried)
        # A drive too short for two keyframes has the word of one.
        agreed = self._agreed(votes, 1) if tried == 1 else None
        return None if agreed is None else replace(agreed, tried=tried)

    def vote(self, b: int, region: Region | None) -> Vote | None:
        """The place of keyframe `b` in the map, None with one more of the `reasons` when there is none or more than one."""
        query = make_level_submap(self._cloud(b), self.config.registration)
        trials = sorted(
            (self._try(query, guess) for guess in self.search.guesses(query, region)), key=lambda found: -found[0]
        )
        if not trials:
            self.reasons.append("nothing stands up there")
            return None
        support, rough = trials[0]
        rivals = [s for s, T in trials[1:] if is_elsewhere(rough, T)]
        r, c = self.config.registration, self.config.loops
        if rivals and rivals[0] > c.max_ambiguity * support:
            self.reasons.append(f"another place fits {rivals[0] / support:.0%} as well")
            return None
        found = self._solve(query.source, rough, Annealing(r.kernel_max, KERNEL_MIN_M, KERNEL_DECAY, c.max_iterations))
        limits = Acceptance(c.min_overlap, MAP_MIN_INLIERS, needs_covariance=True, needs_all_directions=True)
        rejection = limits.rejection(found)
        if rejection is not None:
            self.reasons.append(rejection.reason)
            return None
        assert found.covariance is not None
        R = self._R_level @ self._poses[b, :3, :3]
        T = found.T_world_lidar @ se3.make(R, np.zeros(3)) @ se3.inverse(self._poses[b])
        return Vote(b, T, found.covariance, support)

    def _level(self) -> Floats:
        """(3, 3) the rotation that makes odometry's world level, by its first submap."""
        cloud = submap(self.store, self._poses, 0, self.config.keyframes.submap_size, T_world_frame=np.eye(4))
        mounted = mounted_up(self.store, self._poses, self.config.preprocess)
        return level_rotation(find_up([make_level_submap(cloud, self.config.registration).fine], mounted))

    def _cloud(self, b: int) -> NDArray[np.float32]:
        """The submap about a keyframe in level axes, origin at the keyframe."""
        points = submap(self.store, self._poses, b, self.config.keyframes.submap_size)
        level = np.empty_like(points)
        transform(points, se3.make(self._R_level @ self._poses[b, :3, :3], np.zeros(3)), level)
        return level

    def _region(self, b: int, prior: StartPrior | None) -> Region | None:
        """Where keyframe `b` may be by the prior of the first scan and odometry."""
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

    def _try(self, query: LevelSubmap, guess: Floats) -> tuple[float, Floats]:
        """Inlier share of the upright points where the map was observed, after registration from `guess`, and the pose."""
        r = self.config.registration
        few = thin(query.source, FEW)
        slow = Annealing(CATCH, r.kernel_max / 2, COARSE_DECAY, self.config.loops.max_iterations)
        coarse = self._solve(few, guess, slow, self.search.whole.coarse)
        fine = self._solve(few, coarse.T_world_lidar, Annealing(r.kernel_max, KERNEL_MIN_M, 0.7, 15))
        T = fine.T_world_lidar
        cells, inside = self.search.grid.cells_of(se3.apply(T, query.upright.source))
        comparable = int((inside & self.search.is_seen[cells]).sum())
        width = 2 * KERNEL_MIN_M
        inliers = self._solve(query.upright, T, Annealing(width, width, 0.5, 1)).inliers
        return (0.0 if 2 * comparable < len(query.upright.source) else inliers / comparable), T

    def _solve(
        self, points: PreparedPoints, start: Floats, annealing: Annealing, target: GaussianMap | None = None
    ) -> RegistrationResult:
        level = self.search.whole.fine if target is None else target
        return solve((level,), points, start, annealing, self.config.registration)

    def _drift(self, a: int, b: int) -> tuple[float, float]:
        """m and rad that odometry may be wrong by between two keyframes."""
        c, way = self.config.loops, abs(float(self._distances[b] - self._distances[a]))
        turn = GATE_SIGMAS * np.deg2rad(c.drift_deg) / 100 * way
        return GATE_SIGMAS * 0.01 * c.drift_percent * way + 0.5 * turn * way, float(turn)

    def _same(self, one: Vote, other: Vote) -> bool:
        """Whether two votes put the drive at the same place, as far as odometry can tell.

        Where it drifts by more than lies between two guesses, agreement is no evidence.
        """
        b = other.keyframe
        gap = se3.relative(one.T_level_odometry @ self._poses[b], other.T_level_odometry @ self._poses[b])
        move, turn = self._drift(one.keyframe, b)
        is_near = float(np.linalg.norm(gap[:3, 3])) < SAME_M + move
        return is_near and move < GUESSES_APART_M and float(so3.angle(gap[:3, :3])) < np.deg2rad(SAME_DEG) + turn

    def _agreed(self, votes: list[Vote], least: int) -> Start | None:
        """The start that at least so many keyframes vote for, and more than twice as many as for any other."""
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


def is_elsewhere(T: Floats, other: Floats) -> bool:
    """Whether two poses (4, 4) are of different places."""
    delta = se3.relative(T, other)
    return float(np.linalg.norm(delta[:3, 3])) > ELSEWHERE_M or float(so3.angle(delta[:3, :3])) > ELSEWHERE_RAD
