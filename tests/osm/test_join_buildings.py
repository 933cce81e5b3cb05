"""What the baseline takes from the graph that was solved before it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PoseGraph, PositionFix
from lslam.backend.outcome import BackEndInput
from lslam.core.config import Config
from lslam.core.geometry import se3
from lslam.core.types.building import Building, Footprint, OsmMatches
from lslam.core.types.constraint import Constraint
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm.baseline_matcher import fit_buildings


class NothingSeen:
    """A store of keyframes whose clouds are empty."""

    def __len__(self) -> int:
        return 20

    def points(self, number: int) -> NDArray[np.float32]:
        return np.zeros((0, 3), np.float32)


def test_a_rejected_fix_does_not_affect_the_baseline() -> None:
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = 2.0 * np.arange(20)
    steps = [
        Constraint(k, k + 1, se3.relative(poses[k], poses[k + 1]), np.diag(np.repeat([1e-4, 1e-6], 3)), "odometry")
        for k in range(19)
    ]
    off = np.zeros((20, 3))
    off[10, 1] = 40.0
    fixes = [PositionFix(k, poses[k, :3, 3] + off[k], np.full(3, 0.1), np.zeros(3)) for k in range(20)]
    graph = PoseGraph(poses, steps, fixes=fixes, is_anchored=False)
    solution = optimise(graph, Config().graph)
    assert np.flatnonzero(~solution.fix_inliers).tolist() == [10]
    house = Building("way/1", (Footprint(np.array([[200.0, 0], [210, 0], [210, 10], [200, 10]])),))
    extract = BuildingExtract([house], {}, np.array([49.0, 8.4, 0.0]), None, "a map")
    inputs = BackEndInput([], NothingSeen(), Config(), [])  # type: ignore[arg-type]
    fit = fit_buildings(
        graph,
        solution,
        OsmMatches(extract.origin, (), np.zeros((0, 2, 2)), np.zeros(0, np.int64), (), ()),
        extract,
        inputs,
    )
    assert fit.joint is not None
    np.testing.assert_allclose(fit.joint.poses[:, :3, 3], poses[:, :3, 3], atol=0.1)
    assert [match.reason for match in fit.matches.keyframes] == ["no convergence"] * 20
    assert [c.status for c in fit.buildings.buildings] == ["unseen"]
