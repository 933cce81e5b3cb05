"""Statistical outlier removal against its definition, counted by brute force, and against Open3D itself."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.registration.preprocessing.prepare import dense_points, gate_points


def cloud(seed: int, n: int = 400) -> NDArray[np.float32]:
    """A wall, a ball and a tenth of stray points."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.uniform(-5, 5, (n, 2)), rng.normal(6, 0.01, n)])
    ball = rng.normal([4, 4, 0], 0.3, (n // 2, 3))
    return np.concatenate([wall, ball, rng.uniform(-20, 20, (n // 10, 3))]).astype(np.float32)


def brute_force(points: NDArray[np.float32], neighbours: int, deviations: float) -> list[int]:
    p = points.astype(np.float64)
    all_distances = np.sqrt(((p[:, None] - p[None]) ** 2).sum(2))
    mean = np.sort(all_distances, axis=1)[:, :neighbours].mean(1)
    usual = mean.sum() / len(mean)
    spread = np.sqrt(((mean[mean > 0] - usual) ** 2).sum() / (len(mean) - 1))
    return np.flatnonzero((mean > 0) & (mean < usual + deviations * spread)).tolist()


@pytest.mark.parametrize(("neighbours", "deviations"), [(10, 2.0), (4, 1.0), (2, 0.1), (30, 0.5)])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_points_as_the_definition_and_as_open3d(
    seed: int, neighbours: int, deviations: float, open3d: ModuleType
) -> None:
    points = cloud(seed)
    kept = dense_points(points, neighbours, deviations).tolist()
    assert kept == brute_force(points, neighbours, deviations)
    theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    assert kept == list(theirs.remove_statistical_outlier(neighbours, deviations)[1])
    assert 0 < len(kept) < len(points)


def test_stray_points_go_and_surfaces_stay() -> None:
    points = cloud(2)
    stays = np.zeros(len(points), bool)
    stays[dense_points(points, 10, 2.0)] = True
    assert stays[:600].mean() > 0.99
    assert stays[600:].mean() < 0.1


def test_points_that_coincide_have_no_neighbours() -> None:
    twins = np.repeat(np.array([[9.0, 9, 9]], np.float32), 12, axis=0)
    points = np.concatenate([cloud(3), twins])
    kept = dense_points(points, 10, 2.0)
    assert kept.tolist() == brute_force(points, 10, 2.0)
    assert kept.max() < len(points) - 12


@pytest.mark.parametrize("n", [0, 1, 9, 10])
def test_too_few_points_to_judge_all_stay(n: int) -> None:
    assert dense_points(cloud(0)[:n], 10, 2.0).tolist() == list(range(n))
    same = np.ones((n, 3), np.float32)
    assert dense_points(same, 4, 2.0).tolist() == list(range(n))


def test_the_option_reaches_every_methods_points_after_the_ground_is_gone() -> None:
    points = cloud(4)
    gate = gate_points(points, PreprocessConfig())
    config = PreprocessConfig(denoise=True)
    np.testing.assert_array_equal(gate_points(points, config), gate[dense_points(points[gate])])
    both = config.model_copy(update={"remove_ground": True})
    without = gate_points(points, PreprocessConfig(remove_ground=True))
    np.testing.assert_array_equal(gate_points(points, both), without[dense_points(points[without])])
