"""How far odometry may have drifted: covariances of a chain, and systematic drift against the drift itself."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from known_town import keyframes_of, round_the_square
from numpy.typing import NDArray

from lslam.backend.loops.gating import OdometryUncertainty
from lslam.core.geometry import se3, so3


def chain(poses: NDArray[np.float64], step: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Covariance of each pose when every step adds `step` (6, 6) and a turn moves what comes later."""
    covariances = [np.zeros((6, 6))]
    for before, after in pairwise(poses):
        A = np.eye(6)
        A[:3, 3:] = -so3.hat(after[:3, 3] - before[:3, 3])
        covariances.append(A @ covariances[-1] @ A.T + step)
    return covariances


def test_uncertainty_between_is_that_of_the_way_between() -> None:
    poses = np.array([round_the_square(d) for d in np.arange(0, 200, 5.0)])
    step = np.diag([1e-3, 2e-3, 1e-3, 1e-6, 1e-6, 4e-6])
    whole = chain(poses, step)
    keyframes = [replace(k, covariance=C) for k, C in zip(keyframes_of(poses), whole, strict=True)]
    uncertainty = OdometryUncertainty(keyframes, 0.0, 0.0).between(39, np.array([0, 17]))
    part = chain(poses[17:], step)[-1]
    assert np.allclose(uncertainty.position, [whole[39][:3, :3], part[:3, :3]], rtol=1e-9)
    assert uncertainty.turn == pytest.approx(np.sqrt([whole[39][5, 5], part[5, 5]]))


def test_never_negative_when_estimates_contradict() -> None:
    poses = np.array([round_the_square(d) for d in (0.0, 40.0, 80.0)])
    keyframes = [
        replace(k, covariance=C * np.eye(6)) for k, C in zip(keyframes_of(poses), (0.5, 0.3, 0.1), strict=True)
    ]
    uncertainty = OdometryUncertainty(keyframes, 0.0, 0.0).between(2, np.array([0, 1]))
    assert np.isfinite(uncertainty.reach).all()
    assert (uncertainty.turn >= 0).all()


@pytest.mark.parametrize(("scale", "turn"), [(0.5, 0.0), (0.0, 0.25), (-0.5, -0.25)])
def test_three_sigmas_hold_the_drift_they_are_named_after(scale: float, turn: float) -> None:
    true = np.array([round_the_square(d) for d in np.arange(0, 720, 4.0)])
    drifted = [true[0]]
    for before, after in pairwise(true):
        step = se3.relative(before, after)
        length = float(np.linalg.norm(step[:3, 3]))
        step[:3, 3] *= 1 + scale / 100
        bend = se3.make(so3.exp(np.array([0, 0, np.deg2rad(turn) * length / 100])), np.zeros(3))
        drifted.append(drifted[-1] @ step @ bend)
    uncertainty = OdometryUncertainty(keyframes_of(np.array(drifted)), 0.5, 0.25)
    b, older = 179, np.arange(0, 170, 10)
    errors = [
        se3.relative(drifted[a], drifted[b])[:3, 3] - se3.relative(true[a], true[b])[:3, 3] for a in older
    ]  # fmt: skip
    sigmas = np.linalg.norm(errors, axis=1) / uncertainty.between(b, older).reach
    assert (sigmas < 3).all()
    assert uncertainty.between(b, np.array([0])).reach[0] < 0.03 * 720


def test_drift_of_a_straight_way_is_its_scale_and_its_bend_at_the_lever() -> None:
    """0.5 % and 0.25 deg per 100 m of n steps of h: the lever is the rms of 0, h, ..., n h."""
    h, n = 2.0, 150
    line = keyframes_of(np.array([se3.make(np.eye(3), np.array([k * h, 0.0, 0.0])) for k in range(n + 21)]))
    older = np.array([20, 120])
    uncertainty = OdometryUncertainty(line, 0.5, 0.25).between(n + 20, older)
    for reach, turn, steps in zip(uncertainty.reach, uncertainty.turn, (n, n - 100), strict=True):
        bend = np.deg2rad(0.25) * steps * h / 100
        lever = h * np.sqrt((np.arange(steps + 1) ** 2).mean())
        assert turn == pytest.approx(bend)
        assert reach == pytest.approx(np.hypot(0.005 * steps * h, bend * lever))


@pytest.mark.parametrize("is_known", [True, False])
def test_within_the_gate_is_what_the_uncertainty_between_says(is_known: bool) -> None:
    """Random covariances, so that differences of some are not even positive: each keyframe by itself, against `between`."""
    rng = np.random.default_rng(4)
    poses = np.array([round_the_square(d) for d in np.arange(0, 900, 4.0)])
    keyframes = keyframes_of(poses)
    for k, keyframe in enumerate(keyframes):
        root = rng.normal(0, 0.05, (6, 6)) @ np.diag([1, 1, 1, 0.02, 0.02, 0.02]) * np.sqrt(k)
        keyframes[k] = replace(keyframe, covariance=root @ root.T if is_known else None)
    uncertainty = OdometryUncertainty(keyframes, 0.5, 0.25)
    least, near, sigmas = 60.0, 8.0, 1.5
    seen = 0
    for b in range(0, len(keyframes), 7):
        older = np.flatnonzero(uncertainty.distances[b] - uncertainty.distances[:b] >= least)
        away = np.linalg.norm(uncertainty.positions[older] - uncertainty.positions[b], axis=1)
        expected = older[away <= near + sigmas * uncertainty.between(b, older).reach] if len(older) else older
        np.testing.assert_array_equal(uncertainty.gate(b, np.arange(b), least, near, sigmas), expected)
        among = np.arange(b)[rng.random(b) < 0.5]
        some = uncertainty.gate(b, among, least, near, sigmas)
        np.testing.assert_array_equal(some, np.intersect1d(expected, among))
        seen += 0 < len(expected) < len(older)
    assert seen > 10
