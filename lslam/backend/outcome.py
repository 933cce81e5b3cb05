"""The outcome of the pose graph for a run: poses, verdicts on loop closures, and facts for the manifest."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lslam.backend.georeferencing import MIN_FIXES
from lslam.backend.graph.drift import tilt_factor
from lslam.backend.graph.factors import regularise
from lslam.backend.graph.fix_errors import NO_HEIGHT
from lslam.backend.graph.fix_noise import GaussMarkovNoise
from lslam.backend.graph.loop_drift import without_loop_drift
from lslam.backend.graph.odometry_constraints import correct_scans
from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import EstimatedDrift, PoseGraph, Solution
from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.errors import GraphError
from lslam.core.geometry import se3
from lslam.core.types.building import CorrectedMap, OsmMatches
from lslam.core.types.constraint import Constraint, ControlPoint, ControlResidual, LoopCandidate, LoopStage, Verdict
from lslam.core.types.gnss import Georeference
from lslam.core.types.run_record import LoopSurroundings, LoopView, RunRecord
from lslam.core.types.scan_result import KeyframeClocks, ScanResult

log = logging.getLogger("lslam")

# Names of the rates of an estimated drift, from walls and from loop closures.
_OF_WALLS = ("east_percent", "north_percent", "left_deg_per_100m")
_OF_LOOPS = ("x_percent", "y_percent", "z_percent", "about_x_deg_per_100m", "about_y_deg_per_100m", "left_deg_per_100m")
# Keyframes before and after each end of the loop whose clouds are shown.
CLOUD_KEYFRAMES = 10


@dataclass(frozen=True)
class BackEndInput:
    """The input of the back end.

    results : of odometry, all scans; store : of the keyframes; candidates : all loop candidates with the verdicts of verification
    clocks : time the work on each keyframe; the last one takes that of the whole graph
    points : control points
    problems : what failed so far, one sentence each; appended to. facts : for the manifest, likewise
    """

    results: list[ScanResult]
    store: KeyframeStore
    config: Config
    candidates: list[LoopCandidate]
    clocks: KeyframeClocks = field(default_factory=KeyframeClocks)
    problems: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    points: tuple[ControlPoint, ...] = ()


@dataclass(frozen=True)
class BackEnd:
    """The result of the back end.

    results : all scans at their final poses; candidates : all loop candidates with final verdicts
    keyframes : (K, 4, 4) final poses; constraints : odometry and accepted loop closures, empty without a graph
    georeference : of the world of `results`, None when unknown
    T_final_odometry : (4, 4) from the world of odometry into that of `results`
    solution : of the graph, None where the poses are odometry's
    control : residuals of the control points
    osm : matches of walls with buildings, None without a usable map; buildings : of that map, at their estimated places
    facts : for the manifest; problems : what failed, one sentence each
    """

    results: list[ScanResult]
    candidates: list[LoopCandidate] = field(default_factory=list)
    keyframes: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))
    constraints: list[Constraint] = field(default_factory=list)
    georeference: Georeference | None = None
    T_final_odometry: Floats = field(default_factory=lambda: np.eye(4))
    solution: Solution | None = None
    control: list[ControlResidual] = field(default_factory=list)
    osm: OsmMatches | None = None
    buildings: CorrectedMap | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def is_optimised(self) -> bool:
        """Whether the poses are the graph's and not odometry's."""
        return bool(self.constraints)


def solve(graph: PoseGraph, inputs: BackEndInput, georeference: Georeference | None = None) -> BackEnd | None:
    """The run at the optimum of the graph; None, and one more of the problems, when that fails.

    georeference : of the graph's frame, None where that is odometry's
    """
    config = inputs.config
    try:
        with inputs.clocks[len(inputs.store) - 1].stage("graph"):
            solution = optimise(graph, config.graph)
    except (GraphError, np.linalg.LinAlgError) as error:
        inputs.problems.append(f"{error}; the run goes on without it")
        return None
    free = [not fix.is_binding for fix in graph.fixes]
    accepted_fixes = int(solution.fix_inliers[free].sum())
    if any(free) and accepted_fixes < MIN_FIXES:
        text = f"GNSS: the pose graph accepts {accepted_fixes} of {sum(free)} fixes"
        inputs.problems.append(
            f"{text}: all rejected" if all(free) else f"{text}, the control points contradict the others"
        )
        if all(free):
            return None
    judged, accepted = apply_verdicts(inputs.candidates, graph, solution)
    log.info(
        "pose graph: %d keyframes, %d of %d loop closures accepted, drift factor %.3g, %d rounds",
        len(graph),
        len(accepted),
        len(graph.loops),
        solution.drift,
        solution.rounds,
    )
    T = np.eye(4) if georeference is None else georeference.T_enu_world
    facts = _facts(solution, graph, T @ _odometry(inputs), inputs.candidates, accepted)
    tilts = not accepted and tilt_factor(graph, config.graph) > 0
    if not (accepted or graph.fixes or graph.floors or graph.map_priors or tilts):
        return BackEnd(inputs.results, judged, graph.poses, facts=facts)
    if georeference is not None:
        georeference = replace(_rescore(georeference, graph, solution), T_enu_world=np.eye(4))
    moved = correct_scans(
        inputs.results, inputs.store.keyframes, solution.poses, solution.covariances, solution.drift, config.graph
    )
    # As they were solved: odometry's covariance may be singular and has no information matrix then.
    constraints = [replace(c, covariance=regularise(c.covariance)) for c in (*graph.odometry, *accepted)]
    return BackEnd(moved, judged, solution.poses, constraints, georeference, T, solution=solution, facts=facts)


def without_steady_drift(graph: PoseGraph, inputs: BackEndInput) -> PoseGraph:
    """The graph corrected by the steady drift that its loop closures reveal, if `graph.steady_drift` is set.

    It is unchanged where they reveal none and where it cannot be solved; drift that cannot be estimated becomes a problem.
    """
    if not inputs.config.graph.steady_drift:
        return graph
    try:
        graph = without_loop_drift(graph, inputs.config.graph)
    except GraphError:
        # Reported where it is solved.
        return graph
    except np.linalg.LinAlgError as error:
        inputs.problems.append(f"graph.steady_drift: {error}; steady drift is not corrected")
    if graph.estimated_drift is not None:
        shift, turn = (float(np.linalg.norm(part)) for part in np.split(graph.estimated_drift.rates, 2))
        log.info(
            "loop closures: steady drift of odometry, %.1f %% and %.1f deg/100 m, is corrected",
            100 * shift,
            100 * np.degrees(turn),
        )
    return graph


def keep_odometry(inputs: BackEndInput) -> BackEnd:
    """The run at odometry's poses, for a graph without a solution; accepted loop closures become rejected."""
    candidates = [
        replace(c, verdict=Verdict.REJECTED, stage=LoopStage.GRAPH, reason="the pose graph could not be solved")
        if c.is_accepted
        else c
        for c in inputs.candidates
    ]
    return BackEnd(inputs.results, candidates, _odometry(inputs))


def _odometry(inputs: BackEndInput) -> Floats:
    """(K, 4, 4) poses of the keyframes by odometry."""
    return np.stack([k.T_world_lidar for k in inputs.store.keyframes])


def apply_verdicts(
    candidates: list[LoopCandidate], graph: PoseGraph, solution: Solution
) -> tuple[list[LoopCandidate], list[Constraint]]:
    """Candidates with the graph's verdicts on those accepted before, and the constraints it accepts."""
    judged = iter(zip(graph.loops, solution.loop_reasons, solution.loop_stages, strict=True))
    out, accepted = [], []
    for candidate in candidates:
        if candidate.is_accepted and candidate.constraint is not None:
            loop, reason, stage = next(judged)
            if reason:
                candidate = replace(candidate, verdict=Verdict.REJECTED, stage=stage, reason=reason)
            else:
                accepted.append(loop)
        out.append(candidate)
    return out, accepted


def _rescore(georeference: Georeference, graph: PoseGraph, solution: Solution) -> Georeference:
    """The georeference with new residuals: those of the inlier fixes or walls in the solved graph; unchanged without any."""
    is_control = georeference.method == "control"
    used = [
        fix
        for fix, is_inlier in zip(graph.fixes, solution.fix_inliers, strict=True)
        if is_inlier and fix.is_binding == is_control
    ]
    if not used:
        if not graph.fixes:
            return georeference
        return replace(georeference, used=0, rmse_horizontal=float("nan"), rmse_vertical=float("nan"))
    off = np.stack([f.position - f.predict(solution.poses) for f in used])
    heights = off[[f.sigma[2] < NO_HEIGHT for f in used], 2]
    return replace(
        georeference,
        rmse_horizontal=float(np.sqrt((off[:, :2] ** 2).sum(1).mean())),
        rmse_vertical=float(np.sqrt((heights**2).mean())) if len(heights) else float("nan"),
        used=len(used),
    )


def _facts(
    solution: Solution, graph: PoseGraph, before: Floats, candidates: list[LoopCandidate], closures: list[Constraint]
) -> dict[str, Any]:
    """Facts of the solved graph, for the manifest.

    before : (K, 4, 4) odometry's poses of the keyframes, in the frame of the graph; closures : accepted loop closures
    """
    moved = se3.relative(before, solution.poses)[:, :3, 3]
    return {
        "loop_candidates": len(candidates),
        "loops": len(closures),
        "fixes": sum(
            bool(ok) and not fix.is_binding for fix, ok in zip(graph.fixes, solution.fix_inliers, strict=True)
        ),
        "gravity_factors": len(graph.free_ups),
        **({} if graph.inertial is None else {"imu_factors": len(graph.inertial.links)}),
        "imu_orientation_factors": len(graph.turns),
        "floor_factors": len(graph.floors),
        "map_priors": sum(not reason for reason in solution.map_reasons),
        "drift_factor": round(solution.drift, 4),
        "rounds": solution.rounds,
        "largest_correction_m": round(float(np.linalg.norm(moved, axis=1).max()), 4),
        **({} if graph.estimated_drift is None else _drift_facts(graph.estimated_drift)),
        **({} if graph.fix_noise is None else _noise_facts(graph.fix_noise)),
    }


def _noise_facts(fix_noise: GaussMarkovNoise) -> dict[str, Any]:
    """Sigmas and time constant of the fixes' correlated noise, for the manifest."""
    east, _, up = (round(float(sigma), 3) for sigma in fix_noise.sigma)
    return {"wandering_fixes": {"horizontal_m": east, "vertical_m": up, "memory_s": round(fix_noise.memory, 1)}}


def _drift_facts(drift: EstimatedDrift) -> dict[str, Any]:
    """Estimated rates of drift with sigmas (percent, deg per 100 m) and their significance, for the manifest."""
    names = _OF_WALLS if len(drift.rates) == len(_OF_WALLS) else _OF_LOOPS
    units = np.array([100.0 if name.endswith("percent") else np.degrees(100.0) for name in names])
    columns = {"estimate": drift.rates, "sigma": drift.sigma} | ({} if drift.rms is None else {"rms": drift.rms})
    facts: dict[str, Any] = {
        name: {column: round(float(unit * rates[i]), 4) for column, rates in columns.items()}
        for i, (name, unit) in enumerate(zip(names, units, strict=True))
    }
    facts |= {"log_likelihood_gain": round(0.5 * drift.gain, 1), "gain_by_chance": round(0.5 * drift.chance, 1)}
    return {"wandering_drift" if drift.is_varying else "steady_drift": facts}


def view_loop(record: RunRecord, back_end: BackEnd, store: KeyframeStore) -> LoopView | None:
    """Poses and scans about the loop closure of largest correction, for the report; None without one, or without a solution."""
    closed = [c for c in record.loops if c.is_accepted]
    if record.odometry is None or not back_end.is_optimised or not closed:
        return None
    scans = record.keyframe_scans
    before, after = record.T_final_odometry @ record.odometry.poses[scans], record.trajectory.poses[scans]

    def correction(loop: LoopCandidate) -> float:
        was, now = (se3.relative(poses[loop.a], poses[loop.b])[:3, 3] for poses in (before, after))
        return float(np.linalg.norm(now - was))

    loop = max(closed, key=correction)
    return LoopView(
        int(scans[loop.a]),
        int(scans[loop.b]),
        correction(loop),
        _surroundings(before, loop, store),
        _surroundings(after, loop, store),
    )


def _surroundings(poses: Floats, loop: LoopCandidate, store: KeyframeStore) -> LoopSurroundings:
    """Points and paths near both ends of a loop closure, at the `poses` (K, 4, 4) of the keyframes."""
    older, newer = (
        range(max(end - CLOUD_KEYFRAMES, 0), min(end + CLOUD_KEYFRAMES + 1, len(store))) for end in (loop.a, loop.b)
    )
    points = np.concatenate([se3.apply(poses[k], store.points(k)) for k in sorted({*older, *newer})])
    return LoopSurroundings(points, poses[list(older), :2, 3], poses[list(newer), :2, 3], poses[loop.a, :2, 3])
