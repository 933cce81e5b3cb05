"""Merging of several runs: each is placed relative to the others; then loops, one robust pose graph, and one map."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lslam.backend.graph.odometry_constraints import correct_scans
from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PoseGraph, Solution
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.localization.sessions import Chain, Session, locate_session
from lslam.backend.loops.detector import Detector
from lslam.backend.loops.find_loops import warm_up
from lslam.backend.outcome import apply_verdicts
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.errors import GraphError, InputError, InterruptedRunError, RunFailedError, UsageError
from lslam.core.stopping import asking
from lslam.core.types.constraint import LoopCandidate
from lslam.core.types.scan_result import ScanResult
from lslam.core.untrusted import MISFIT
from lslam.io.formats.state_files import Records, read_npz
from lslam.odometry.frontend.checkpoints import Checkpoints
from lslam.pipeline.map_files import read_json
from lslam.pipeline.rebuild import EarlierRun, read_run, results_of
from lslam.pipeline.run_folder import KEYFRAMES, MANIFEST

log = logging.getLogger("lslam")
Stop = Callable[[], bool]


@dataclass(frozen=True)
class LeftOut:
    """A session that could not be connected to the others, and the reason."""

    name: str
    why: str


@dataclass(frozen=True)
class Merge:
    """Result of `merge_runs`.

    runs : that were merged, in the order in which they were tied; sessions : likewise, at the poses they were tied at
    results : all scans of each at their final poses, in the common world: that of the first
    before : (K, 4, 4) of the chain's keyframes as tied; after : (K, 4, 4) optimised
    candidates : loop candidates between numbers of the chain
    """

    runs: list[EarlierRun]
    sessions: list[Session]
    results: list[list[ScanResult]]
    chain: Chain
    before: Floats
    solution: Solution
    candidates: list[LoopCandidate]
    left_out: list[LeftOut] = field(default_factory=list)

    def between(self, session: int) -> int:
        """Accepted loops between two sessions."""
        ends = [(self.chain.session_of(c.a), self.chain.session_of(c.b)) for c in self.candidates if c.is_accepted]
        return sum(a != b and session in (a, b) for a, b in ends)


def expand_folders(folders: Sequence[Path]) -> list[Path]:
    """Run folders, merges replaced by their runs. Raises InputError for no run, UsageError for fewer than two or a duplicate."""
    out: list[Path] = []
    for folder in folders:
        inside = sessions_of(folder)
        out += [folder] if inside is None else inside.values()
    for folder, count in Counter(folder.resolve() for folder in out).items():
        if count > 1:
            raise UsageError(f"{folder} is named twice")
    if len(out) < 2:
        raise UsageError("merging takes two runs at least")
    return out


def sessions_of(folder: Path) -> dict[str, Path] | None:
    """Run folders behind a merged folder by the names of its sessions, None for the folder of a single run.

    Raises InputError where the manifest does not list them.
    """
    manifest = read_json(folder / MANIFEST)
    if manifest.get("kind") != "merge":
        return None
    try:
        return {str(row["name"]): Path(row["run"]) for row in manifest["sessions"]}
    except MISFIT as error:
        raise InputError(f"{folder / MANIFEST}: sessions: {error}; merge the runs again") from None


def read_session(folder: Path, name: str) -> tuple[EarlierRun, Session]:
    """Session of a run with its keyframes. Raises InputError for fewer than two, or those of other poses."""
    run = read_run(folder)
    store = KeyframeStore(folder / KEYFRAMES)
    if len(store) < 2:
        raise InputError(f"{folder} has {len(store)} keyframes, merging needs two: run the sequence again")
    results = _with_covariances(run)
    if store.keyframes[-1].scan >= len(results):
        raise InputError(f"{folder / KEYFRAMES} does not belong to the {len(results)} poses of trajectory.tum")
    keyframes = [replace(k, T_world_lidar=results[k.scan].T_world_lidar) for k in store.keyframes]
    return run, Session(
        name, store, keyframes, results, georeference=run.georeference, preprocess=run.config.preprocess
    )


def _with_covariances(run: EarlierRun) -> list[ScanResult]:
    """Scans of the run, with the covariances of their registrations if stored."""
    results = results_of(run)
    path = run.folder / "covariances.npz"
    if not path.is_file():
        return results
    covariances = read_npz(path).get("registration")
    if covariances is None or covariances.shape != (len(results), 6, 6):
        return results
    # Of the registration alone: how a pose graph spread the rest over the keyframes is not how it grows.
    return [
        r if np.isnan(C).any() else replace(r, registration_covariance=C)
        for r, C in zip(results, covariances, strict=True)
    ]


def merge_runs(
    folders: Sequence[Path],
    config: Config,
    should_stop: Stop = lambda: False,
    on_stage: Callable[[str], None] = lambda stage: None,
    checkpoints: Checkpoints | None = None,
) -> Merge:
    """Connect the sessions, find loops, optimise.

    on_stage : called with the name of each stage; checkpoints : of the loops, to go on from
    The first run defines the world. Raises RunFailedError when no other can be connected to it, InterruptedRunError when
    `should_stop` returns True; InputError and UsageError as `expand_folders` and `read_session`.
    """
    read = [read_session(folder, name) for folder, name in zip(folders, names_of(folders), strict=True)]
    warm_up(config.loops)
    runs = {session.name: run for run, session in read}
    on_stage("tie")
    tied, left_out = _connect([session for _, session in read], config, should_stop)
    while True:
        if len(tied) < 2:
            raise RunFailedError(
                "no run can be tied to the first: " + "; ".join(f"{one.name}: {one.why}" for one in left_out)
            )
        chain = Chain(tied, config)
        on_stage("loops")
        candidates = _loops(chain, config, should_stop, checkpoints)
        on_stage("graph")
        merge = _solve(chain, candidates, config, runs, left_out, should_stop)
        loose = [n for n in range(1, len(tied)) if merge.between(n) == 0]
        if not loose:
            return merge
        left_out += [LeftOut(tied[n].name, "no loop closure with another run holds") for n in loose]
        tied = [session for n, session in enumerate(tied) if n not in loose]


def names_of(folders: Sequence[Path]) -> list[str]:
    """Names of the runs, with a number added to duplicates."""
    names: list[str] = []
    for folder in folders:
        name = folder.absolute().name
        count = sum(known == name or known.startswith(f"{name}-") for known in names)
        names.append(name if name not in names else f"{name}-{count + 1}")
    return names


def _connect(sessions: list[Session], config: Config, should_stop: Stop) -> tuple[list[Session], list[LeftOut]]:
    """Sessions connected to the ones before, starting with the first.

    Failed ones are tried again after each success, since more of the place is mapped then.
    """
    tied, waiting, why = [sessions[0]], sessions[1:], {}
    while waiting:
        left = []
        for session in waiting:
            placed, reason = locate_session(session, tied, config, should_stop)
            if should_stop():
                raise InterruptedRunError(f"interrupted while {session.name} was searched among the other runs")
            if placed is None:
                why[session.name] = reason
                left.append(session)
                continue
            assert placed.start is not None
            log.info("%s: found by %d of %d keyframes tried", placed.name, placed.start.votes, placed.start.tried)
            tied.append(placed)
        if len(left) == len(waiting):
            break
        waiting = left
    return tied, [LeftOut(session.name, f"not found among the others: {why[session.name]}") for session in waiting]


def _loops(chain: Chain, config: Config, should_stop: Stop, checkpoints: Checkpoints | None) -> list[LoopCandidate]:
    """Loop candidates of the whole chain; those of an interrupted merge with the same keyframes are reused."""
    known = None if checkpoints is None else checkpoints.latest()
    if known is not None and np.array_equal(known["poses"], chain.poses):
        found: list[LoopCandidate] = known["candidates"]
        return found
    up = chain.sessions[0].up
    detector = Detector(chain.keyframes(), chain.cloud, config.loops, config.registration, up=up)
    candidates = detector.find(None, should_stop, config.input.workers)
    if checkpoints is not None:
        checkpoints.write(len(chain), lambda: {"poses": chain.poses, "candidates": Records(candidates)})
    return candidates


def _solve(
    chain: Chain,
    candidates: list[LoopCandidate],
    config: Config,
    runs: dict[str, EarlierRun],
    left_out: list[LeftOut],
    should_stop: Stop,
) -> Merge:
    """Optimise the graph of the chain and correct all scans by it. Raises RunFailedError where it has no solution."""
    keyframes = chain.keyframes()
    loops = [c.constraint for c in candidates if c.is_accepted and c.constraint is not None]
    graph = PoseGraph(
        poses=chain.poses, odometry=chain.odometry(), loops=loops, distances=np.array([k.distance for k in keyframes])
    )
    try:
        with asking(should_stop, "interrupted before the pose graph was solved"):
            solution = optimise(graph, config.graph)
    except (GraphError, np.linalg.LinAlgError) as error:
        raise RunFailedError(f"the runs cannot be merged: {error}") from None
    results = []
    for n, session in enumerate(chain.sessions):
        part = chain.part(n)
        poses, covariances = solution.poses[part], solution.covariances[part]
        results.append(
            correct_scans(session.results, session.keyframes, poses, covariances, solution.drift, config.graph)
        )
    judged, _ = apply_verdicts(candidates, graph, solution)
    return Merge(
        [runs[s.name] for s in chain.sessions], chain.sessions, results, chain, chain.poses, solution, judged, left_out
    )
