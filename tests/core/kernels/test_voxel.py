"""Voxel keys, range gate and down-sampling against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lslam.core.kernels import voxel

UNTIMED = np.zeros(0, np.float32)
NO_BOX = np.zeros(0)


def cloud(seed: int = 0, n: int = 5000, spread: float = 20.0) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(-spread, spread, (n, 3)).astype(np.float32)


def groups(points: NDArray[np.float32], size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Index of the first point of each voxel, in order of appearance, and the voxel number of each point in that order."""
    cells = np.floor(points.astype(np.float64) * (1.0 / size))
    _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order].astype(np.int64), rank[inverse.ravel()]


@given(st.tuples(*[st.integers(-(2**20), 2**20 - 1)] * 3), st.tuples(*[st.integers(-(2**20), 2**20 - 1)] * 3))
@settings(max_examples=200)
def test_keys_are_unique_positive_and_unpack(a: tuple[int, int, int], b: tuple[int, int, int]) -> None:
    key = int(voxel.pack(*a))
    assert 0 <= key < 2**63
    unpacked = tuple((key >> shift & voxel.MASK) - voxel.OFFSET for shift in (42, 21, 0))
    assert unpacked == a
    assert (key == int(voxel.pack(*b))) == (a == b)


def test_a_map_finds_its_voxels_in_few_probes() -> None:
    mask = 2**16 - 1
    floor = [(i, j, -3) for i in range(-50, 50) for j in range(-50, 50)]
    walls = [(i, j, k) for i in (-20, 21) for j in range(-50, 50) for k in range(-2, 10)]
    taken: set[int] = set()
    probes = 0
    for cell in floor + walls:
        home = int(voxel.hash_key(voxel.pack(*cell), mask))
        assert 0 <= home <= mask
        while home in taken:
            home, probes = (home + 1) & mask, probes + 1
        taken.add(home)
        probes += 1
    assert probes < 1.5 * len(taken)


@pytest.mark.parametrize("n", [0, 1, 31, 32, 33, 5000])
def test_tables_are_powers_of_two_at_most_half_full(n: int) -> None:
    size = int(voxel.table_size(n))
    assert size >= max(2 * n, 64)
    assert size & (size - 1) == 0
    assert size < max(4 * n, 65)


@pytest.mark.parametrize("is_cylinder", [False, True])
def test_gate_is_the_numpy_mask(is_cylinder: bool) -> None:
    points = cloud()
    points[::50] = 0.0
    points[1::50, 1] = np.nan
    points[2::50, 2] = np.inf
    points[3::50, 0] = -np.inf
    box = np.array([-3.0, 4.0, -5.0, 6.0, -7.0, 8.0])
    p = points.astype(np.float64)
    r = np.linalg.norm(p[:, : 2 if is_cylinder else 3], axis=1)
    inside = ((p >= box[::2]) & (p <= box[1::2])).all(1)
    expected = np.isfinite(p).all(1) & (p != 0).any(1) & (r >= 2.5) & (r <= 18.0) & ~inside
    np.testing.assert_array_equal(voxel.gate(points, 2.5, 18.0, is_cylinder, box), np.flatnonzero(expected))
    assert expected.any()
    assert np.any(inside & (r >= 2.5))


def test_gate_without_limits_drops_only_what_is_no_point() -> None:
    points = np.array([[0, 0, 0], [0, 0, 5], [np.nan, 1, 1], [1, 2, np.inf], [3, 0, 0], [1e15, 0, 0]], np.float32)
    assert voxel.gate(points, 0.0, np.inf, False, NO_BOX).tolist() == [1, 4, 5]
    assert voxel.gate(points, 0.0, np.inf, True, NO_BOX).tolist() == [1, 4, 5]
    assert voxel.gate(points, 0.0, 100.0, True, NO_BOX).tolist() == [1, 4]
    assert voxel.gate(np.zeros((0, 3), np.float32), 0.0, 100.0, False, NO_BOX).tolist() == []


@pytest.mark.parametrize("size", [0.3, 1.0, 2.7])
def test_centroids_and_scatter_are_those_of_numpy(size: float) -> None:
    points = cloud(1, spread=4.0)
    first, voxel_of = groups(points, size)
    out, _, scatter, found = voxel.centroids(points, UNTIMED, size)
    assert len(out) == len(first)
    counts = np.bincount(voxel_of)
    np.testing.assert_array_equal(found, counts)
    assert counts.max() > 1
    p = points.astype(np.float64)
    mean = np.stack([np.bincount(voxel_of, p[:, k]) for k in range(3)], axis=1) / counts[:, None]
    np.testing.assert_allclose(out, mean, atol=1e-6)
    away = p - mean[voxel_of]
    for column, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        expected = np.bincount(voxel_of, away[:, i] * away[:, j]) / counts
        np.testing.assert_allclose(scatter[:, column], expected, atol=1e-6)


@pytest.mark.parametrize("is_timed", [False, True])
def test_means_are_the_centroids_to_the_last_bit(is_timed: bool) -> None:
    points = cloud(4, 3000, 5.0)
    times = np.linspace(-0.05, 0.05, 3000).astype(np.float32) if is_timed else UNTIMED
    whole, times_of, _, counts = voxel.centroids(points, times, 0.7)
    for a, b in zip((whole, times_of, counts), voxel.means(points, times, 0.7), strict=True):
        np.testing.assert_array_equal(a, b)
    assert counts.max() > 1
    assert len(times_of) == (len(whole) if is_timed else 0)


def test_impossible_ranges_are_removed_and_counted() -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [0, np.inf, 0], [0, 0, -9999.5], [0, 0, 10000]], np.float32)
    assert voxel.count_within(points, 1e4) == 2
    assert voxel.count_within(points[:0], 1e4) == 0


def test_centroids_far_from_the_origin_keep_their_digits() -> None:
    points = (cloud(2, 2000, 0.5) + np.array([90_000.0, -70_000.0, 300.0])).astype(np.float32)
    out, _, scatter, _ = voxel.centroids(points, UNTIMED, 1.0)
    _, voxel_of = groups(points, 1.0)
    p = points.astype(np.float64)
    for j in range(len(out)):
        np.testing.assert_allclose(scatter[j, [0, 3, 5]], p[voxel_of == j].var(0), atol=1e-6)
        np.testing.assert_allclose(out[j], p[voxel_of == j].mean(0), rtol=1e-7)


@pytest.mark.parametrize("size", [0.3, 1.0, 2.7])
def test_first_points_are_those_of_numpy(size: float) -> None:
    points = cloud(3)
    np.testing.assert_array_equal(voxel.first_points(points, size), groups(points, size)[0])


def test_one_point_and_none() -> None:
    one = np.array([[1.0, 2.0, 3.0]], np.float32)
    out, _, scatter, _ = voxel.centroids(one, UNTIMED, 0.5)
    np.testing.assert_array_equal(out, one)
    np.testing.assert_array_equal(scatter, np.zeros((1, 6)))
    none = np.zeros((0, 3), np.float32)
    assert voxel.centroids(none, UNTIMED, 0.5)[0].shape == (0, 3)
    assert voxel.first_points(none, 0.5).shape == (0,)


def test_points_on_voxel_borders_belong_to_the_upper_voxel() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0], [0.999, 0, 0], [-0.001, 0, 0]], np.float32)
    assert voxel.first_points(points, 1.0).tolist() == [0, 1, 2]
    np.testing.assert_allclose(voxel.centroids(points, UNTIMED, 1.0)[0][:, 0], [0.4995, 1.0, -0.5005], atol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30, -314573.1])
def test_points_without_a_voxel_do_not_affect_others(bad: float) -> None:
    good = cloud(4, 300, 3.0)
    points = np.concatenate([np.array([[0.0, 0.0, bad]], np.float32), good])
    assert set(groups(good, 0.3)[0] + 1) <= set(voxel.first_points(points, 0.3).tolist())
    out, _, scatter, _ = voxel.centroids(points, UNTIMED, 0.3)
    expected, _, expected_scatter, _ = voxel.centroids(good, UNTIMED, 0.3)
    np.testing.assert_array_equal(out[-len(expected) :], expected)
    np.testing.assert_array_equal(scatter[-len(expected) :], expected_scatter)
    assert len(out) == len(expected) + 1


def test_results_do_not_depend_on_the_memory_layout_of_the_caller() -> None:
    wide = np.random.default_rng(5).uniform(-5, 5, (4000, 4)).astype(np.float32)
    view, copy = wide[:, :3], np.ascontiguousarray(wide[:, :3])
    assert voxel.centroids(view, UNTIMED, 0.7)[0].tobytes() == voxel.centroids(copy, UNTIMED, 0.7)[0].tobytes()
    np.testing.assert_array_equal(voxel.first_points(view, 0.7), voxel.first_points(copy, 0.7))


def test_mean_times_and_the_two_halves_of_a_sweep() -> None:
    """A wall where the sweep closes: seen first and last, with the sensor elsewhere. Its centroids stay apart."""
    points = cloud(6, 6000, 2.0)
    times = np.random.default_rng(6).uniform(0.0, 0.1, len(points)).astype(np.float32)
    times[:2] = [0.0, 0.1]
    out, mean_times, scatter, _ = voxel.centroids(points, times, 0.7)
    is_late = times > 0.05
    parts = [voxel.centroids(points[part], UNTIMED, 0.7) for part in (~is_late, is_late)]
    together = np.concatenate([part[0] for part in parts])
    assert len(out) == len(together) > len(voxel.centroids(points, UNTIMED, 0.7)[0])
    order, wanted = np.lexsort(out.T), np.lexsort(together.T)
    np.testing.assert_allclose(out[order], together[wanted], atol=1e-6)
    np.testing.assert_allclose(scatter[order], np.concatenate([part[2] for part in parts])[wanted], atol=1e-6)
    _, voxel_of = groups(points[is_late], 0.7)
    means = np.bincount(voxel_of, times[is_late].astype(float)) / np.bincount(voxel_of)
    np.testing.assert_allclose(mean_times[mean_times > 0.05], means, rtol=1e-5)
    assert len(voxel.centroids(points, UNTIMED, 0.7)[1]) == 0


def test_take_gives_the_rows_in_the_order_asked_for() -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(200, 3)).astype(np.float32)
    index = rng.integers(0, 200, 333)
    np.testing.assert_array_equal(voxel.take(points, index), points[index])
    assert voxel.take(points, index[:0]).shape == (0, 3)


@pytest.mark.parametrize("is_timed", [True, False])
@pytest.mark.parametrize("box", [NO_BOX, np.array([-5.0, 5, -4, 4, -3, 3])])
def test_gated_points_are_those_that_the_gate_names(is_timed: bool, box: NDArray[np.float64]) -> None:
    points = cloud(3)
    points[::7] = np.nan
    times = np.arange(len(points), dtype=np.float32) if is_timed else UNTIMED
    chosen = voxel.gate(points, 2.0, 15.0, True, box)
    assert 0 < len(chosen) < len(points)
    kept, when = voxel.select_in_gate(points, times, 2.0, 15.0, True, box)
    np.testing.assert_array_equal(kept, points[chosen])
    np.testing.assert_array_equal(when, chosen.astype(np.float32) if is_timed else UNTIMED)
