"""Crispness on maps of known blur, against SciPy and a formula."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.cloud import ArrayCloud
from lslam.maps.crispness import crispness
from lslam.maps.merge import MapMerger


def plane(sigma: float, count: int = 40_000, seed: int = 0) -> NDArray[np.float64]:
    """10 m x 10 m, tilted and far from the origin."""
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.uniform(0, 10, (count, 2)), rng.normal(0, sigma, count)])
    T = se3.make(so3.exp(np.array([0.4, -0.7, 0.3])), np.array([500.0, -2000.0, 30.0]))
    return se3.apply(T, flat)


def reference(points: NDArray[np.float64], radius: float, least: int) -> tuple[float, float]:
    """Plain NumPy: every point's neighbourhood by a k-d tree."""
    entropies, variances = [], []
    for near in cKDTree(points).query_ball_point(points, radius):
        if len(near) < least:
            continue
        part = points[near] - points[near].mean(0)
        C = part.T @ part / (len(near) - 1)
        entropies.append(0.5 * np.linalg.slogdet(2 * np.pi * np.e * C)[1])
        variances.append(np.linalg.eigvalsh(part.T @ part)[0] / (len(near) - 3))
    return float(np.mean(entropies)), float(np.mean(variances))


def test_equals_brute_force() -> None:
    points = np.random.default_rng(3).normal(0, [3, 2, 0.4], (3000, 3))
    entropy, variance = reference(points, 0.5, 10)
    score = crispness(ArrayCloud.of(points))
    assert score.sampled == 3000
    assert score.entropy == pytest.approx(entropy, abs=1e-9)
    assert score.plane_variance == pytest.approx(variance, rel=1e-9)


def test_a_merged_map_is_scored_in_slabs_as_its_points_are(monkeypatch: pytest.MonkeyPatch) -> None:
    merger = MapMerger(0.2, 0.0, 1000.0)
    rng = np.random.default_rng(5)
    merger.add(rng.normal(0, [6, 3, 0.3], (40_000, 3)).astype(np.float32), np.eye(4))
    merged = merger.result()
    monkeypatch.setattr("lslam.maps.merge.BLOCK", 1500)
    slabs, whole = crispness(merged, samples=5000), crispness(ArrayCloud.of(merged.points), samples=5000)
    assert slabs.sampled == whole.sampled
    assert slabs.entropy == pytest.approx(whole.entropy, abs=1e-9)
    assert slabs.plane_variance == pytest.approx(whole.plane_variance, rel=1e-9)
    assert slabs.neighbourhoods == whole.neighbourhoods


@pytest.mark.parametrize("sigma", [0.005, 0.02, 0.05])
def test_a_plane_with_noise_has_its_variance_and_its_entropy(sigma: float) -> None:
    points = plane(sigma)
    score = crispness(ArrayCloud.of(points), samples=5000)
    assert score.plane_variance == pytest.approx(sigma**2, rel=0.04)
    # A disc of radius r: variance r^2 / 4 along both of its axes; half-discs at the border are smaller.
    h = 0.5 * np.log((2 * np.pi * np.e) ** 3 * (0.5**2 / 4) ** 2 * sigma**2)
    assert score.entropy == pytest.approx(h, abs=0.1)
    assert 4900 < score.neighbourhoods <= 5100


def test_both_grow_with_the_blur() -> None:
    """Also after voxel averaging, which is how a run's map is scored."""
    scores = []
    for sigma in (0.0, 0.02, 0.06, 0.12):
        merger = MapMerger(0.2, 0.0, 1e5)
        merger.add(plane(sigma, 200_000) - [500, -2000, 30], np.eye(4))
        scores.append(crispness(merger.result()))
    for attribute in ("entropy", "plane_variance"):
        values = [getattr(score, attribute) for score in scores]
        assert all(a < b for a, b in pairwise(values)), values


def test_the_sample_stands_for_the_whole() -> None:
    points = plane(0.03)
    some, every = crispness(ArrayCloud.of(points), samples=2000), crispness(ArrayCloud.of(points), samples=10**6)
    assert some.sampled == 2000
    assert every.sampled == len(points)
    assert some.plane_variance == pytest.approx(every.plane_variance, rel=0.05)


def test_nothing_to_score() -> None:
    for points in ([], [[0, 0, 0]], np.full((50, 3), np.nan), np.arange(300).reshape(-1, 3) * 10.0):
        score = crispness(ArrayCloud.of(points))
        assert (score.entropy, score.plane_variance, score.neighbourhoods) == (None, None, 0)
    # All points in one place, or on one line: as thin as it gets, and finite.
    for points in (np.zeros((50, 3)), np.outer(np.linspace(0, 1, 50), [1, 0, 0])):
        score = crispness(ArrayCloud.of(points))
        assert np.isfinite([score.entropy, score.plane_variance]).all()
    for bad in ({"radius": 0.0}, {"radius": np.nan}, {"least": 3}, {"samples": 0}):
        with pytest.raises(UsageError, match="a radius above 0"):
            crispness(ArrayCloud.of([]), **bad)


def test_the_sample_data_of_a_drive_is_crisper_at_true_poses(recordings: object) -> None:
    """Real scans: poses disturbed by 5 cm and 0.3 deg blur the map."""
    from lslam.io.formats.trajectory_files import read_trajectory

    drive: Path = recordings("kitti_raw_0048") / "2011_09_26" / "2011_09_26_drive_0048_sync"  # type: ignore[operator]
    poses = read_trajectory(drive / "reference_lidar.tum").poses
    files = sorted((drive / "velodyne_points" / "data").glob("*.bin"))
    scores = []
    for blur in (0.0, 1.0):
        rng = np.random.default_rng(0)
        merger = MapMerger()
        for file, T in zip(files, poses, strict=True):
            error = se3.exp(blur * rng.normal(0, [0.05] * 3 + [0.005] * 3))
            merger.add(np.fromfile(file, np.float32).reshape(-1, 4)[:, :3], error @ T)
        scores.append(crispness(merger.result(), samples=20_000))
    sharp, blurred = scores
    assert sharp.entropy < blurred.entropy - 0.05
    assert sharp.plane_variance < 0.9 * blurred.plane_variance
