"""From a raw scan to map points and source points: what is kept, how many, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError
from lslam.core.kernels import voxel
from lslam.registration.preprocessing.prepare import COARSEST_SOURCE_M, PreparedPoints, gate_points, prepare_points

UNTIMED = np.zeros(0, np.float32)


def street(n: int, seed: int = 0, length: float = 60.0) -> NDArray[np.float32]:
    """Ground and two house fronts."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-length, length, n), rng.uniform(-10, 10, n), rng.normal(-1.7, 0.02, n)])
    fronts = np.column_stack([rng.uniform(-length, length, n), rng.choice([-10.0, 10.0], n), rng.uniform(-1.7, 8, n)])
    return np.concatenate([ground, fronts]).astype(np.float32)


def same(a: PreparedPoints, b: PreparedPoints) -> bool:
    fields = ("map_points", "source", "scatter")
    return a.in_range == b.in_range and all(getattr(a, f).tobytes() == getattr(b, f).tobytes() for f in fields)


def test_map_points_are_centroids_and_source_points_centroids_of_these() -> None:
    points = street(20_000)
    config = PreprocessConfig(range_max=50.0, downsample="grid", source_voxel=1.2, least_line=0)
    out = prepare_points(points, config)
    kept = points[gate_points(points, config)]
    map_points, _, _, _ = voxel.centroids(kept, UNTIMED, config.map_leaf)
    source, _, scatter, _ = voxel.centroids(map_points, UNTIMED, 1.2)
    np.testing.assert_array_equal(out.map_points, map_points)
    np.testing.assert_array_equal(out.source, source)
    np.testing.assert_array_equal(out.scatter, scatter)
    assert out.in_range == len(kept) < len(points)
    assert [a.dtype.name for a in (out.map_points, out.source, out.scatter)] == ["float32", "float64", "float64"]


@pytest.mark.parametrize(("n", "length"), [(9000, 20.0), (20_000, 60.0), (60_000, 60.0), (60_000, 90.0)])
def test_target_count_is_reached_whatever_the_scan(n: int, length: float) -> None:
    config = PreprocessConfig()
    out = prepare_points(street(n, length=length), config)
    assert config.source_points_min <= len(out.source) <= config.source_points_max


def test_sparse_scans_keep_all_their_map_points_and_wide_ones_stop_at_the_coarsest_grid() -> None:
    sparse = prepare_points(street(800), PreprocessConfig())
    assert len(sparse.source) == pytest.approx(len(sparse.map_points), rel=0.05)
    wide = np.random.default_rng(0).uniform(-90, 90, (200_000, 3)).astype(np.float32)
    config = PreprocessConfig(range_max=200.0)
    coarsest = voxel.centroids(prepare_points(wide, config).map_points, UNTIMED, COARSEST_SOURCE_M)[0]
    assert len(prepare_points(wide, config).source) == len(coarsest) > config.source_points_max


def test_the_random_share_is_seeded_scan_by_scan() -> None:
    points = street(5000)
    config = PreprocessConfig(downsample="random", random_share=0.2)
    a, b, other = (prepare_points(points, config, index) for index in (3, 3, 4))
    assert same(a, b)
    assert not same(a, other)
    assert not same(a, prepare_points(points, PreprocessConfig(downsample="random", random_share=0.2, seed=1), 3))
    assert len(a.source) == round(0.2 * a.in_range)
    kept = points[gate_points(points, config)].astype(np.float64)
    rows = {tuple(p) for p in kept.tolist()}
    assert all(tuple(p) in rows for p in a.source.tolist())
    assert len({tuple(p) for p in a.source.tolist()}) == len(a.source)


def test_first_points_and_all_points() -> None:
    points = street(3000)
    first = prepare_points(points, PreprocessConfig(downsample="first", source_voxel=2.0))
    kept = points[gate_points(points, PreprocessConfig())]
    np.testing.assert_array_equal(first.source, kept[voxel.first_points(kept, 2.0)])
    everything = prepare_points(points, PreprocessConfig(downsample="none"))
    np.testing.assert_array_equal(everything.source, kept)
    for out in (first, everything):
        np.testing.assert_array_equal(out.scatter, np.zeros((len(out.source), 6)))


def test_range_cylinder_and_ego_box_reach_the_gate() -> None:
    points = np.array([[0.5, 0, 0], [5, 0, 0], [0, 9, 9], [30, 0, 0], [2, 2, 0]], np.float32)
    sphere = PreprocessConfig(range_min=1.0, range_max=10.0)
    assert gate_points(points, sphere).tolist() == [1, 4]
    assert gate_points(points, sphere.model_copy(update={"range_shape": "cylinder"})).tolist() == [1, 2, 4]
    box = PreprocessConfig(range_max=10.0, ego_box=(1.0, 3.0, 1.0, 3.0, -1.0, 1.0))
    assert gate_points(points, box).tolist() == [1]


def test_bad_points_change_nothing_but_themselves() -> None:
    good = street(4000)
    bad = np.array([[np.nan, 1, 1], [np.inf, 0, 0], [0, 0, 0], [1, -np.inf, 2], [1e6, 0, 0], [np.nan] * 3], np.float32)
    order = np.random.default_rng(0).permutation(len(good) + 600)
    mixed = np.concatenate([good, np.tile(bad, (100, 1))])[order]
    clean = mixed[np.isin(order, np.arange(len(good)))]
    assert same(prepare_points(mixed, PreprocessConfig()), prepare_points(clean, PreprocessConfig()))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((50, 3)), np.full((50, 3), np.nan)])
def test_a_scan_without_usable_points_prepares_to_nothing(points: NDArray[Any]) -> None:
    for kind in ("target", "grid", "first", "random", "none"):
        out = prepare_points(points, PreprocessConfig(downsample=kind))
        assert out.in_range == len(out.map_points) == len(out.source) == len(out.scatter) == 0
        assert out.source.shape[1:] == (3,)


def test_other_types_columns_and_layouts_are_taken_as_they_are() -> None:
    points = street(4000)
    expected = prepare_points(points, PreprocessConfig())
    wide = np.column_stack([points, np.ones(len(points))])
    for variant in (points.astype(np.float64), wide, np.asfortranarray(points), wide.astype(np.float32)[:, :3]):
        assert same(prepare_points(variant, PreprocessConfig()), expected)
    assert prepare_points(np.array([[3, 4, 5], [6, 7, 8]]), PreprocessConfig()).in_range == 2


def test_the_callers_points_are_left_alone() -> None:
    points = street(2000)
    kept = points.copy()
    prepare_points(points, PreprocessConfig())
    np.testing.assert_array_equal(points, kept)


@pytest.mark.parametrize("shape", [(5, 2), (7,), (3, 4, 4), ()])
def test_arrays_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"points .*shape"):
        prepare_points(np.ones(shape), PreprocessConfig())
