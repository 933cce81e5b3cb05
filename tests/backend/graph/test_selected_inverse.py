"""Blocks of a covariance by recursion over a Bayes net, against the inverse of the whole information matrix."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
import pytest

from lslam.backend.graph.marginals import selected_inverse

POSES, POINTS = range(30), range(100, 110)


def tangled(seed: int) -> Any:
    """A chain of six numbers each with loops anywhere, and points seen from two of them each: two sizes, much fill-in."""
    rng = np.random.default_rng(seed)
    linear, unit = gtsam.GaussianFactorGraph(), gtsam.noiseModel.Unit.Create

    def two() -> list[int]:
        return rng.choice(len(POSES), 2, replace=False).tolist()

    def some(rows: int, columns: int) -> Any:
        return rng.normal(size=(rows, columns))

    linear.add(0, some(6, 6), np.zeros(6), unit(6))
    for a, b in [(k, k + 1) for k in POSES[:-1]] + [two() for _ in range(12)]:
        linear.add(a, some(6, 6), b, some(6, 6), np.zeros(6), unit(6))
    for key in POINTS:
        linear.add(key, some(3, 3), np.zeros(3), unit(3))
        for pose in two():
            linear.add(pose, some(3, 6), key, some(3, 3), np.zeros(3), unit(3))
    return linear


@pytest.mark.parametrize("wanted", [[*POSES, *POINTS], [7], [*POINTS[:3], 0]])
@pytest.mark.parametrize("seed", range(3))
def test_it_has_the_blocks_of_the_whole_inverse(seed: int, wanted: list[int]) -> None:
    linear = tangled(seed)
    order = gtsam.Ordering()
    for key in (*POSES, *POINTS):
        order.push_back(key)
    whole = np.linalg.inv(linear.hessian(order)[0])
    begins = {**{k: 6 * k for k in POSES}, **{k: 180 + 3 * (k - 100) for k in POINTS}}
    net = linear.eliminateSequential(gtsam.Ordering.OrderingType.COLAMD)
    found = dict(selected_inverse(net, wanted))
    assert sorted(found) == sorted(wanted)
    for key, block in found.items():
        rows = slice(begins[key], begins[key] + len(block))
        assert len(block) == (6 if key < 100 else 3)
        np.testing.assert_allclose(block, whole[rows, rows], rtol=1e-8, atol=1e-10)


def test_what_is_not_joined_is_known_by_itself() -> None:
    """Two trees of one net."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for key, sigma in ((0, 0.5), (1, 2.0)):
        factors.add(gtsam.PriorFactorPoint3(key, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, sigma)))
        values.insert(key, np.zeros(3))
    net = factors.linearize(values).eliminateSequential(gtsam.Ordering.OrderingType.COLAMD)
    found = dict(selected_inverse(net, [0, 1]))
    np.testing.assert_allclose(found[0], 0.25 * np.eye(3))
    np.testing.assert_allclose(found[1], 4.0 * np.eye(3))
