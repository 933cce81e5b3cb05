"""Loop closures and positions that a person vouches for: they hold, and everything else is judged from where they put it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from graph_builders import LOOP_SIGMAS, ate, graph_of, measured, truth

from lslam.backend.graph import factors
from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PoseGraph, PositionFix
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.constraint import Constraint

LAPS = 2
REAL = truth(160, LAPS)
RNG = np.random.default_rng(5)
TURN = so3.exp(np.array([0.0, 0.0, np.deg2rad(0.35)]))


def run_away() -> PoseGraph:
    """Two laps whose odometry turns by a third of a degree in each step: by far more than it may drift, or says it does."""
    graph = graph_of(REAL, 0, 0, np.random.default_rng(3), LAPS)
    steps = [replace(c, T_a_b=c.T_a_b @ se3.make(TURN, np.zeros(3))) for c in graph.odometry]
    chain = [np.eye(4)]
    for step in steps:
        chain.append(se3.normalise(chain[-1] @ step.T_a_b))
    return replace(graph, poses=np.stack(chain), odometry=steps)


def loop(a: int, b: int, off: float = 0.0, is_binding: bool = False) -> Constraint:
    T = measured(se3.relative(REAL[a], REAL[b]), LOOP_SIGMAS, RNG)
    T[0, 3] += off
    return Constraint(a, b, T, np.diag(LOOP_SIGMAS**2), is_binding=is_binding)


def test_a_held_loop_lets_right_loops_in_that_odometry_excludes_and_keeps_wrong_ones_out() -> None:
    graph = run_away()
    others = [loop(20, 100), loop(21, 101), loop(40, 120), loop(41, 121), loop(60, 140, off=12.0)]
    alone = optimise(replace(graph, loops=others), GraphConfig())
    assert all(alone.loop_reasons[:4])
    helped = optimise(replace(graph, loops=[loop(0, 159, is_binding=True), *others]), GraphConfig())
    assert helped.loop_reasons[:5] == [""] * 5
    assert helped.loop_reasons[5]
    assert ate(helped.poses, REAL) < 0.1 * ate(alone.poses, REAL)


def test_a_held_loop_is_never_rejected_however_wrong() -> None:
    graph = graph_of(REAL, 40, 0, np.random.default_rng(4), LAPS)
    wrong = loop(10, 90, off=30.0)
    free = optimise(replace(graph, loops=[*graph.loops, wrong]), GraphConfig())
    assert free.loop_reasons[-1]
    held = optimise(replace(graph, loops=[*graph.loops, replace(wrong, is_binding=True)]), GraphConfig())
    assert held.loop_reasons[-1] == ""
    moved = se3.relative(held.poses[10], held.poses[90])
    assert np.linalg.norm(moved[:3, 3] - wrong.T_a_b[:3, 3]) < 1.0


def test_control_points_anchor_a_run_and_hold_an_instant_between_two_keyframes() -> None:
    graph = run_away()
    ahead, share = np.array([0.4, 0.0, 0.1]), 0.25
    fixes = []
    for k in (0, 12, 25, 52, 66, 92, 105, 132, 158):
        # As scans are corrected between keyframes: on SE(3), in proportion of the time.
        between = REAL[k] @ se3.exp(share * se3.log(se3.relative(REAL[k], REAL[k + 1])))
        at = se3.apply(between, ahead[None])[0]
        arms = [se3.apply(se3.inverse(REAL[j]), at[None])[0] for j in (k, k + 1)]
        fixes.append(PositionFix(k, at, np.full(3, 0.01), arms[0], is_binding=True, share=share, next_arm=arms[1]))
    out = optimise(replace(graph, fixes=fixes, is_anchored=False, tilt_sigma=0.2), GraphConfig())
    assert out.fix_inliers.all()
    off = np.array([fix.predict(out.poses) - fix.position for fix in fixes])
    assert np.abs(off).max() < 0.01
    assert ate(out.poses, REAL) < 0.25 * ate(graph.poses, REAL)


def test_the_factor_between_keyframes_has_the_derivative_of_its_error() -> None:
    import gtsam

    fix = PositionFix(
        0, np.array([3.0, -2.0, 1.0]), np.array([0.1, 0.2, 0.4]), np.array([1.0, 0.5, -0.2]), is_binding=True, share=0.3,
        next_arm=np.array([-0.7, 0.4, 0.3]),
    )  # fmt: skip
    factor = factors.position(fix)
    poses = [gtsam.Pose3(pose) for pose in REAL[[5, 9]]]

    def whitened(moved: list[object]) -> np.ndarray:
        values = gtsam.Values()
        for key, pose in enumerate(moved):
            values.insert(key, pose)
        return -factor.linearize(values).jacobian()[1]

    values = gtsam.Values()
    for key, pose in enumerate(poses):
        values.insert(key, pose)
    A = factor.linearize(values).jacobian()[0]
    for column in range(12):
        step = np.zeros(12)
        step[column] = 1e-6
        ends = [
            whitened([pose.retract(sign * step[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)]) for sign in (1, -1)
        ]
        np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, A[:, column], atol=1e-5)
