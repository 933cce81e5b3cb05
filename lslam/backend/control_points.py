"""Control points, surveyed positions as factors of the pose graph: what they hold first, and what is left of them."""

from __future__ import annotations

import logging
from collections.abc import Sequence as Many
from dataclasses import replace

import numpy as np

from lslam.backend.fixes import fit_pose
from lslam.backend.georeferencing import LEVELLED, UNLEVELLED, Placement, on_earth
from lslam.backend.graph.fix_errors import heading_change
from lslam.backend.graph.odometry_constraints import odometry_constraints
from lslam.backend.graph.pose_graph import Drift, apply_manual, judge_loops
from lslam.backend.graph.problem import PoseGraph, PositionFix
from lslam.backend.manual import stamp_of
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.errors import GraphError, UsageError
from lslam.core.geometry import geodesy, noise, se3, so3
from lslam.core.geometry.noise import quantile
from lslam.core.geometry.se3 import poses_at
from lslam.core.printable import count_of
from lslam.core.types.constraint import Constraint, ControlPoint, ControlResidual, KnownPair, LoopCandidate
from lslam.core.types.gnss import Georeference
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe
from lslam.maps.georeference import Projection, to_wgs84
from lslam.registration.preprocessing.ground import world_up_of

log = logging.getLogger("lslam")

# rad; with a heading known no better, the points say nothing of which way a run goes.
VAGUE = np.deg2rad(10.0)
# Sentences of one run.
MOST_MESSAGES = 6


def with_control(
    placement: Placement,
    points: Many[ControlPoint],
    results: Many[ScanResult],
    keyframes: Many[Keyframe],
    up: Floats | None,
    config: Config,
) -> Placement:
    """The placement with the control points as fixes that are never rejected; without a georeference, they define it.

    results : at odometry's poses; up : (3,) up in odometry's world by an IMU, None for that of the sensor's mounting
    Returns the placement with a `problem` when the points do not determine a heading.

    Raises UsageError for coordinates that PROJ rejects or that lie nowhere on the Earth.
    """
    survey = _Survey(points, results, config.gnss.geoid)
    on_earth, own = survey.on_earth, survey.own
    sigmas = np.stack([point.sigma for point in points])
    reference = placement.georeference
    if reference is None:
        direction = world_up_of(config.preprocess, results[0].T_world_lidar) if up is None else up
        level = so3.least_rotation(direction, np.array([0.0, 0.0, 1.0]))
        enu = geodesy.to_local(on_earth, on_earth[0])
        T = _align_level(own @ level.T, enu, sigmas)
        if T is None:
            return replace(
                placement,
                problem=f"control points: from {count_of(len(points), 'place')} nobody can say which way the run goes; it "
                "takes two that lie apart",
            )
        tilt = LEVELLED if up is not None else UNLEVELLED
        T = fit_pose(T, own @ level.T, enu, sigmas, tilt)  # a slope under the first scan is no drift of odometry
        T_enu_world = T @ se3.make(level, np.zeros(3))
        reference = _in_crs(Georeference(on_earth[0], T_enu_world, method="control"), points, config)
    else:
        enu, tilt = geodesy.to_local(on_earth, reference.origin), placement.tilt_sigma
        reference = reference if reference.epsg else _in_crs(reference, points, config)
    fixes = [
        _position_fix(position, sigma, place, int(stamp), results, keyframes)
        for position, sigma, place, stamp in zip(enu, sigmas, own, survey.stamps, strict=True)
    ]
    return replace(placement, georeference=reference, fixes=(*placement.fixes, *fixes), tilt_sigma=tilt)


def _position_fix(
    position: Floats, sigma: Floats, own: Floats, stamp_ns: int, results: Many[ScanResult], keyframes: Many[Keyframe]
) -> PositionFix:
    """Position factor of a control point, interpolated between the keyframes before and after its instant.

    position, sigma : (3,) m, of the survey; own : (3,) m, the point in the LiDAR frame
    """
    stamps = [k.stamp_ns for k in keyframes]
    owner = int(np.clip(np.searchsorted(stamps, stamp_ns, side="right") - 1, 0, len(stamps) - 2))
    share = float(np.clip((stamp_ns - stamps[owner]) / (stamps[owner + 1] - stamps[owner]), 0.0, 1.0))
    arms = [se3.apply(se3.inverse(results[keyframes[k].scan].T_world_lidar), own[None])[0] for k in (owner, owner + 1)]
    return PositionFix(owner, position, sigma, arms[0], is_binding=True, share=share, next_arm=arms[1])


def control_residuals(
    points: Many[ControlPoint], results: Many[ScanResult], georeference: Georeference, geoid: str = ""
) -> list[ControlResidual]:
    """Residuals of the points at the final poses."""
    survey = _Survey(points, results, geoid)
    there = geodesy.to_local(survey.on_earth, georeference.origin)
    off = there - se3.apply(georeference.T_enu_world, survey.own)
    return [ControlResidual(*one) for one in zip(points, survey.stamps.tolist(), off, survey.on_earth, strict=True)]


def against_odometry(
    points: Many[ControlPoint],
    results: Many[ScanResult],
    keyframes: Many[Keyframe],
    drift: Drift,
    probability: float,
    geoid: str = "",
) -> list[str]:
    """One sentence for each pair of successive points whose distance differs from odometry's by more than it may drift.

    Distances need no heading. A trajectory bends to a wrong point without a residual, so only odometry reveals the error.
    drift : odometry's uncertainty; probability : of the chi-square quantile that a difference must exceed
    geoid : grid by which heights of the points are made ellipsoidal, or empty
    """
    if len(points) < 2 or len(keyframes) < 2:
        return []
    survey = _Survey(points, results, geoid)
    order = np.argsort(survey.stamps, kind="stable")
    there, seen = survey.on_earth[order], survey.own[order]
    enu = geodesy.to_local(there, there[0])
    nearest = np.abs(np.array([k.stamp_ns for k in keyframes]) - survey.stamps[order][:, None]).argmin(1)
    own = np.array([float((points[i].sigma ** 2).max()) for i in order])
    sigma = np.sqrt(drift.covariance(nearest[:-1], nearest[1:])[:, 0, 0] + own[:-1] + own[1:])
    off = np.linalg.norm(np.diff(enu, axis=0), axis=1) - np.linalg.norm(np.diff(seen, axis=0), axis=1)
    times = np.abs(off) / (float(np.sqrt(quantile(probability, 1))) * sigma)
    names = [points[i].at.source for i in order]
    texts = [
        f"{names[k]} and {names[k + 1]}: the control points are {abs(off[k]):.2f} m "
        f"{'farther apart' if off[k] > 0 else 'nearer to each other'} than odometry has them, {times[k]:.1f} times what it may "
        "drift: they hold, are scan, sigma and CRS right?"
        for k in np.flatnonzero(times > 1).tolist()
    ]
    return _some(texts, "pairs of control points")


def control_positions(points: Many[ControlPoint], results: Many[ScanResult], geoid: str = "") -> tuple[Floats, Floats]:
    """(N, 3) m, of the points by their survey, east, north, up from the first, and by the results, in their world."""
    survey = _Survey(points, results, geoid)
    return geodesy.to_local(survey.on_earth, survey.on_earth[0]), survey.own


def control_facts(residuals: Many[ControlResidual]) -> dict[str, float]:
    """Number, rms (m) and largest normalised residual of the control points, for the manifest."""
    off = np.stack([one.residual for one in residuals])
    return {
        "count": len(residuals),
        "rms_horizontal_m": round(float(np.sqrt((off[:, :2] ** 2).sum(1).mean())), 4),
        "rms_vertical_m": round(float(np.sqrt((off[:, 2] ** 2).mean())), 4),
        "worst_sigmas": round(max(one.size for one in residuals), 2),
    }


def contradicting(residuals: Many[ControlResidual], probability: float) -> list[str]:
    """Sentence for each control point, kept in use, whose residual's chi2 lies beyond the quantile at `probability`."""
    limit = float(np.sqrt(quantile(probability, 3)))
    wrong = sorted((one for one in residuals if one.size > limit), key=lambda one: -one.size)
    texts = [
        f"{one.point.at.source}: the control point is left off by {np.linalg.norm(one.residual):.2f} m, {one.size:.1f} sigmas: "
        "is it the right scan, sigma and CRS?"
        for one in wrong
    ]
    return _some(texts, "control points: see control.csv")


def _some(texts: list[str], what: str) -> list[str]:
    """The first few of many sentences, and one that counts the others; what : plural noun for them."""
    more = len(texts) - MOST_MESSAGES
    return [*texts[:MOST_MESSAGES], f"and {more} more {what}"] if more > 0 else texts


class _Survey:
    """Control points as they were surveyed, and where results have them.

    on_earth : (N, 3) lat, lon (deg), height (m); stamps : (N,) ns; own : (N, 3) m, in the world of the results
    """

    def __init__(self, points: Many[ControlPoint], results: Many[ScanResult], geoid: str) -> None:
        self.on_earth = np.concatenate([to_wgs84(p.position[None], p.epsg, p.height_epsg, geoid) for p in points])
        self.stamps = np.array([stamp_of(point.at, results) for point in points])
        stamps, poses = np.array([r.stamp_ns for r in results]), np.stack([r.T_world_lidar for r in results])
        at, arms = poses_at(stamps, poses, self.stamps), np.stack([p.point_lidar for p in points])
        self.own: Floats = np.einsum("nij,nj->ni", at[:, :3, :3], arms) + at[:, :3, 3]


def _align_level(own: Floats, enu: Floats, sigmas: Floats) -> Floats | None:
    """Least-squares heading and translation (4, 4) from level points `own` to `enu` (N, 3); None where the heading is vague."""
    weights = 1.0 / sigmas[:, 0] ** 2
    weights /= weights.sum()
    a, b = (points - weights @ points for points in (own, enu))
    spread = weights @ (a[:, :2] ** 2).sum(1)
    if float(np.sqrt((weights @ sigmas[:, 0] ** 2) / len(own))) > VAGUE * float(np.sqrt(spread)):
        return None
    R = so3.exp(np.array([0.0, 0.0, heading_change(a, b, weights)]))
    return se3.make(R, weights @ enu - R @ (weights @ own))


def _in_crs(georeference: Georeference, points: Many[ControlPoint], config: Config) -> Georeference:
    """Georeference with the CRS of the outputs: the configured one, else that of the points if it is a projection in metres."""
    crs, height_crs, geoid = config.gnss.crs, config.gnss.height_crs, config.gnss.geoid
    configured = replace(georeference, epsg=crs, height_epsg=height_crs, geoid=geoid)
    codes = {(point.epsg, point.height_epsg) for point in points}
    if crs is not None or height_crs is not None or len(codes) > 1:
        return configured
    epsg, height_epsg = codes.pop()
    given = replace(configured, epsg=epsg, height_epsg=height_epsg)
    try:
        Projection(given).check()
    except UsageError:
        return configured
    return given


def place_keyframes(
    keyframes: list[Keyframe],
    pairs: list[LoopCandidate],
    points: Many[ControlPoint],
    results: list[ScanResult],
    config: Config,
) -> list[Keyframe]:
    """The keyframes at the poses that odometry, known pairs and control points imply; loop search starts from these.

    Unchanged where there are neither pairs nor points, or where the graph of these cannot be solved.
    """
    loops = [c.constraint for c in pairs if c.is_accepted and c.constraint is not None]
    if len(keyframes) < 2 or not (loops or points):
        return keyframes
    graph, R = _graph_of(keyframes, loops, results, config), np.eye(3)
    if points:
        placement = with_control(Placement(), points, results, keyframes, None, config)
        if placement.georeference is not None:
            graph, R = on_earth(graph, placement), placement.georeference.T_enu_world[:3, :3]
    try:
        poses = apply_manual(graph, config.graph).poses
    except (GraphError, np.linalg.LinAlgError) as error:
        log.debug("known pairs and control points alone: %s", error)  # said where all of it is solved
        return keyframes
    return [
        replace(k, T_world_lidar=T, covariance=None if k.covariance is None else noise.rotate(k.covariance, R))
        for k, T in zip(keyframes, poses, strict=True)
    ]


def doubts(
    keyframes: list[Keyframe],
    candidates: list[LoopCandidate],
    pairs: Many[KnownPair],
    results: list[ScanResult],
    config: Config,
) -> list[str]:
    """One sentence for each known pair that fails to register, and for each that odometry contradicts but that stays in use."""
    texts = [
        f"{pair.source}: the scans of the known pair do not close a loop: {candidate.reason}"
        for pair, candidate in zip(pairs, candidates, strict=True)
        if not candidate.is_accepted
    ]
    held = [
        (p, c.constraint) for p, c in zip(pairs, candidates, strict=True) if c.is_accepted and c.constraint is not None
    ]
    if held:
        graph = _graph_of(keyframes, [constraint for _, constraint in held], results, config)
        reasons = judge_loops(graph, config.graph)
        texts += [
            f"{pair.source}: the known pair holds, though {reason}"
            for (pair, _), reason in zip(held, reasons, strict=True)
            if reason
        ]
    return texts


def _graph_of(
    keyframes: list[Keyframe], loops: list[Constraint], results: list[ScanResult], config: Config
) -> PoseGraph:
    """Pose graph of odometry and `loops` alone."""
    return PoseGraph(
        poses=np.stack([k.T_world_lidar for k in keyframes]),
        odometry=odometry_constraints(keyframes, results, config.graph, None),
        loops=loops,
        distances=np.array([k.distance for k in keyframes]),
    )
