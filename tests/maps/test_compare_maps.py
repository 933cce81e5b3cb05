"""Two clouds against each other, by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.errors import InputError, UsageError
from lslam.core.types.cloud import ArrayCloud
from lslam.maps.crispness import compare


def test_equals_brute_force() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 2, (300, 3)), rng.uniform(0.5, 2.5, (200, 3))
    d = np.linalg.norm(a[:, None] - b[None], axis=2)
    score = compare(ArrayCloud.of(a), ArrayCloud.of(b), 0.25)
    precision, recall = (d.min(1) <= 0.25).mean(), (d.min(0) <= 0.25).mean()
    assert 0.1 < precision < 0.9
    assert (score.precision, score.recall) == (precision, recall)
    assert score.f1 == pytest.approx(2 * precision * recall / (precision + recall))
    assert score.chamfer == pytest.approx((d.min(1).mean() + d.min(0).mean()) / 2)
    assert (score.points, score.reference_points) == (300, 200)


def test_a_cloud_is_itself_and_a_shift_is_its_length() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1).reshape(-1, 3)
    same = compare(ArrayCloud.of(grid), ArrayCloud.of(np.vstack([grid, [[np.nan] * 3]])))
    assert (same.f1, same.chamfer, same.reference_points) == (1.0, 0.0, len(grid))
    moved = compare(ArrayCloud.of(grid + np.array([0, 0, 0.3])), ArrayCloud.of(grid), 0.2)
    assert (moved.precision, moved.recall, moved.f1) == (0, 0, 0)
    assert moved.chamfer == pytest.approx(0.3)


def test_nothing_to_compare() -> None:
    some = ArrayCloud.of([[0, 0, 0]])
    with pytest.raises(InputError, match="the map has no points"):
        compare(ArrayCloud.of([]), some)
    with pytest.raises(InputError, match="the reference cloud has no points"):
        compare(some, ArrayCloud.of([]))
    with pytest.raises(UsageError, match="--threshold 0"):
        compare(some, some, 0.0)
