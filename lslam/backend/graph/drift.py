"""Scale of odometry's drift beyond its covariances, estimated from loop closures and fixes.

The covariance of a registration models noise, not systematic errors (range bias, calibration), which accumulate. Loop closures
observe the sum: the drift factor is that with which the median residual has its expected size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.problem import PoseGraph, PositionFix
from lslam.core.arrays import Floats
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.geometry.noise import RIGHT_PROBABILITY, chance_of_median, quantile, squared_distances
from lslam.core.types.constraint import Constraint

# Loop closures used at most, evenly spread, and bounds of the factor on the drift's variance.
MOST, SMALLEST, LARGEST = 300, 1e-8, 1e8
# m, correlation length of a rate.
MEMORY_M = 100.0
# Hyperparameters tried: share of the variance of rates that is constant over the run, and scale of the configured drift.
LASTING, SIZES = (0.5, 0.9, 0.99), (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


def drift_covariance(way: float, config: GraphConfig) -> Floats:
    """(6, 6) covariance of odometry's drift over `way` m as a random walk, at factor 1.

    The sigmas are in the ratio of `drift_percent` to `drift_deg_per_100m`. The variance is proportional to the way.
    """
    turn = np.deg2rad(config.drift_deg_per_100m) / 100
    return np.diag(np.repeat([(0.01 * config.drift_percent) ** 2 * way, turn**2 * way], 3))


def with_drift(graph: PoseGraph, factor: float, config: GraphConfig) -> list[Constraint]:
    """The graph's odometry with `factor` times the drift added to its covariances; zero covariances where it is rigid."""
    if graph.is_rigid:
        return [replace(c, covariance=np.zeros((6, 6))) for c in graph.odometry]
    if factor == 0:
        return list(graph.odometry)
    unit = factor * drift_covariance(1.0, config)
    return [replace(c, covariance=c.covariance + _length(c) * unit) for c in graph.odometry]


def drift_factor(graph: PoseGraph, loops: Sequence[Constraint], config: GraphConfig) -> float:
    """Factor on odometry's drift covariance with which the median residual has its expected size; 0 where none is needed.

    Fixes and walls of a map are much noisier than odometry, so they count only where their median is significant. The factor is
    at least `tilt_factor`.
    """
    on_map = _as_fixes(graph)
    if not loops and max(len(graph.fixes), len(on_map)) < 2 and not graph.ups:
        return 0.0
    noise, drift = chains(graph, config)
    by_loops = _of_loops(graph, loops, noise, drift) if loops else 0.0
    # Where the noise of fixes was estimated, odometry's drift was beside it: `graph.walk`.
    fixes = graph.fixes if graph.fix_noise is None else ()
    by_fixes = _of_fixes(graph.poses, fixes, 3, noise, drift, RIGHT_PROBABILITY)
    by_map = _of_fixes(graph.poses, on_map, 2, noise, drift, RIGHT_PROBABILITY)
    return max(by_loops, by_fixes, by_map, _of_ups(graph, noise, drift, config))


def tilt_factor(graph: PoseGraph, config: GraphConfig) -> float:
    """Factor on odometry's drift, as `drift_factor`, by the up directions alone: 0 unless a tilt of odometry is significant."""
    return _of_ups(graph, *chains(graph, config), config) if graph.ups else 0.0


def chains(graph: PoseGraph, config: GraphConfig) -> tuple[Floats, Floats]:
    """Covariances (K, 6, 6) of the keyframes' poses by odometry's own noise, and by drift of factor 1.

    Both accumulate from the first keyframe on.
    """
    steps = [c for c in graph.odometry if c.b == c.a + 1]
    b, own = np.array([c.b for c in steps], np.intp), np.array([c.covariance for c in steps]).reshape(-1, 6, 6)
    lengths = np.array([_length(c) for c in steps])
    drifting = lengths[:, None, None] * drift_covariance(1.0, config)
    return _accumulate(graph.poses, b, own), _accumulate(graph.poses, b, drifting)


def _as_fixes(graph: PoseGraph) -> list[PositionFix]:
    """Planar priors that observe both coordinates, as positions; their height is meaningless."""
    out = []
    for prior in graph.map_priors:
        if prior.rank == 3:
            sigma = np.sqrt(np.diag(np.linalg.inv(prior.information)) + graph.map_sigma**2)
            place, spread = np.array([*prior.pose[:2], 0.0]), np.array([*sigma[:2], np.inf])
            out.append(PositionFix(prior.keyframe, place, spread, np.zeros(3)))
    return out


def _accumulate(poses: Floats, b: NDArray[np.intp], own: Floats) -> Floats:
    """Covariances (K, 6, 6) of all poses from those of single steps.

    b, own : (P,) keyframe at the end of each step, and (P, 6, 6) its covariance relative to the keyframe before
    """
    # About one point the covariances of all steps add up.
    about_origin = np.zeros((len(poses), 6, 6))
    about_origin[b] = noise.transport(noise.rotate(own, poses[b - 1, :3, :3]), -poses[b, :3, 3])
    return noise.transport(np.cumsum(about_origin, axis=0), poses[:, :3, 3])


def _between(chain: Floats, poses: Floats, a: NDArray[np.intp], b: NDArray[np.intp]) -> Floats:
    """Covariances (P, 6, 6) of keyframes `b` relative to `a`, world axes, by those of `chains`."""
    return np.asarray(chain[b] - noise.transport(chain[a], poses[b, :3, 3] - poses[a, :3, 3]))


def _of_loops(graph: PoseGraph, loops: Sequence[Constraint], white: Floats, drift: Floats) -> float:
    """Drift factor by the residuals of loop closures; white, drift : (K, 6, 6) covariances of the chains of `chains`."""
    few = [loops[i] for i in np.unique(np.linspace(0, len(loops) - 1, MOST).round().astype(int))]
    a, b = np.array([c.a for c in few]), np.array([c.b for c in few])
    T = np.stack([c.T_a_b for c in few])
    R_a = graph.poses[a, :3, :3]
    error = noise.changes(se3.relative(graph.poses[a], graph.poses[b]), T)
    own, grown = (
        noise.rotate(_between(chain, graph.poses, a, b), np.swapaxes(R_a, -1, -2)) for chain in (white, drift)
    )
    return _fitting(error, own + np.stack([c.covariance for c in few]), grown)


def _of_fixes(
    poses: Floats, fixes: Sequence[PositionFix], dim: int, white: Floats, drift: Floats, probability: float
) -> float:
    """Drift factor by pairs of fixes, half the fixes apart: their displacement minus odometry's, along `dim` axes.

    white, drift : (K, 6, 6) as of `chains`
    probability : of the median under the null hypothesis, below which the factor is 0
    """
    half = len(fixes) // 2
    if not half:
        return 0.0
    first = np.unique(np.linspace(0, len(fixes) - half - 1, MOST).round().astype(int))
    k = np.array([f.keyframe for f in fixes])
    arms = np.stack([f.arm for f in fixes])
    antenna = np.einsum("fij,fj->fi", poses[k, :3, :3], arms) + poses[k, :3, 3]
    off = (np.stack([f.position for f in fixes]) - antenna)[:, :dim]
    own = np.stack([f.sigma for f in fixes])[:, :dim] ** 2
    a, b = k[first], k[first + half]
    noise_of_pair = (own[first] + own[first + half])[:, :, None] * np.eye(dim)
    moved, grown = (_between(chain, poses, a, b)[:, :dim, :dim] for chain in (white, drift))
    error, known_of_pair = off[first + half] - off[first], moved + noise_of_pair
    median = float(np.median(squared_distances(error, known_of_pair)))
    if chance_of_median(median, dim, len(first)) < probability:
        return 0.0
    return _fitting(error, known_of_pair, grown)


def _of_ups(graph: PoseGraph, white: Floats, drift: Floats, config: GraphConfig) -> float:
    """Drift factor by the tilts of all measured up directions in odometry's world, relative to the first.

    Gravity is mostly less accurate than odometry: only a significant tilt counts.
    """
    keyframes, ups, variances = _measurements(graph)
    count = len(ups) - 1
    if count < 1:
        return 0.0
    level = np.linalg.svd(graph.world_up[None])[2][1:]
    tilt = (np.cross(ups[0], ups[1:]) @ level.T).reshape(1, -1)
    shared = np.minimum.outer(np.arange(count), np.arange(count))

    def together(chain: Floats) -> Floats:
        """Of all tilts, (1, 2 M, 2 M): two of them share the way to the earlier one."""
        single = level @ (chain[keyframes[1:], 3:, 3:] - chain[keyframes[0], 3:, 3:]) @ level.T
        return np.asarray(single[shared].swapaxes(1, 2).reshape(1, 2 * count, 2 * count))

    own = together(white) + np.kron(np.diag(variances[1:]) + variances[0], np.eye(2))
    surprise = float(tilt[0] @ np.linalg.solve(own[0], tilt[0]))
    return _fitting(tilt, own, together(drift)) if surprise > quantile(RIGHT_PROBABILITY, 2 * count) else 0.0


def _measurements(graph: PoseGraph) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Up directions that are one measurement each: keyframe, (M, 3) in the world of odometry, rad2."""
    shares = np.array([u.share for u in graph.ups])
    number = (np.cumsum(shares) - 0.5 * shares).astype(int)
    keyframes, ups, variances = [], [], []
    for n in np.unique(number):
        stretch = [u for u, m in zip(graph.ups, number, strict=True) if m == n]
        part = sum(u.share for u in stretch)
        mean = np.sum([graph.poses[u.keyframe, :3, :3] @ u.up for u in stretch], axis=0)
        keyframes.append(stretch[len(stretch) // 2].keyframe)
        ups.append(mean / np.linalg.norm(mean))
        variances.append(float(np.mean([u.sigma**2 for u in stretch])) / min(part, 1.0))
    return np.array(keyframes, np.intp), np.array(ups).reshape(-1, 3), np.array(variances)


def _fitting(error: Floats, own: Floats, drift: Floats) -> float:
    """The factor on the covariances `drift` with which the median of the errors has its expected size.

    error : (P, n); own, drift : (P, n, n), covariance without drift, and of drift of factor 1
    0 where `own` is enough, and `LARGEST` at most.
    """
    typical = quantile(0.5, error.shape[1])

    def is_enough(factor: float) -> bool:
        return bool(np.median(squared_distances(error, factor * drift + own)) <= typical)

    if is_enough(0.0):
        return 0.0
    low, high = np.log(SMALLEST), np.log(LARGEST)
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if is_enough(float(np.exp(middle))) else (middle, high)
    return float(np.exp(high))


def _length(constraint: Constraint) -> float:
    """Length of a constraint's translation, m."""
    return float(np.linalg.norm(constraint.T_a_b[:3, 3]))


def linear_basis(distances: Floats, apart: float = MEMORY_M) -> Floats:
    """(K-1, n) linear basis of knots at most `apart` m apart, between keyframes reached after `distances` (K,), m."""
    middle, knots = 0.5 * (distances[1:] + distances[:-1]), _knots(distances[-1], apart)
    return np.column_stack([np.interp(middle, knots, unit) for unit in np.eye(len(knots))])


def mean_rates(distances: Floats, at_knots: Floats, rates: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Mean rates (d,) over the way, and their sigmas (d,), from `rates` (n d,) at the knots with covariance (n d, n d).

    distances : (K,) m travelled at the keyframes; at_knots : (K-1, n) of `linear_basis`
    """
    shares = np.diff(distances) / np.ptp(distances)
    mean = np.kron(shares @ at_knots, np.eye(len(rates) // at_knots.shape[1]))
    return np.asarray(mean @ rates, np.float64), np.sqrt(np.diag(mean @ covariance @ mean.T)).astype(np.float64)


def rate_roots(
    length: float,
    config: GraphConfig,
    axes: list[int],
    lasting: tuple[float, ...] = LASTING,
    apart: float = MEMORY_M,
    is_smooth: bool = True,
) -> list[Floats]:
    """(n d, n d) each, square roots of the prior covariance of the rates at the knots over `length` m, per constant share.

    axes : the d among x, y, z and the rotations about them
    apart : m from knot to knot at the most
    is_smooth : whether the varying part has a squared exponential kernel; else it is a Markov process
    """
    knots = _knots(length, apart)
    gap = np.abs(knots[:, None] - knots) / MEMORY_M
    alike = np.exp(-0.5 * gap**2 if is_smooth else -gap)
    size = _prior_sigmas(config, axes)
    return [np.asarray(np.kron(np.linalg.cholesky(share + (1.0 - share) * alike), size)) for share in lasting]


def walk_root(length: float, config: GraphConfig, axes: list[int], apart: float) -> Floats:
    """(n d, n d) as `rate_roots`, of independent rates: a random walk, over `MEMORY_M` as far as constant rates."""
    knots = _knots(length, apart)
    times = np.sqrt(MEMORY_M / (knots[1] - knots[0]))
    return np.asarray(np.kron(times * np.eye(len(knots)), _prior_sigmas(config, axes)))


def correct_drift(graph: PoseGraph, rates: Floats) -> PoseGraph:
    """The graph with poses and odometry corrected by `rates` (K-1, 6) per m: m along the axes of the world, rad about them."""
    steps = se3.relative(graph.poses[:-1], graph.poses[1:])
    by = rates * np.diff(graph.distances)[:, None]
    poses = [graph.poses[0]]
    for step, turn, shift in zip(steps, so3.exp(by[:, 3:]), by[:, :3], strict=True):
        pose = poses[-1] @ step
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += shift
        poses.append(pose)
    moved = se3.normalise(np.stack(poses))
    odometry = [
        replace(
            c, T_a_b=se3.relative(moved[c.a], graph.poses[c.a] @ c.T_a_b @ se3.relative(graph.poses[c.b], moved[c.b]))
        )
        for c in graph.odometry
    ]
    return replace(graph, poses=moved, odometry=odometry)


def _prior_sigmas(config: GraphConfig, axes: list[int]) -> Floats:
    """(d, d) diagonal matrix of the prior sigmas of the drift rates along the axes, per m."""
    percent, turn = 0.01 * config.drift_percent, np.radians(config.drift_deg_per_100m) / 100
    return np.diag(np.repeat([percent, turn], 3)[axes])


def _knots(length: float, apart: float) -> Floats:
    """Positions of knots along a way of `length` m, at most `apart` m from one another."""
    return np.linspace(0.0, length, int(np.ceil(length / apart)) + 1)
