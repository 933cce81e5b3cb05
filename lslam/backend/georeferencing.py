"""GNSS fixes of a run: its georeference, and position factors for the pose graph."""

from __future__ import annotations

import logging
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.fixes import (
    Faults,
    Fixes,
    GnssAlignment,
    align_fixes,
    clock_of,
    describe_clock,
    on_clock_of_scans,
    with_actual_sigmas,
)
from lslam.backend.graph.drift import chains, drift_covariance
from lslam.backend.graph.fix_noise import DriftOfFixes, GaussMarkovNoise, fit_gauss_markov
from lslam.backend.graph.problem import PoseGraph, PositionFix
from lslam.core.arrays import Floats
from lslam.core.config.backend import GnssConfig, GraphConfig
from lslam.core.config.config import Config
from lslam.core.errors import InputError
from lslam.core.geometry import geodesy, noise, se3, so3
from lslam.core.geometry.noise import RIGHT_PROBABILITY, quantile
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.gnss import Georeference, GnssStream
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Keyframe
from lslam.maps.georeference import Projection
from lslam.registration.preprocessing.ground import world_up_of

log = logging.getLogger("lslam")

# m; of a fix that does not state its sigma.
USUAL_SIGMA_M = 5.0
# m; least sigma of a fix, and by how much heights are worse than positions.
MIN_SIGMA_M, VERTICAL_RATIO = 0.02, 1.8
# m; a fix that states more is left out: odometry errs by as much in two kilometres.
MAX_SIGMA_M = 20.0
# With fewer fixes that agree there is no georeference.
MIN_FIXES = 5
# rad; one sigma of the z axis against up, of a world that nothing levelled and of one levelled by an IMU.
UNLEVELLED, LEVELLED = np.deg2rad(10.0), np.deg2rad(1.0)
# Sigmas (noise and drift) beyond which a fix is no outlier candidate of the graph but left out.
ABSURD = 20.0
# m; beyond noise and multipath: a lost sign.
ELSEWHERE = 1e5
# Significance of too many rejected fixes, or of one too far away, under the null hypothesis that all are sound; and the
# probability with which `align` rejects a sound one.
CHANCE, FALSE_REJECTION = 1e-5, 1e-3
# Share of the fixes from which a group of outliers is as plausible as the inliers.
AMBIGUOUS = 0.4


@dataclass(frozen=True)
class Placement:
    """A georeference and, for the graph, position factors of the fixes with their correlated noise.

    walk : factor on odometry's random-walk drift, estimated from the fixes
    tilt_sigma : rad, of the tilt that the georeference gives the first pose
    problem : why there is none, or what was left out
    faults : what is wrong with the fixes beside, and was set right
    """

    georeference: Georeference | None = None
    fixes: tuple[PositionFix, ...] = ()
    fix_noise: GaussMarkovNoise | None = None
    walk: float = 0.0
    problem: str = ""
    tilt_sigma: float = PoseGraph.tilt_sigma
    faults: Faults = field(default_factory=Faults)


def require_gnss(sequence: Sequence, config: GnssConfig) -> None:
    """Raise InputError when fixes are wanted of a sequence that has none: before odometry, not after.

    UsageError when the result is wanted in coordinates that no map can be written in.
    """
    if config.mode == "off":
        return
    if sequence.gnss is None or not len(sequence.gnss):
        flag = "--gnss" if config.mode == "graph" else "--georeference"
        raise InputError(
            f"{sequence.path} has no satellite fixes: name their file with `gnss` in sequence.toml, or run without {flag}"
        )
    places = sequence.gnss.lat_lon_alt[sequence.gnss.is_place]
    if len(places):
        require_crs(np.median(places, axis=0), config)


def require_crs(origin: Floats, config: GnssConfig) -> None:
    """Raise UsageError when results about `origin`, lat, lon (deg), height (m), are wanted in coordinates of no map."""
    if config.crs is not None or config.height_crs is not None or config.geoid:
        place = Georeference(origin, np.eye(4), config.crs, height_epsg=config.height_crs, geoid=config.geoid)
        Projection(place).check()


def place(
    sequence: Sequence,
    results: Many[ScanResult],
    keyframes: Many[Keyframe],
    up: Floats | None,
    graph: PoseGraph,
    config: Config,
) -> Placement:
    """Fit the run's trajectory to its fixes: the placement with georeference and position factors, or with the `problem`.

    up : (3,) up in the world of the trajectory by an IMU, or None; graph : of the keyframes, without the fixes
    """
    stream = sequence.gnss
    assert stream is not None
    arm = _antenna(sequence)
    mounted = world_up_of(config.preprocess, results[0].T_world_lidar)
    direction, sigma = (mounted, UNLEVELLED) if up is None else (up, LEVELLED)
    level = so3.least_rotation(direction, np.array([0.0, 0.0, 1.0]))
    fixes, faults = _on_one_clock(stream, results, arm, level, config)
    if isinstance(fixes, str):
        return Placement(problem=fixes)
    fixes, faults = with_actual_sigmas(fixes, level, MAX_SIGMA_M, RIGHT_PROBABILITY, faults)
    alignment, fixes, faults = align_fixes(fixes, direction, sigma, MIN_FIXES, faults)
    if alignment is None:
        return Placement(
            faults=faults,
            problem=f"GNSS: no place and heading on the Earth fits half of {fixes.count} fixes, and "
            f"{MIN_FIXES} at the least: all rejected",
        )
    georeference, shift = _at_first(alignment, fixes, config.gnss)
    log.info(
        "GNSS: %d of %d fixes are inliers, %.2f m rms from the antenna horizontally, %.2f m vertically",
        georeference.used,
        georeference.fixes,
        georeference.rmse_horizontal,
        georeference.rmse_vertical,
    )
    fix_noise, walk = None, 0.0
    if config.gnss.mode == "graph":
        fix_noise, walk = _fix_noise(fixes, alignment, keyframes, graph, config)
    factors = _as_factors(fixes, alignment, shift, results, keyframes, fix_noise)
    problem = _elsewhere(alignment) or describe_outliers(alignment, fixes)
    return Placement(georeference, factors, fix_noise, walk, problem, faults=faults)


def on_earth(graph: PoseGraph, placement: Placement) -> PoseGraph:
    """The graph in east, north, up, anchored by its fixes instead of its first pose."""
    assert placement.georeference is not None
    T = placement.georeference.T_enu_world
    spread = None if graph.spread is None else noise.rotate(graph.spread, T[:3, :3])
    up = np.array([0.0, 0.0, 1.0])
    return replace(
        graph,
        poses=T @ graph.poses,
        fixes=placement.fixes,
        world_up=up,
        is_anchored=False,
        spread=spread,
        fix_noise=placement.fix_noise,
        walk=max(graph.walk, placement.walk),
        tilt_sigma=placement.tilt_sigma,
    )


def final_fixes(sequence: Sequence, results: Many[ScanResult], config: Config) -> Fixes | None:
    """The usable fixes of a recording with the antenna at its final poses, whether the run used them or not.

    None where too few are usable.
    """
    assert sequence.gnss is not None
    fixes = _usable(sequence.gnss, results, _antenna(sequence), config.gnss, config.graph)
    return None if isinstance(fixes, str) else fixes


def _antenna(sequence: Sequence) -> Floats:
    """(3,) m, antenna position in the LiDAR frame; zero where the calibration lacks it."""
    T_lidar_gnss = sequence.calibration.T_lidar_gnss
    return np.zeros(3) if T_lidar_gnss is None else T_lidar_gnss[:3, 3]


def _on_one_clock(
    stream: GnssStream, results: Many[ScanResult], arm: Floats, level: Floats, config: Config
) -> tuple[Fixes | str, Faults]:
    """The usable fixes, or the reason for too few, after correction of a significant clock offset; with the faults found."""
    fixes = _usable(stream, results, arm, config.gnss, config.graph)
    if isinstance(fixes, str):
        return fixes, Faults()
    stamps, poses = np.array([r.stamp_ns for r in results]), np.stack([r.T_world_lidar for r in results])
    offset = clock_of(fixes, stamps, poses, arm, level)
    again = (
        fixes if offset is None else _usable(on_clock_of_scans(stream, offset), results, arm, config.gnss, config.graph)
    )
    if offset is None or isinstance(again, str):
        return fixes, Faults()
    facts = {"seconds": round(-offset.seconds, 3), "sigma_s": round(offset.sigma, 3)}
    return again, Faults().and_another(describe_clock(offset), fixes_late=facts)


def _usable(
    stream: GnssStream, results: Many[ScanResult], arm: Floats, config: GnssConfig, drift: GraphConfig
) -> Fixes | str:
    """The fixes of the run with a position and a sigma of at most `MAX_SIGMA_M`; or a sentence why there are too few."""
    stamps = np.array([r.stamp_ns for r in results], np.int64)
    stated = np.full(len(stream), config.sigma) if config.sigma is not None else stream.sigma
    stated = np.maximum(np.where(np.isfinite(stated) & (stated > 0), stated, USUAL_SIGMA_M), MIN_SIGMA_M)
    inside = (stream.stamps_ns >= stamps[0]) & (stream.stamps_ns <= stamps[-1])
    good = inside & stream.is_place & (stated <= MAX_SIGMA_M)
    count = int(inside.sum())
    if len(stamps) < 2 or good.sum() < MIN_FIXES:
        return (
            f"GNSS: {int(good.sum())} of {len(stream)} fixes were taken during the run, are places and state at most "
            f"{MAX_SIGMA_M:g} m; {MIN_FIXES} are needed"
        )
    poses = np.stack([r.T_world_lidar for r in results])
    at = poses_at(stamps, poses, stream.stamps_ns[good])
    origin = np.median(stream.lat_lon_alt[good], axis=0)
    # Where the projection ends there is no position: far from where most fixes are.
    with np.errstate(all="ignore"):
        positions = geodesy.to_local(stream.lat_lon_alt[good], origin)
    positions[~np.isfinite(positions).all(1)] = 1e9
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    travelled = np.interp(stream.stamps_ns[good], stamps, way)
    slack = 0.01 * drift.drift_percent * np.abs(travelled - 0.5 * way[-1])
    sigmas = stated[good, None] * [1.0, 1.0, VERTICAL_RATIO]
    antenna = np.einsum("fij,j->fi", at[:, :3, :3], arm) + at[:, :3, 3]
    is_stated = config.sigma is None and bool((np.isfinite(stream.sigma) & (stream.sigma > 0))[good].all())
    return Fixes(stream.stamps_ns[good], positions, sigmas, antenna, slack, origin, count, is_stated)


def _at_first(alignment: GnssAlignment, fixes: Fixes, config: GnssConfig) -> tuple[Georeference, Floats]:
    """The georeference with its origin at the first inlier fix, and that shift of origin, (4, 4)."""
    first = fixes.positions[int(np.argmax(alignment.inliers))]
    origin = geodesy.from_local(first[None], fixes.origin)[0]
    shift = geodesy.frame_change(fixes.origin, origin)
    residuals = alignment.residuals[alignment.inliers]
    heights = alignment.residuals[alignment.inliers & fixes.has_height, 2]
    return Georeference(
        origin=origin,
        T_enu_world=shift @ alignment.T_enu_world,
        epsg=config.crs,
        method="graph" if config.mode == "graph" else "fit",
        fixes=fixes.count,
        used=int(alignment.inliers.sum()),
        rmse_horizontal=float(np.sqrt((residuals[:, :2] ** 2).sum(1).mean())),
        rmse_vertical=float(np.sqrt((heights**2).mean())) if len(heights) else float("nan"),
        height_epsg=config.height_crs,
        geoid=config.geoid,
    ), shift


def _elsewhere(alignment: GnssAlignment) -> str:
    """A sentence about fixes more than `ELSEWHERE` m from the others; empty without such fixes."""
    away = int((np.linalg.norm(alignment.residuals, axis=1) > ELSEWHERE).sum())
    if not away:
        return ""
    return (
        f"GNSS: {away} of {len(alignment.residuals)} fixes lie more than {ELSEWHERE / 1e3:g} km from the others and are left "
        "out: has their latitude or longitude lost its sign?"
    )


def describe_outliers(alignment: GnssAlignment, fixes: Fixes) -> str:
    """A sentence about fixes that odometry rejects, and whether they agree with each other; empty where insignificant."""
    from scipy.special import bdtrc, chdtrc

    wrong = np.flatnonzero(~alignment.inliers)
    n, k = len(alignment.residuals), len(wrong)
    if not k:
        return ""
    sigmas = np.hypot(fixes.sigmas, fixes.slack[:, None])
    farthest = float(((alignment.residuals / sigmas)[wrong] ** 2).sum(1).max())
    if bdtrc(k - 1, n, FALSE_REJECTION) > CHANCE and n * chdtrc(3, farthest) > CHANCE:
        return ""
    off = alignment.residuals[wrong]
    middle = np.median(off, axis=0)
    worst = wrong[int(np.argmax(np.linalg.norm(off, axis=1)))]
    text = (
        f"GNSS: odometry contradicts {k} of {n} fixes, the farthest by {np.linalg.norm(alignment.residuals[worst]):.1f} m, "
        f"{(fixes.stamps_ns[worst] - fixes.stamps_ns[0]) * 1e-9:.1f} s after the first"
    )
    is_together = (((off - middle) / sigmas[wrong]) ** 2).sum(1) <= quantile(1.0 - FALSE_REJECTION, 3)
    first, last = int(wrong[0]), int(wrong[-1])
    if k < 3 or is_together.mean() < 0.8 or last - first + 1 != k or (first > 0 and last < n - 1):
        return f"{text}: they are left out, look at their receiver or state their true sigmas"
    where = "before" if first == 0 else "from then on"
    at = first if first > 0 else last + 1
    text = (
        f"GNSS: all fixes jump by {np.linalg.norm(middle):.1f} m together "
        f"{(fixes.stamps_ns[at] - fixes.stamps_ns[0]) * 1e-9:.1f} s after the first, where odometry does not: the {k} of {n} "
        f"{where} are left out"
    )
    return text + (", but they may as well be the right ones" if k >= AMBIGUOUS * n else "")


def _fix_noise(
    fixes: Fixes, alignment: GnssAlignment, keyframes: Many[Keyframe], graph: PoseGraph, config: Config
) -> tuple[GaussMarkovNoise | None, float]:
    """Correlated noise of the fixes and factor on odometry's drift, from the inliers; neither without stated sigmas."""
    good = alignment.inliers
    if not (fixes.has_stated_sigmas or fixes.is_overconfident):
        return None, 0.0
    constant, unit = (noise.rotate(chain, alignment.T_enu_world[:3, :3]) for chain in chains(graph, config.graph))
    metre = drift_covariance(1.0, config.graph)
    places = se3.apply(alignment.T_enu_world, graph.poses[:, :3, 3])
    drift = DriftOfFixes(constant + graph.walk * unit, unit, places, metre, _owners(fixes, keyframes)[good])
    fix_noise, walk = fit_gauss_markov(
        1e-9 * (fixes.stamps_ns[good] - fixes.stamps_ns[0]),
        alignment.residuals[good],
        fixes.sigmas[good],
        (fixes.positions - alignment.residuals)[good],
        RIGHT_PROBABILITY,
        drift,
        MAX_SIGMA_M if fixes.is_overconfident else None,
    )
    if fix_noise is not None:
        log.info(
            "GNSS: errors of fixes are correlated: noise of %.2f m over %.0f s is estimated",
            fix_noise.sigma[0],
            fix_noise.memory,
        )
    if walk > 0:
        log.info(
            "GNSS: odometry drifts by more than its covariances, by about %.2f m after 100 m",
            np.sqrt(walk * drift_covariance(100.0, config.graph)[0, 0]),
        )
    return fix_noise, walk


def _owners(fixes: Fixes, keyframes: Many[Keyframe]) -> NDArray[np.intp]:
    """(F,) index of the keyframe before each fix."""
    stamps = np.array([k.stamp_ns for k in keyframes], np.int64)
    return np.clip(np.searchsorted(stamps, fixes.stamps_ns, side="right") - 1, 0, None)


def _as_factors(
    fixes: Fixes,
    alignment: GnssAlignment,
    shift: Floats,
    results: Many[ScanResult],
    keyframes: Many[Keyframe],
    fix_noise: GaussMarkovNoise | None,
) -> tuple[PositionFix, ...]:
    """Position factors on keyframes, without gross outliers; shift : (4, 4) from the fixes' frame to the georeference's."""
    near = np.linalg.norm(alignment.residuals / np.hypot(fixes.sigmas, fixes.slack[:, None]), axis=1) < ABSURD
    owners = _owners(fixes, keyframes)
    positions = se3.apply(shift, fixes.positions)
    seconds = 1e-9 * (fixes.stamps_ns - fixes.stamps_ns[0])
    out = []
    for i in np.flatnonzero(near).tolist():
        keyframe = keyframes[int(owners[i])]
        antenna = se3.apply(se3.inverse(results[keyframe.scan].T_world_lidar), fixes.antenna[i][None])[0]
        instant = None if fix_noise is None else int(np.argmin(np.abs(fix_noise.seconds - seconds[i])))
        out.append(PositionFix(keyframe.number, positions[i], fixes.sigmas[i], antenna, instant))
    return tuple(out)
