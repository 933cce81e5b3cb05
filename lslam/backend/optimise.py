"""From odometry to a consistent trajectory: loop closures, GNSS fixes, gravity and floor in one pose graph.

Odometry's poses stay as they are, byte for byte, where the graph has no other constraint (gravity counts where it is
significant) or cannot be solved. Once it is solved, fixes, control points and the map are checked against each other.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.backend.control_points import (
    against_odometry,
    contradicting,
    control_facts,
    control_positions,
    control_residuals,
    with_control,
)
from lslam.backend.fixes import Fixes
from lslam.backend.georeferencing import Placement, final_fixes, on_earth, place
from lslam.backend.graph.drift import tilt_factor
from lslam.backend.graph.odometry_constraints import (
    IDENTITY,
    bend_scans,
    fitness_covariance,
    fitness_score,
    odometry_constraints,
)
from lslam.backend.graph.pose_graph import Drift, drift_of, optimise
from lslam.backend.graph.problem import PoseGraph
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.levelling import floor_planes, on_one_plane, up_directions, world_up
from lslam.backend.outcome import BackEnd, BackEndInput, keep_odometry, solve, without_steady_drift
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.errors import GraphError
from lslam.core.geometry import geodesy, se3
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile
from lslam.core.stopping import checking
from lslam.core.types.constraint import ControlPoint, LoopCandidate, Turn
from lslam.core.types.gnss import Georeference
from lslam.core.types.imu import InertialChain
from lslam.core.types.scan_result import KeyframeClocks, ScanResult
from lslam.core.types.sequence import Sequence
from lslam.maps.crispness import plane_variances
from lslam.registration.preprocessing.ground import up_of, world_up_of

log = logging.getLogger("lslam")
# Solves the graph with the priors of a map, given its georeference; None where the map gives none.
Hold = Callable[[PoseGraph, Placement, BackEndInput], BackEnd | None]


def run_back_end(
    sequence: Sequence,
    results: list[ScanResult],
    store: KeyframeStore,
    config: Config,
    candidates: list[LoopCandidate],
    turns: Many[Turn] = (),
    hold: Hold | None = None,
    clocks: KeyframeClocks | None = None,
    inertial: InertialChain | None = None,
    points: Many[ControlPoint] = (),
) -> BackEnd:
    """Optimise the pose graph with loop closures, fixes and map priors, and correct all scans; odometry's poses on failure.

    turns : rotations by a gyroscope; points : control points, which are never rejected
    hold : solves with a map of buildings instead, None without one
    """
    keyframes = store.keyframes
    clocks = KeyframeClocks() if clocks is None else clocks
    inputs = BackEndInput(results, store, config, candidates, clocks, points=tuple(points))
    problems = inputs.problems
    if len(keyframes) < 2:
        if config.gnss.mode != "off" or points:
            what = "control points" if points else "GNSS"
            problems.append(f"{what}: fewer than two keyframes have no heading on the Earth")
        return BackEnd(results, candidates, problems=problems)
    graph = replace(_graph(inputs, inertial), turns=turns)
    drift = drift_of(graph, config.graph)
    out = None
    if hold is not None:
        out = hold(
            graph,
            _place(sequence, graph, inputs, ("graph", "fit") if config.osm.origin is None else ("graph",)),
            inputs,
        )
    if out is None:
        # Loop closures observe a steady drift far better than fixes, whose gates assume odometry without it.
        graph = without_steady_drift(graph, inputs)
        placement = _place(sequence, graph, inputs)
        if placement.georeference is not None:
            out = solve(on_earth(graph, placement), inputs, placement.georeference)
    if out is None and (graph.loops or graph.floors or tilt_factor(graph, config.graph) > 0):
        out = solve(graph, inputs)
    if out is None:
        out = keep_odometry(inputs)
    if config.gnss.mode == "fit" and out.georeference is None:
        moved = replace(graph, poses=out.keyframes)
        out = replace(out, georeference=_by_fixes(sequence, moved, inputs, out.results).georeference)
    if points and out.georeference is not None:
        out = _with_residuals(out, out.georeference, sequence, drift, inputs, is_level=bool(graph.ups))
    out = _compared_with_map(out, graph, inputs)
    problems[:] = [problem for problem in problems if problem]
    for problem in problems:
        log.warning("%s", problem)
    return replace(out, problems=problems, facts={"keyframes": len(keyframes)} | out.facts | inputs.facts)


def _with_residuals(
    out: BackEnd, georeference: Georeference, sequence: Sequence, drift: Drift, inputs: BackEndInput, is_level: bool
) -> BackEnd:
    """The outcome with the control points' residuals; contradictions become `problems` of `inputs`.

    drift : odometry's uncertainty; is_level : whether an IMU measures the vertical
    """
    config, points, results = inputs.config, inputs.points, inputs.results
    geoid = config.gnss.geoid
    residuals = control_residuals(points, out.results, georeference, geoid)
    inputs.problems.extend(against_odometry(points, results, inputs.store.keyframes, drift, RIGHT_PROBABILITY, geoid))
    inputs.problems.extend(contradicting(residuals, RIGHT_PROBABILITY))
    single, facts = redundancy(*control_positions(points, results, geoid), is_level)
    if single and config.gnss.mode == "off":
        log.warning("%s", single)
    if sequence.gnss is not None and len(sequence.gnss):
        fixes = final_fixes(sequence, out.results, config)
        inputs.problems.append("" if fixes is None else fixes_against_points(fixes, points, georeference))
    return replace(out, control=residuals, facts=out.facts | {"control_points": control_facts(residuals) | facts})


def _compared_with_map(out: BackEnd, graph: PoseGraph, inputs: BackEndInput) -> BackEnd:
    """The outcome with the thickness of planes with and without fixes and control points; a significant growth is a problem."""
    config, place = inputs.config, out.georeference
    if place is None or place.method not in ("graph", "control") or out.solution is None:
        return out
    without, loops = graph.poses, [c for c in out.candidates if c.is_accepted and c.constraint is not None]
    if loops and inputs.points:
        try:
            without = optimise(graph, config.graph).poses
        except (GraphError, np.linalg.LinAlgError) as error:
            log.debug("the graph without control points: %s", error)
            return out
    held_by = "control points" if inputs.points else "GNSS"
    text, facts = thicker_map(thickening(inputs.store, without, out.keyframes), held_by, RIGHT_PROBABILITY)
    if text and len(inputs.points) > 2:
        text += _without_one(graph, without, inputs)
    inputs.problems.append(text)
    return replace(out, facts=out.facts | facts)


def _without_one(graph: PoseGraph, without: Floats, inputs: BackEndInput) -> str:
    """End of a sentence on control points that contradict the scans: names those without which the others agree with these."""
    config, points, keyframes = inputs.config, inputs.points, inputs.store.keyframes
    results = bend_scans(inputs.results, keyframes, graph.poses)
    names = []
    for i in checking(range(len(points))):
        others = [*points[:i], *points[i + 1 :]]
        placement = with_control(Placement(), others, results, keyframes, _up(graph), config)
        if placement.georeference is None:
            continue
        try:
            change = thickening(inputs.store, without, optimise(on_earth(graph, placement), config.graph).poses)
        except (GraphError, np.linalg.LinAlgError) as error:
            log.debug("the graph without a control point: %s", error)
            continue
        if change is not None and not change.is_clear(RIGHT_PROBABILITY):
            names.append(points[i].at.source)
    if not names:
        return "; no single one of them is why"
    return f"; without {' or without '.join(names)} the others do not: are scan, sigma and CRS right?"


def _place(
    sequence: Sequence, graph: PoseGraph, inputs: BackEndInput, modes: tuple[str, ...] = ("graph",)
) -> Placement:
    """Placement on the Earth by fixes, when `gnss.mode` is one of the `modes`, and by control points; empty without both."""
    placement = _by_fixes(sequence, graph, inputs) if inputs.config.gnss.mode in modes else Placement()
    if not inputs.points:
        return placement
    is_fitted = placement.georeference is not None and not placement.georeference.is_in_graph
    results = bend_scans(inputs.results, inputs.store.keyframes, graph.poses)
    placed = with_control(
        Placement() if is_fitted else placement,
        inputs.points,
        results,
        inputs.store.keyframes,
        _up(graph),
        inputs.config,
    )
    return _report(placed, inputs)


def _report(placement: Placement, inputs: BackEndInput) -> Placement:
    """Add the placement's problems and facts to those of the run; returns it unchanged."""
    texts = (*placement.faults.problems, placement.problem)
    inputs.problems.extend(problem for problem in texts if problem and problem not in inputs.problems)
    inputs.facts.update(placement.faults.facts or {})
    return placement


def _by_fixes(
    sequence: Sequence, graph: PoseGraph, inputs: BackEndInput, results: list[ScanResult] | None = None
) -> Placement:
    """Placement of the graph's poses on the Earth by GNSS fixes.

    results : scans at those poses; None: odometry's, corrected as the keyframes were
    """
    keyframes, config = inputs.store.keyframes, inputs.config
    up = _up(graph)
    if results is None and graph.estimated_drift is None:
        # Odometry's tilt drifts: the first measurements of up are the best.
        results, up = inputs.results, None if up is None else graph.world_up
    elif results is None:
        results = bend_scans(inputs.results, keyframes, graph.poses)
    return _report(place(sequence, results, keyframes, up, graph, config), inputs)


def _up(graph: PoseGraph) -> Floats | None:
    """(3,) up in the world of the graph's poses, by the up directions of the keyframes; None without any."""
    if not graph.ups:
        return None
    turned = sum(graph.poses[u.keyframe, :3, :3] @ u.up * u.share / u.sigma**2 for u in graph.ups)
    return np.asarray(turned / np.linalg.norm(turned))


def _fitness(store: KeyframeStore, a: int, b: int, T_a_b: Floats) -> float:
    """Fitness score, m2, of keyframe `b` on keyframe `a`."""
    return fitness_score(store.points(b), store.points(a), T_a_b)


def _graph(inputs: BackEndInput, inertial: InertialChain | None) -> PoseGraph:
    """The pose graph of a run before fixes: odometry, accepted loops, gravity, floors and the IMU's chain."""
    store, config, results, candidates = inputs.store, inputs.config, inputs.results, inputs.candidates
    loops = [c.constraint for c in candidates if c.is_accepted and c.constraint is not None]
    fitness = None
    if config.graph.information == "identity":
        loops = [replace(loop, covariance=IDENTITY) for loop in loops]
    if config.graph.information == "fitness":
        loops = [
            replace(loop, covariance=fitness_covariance(_fitness(store, loop.a, loop.b, loop.T_a_b), config.graph))
            for loop in checking(loops)
        ]
        known = [k.T_world_lidar for k in store.keyframes]
        steps = [se3.relative(a, b) for a, b in pairwise(known)]
        fitness = [_fitness(store, k, k + 1, T) for k, T in enumerate(checking(steps))]
    ups = up_directions(store.keyframes, results, config.graph) if config.graph.gravity_deg > 0 else []
    up = world_up(ups, store.keyframes)
    poses = np.stack([k.T_world_lidar for k in store.keyframes])
    distances = np.array([k.distance for k in store.keyframes])
    horizon = world_up_of(config.preprocess, store.keyframes[0].T_world_lidar)
    seen = floor_planes(store, config.graph, up_of(config.preprocess), horizon) if config.graph.floor else []
    floors = on_one_plane(seen, poses, distances, config.graph) if config.graph.floor_is_flat else seen
    if seen and not floors:
        inputs.problems.append(
            f"floor: the ground seen from {len(seen)} keyframes is not one plane: it holds no pose "
            "(graph.floor = false looks for none)"
        )
    # Odometry that a smoother estimated knows of the IMU: beside its factors it weighs as much as its points.
    by_points = results if inertial is None else [result.by_points for result in results]
    return PoseGraph(
        poses=poses,
        odometry=odometry_constraints(store.keyframes, by_points, config.graph, fitness),
        loops=loops,
        floors=floors,
        distances=distances,
        ups=ups,
        inertial=inertial,
        world_up=horizon if up is None else up,
    )


# Points of all keyframes, neighbourhoods of that comparison, and parts of the drive whose noise is independent.
POINTS, SAMPLES, PARTS = 400_000, 20_000, 16
# Sigmas by which fixes and control points may disagree.
APART_SIGMAS = 4.0
# From the median absolute deviation to one sigma.
MAD = 1.4826


@dataclass(frozen=True)
class Thickening:
    """Thickness of planes, m, before and after poses were held, and the growth of its square in units of its noise."""

    before: float
    after: float
    sigmas: float

    def is_clear(self, probability: float) -> bool:
        """Whether planes got thicker, by more than chance and by a millimetre at the least that is written."""
        return self.sigmas > np.sqrt(quantile(probability, 1)) and round(self.after, 3) > round(self.before, 3)


def thickening(store: KeyframeStore, without: Floats, final: Floats) -> Thickening | None:
    """Change of the planes' thickness by the `final` poses (K, 4, 4) against the poses `without` (K, 4, 4); None without planes.

    The same neighbourhoods are compared. Errors within a part of the drive are correlated, so that parts give the noise.
    """
    (before, owner), (after, _) = (_plane_variances(store, poses) for poses in (without, final))
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return None
    part = np.unique(owner[both] * PARTS // len(final), return_inverse=True)[1]
    count, grown = np.bincount(part), np.bincount(part, (after - before)[both])
    mean = grown.sum() / count.sum()
    noise = np.sqrt(((grown - mean * count) ** 2).sum()) / count.sum()
    was, is_now = (float(np.sqrt(values[both].mean())) for values in (before, after))
    return Thickening(was, is_now, float(mean / max(noise, 1e-12)))


def thicker_map(change: Thickening | None, held_by: str, probability: float) -> tuple[str, dict[str, Any]]:
    """A sentence where planes are significantly thicker with `held_by` than without, else empty; and both thicknesses, m.

    held_by : what constrains the graph, the subject of the sentence; probability : of the test for significance
    """
    if change is None:
        return "", {}
    facts = {"planes_without_m": round(change.before, 4), "planes_m": round(change.after, 4)}
    if not change.is_clear(probability):
        return "", facts
    return (
        f"{held_by}: planes of the keyframes are {change.after / change.before:.2f} times as thick where the trajectory follows "
        f"them, {change.after:.3f} m in place of {change.before:.3f} m without, {change.sigmas:.1f} sigmas: they contradict the "
        "scans"
    ), facts


def _plane_variances(store: KeyframeStore, poses: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """(Q,) m2, variances about planes of the keyframes' points at `poses`, NaN where these are few; and (Q,) their keyframes."""
    clouds = [store.points(k) for k in range(len(poses))]
    step = 1 + sum(map(len, clouds)) // POINTS
    parts = [se3.apply(T, cloud[::step]) for T, cloud in zip(poses, clouds, strict=True)]
    points, owner = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    queries = slice(None, None, max(1, -(-len(owner) // SAMPLES)))
    return plane_variances(points, points[queries]), owner[queries]


def fixes_against_points(fixes: Fixes, points: Many[ControlPoint], georeference: Georeference) -> str:
    """A sentence where the fixes deviate from the run as the control points place it, horizontally or in height, else empty.

    fixes : with the antenna in the world of the final poses
    """
    places = geodesy.to_local(geodesy.from_local(fixes.positions, fixes.origin), georeference.origin)
    off = places - se3.apply(georeference.T_enu_world, fixes.antenna)
    off = off[np.isfinite(off).all(1) & (np.abs(off) < 1e6).all(1)]
    if not len(off):
        return ""
    middle = np.median(off, axis=0)
    scatter = MAD * np.median(np.abs(off - middle), axis=0)
    # Errors of fixes are correlated: many say no more than one.
    own = np.maximum(np.median(fixes.sigmas, axis=0), scatter)
    sigma = np.hypot(own, np.median([point.sigma for point in points], axis=0))
    aside, sigma_aside = float(np.hypot(*middle[:2])), float(sigma[:2].max())
    texts = []
    if aside > APART_SIGMAS * sigma_aside:
        texts.append(f"{aside:.1f} m aside (one sigma {sigma_aside:.2g} m)")
    if abs(middle[2]) > APART_SIGMAS * sigma[2]:
        texts.append(f"{abs(middle[2]):.1f} m {'above' if middle[2] > 0 else 'below'} (one sigma {sigma[2]:.2g} m)")
    if not texts:
        return ""
    return (
        f"GNSS: fixes and control points disagree: the fixes lie {' and '.join(texts)} of where the points put the run; are CRS, "
        "geoid and datum right?"
    )


def redundancy(survey: Floats, run: Floats, is_level: bool) -> tuple[str, dict[str, Any]]:
    """A sentence about control points without redundancy (two, or the heights of three), and facts for the manifest.

    survey, run : (N, 3) m, of the points by their survey and by odometry
    is_level : whether an IMU measures the vertical
    """
    if len(survey) == 3 and not is_level:
        text = "the heights of three have no redundancy where no IMU tells what is up: a wrong one tilts the drive"
        return f"control points: {text}", {"height_redundancy": 0}
    if len(survey) != 2:
        return "", {}
    there, here = (float(np.linalg.norm(places[1] - places[0])) for places in (survey, run))
    if here <= 0:
        return "", {}
    scale = there / here
    return (
        f"control points: two have no redundancy, nothing but odometry checks them: they lie {there:.2f} m apart, {scale:.4f} "
        "times as far as odometry has them"
    ), {"redundancy": 0, "scale_to_odometry": round(scale, 5)}
