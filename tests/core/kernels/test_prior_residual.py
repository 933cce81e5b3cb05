"""The prior's normal equations against finite differences of its squared length."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels import linearisation as at
from lslam.core.kernels.gauss_newton import linearise_prior

Floats = NDArray[np.float64]
WIDTH = (1.0, 1.0, np.inf)


def known() -> tuple[Floats, Floats, Floats]:
    """A prior with full information."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    return so3.exp(rng.normal(size=3)), rng.normal(size=3), root @ root.T + np.eye(6)


def half_square(R: Floats, t: Floats, target: tuple[Floats, Floats, Floats]) -> float:
    R0, t0, information = target
    away = np.concatenate([t - t0, so3.log(R @ R0.T)])
    return float(0.5 * away @ information @ away)


def sums_at(R: Floats, t: Floats, target: tuple[Floats, Floats, Floats], population: float = 0.0) -> tuple[Floats, ...]:
    facts = np.zeros(at.COUNT)
    facts[at.MATCHED], facts[at.POPULATION] = 100.0, population
    sums = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), facts
    linearise_prior((), target, (), (), (R, t), WIDTH, sums)
    return sums


@pytest.mark.parametrize("turn", [0.0, 1e-10, 1e-3, 0.02])
def test_gradient_and_curvature_are_those_of_the_squared_length(turn: float) -> None:
    target = known()
    R = so3.exp(turn * np.array([0.6, -0.64, 0.48])) @ target[0]
    t = target[1] + np.array([0.3, -0.2, 0.1])
    H, S, g, _ = sums_at(R, t, target)
    np.testing.assert_array_equal(S, 0)
    np.testing.assert_allclose(H, np.triu(target[2]))
    step = 1e-6
    for k in range(6):
        d = step * np.eye(6)[k]
        ahead, behind = (half_square(so3.exp(s * d[3:]) @ R, t + s * d[:3], target) for s in (1, -1))
        # The Jacobian of the rotation is the identity to half the angle.
        assert g[k] == pytest.approx((ahead - behind) / (2 * step), abs=1e-6 + 12 * turn)


def test_the_prior_is_unaffected_by_the_relative_weights_of_points() -> None:
    target = known()
    t = target[1] + 0.1
    H, _, g, facts = sums_at(target[0], t, target, population=25.0)
    plain_H, _, plain_g, _ = sums_at(target[0], t, target)
    scale = facts[at.MATCHED] / facts[at.POPULATION]
    np.testing.assert_allclose(scale * H, plain_H)
    np.testing.assert_allclose(scale * g, plain_g)
