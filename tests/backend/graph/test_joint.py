"""Buildings and trajectory in one graph: walls correct drift and a wrong map together; the baseline rejects none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graph_builders import STEP_SIGMAS, measured
from numpy.typing import NDArray
from test_building_graph import across

from lslam.backend.graph import building_graph
from lslam.backend.graph.building_graph import MapPrior, optimise_jointly
from lslam.backend.graph.drift import with_drift
from lslam.backend.graph.marginals import scaled_blocks
from lslam.backend.graph.odometry_constraints import in_plane
from lslam.backend.graph.problem import FloorPlane, PoseGraph
from lslam.core.config.backend import GraphConfig
from lslam.core.errors import GraphError
from lslam.core.geometry import se2, se3, so3
from lslam.core.types.building import BuildingMatch
from lslam.core.types.constraint import Constraint

Floats = NDArray[np.float64]

FULL = np.diag([1 / 0.1**2, 1 / 0.1**2, 1 / 0.01**2])
MAP_PRIOR = MapPrior(np.zeros(2), np.full(2, 1e-3), np.array([0.3, 0.3, np.radians(1.0)]))


def drive(seed: int) -> tuple[PoseGraph, Floats, Floats, Floats, list[BuildingMatch]]:
    """A hilly ring road whose odometry drifts: graph, true poses, middles on the map, real displacements, matches."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    real = se3.make(
        so3.from_euler_rpy(np.column_stack([0.02 * np.sin(phase), 0.03 * np.cos(phase), phase + np.pi / 2])),
        np.column_stack([40 * np.cos(phase), 40 * np.sin(phase), 2 * np.sin(phase)]),
    )
    sigmas = 3 * STEP_SIGMAS
    steps = measured(se3.relative(real[:-1], real[1:]), sigmas, rng)
    chain = [real[0]]
    for step in steps:
        chain.append(se3.normalise(chain[-1] @ step))
    odometry = [Constraint(k, k + 1, steps[k], np.diag(sigmas**2), "odometry") for k in range(59)]
    angle = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    middles = 55 * np.column_stack([np.cos(angle), np.sin(angle)])
    off = np.column_stack([rng.normal(0, 0.3, (14, 2)), rng.normal(0, np.radians(1.0), 14)])
    off[0] = 0.0
    planar = se2.of_se3(real)
    matches = []
    for b, middle in enumerate(middles):
        where = np.append(middle, 0.0) + off[b]
        for k in range(60):
            if np.linalg.norm(planar[k, :2] - middle) < 28:
                pose = se2.relative(planar[k], where) + rng.normal(0, [0.03, 0.03, 0.003])
                matches.append(BuildingMatch(k, b, pose, FULL, 3, "edges", 50.0, 0.5, 0.1, np.zeros((1, 2), np.int64)))
    return PoseGraph(np.stack(chain), odometry), real, middles, off, matches


def off_the_way(poses: Floats, real: Floats) -> float:
    """Root mean square distance in the plane, m: walls say nothing of heights."""
    return float(np.sqrt(np.mean(np.sum((poses[:, :2, 3] - real[:, :2, 3]) ** 2, axis=1))))


def test_a_given_spread_adds_to_the_covariances() -> None:
    graph, _, middles, _, matches = drive(0)
    spread = np.tile(np.diag([0.04, 0.09, 0.0, 0.0, 0.0, 1e-4]), (len(graph), 1, 1))
    known = optimise_jointly(graph, middles, matches, MAP_PRIOR, GraphConfig())
    unsure = optimise_jointly(replace(graph, spread=spread), middles, matches, MAP_PRIOR, GraphConfig())
    np.testing.assert_allclose(unsure.covariances - known.covariances, spread, atol=1e-12)
    np.testing.assert_array_equal(unsure.poses, known.poses)


@pytest.mark.parametrize("seed", range(3))
def test_walls_correct_trajectory_and_map_together(seed: int) -> None:
    graph, real, middles, off, matches = drive(seed)
    found = optimise_jointly(graph, middles, matches, MAP_PRIOR, GraphConfig())
    assert off_the_way(found.poses, real) < max(0.5 * off_the_way(graph.poses, real), 0.2)
    assert found.buildings.inliers.mean() > 0.98
    away = np.linalg.norm(found.buildings.displacements[:, :2] - off[:, :2], axis=1)
    assert np.median(away) < 0.3
    assert (np.linalg.eigvalsh(found.covariances) > 0).all()
    errors = found.buildings.displacements - off
    nees = [e @ np.linalg.solve(c, e) for e, c in zip(errors, found.buildings.covariances, strict=True)]
    assert np.mean(nees) < 8


def test_only_what_is_seen_from_above_is_touched() -> None:
    graph, _, middles, _, matches = drive(1)
    alone = optimise_jointly(graph, middles, [], MAP_PRIOR, GraphConfig())
    found = optimise_jointly(graph, middles, matches, MAP_PRIOR, GraphConfig())
    np.testing.assert_allclose(found.poses[:, 2, 3], alone.poses[:, 2, 3], atol=0.15)
    np.testing.assert_allclose(found.poses[:, 2, :2], alone.poses[:, 2, :2], atol=0.03)


def test_matches_with_the_wrong_wall_are_given_up_but_not_by_the_baseline() -> None:
    graph, real, middles, _, matches = drive(2)
    wrong = [replace(m, pose=np.add(m.pose, [4.0, -3.0, 0.1])) for m in matches[::12]]
    found = optimise_jointly(graph, middles, [*matches, *wrong], MAP_PRIOR, GraphConfig())
    assert not found.buildings.inliers[len(matches) :].any()
    assert found.buildings.inliers[: len(matches)].mean() > 0.95
    baseline = optimise_jointly(graph, middles, [*matches, *wrong], None, GraphConfig())
    assert baseline.buildings.inliers.all()
    assert off_the_way(baseline.poses, real) > 2 * off_the_way(found.poses, real)


def test_the_baseline_holds_its_first_building_and_no_other() -> None:
    graph, _, middles, _, matches = drive(0)
    found = optimise_jointly(graph, middles, matches, None, GraphConfig())
    first = matches[0].building
    np.testing.assert_allclose(found.buildings.displacements[first], 0.0, atol=1e-3)
    assert np.abs(np.delete(found.buildings.displacements, first, axis=0)).max() > 0.1


def test_a_lone_wall_leaves_its_building_free_along_it() -> None:
    graph, _, middles, _, matches = drive(0)
    planar = se2.of_se3(graph.poses)
    n = np.array([1.0, 0.0])
    walls = [replace(m, information=across(n, planar[m.keyframe]), rank=2) for m in matches if m.building == 3]
    rest = [m for m in matches if m.building != 3]
    sure = replace(graph, odometry=[replace(c, covariance=1e-6 * np.eye(6)) for c in graph.odometry])
    found = optimise_jointly(sure, middles, [*rest, *walls], MAP_PRIOR, GraphConfig(robust="none"))
    spread = np.sqrt(np.diag(found.buildings.covariances[3]))
    assert spread[1] == pytest.approx(0.3, rel=0.1)
    assert spread[0] < 0.15


def test_covariances_of_buildings_do_not_depend_on_how_they_are_had(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without and with a floor, whose unknowns are fewer, before the buildings'."""
    graph, _, middles, _, matches = drive(0)
    floors = [FloorPlane(k, np.array([0.0, 0.0, 1.0]), 1.7, 0.1, 1.0) for k in (0, 30)]
    for known in (graph, replace(graph, floors=floors)):
        config = GraphConfig(robust="none")
        by_gtsam = optimise_jointly(known, middles, matches, MAP_PRIOR, config)
        with monkeypatch.context() as without:
            without.setattr(building_graph, "marginal_blocks", lambda f, v, keys: scaled_blocks(f, v, list(keys)))
            by_scaling = optimise_jointly(known, middles, matches, MAP_PRIOR, config)
        np.testing.assert_allclose(
            by_scaling.buildings.covariances, by_gtsam.buildings.covariances, rtol=1e-4, atol=1e-9
        )


def test_what_nothing_was_matched_with_follows_the_others() -> None:
    graph, _, middles, _, matches = drive(1)
    more = np.vstack([middles, [[300.0, 0.0]]])
    found = optimise_jointly(graph, more, matches, MAP_PRIOR, GraphConfig()).buildings
    np.testing.assert_allclose(found.displacements[-1], [*found.displacements[:-1, :2].mean(axis=0), 0.0], atol=1e-9)
    assert np.linalg.norm(found.shift) > 0.01
    baseline = optimise_jointly(graph, more, matches, None, GraphConfig()).buildings
    np.testing.assert_array_equal(baseline.displacements[-1], 0.0)


def test_a_wall_that_fixes_less_is_judged_by_less() -> None:
    """4.2 sigmas off are too much for the two directions of a lone wall, though not for six."""
    graph, _, middles, off, matches = drive(0)
    planar = se2.of_se3(graph.poses)
    sure = replace(graph, odometry=[replace(c, covariance=1e-8 * np.eye(6)) for c in graph.odometry])
    n = np.array([1.0, 0.0])
    walls = [
        replace(
            m, rank=2, information=across(n, planar[m.keyframe]),
            pose=se2.relative(planar[m.keyframe], np.append(middles[3], 0.0) + off[3]),
        )
        for m in matches if m.building == 3
    ]  # fmt: skip
    at, place = walls[0].keyframe, np.append(middles[3], 0.0) + off[3]
    odd = replace(walls[0], pose=se2.relative(planar[at], np.add(place, [4.2 * 0.3, 0.0, 0.0])))
    found = optimise_jointly(sure, middles, [*walls * 4, odd], MAP_PRIOR, GraphConfig())
    assert found.buildings.inliers.tolist() == [True] * (4 * len(walls)) + [False]


def test_trusted_odometry_is_not_bent_by_walls() -> None:
    graph, _, middles, _, matches = drive(1)
    rigid = replace(graph, is_rigid=True, start_sigma=np.array([3.0, 3.0, 0.1]))
    rigid = replace(rigid, odometry=with_drift(rigid, 4.0, GraphConfig()))
    found = optimise_jointly(rigid, middles, matches, MAP_PRIOR, GraphConfig())
    np.testing.assert_allclose(
        se3.relative(found.poses[:1], found.poses), se3.relative(graph.poses[:1], graph.poses), atol=0.01
    )


def test_a_graph_in_pieces_is_refused() -> None:
    graph, _, middles, _, matches = drive(0)
    with pytest.raises(GraphError, match="in pieces"):
        optimise_jointly(replace(graph, odometry=graph.odometry[:-3]), middles, matches, MAP_PRIOR, GraphConfig())


@pytest.mark.parametrize("seed", range(3))
def test_a_planar_graph_does_not_tip_over_when_all_sigmas_are_of_metres(seed: int) -> None:
    """Del Tufo's baseline: odometry and buildings weigh alike, a tenth of the matches is wrong. In space it tilts by 114 deg."""
    graph, real, middles, _, matches = drive(seed)
    rng = np.random.default_rng(seed)
    information = np.diag([1 / 5.0, 1 / 5.0, 1 / 0.2])
    noisy = [
        replace(
            m, information=information, pose=m.pose + rng.normal(0, [0.3, 0.3, 0.03]) * (1 + 9 * (rng.random() < 0.1))
        )
        for m in matches
    ]
    wide = in_plane(np.diag(np.repeat([5.0, 0.2], 3)))
    flat = replace(graph, odometry=[replace(c, covariance=wide) for c in graph.odometry])
    found = optimise_jointly(flat, middles, noisy, None, GraphConfig())
    assert np.degrees(np.arccos(found.poses[:, 2, 2])).max() < 5
    assert off_the_way(found.poses, real) < 3
