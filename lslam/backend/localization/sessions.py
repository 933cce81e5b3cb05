"""Several drives as one chain of keyframes: each tied to those before it by the place where it was found among them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lslam.backend.graph.odometry_constraints import positive
from lslam.backend.keyframes.store import KeyframeStore, mounted_up, submap
from lslam.backend.localization.locate import PlaceFinder, Start, StartPrior
from lslam.backend.localization.prior_map import PlaceSearch, make_prior_map
from lslam.backend.loops.level_submap import move_points
from lslam.backend.loops.verify import LEAST_SIGMA_DEG, LEAST_SIGMA_M
from lslam.core.arrays import Floats, Points
from lslam.core.config.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import geodesy, noise, se3
from lslam.core.kernels import voxel
from lslam.core.types.constraint import Constraint
from lslam.core.types.gnss import Georeference
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe
from lslam.registration.preprocessing.ground import ahead_of
from lslam.registration.preprocessing.prepare import NO_TIMES

# m, voxels of the cloud that further sessions are searched in.
FINE = 0.2


@dataclass(frozen=True)
class Session:
    """One drive of several.

    keyframes : at the final poses of its run, in its own world; store : their clouds
    results : all its scans, likewise; T_town_session : (4, 4) from its world into the common one
    start : how it was found among the sessions before it, None of the first
    georeference : of its own world, None where that lies nowhere
    preprocess : its run's, which says how the sensor was mounted
    """

    name: str
    store: KeyframeStore
    keyframes: list[Keyframe]
    results: list[ScanResult]
    T_town_session: Floats = field(default_factory=lambda: np.eye(4))
    start: Start | None = None
    georeference: Georeference | None = None
    preprocess: PreprocessConfig = field(default_factory=PreprocessConfig)

    @property
    def poses(self) -> Floats:
        """(K, 4, 4) of the keyframes in the common world."""
        return self.T_town_session @ np.stack([k.T_world_lidar for k in self.keyframes])

    @property
    def up(self) -> Floats:
        """(3,) up in the common world by the mounting of its sensor."""
        return mounted_up(self.store, self.poses, self.preprocess)


class Chain:
    """The keyframes of sessions one after the other, numbered through."""

    def __init__(self, sessions: Sequence[Session], config: Config) -> None:
        self.sessions, self.config = list(sessions), config
        self.firsts = np.cumsum([0, *(len(s.keyframes) for s in sessions)])
        self._whole = [s.poses for s in sessions]
        self.breaks = [self._break(n) for n in range(1, len(sessions))]

    def __len__(self) -> int:
        return int(self.firsts[-1])

    def session_of(self, number: int) -> int:
        """Index of the session that keyframe `number` belongs to."""
        return int(np.searchsorted(self.firsts, number, side="right")) - 1

    def part(self, session: int) -> slice:
        """Slice of the chain's keyframes that belong to a session."""
        return slice(int(self.firsts[session]), int(self.firsts[session + 1]))

    def cloud(self, number: int) -> Points:
        """The submap about a keyframe, (M, 3) m, its own axes; of its session alone."""
        n = self.session_of(number)
        own = number - int(self.firsts[n])
        return submap(self.sessions[n].store, self._whole[n], own, self.config.keyframes.submap_size)

    @property
    def poses(self) -> Floats:
        """(K, 4, 4) in the common world."""
        return np.concatenate(self._whole)

    def odometry(self) -> list[Constraint]:
        """Constraints from each keyframe to the next: odometry within a session, and `_break` from one session to the next."""
        out: list[Constraint] = []
        for n, session in enumerate(self.sessions):
            if n:
                out.append(self.breaks[n - 1])
            first = int(self.firsts[n])
            for k, (a, b) in enumerate(zip(session.keyframes, session.keyframes[1:], strict=False), first):
                T = se3.relative(a.T_world_lidar, b.T_world_lidar)
                grown = noise.rotate(self._growth(a, b), a.T_world_lidar[:3, :3].T)
                out.append(Constraint(k, k + 1, T, grown, "odometry"))
        return out

    def keyframes(self) -> list[Keyframe]:
        """All keyframes with covariance and distance travelled accumulated over all sessions, as in one drive."""
        out: list[Keyframe] = []
        covariance, distance = np.zeros((6, 6)), 0.0
        constraints, poses = self.odometry(), self.poses
        single = [keyframe for session in self.sessions for keyframe in session.keyframes]
        for number, (own, T) in enumerate(zip(single, poses, strict=True)):
            if number:
                before = poses[number - 1]
                covariance = noise.transport(covariance, T[:3, 3] - before[:3, 3])
                covariance = covariance + noise.rotate(constraints[number - 1].covariance, before[:3, :3])
                is_break = number in self.firsts
                distance += self.config.loops.min_travel if is_break else own.distance - single[number - 1].distance
            out.append(Keyframe(number, own.scan, own.stamp_ns, T, covariance, distance))
        return out

    def _growth(self, a: Keyframe, b: Keyframe) -> Floats:
        """(6, 6) growth of odometry's covariance between two keyframes of a session, its world's axes."""
        c, way = self.config.graph, max(b.distance - a.distance, 0.0)
        least = np.diag(np.repeat([1e-3**2, 1e-4**2], 3))
        if a.covariance is None or b.covariance is None:
            turn = np.deg2rad(c.drift_deg_per_100m) / 100 * way
            return np.asarray(np.diag(np.repeat([(0.01 * c.drift_percent * way) ** 2, turn**2], 3)) + least)
        step = b.T_world_lidar[:3, 3] - a.T_world_lidar[:3, 3]
        return positive(b.covariance - noise.transport(a.covariance, step)) + least

    def _break(self, n: int) -> Constraint:
        """Constraint from the end of the session before to the begin of session `n`, as these were located in each other.

        Its covariance has odometry's drift over the ways between them.
        """
        session, last = self.sessions[n], int(self.firsts[n]) - 1
        T = se3.relative(self._whole[n - 1][-1], self._whole[n][0])
        assert session.start is not None
        keyframe = session.start.vote.keyframe
        at = self._whole[n][keyframe][:3, 3]
        before = np.concatenate(self._whole[:n])[:, :3, 3]
        near = int(np.linalg.norm(before - at, axis=1).argmin())
        own = session.keyframes[keyframe].distance - session.keyframes[0].distance
        old = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(before, axis=0), axis=1))])
        way = own + float(old[-1] - old[near])
        c = self.config.loops
        turn = np.deg2rad(LEAST_SIGMA_DEG) + np.deg2rad(c.drift_deg) / 100 * way
        move = LEAST_SIGMA_M + 0.01 * c.drift_percent * way + turn * max(float(np.linalg.norm(T[:3, 3])), way)
        return Constraint(last, last + 1, T, np.diag(np.repeat([move**2, turn**2], 3)), "odometry")


@dataclass(frozen=True)
class Vicinity:
    """Where a session begins at the most: within `reach` m of a `position` (3,), common world."""

    position: Floats
    reach: float


def locate_session(
    session: Session,
    others: Sequence[Session],
    config: Config,
    should_stop: Callable[[], bool] = lambda: False,
    vicinity: Vicinity | None = None,
) -> tuple[Session | None, str]:
    """Locate a session in the map of the `others`: the session with its pose in their world, or None and the reason.

    vicinity : position and radius to search in, instead of the georeferences
    should_stop : called between keyframes; if it returns True the result is None
    """
    cloud = np.concatenate([_cloud_of(s) for s in others])
    prior_map = make_prior_map(
        cloud.astype(np.float64), config.registration, source="the sessions before", up=others[0].up
    )
    own = config.model_copy(update={"preprocess": session.preprocess})
    finder = PlaceFinder(PlaceSearch(prior_map, config.registration), _AtFinalPoses(session), own)
    expected = by_georeference(session, others)
    T_level_map = se3.inverse(prior_map.T_map_level)
    prior = None if expected is None else _prior(T_level_map @ expected, session, config)
    if vicinity is not None:
        prior = StartPrior(se3.apply(T_level_map, vicinity.position[None])[0, :2], None, vicinity.reach)
    start = finder.find(prior, should_stop)
    if start is None and expected is not None:
        return None, "it is not where its georeference puts it among them"
    if start is None:
        reasons = [reason.split(",")[0] for reason in finder.reasons]
        return None, max(set(reasons), key=reasons.count) if reasons else "its keyframes do not agree on a place"
    return replace(session, T_town_session=prior_map.T_map_level @ start.vote.T_level_odometry, start=start), ""


def by_georeference(session: Session, others: Sequence[Session]) -> Floats | None:
    """Transform (4, 4) of the session's world into the common one by georeferences; None without two of them."""
    other = next((s for s in others if s.georeference is not None), None)
    if other is None or other.georeference is None or session.georeference is None:
        return None
    T_other_own = geodesy.frame_change(session.georeference.origin, other.georeference.origin)
    T_world_enu = se3.inverse(other.georeference.T_enu_world)
    return np.asarray(other.T_town_session @ T_world_enu @ T_other_own @ session.georeference.T_enu_world)


def _prior(T: Floats, session: Session, config: Config) -> StartPrior:
    """Where the first keyframe is expected by T (4, 4), from the session's world into level axes of the map."""
    first = T @ session.keyframes[0].T_world_lidar
    c, ahead = config.localize, first[:3, :3] @ ahead_of(first[2, :3])
    heading = float(np.arctan2(ahead[1], ahead[0]))
    return StartPrior(first[:2, 3], heading, c.start_radius, float(np.deg2rad(c.start_turn_deg)))


class _AtFinalPoses(KeyframeStore):
    """The clouds of a session at the poses of its run's end."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self.keyframes, self._clouds = session.keyframes, session.store

    def points(self, number: int) -> Points:
        """Cloud (N, 3), m, of keyframe `number`, LiDAR frame."""
        return self._clouds.points(number)


def _cloud_of(session: Session) -> Points:
    """(N, 3) m, common world: the clouds of its keyframes, one mean per voxel."""
    parts = [move_points(session.store.points(k), T) for k, T in enumerate(session.poses)]
    return np.asarray(voxel.means(np.concatenate(parts), NO_TIMES, FINE)[0])
