"""Loop closures of a run: candidates that are searched, pairs that a person knows, and views of their scans for people."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np

from lslam.backend.keyframes.store import KeyframeStore, submap
from lslam.backend.loops import create_descriptor
from lslam.backend.loops.detector import LEAST_REACH, Detector
from lslam.backend.loops.gating import OdometryUncertainty
from lslam.backend.loops.level_submap import make_level_submap, move_points
from lslam.backend.loops.verify import Verifier
from lslam.core.arrays import Floats, Points
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InterruptedRunError
from lslam.core.geometry import se3
from lslam.core.types.constraint import KnownPair, LoopCandidate, LoopStage
from lslam.core.types.run_record import PairView, RunRecord
from lslam.core.types.scan_result import KeyframeClocks
from lslam.core.types.trajectory import Keyframe
from lslam.registration.preprocessing.ground import Z

log = logging.getLogger("lslam")


def find_loops(
    store: KeyframeStore,
    config: LoopsConfig,
    registration: RegistrationConfig,
    submap_size: int = 5,
    clocks: KeyframeClocks | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    threads: int = 1,
    keyframes: Sequence[Keyframe] | None = None,
    forbidden: Sequence[tuple[int, int]] = (),
    up: Floats = Z,
) -> list[LoopCandidate]:
    """Loop candidates of a run in the order of the newer keyframe, with verdicts.

    store : the run's keyframes with odometry's poses, their covariances and the distance travelled
    submap_size : keyframes whose clouds make one submap (`keyframes.submap_size`)
    clocks : measure the time of each keyframe, stage `loops`
    threads : number of keyframes verified at once; the candidates do not depend on it
    keyframes : those of the store at other poses than odometry's; forbidden : pairs excluded as candidates, with those around
        them
    up : (3,) unit vector, up in their world by the mounting of the sensor

    An accepted candidate carries its constraint, T_a_b between LiDAR frames. Raises InterruptedRunError when `should_stop`
    returns True between two keyframes.
    """
    at = store.keyframes if keyframes is None else keyframes
    detector = _detector(store, at, config, registration, submap_size, forbidden, up)
    candidates = detector.find(clocks, should_stop, threads)
    accepted = sum(c.is_accepted for c in candidates)
    attempts = sum(c.stage != LoopStage.THINNED for c in candidates)
    log.info("loop closures: %d of %d candidates accepted, %d keyframes", accepted, attempts, len(store))
    return candidates


def verify_pairs(
    store: KeyframeStore,
    pairs: Sequence[KnownPair],
    config: LoopsConfig,
    registration: RegistrationConfig,
    submap_size: int = 5,
    should_stop: Callable[[], bool] = lambda: False,
    up: Floats = Z,
) -> list[LoopCandidate]:
    """The known pairs as candidates, verified whatever odometry says; accepted ones are binding for the graph.

    submap_size : keyframes whose clouds make a submap; up : (3,) unit vector in the world of odometry
    Raises InterruptedRunError when `should_stop` returns True between two.
    """
    detector = _detector(store, store.keyframes, config, registration, submap_size, up=up)
    loops = []
    for pair in pairs:
        if should_stop():
            raise InterruptedRunError("interrupted while known pairs were verified")
        loops.append(detector.verify_pair(pair))
    return loops


def _detector(
    store: KeyframeStore,
    keyframes: Sequence[Keyframe],
    config: LoopsConfig,
    registration: RegistrationConfig,
    submap_size: int,
    forbidden: Sequence[tuple[int, int]] = (),
    up: Floats = Z,
) -> Detector:
    """A detector over `keyframes`, with submaps of the store's clouds at their poses."""
    poses = np.array([keyframe.T_world_lidar for keyframe in keyframes]).reshape(-1, 4, 4)
    return Detector(
        keyframes, lambda number: submap(store, poses, number, submap_size), config, registration, forbidden, up
    )


def warm_up(config: LoopsConfig) -> None:
    """Compile or load every kernel that loop closure detection needs, with a small room."""
    room = warm_up_candidates(config)
    submap_of_room = make_level_submap(room, RegistrationConfig())
    Verifier(LoopsConfig(), RegistrationConfig()).verify(
        submap_of_room, submap_of_room, np.zeros(3), LEAST_REACH, [0.0]
    )


def warm_up_candidates(config: LoopsConfig) -> Points:
    """Compile or load the kernels of candidate search; returns the synthetic room (3000, 3), m, used for it."""
    room = np.random.default_rng(0).uniform(-8, 8, (3000, 3)).astype(np.float32)
    room[np.arange(3000), np.arange(3000) % 3] = 8.0
    move_points(room, np.eye(4))
    OdometryUncertainty([Keyframe(0, 0, 0, np.eye(4), np.eye(6))], 0.0, 0.0).gate(0, np.arange(0), 1.0, 1.0, 1.0)
    create_descriptor(config).add(0, room)
    return room


# Candidates that a page shows without a server, and points of each of their clouds.
MOST_VIEWS, FEW_POINTS = 20, 1500


def view_pairs(record: RunRecord, store: KeyframeStore, size: int) -> list[PairView]:
    """The most doubtful candidates of a run; size : keyframes whose clouds make one submap."""
    tried = [c for c in record.loops if c.stage != LoopStage.THINNED]
    doubtful = sorted(tried, key=lambda c: (-c.doubt, c.a, c.b))[:MOST_VIEWS]
    poses = record.trajectory.poses
    return [view_pair(store, c, poses[record.keyframe_scans[c.a]], size, FEW_POINTS) for c in doubtful]


def view_pair(store: KeyframeStore, candidate: LoopCandidate, T_world_a: Floats, size: int, most: int) -> PairView:
    """The submaps of both keyframes of a candidate, for people to compare in the report.

    T_world_a : (4, 4) the older keyframe in a level world; size : keyframes whose clouds make a submap
    most : points of each cloud that are kept
    """
    odometry = np.stack([k.T_world_lidar for k in store.keyframes])
    a, b = (submap(store, odometry, k, size) for k in (candidate.a, candidate.b))
    a, b = (points[:: max(1, -(-len(points) // most))] for points in (a, b))
    R = se3.make(T_world_a[:3, :3], np.zeros(3))
    before = R @ se3.relative(odometry[candidate.a], odometry[candidate.b])
    closed = candidate.constraint
    return PairView(
        candidate,
        se3.apply(R, a).astype(np.float32),
        b,
        before,
        None if closed is None else R @ closed.T_a_b,
    )
