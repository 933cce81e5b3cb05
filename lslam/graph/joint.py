"""Buildings and trajectory in one graph: the thesis' first level, where each wall moves both.

`non-rigid` lets the map believe in itself and doubts matches; the baseline (second thesis, section 2.5) holds the first
building where the map has it, all others by nothing but matches, and doubts none.
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
from lslam.graph.building_graph import BuildingSolution, MapBelief
from lslam.graph.gnc import Doubted, joined, settle
from lslam.graph.pose_graph import check_graph
from lslam.graph.problem import PlanarPrior, PoseGraph
from lslam.graph.solve import marginal_blocks, marginals
from lslam.types.building_match import BuildingMatch

Floats = NDArray[np.float64]

FIRM, LOOSE = 1e-4, 1e4  # m and rad; what is held, and what nothing says


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
    belief: MapBelief | None,
    config: GraphConfig,
) -> JointSolution:
    """Poses of keyframes and displacements of the buildings with `middles` (B, 2), m, from everything at once.

    Parameters
    ----------
    graph : in the frame of the map; its loops and fixes are taken at their word, so give the believed ones;
        it has no planar priors
    belief : what the map is trusted with; None is the baseline: the first building matched is held, no match is doubted

    Raises GraphError when the graph is in pieces, singular or not finite.
    """
    check_graph(graph)
    seen = list(dict.fromkeys(m.building for m in matches))
    keys = {building: factors.map_key(graph) + 1 + n for n, building in enumerate(seen)}
    certain = [factors.between(loop) for loop in graph.loops] + [factors.position(fix) for fix in graph.fixes]
    values = factors.start_values(graph, graph.poses)
    for building, key in keys.items():
        shift = np.zeros(2) if belief is None else belief.shift
        pose = se2.to_se3(np.append(middles[building] + shift, 0.0))
        certain.append(_own(key, pose, _sigma(belief, building == seen[0])))
        _insert(values, key, pose)
    edges = [partial(factors.planar, _seen_from(m), graph.poses[m.keyframe], keys[m.building]) for m in matches]
    fixed = joined(factors.fixed_part(graph), certain)
    doubted = [Doubted(edge, max(m.rank, 1)) for edge, m in zip(edges, matches, strict=True)]
    settled = settle(fixed, doubted, values, config if belief else config.model_copy(update={"robust": "none"}))
    poses = se3.normalise(factors.poses_of(settled.values, len(graph)))
    places = np.array([settled.values.atPose3(key).matrix() for key in keys.values()]).reshape(-1, 4, 4)
    spread = np.zeros((0, 6, 6))
    if seen:
        spread = noise.from_body(marginal_blocks(settled.factors, settled.values, keys.values()), places)
    buildings = _solution(middles, seen, places, spread, settled.weights >= 0.5, belief)
    covariances = marginals(settled.factors, settled.values, poses)
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


def _sigma(belief: MapBelief | None, is_first: bool) -> Floats:
    """(3,) x, y (m), yaw (rad) by which a building may be off its place on the map."""
    if belief is None:
        return np.full(3, FIRM if is_first else LOOSE)
    return np.asarray(np.sqrt(belief.sigma**2 + np.append(belief.shift_sigma, 0.0) ** 2))


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
    believed: NDArray[np.bool_],
    belief: MapBelief | None,
) -> BuildingSolution:
    """Displacements of all; those that nothing was matched with follow the others."""
    found, covariances = np.zeros((len(middles), 3)), np.tile(np.diag(_sigma(belief, False) ** 2), (len(middles), 1, 1))
    if seen:
        found[seen] = se2.of_se3(places) - np.column_stack([middles[seen], np.zeros(len(seen))])
        covariances[seen] = spread[:, factors.PLANAR][:, :, factors.PLANAR]
    shift = found[seen, :2].mean(axis=0) if seen else (np.zeros(2) if belief is None else belief.shift)
    unseen = np.setdiff1d(np.arange(len(middles)), seen)
    found[unseen, :2] = 0.0 if belief is None else shift
    return BuildingSolution(found, covariances, shift, believed)
