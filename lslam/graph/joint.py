"""Buildings and trajectory in one graph.

Mode `non-rigid` has the map's prior on all buildings and matches as outlier candidates; the baseline (Del Tufo, section 2.5)
anchors the first building, leaves all others to their matches, and rejects none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config.graph import GraphConfig
from lslam.geometry import noise, se2, se3
from lslam.graph import factors
from lslam.graph.building_graph import BuildingSolution, MapPrior
from lslam.graph.gnc import OutlierCandidate, gnc_solve, joined
from lslam.graph.pose_graph import check_graph
from lslam.graph.problem import PlanarPrior, PoseGraph
from lslam.graph.solve import marginal_blocks, marginals
from lslam.types.building import BuildingMatch

Floats = NDArray[np.float64]

FIRM, LOOSE = 1e-4, 1e4  # m and rad; sigmas of what is anchored, and of what has no prior


@dataclass(frozen=True)
class JointSolution:
    """poses : (K, 4, 4) of all keyframes; covariances : (K, 6, 6) as of `Solution`; buildings : as of `solve_buildings`."""

    poses: Floats
    covariances: Floats
    buildings: BuildingSolution


def optimise_jointly(
    graph: PoseGraph,
    middles: NDArray[np.float64],
    matches: Sequence[BuildingMatch],
    map_prior: MapPrior | None,
    config: GraphConfig,
) -> JointSolution:
    """Poses of keyframes and displacements of the buildings with `middles` (B, 2), m, from everything at once.

    Parameters
    ----------
    graph : in the frame of the map; its loop closures and fixes are inliers; it has no planar priors
    map_prior : None is the baseline: the first building matched is anchored, no match is an outlier candidate

    Raises GraphError when the graph is disconnected, singular or not finite.
    """
    check_graph(graph)
    seen = list(dict.fromkeys(m.building for m in matches))
    keys = {building: factors.map_key(graph) + 1 + n for n, building in enumerate(seen)}
    certain = [factors.between(loop) for loop in graph.loops] + [factors.position(fix) for fix in graph.fixes]
    values = factors.start_values(graph, graph.poses)
    for building, key in keys.items():
        shift = np.zeros(2) if map_prior is None else map_prior.shift
        pose = se2.to_se3(np.append(middles[building] + shift, 0.0))
        certain.append(_own(key, pose, _sigma(map_prior, building == seen[0])))
        _insert(values, key, pose)
    edges = [partial(factors.planar, _seen_from(m), graph.poses[m.keyframe], keys[m.building]) for m in matches]
    fixed = joined(factors.fixed_part(graph), certain)
    candidates = [OutlierCandidate(edge, max(m.rank, 1)) for edge, m in zip(edges, matches, strict=True)]
    solved = gnc_solve(fixed, candidates, values, config if map_prior else config.model_copy(update={"robust": "none"}))
    poses = se3.normalise(factors.poses_of(solved.values, len(graph)))
    places = np.array([solved.values.atPose3(key).matrix() for key in keys.values()]).reshape(-1, 4, 4)
    spread = np.zeros((0, 6, 6))
    if seen:
        spread = noise.from_body(marginal_blocks(solved.factors, solved.values, keys.values()), places)
    buildings = _solution(middles, seen, places, spread, solved.weights >= 0.5, map_prior)
    covariances = marginals(solved.factors, solved.values, poses)
    covariances = covariances if graph.spread is None else covariances + graph.spread
    return JointSolution(poses, covariances, buildings)


def _seen_from(match: BuildingMatch) -> PlanarPrior:
    """The keyframe in the axes of the building, from the building in those of the keyframe."""
    pose = se2.inverse(match.pose)
    back = np.zeros((3, 3))
    back[:2, :2] = -se2.rotation(-match.pose[2])
    back[:2, 2] = [pose[1], -pose[0]]
    back[2, 2] = -1.0
    undone = np.linalg.inv(back)
    return PlanarPrior(match.keyframe, pose, undone.T @ match.information @ undone, match.rank)


def _sigma(map_prior: MapPrior | None, is_first: bool) -> Floats:
    """(3,) prior sigmas of a building's displacement: x, y (m), yaw (rad)."""
    if map_prior is None:
        return np.full(3, FIRM if is_first else LOOSE)
    return np.asarray(np.sqrt(map_prior.sigma**2 + np.append(map_prior.shift_sigma, 0.0) ** 2))


def _own(key: int, pose: Floats, sigma: Floats) -> Any:
    import gtsam

    spread = np.diag(np.array([*sigma[:2], FIRM, FIRM, FIRM, sigma[2]]) ** 2)
    model = gtsam.noiseModel.Gaussian.Covariance(noise.to_body(spread, pose))
    return gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), model)


def _insert(values: Any, key: int, pose: Floats) -> None:
    import gtsam

    values.insert(key, gtsam.Pose3(pose))


def _solution(
    middles: Floats,
    seen: list[int],
    places: Floats,
    spread: Floats,
    inliers: NDArray[np.bool_],
    map_prior: MapPrior | None,
) -> BuildingSolution:
    """Displacements of all buildings; those without a match follow the shift of the others."""
    found, covariances = (
        np.zeros((len(middles), 3)),
        np.tile(np.diag(_sigma(map_prior, False) ** 2), (len(middles), 1, 1)),
    )
    if seen:
        found[seen] = se2.of_se3(places) - np.column_stack([middles[seen], np.zeros(len(seen))])
        covariances[seen] = spread[:, factors.PLANAR][:, :, factors.PLANAR]
    shift = found[seen, :2].mean(axis=0) if seen else (np.zeros(2) if map_prior is None else map_prior.shift)
    unseen = np.setdiff1d(np.arange(len(middles)), seen)
    found[unseen, :2] = 0.0 if map_prior is None else shift
    return BuildingSolution(found, covariances, shift, inliers)
