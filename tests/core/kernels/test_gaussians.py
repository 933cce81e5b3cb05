"""The local map's voxels: moments, kinds, decay, eviction and the hash table."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from numpy_voxels import FLOOR, VoxelMap, cell_of, find_all, kind_of

from lslam.core.geometry import so3
from lslam.core.kernels import gaussians
from lslam.core.kernels.voxel import pack
from lslam.registration.gaussian_map import GaussianMap

Floats = NDArray[np.float64]


def pose(R: Floats, t: Floats) -> Floats:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def at(*t: float) -> Floats:
    return pose(np.eye(3), np.array(t, float))


def surfaces(seed: int, n: int = 4000) -> NDArray[np.float32]:
    """A floor, a wall, a pole, a bush and single points: planes, lines, blobs and voxels too empty to match."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-8, 8, (n, 2)), rng.normal(-1.7, 0.01, n)])
    wall = np.column_stack([rng.uniform(-8, 8, n), rng.normal(5.1, 0.02, n), rng.uniform(-2, 4, n)])
    pole = np.column_stack([rng.normal(0, 0.02, (n // 8, 2)) + np.array([3.3, 2.2]), rng.uniform(-2, 4, n // 8)])
    bush = rng.normal(0, 0.6, (n // 4, 3)) + np.array([-4.0, -5.0, 1.0])
    return np.concatenate([floor, wall, pole, bush, rng.uniform(-9, 9, (40, 3))]).astype(np.float32)


def live_slots(m: GaussianMap) -> NDArray[np.int64]:
    return np.flatnonzero(m.keys != gaussians.FREE)


def test_the_slope_of_a_narrow_strip_stays_uncertain_however_many_points_it_has() -> None:
    """Its points may all be a centimetre too high at one end: more of them do not tell."""
    rng = np.random.default_rng(4)
    strip = np.column_stack([rng.uniform(0.2, 0.7, 2000), rng.uniform(0.1, 0.9, 2000), rng.normal(0.5, 0.002, 2000)])
    m = GaussianMap(1.0, count_cap=1e9, scan_variance=FLOOR)
    tilts = []
    for points in np.array_split(strip.astype(np.float32), 10):
        m.insert(points, at(0.0, 0.0, 0.0))
        tilts.append(float(m.planes[live_slots(m)[0], 7]))
    across2 = 0.5**2 / 12
    assert np.sqrt(tilts[-1]) == pytest.approx(np.sqrt(FLOOR / across2), rel=0.05)
    assert tilts[-1] > 0.9 * tilts[0]


def test_the_place_of_the_sensor_is_kept_about_the_middle_of_each_voxel() -> None:
    """The mean over its points, of two scans from two places: what tells a surface from what one ring of it shows."""
    m, places = GaussianMap(1.0), (np.array([1.0, -2.0, 3.0]), np.array([-4.0, 0.5, 0.25]))
    for k, t in enumerate(places):
        m.insert((surfaces(1) - t).astype(np.float32)[k::2], pose(np.eye(3), t))
    slots = live_slots(m)
    n = m.moments[slots, :1]
    centres = np.array([cell_of(int(key)) for key in m.keys[slots]]) + 0.5
    seen_from = m.moments[slots, 10:13] / n + centres
    share = (seen_from - places[1]) @ (places[0] - places[1]) / np.sum((places[0] - places[1]) ** 2)
    np.testing.assert_allclose(seen_from, places[1] + share[:, None] * (places[0] - places[1]), atol=1e-5)
    assert share.min() >= -1e-6
    assert share.max() <= 1 + 1e-6
    assert np.average(share, weights=n[:, 0]) == pytest.approx(0.5, abs=1e-3)


def assert_same_voxels(m: GaussianMap, reference: VoxelMap) -> None:
    slots = live_slots(m)
    assert {cell_of(int(m.keys[s])) for s in slots} == set(reference.voxels)
    assert len(m) == len(slots)
    kinds = set()
    for slot in slots:
        cell = cell_of(int(m.keys[slot]))
        voxel = reference.voxels[cell]
        mean, cov = voxel.moments()
        n = m.moments[slot, 0]
        centre = (np.array(cell) + 0.5) * m.size
        assert n == pytest.approx(voxel.count, rel=1e-9)
        np.testing.assert_allclose(m.moments[slot, 1:4] / n + centre, mean, atol=1e-9)
        s = m.moments[slot, 4:] / n
        second = np.array([[s[0], s[1], s[2]], [s[1], s[3], s[4]], [s[2], s[4], s[5]]])
        np.testing.assert_allclose(second, cov + np.outer(mean - centre, mean - centre), atol=1e-9)
        kinds.add(assert_same_plane(m, slot, kind_of(voxel, m.min_points, m.planarity)))
    assert kinds == {"plane", "blob", "empty"}


def assert_same_plane(m: GaussianMap, slot: int, expected: tuple[str, Floats, Floats, float, float]) -> str:
    kind, mean, normal, variance, tilt = expected
    p = m.planes[slot]
    if kind == "empty":
        assert p[7] == gaussians.EMPTY
        return kind
    np.testing.assert_allclose(p[:3], mean, atol=1e-9)
    assert p[6] == pytest.approx(variance, rel=1e-6)
    if kind == "plane":
        assert abs(p[3:6] @ normal) == pytest.approx(1.0, abs=1e-9)
        assert p[7] == pytest.approx(tilt, rel=1e-5)
    else:
        assert p[7] == gaussians.BLOB
    return kind


@pytest.mark.parametrize("size", [0.8, 2.5])
def test_one_scan_gives_the_gaussians_of_numpy(size: float) -> None:
    R, t = so3.exp(np.array([0.1, -0.2, 0.7])), np.array([103.0, -57.0, 4.0])
    points = surfaces(0)
    m, reference = GaussianMap(size, count_cap=1e9), VoxelMap(size, cap=1e9)
    assert m.insert(points, pose(R, t)) == 0
    reference.insert(points, R, t)
    assert_same_voxels(m, reference)
    assert m.planes[live_slots(m), 6].max() > FLOOR


def test_many_scans_fade_the_old_points_as_the_cap_says() -> None:
    m, reference = GaussianMap(1.0, count_cap=20), VoxelMap(1.0, cap=20)
    for k in range(8):
        R, t = so3.exp(np.array([0.0, 0.0, 0.3 * k])), np.array([0.5 * k, 0.1 * k, 0.0])
        points = surfaces(k, 700)
        m.insert(points, pose(R, t))
        reference.insert(points, R, t)
    counts = m.moments[live_slots(m), 0]
    # A voxel is looked at again only when it has grown by a tenth.
    assert 20 <= counts.max() < 22
    slots = live_slots(m)
    for slot in slots:
        voxel = reference.voxels[cell_of(int(m.keys[slot]))]
        assert m.moments[slot, 0] == pytest.approx(voxel.count, rel=1e-9)
        centre = (np.array(cell_of(int(m.keys[slot]))) + 0.5) * m.size
        np.testing.assert_allclose(m.moments[slot, 1:4] / m.moments[slot, 0] + centre, voxel.moments()[0], atol=1e-9)


def test_a_moved_surface_is_forgotten() -> None:
    rng = np.random.default_rng(0)
    m = GaussianMap(1.0, count_cap=100)
    for k in range(20):
        points = np.column_stack([rng.uniform(0.1, 0.9, (100, 2)), np.full(100, 0.3 if k < 10 else 0.7)])
        m.insert(points.astype(np.float32), np.eye(4))
    assert m.planes[live_slots(m)[0], 2] == pytest.approx(0.7, abs=0.01)


def test_planes_are_refreshed_after_a_tenth_more_points() -> None:
    rng = np.random.default_rng(0)
    m = GaussianMap(1.0)
    box = rng.uniform(0.1, 0.9, (100, 3)) * [1, 1, 0.001]
    m.insert(box.astype(np.float32), np.eye(4))
    before = m.planes[live_slots(m)[0]].copy()
    m.insert(box[:9].astype(np.float32) + np.float32(0.05), np.eye(4))
    np.testing.assert_array_equal(m.planes[live_slots(m)[0]], before)
    m.insert(box[9:11].astype(np.float32) + np.float32(0.05), np.eye(4))
    assert (m.planes[live_slots(m)[0], :3] != before[:3]).all()


def test_a_standing_sensor_does_not_collapse_a_voxel() -> None:
    point = np.tile(np.array([[0.3, 0.3, 0.3]], np.float32), (50, 1)) + np.eye(50, 3, dtype=np.float32) * 0.2
    m = GaussianMap(1.0)
    for _ in range(200):
        m.insert(point, np.eye(4))
    assert m.planes[live_slots(m)[0], 6] >= FLOOR
    assert np.isfinite(m.planes[live_slots(m)]).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e7, -1e30])
def test_points_without_a_voxel_are_counted_and_left_out(bad: float) -> None:
    points = surfaces(1, 300)
    expected = GaussianMap(0.8)
    expected.insert(points, np.eye(4))
    m = GaussianMap(0.8)
    spoilt = np.concatenate([np.full((3, 3), bad, np.float32), points, np.array([[0, bad, 0]], np.float32)])
    assert m.insert(spoilt, np.eye(4)) == 4
    np.testing.assert_array_equal(m.moments, expected.moments)
    np.testing.assert_array_equal(m.keys, expected.keys)


def test_a_pose_that_is_not_finite_enters_nothing() -> None:
    m = GaussianMap(0.8)
    for bad in (at(np.nan, 0, 0), at(0, np.inf, 0), np.full((4, 4), np.nan)):
        assert m.insert(surfaces(1, 300), bad) == len(surfaces(1, 300))
    assert len(m) == 0
    assert m.insert(np.zeros((0, 3), np.float32), np.eye(4)) == 0


def test_the_pool_grows_and_changes_nothing_by_it() -> None:
    small, large = GaussianMap(0.5, capacity=256), GaussianMap(0.5, capacity=1 << 16)
    for k in range(4):
        points = np.random.default_rng(k).uniform(-20, 20, (3000, 3)).astype(np.float32)
        assert small.insert(points, at(k, 0, 0)) == large.insert(points, at(k, 0, 0)) == 0
    assert len(small.keys) > 256
    assert len(small) == len(large) > 5000
    slots = live_slots(small)
    np.testing.assert_array_equal(slots, live_slots(large))
    for name in ("keys", "moments", "planes"):
        np.testing.assert_array_equal(getattr(small, name)[slots], getattr(large, name)[slots])
    np.testing.assert_array_equal(find_all(small.keys[slots], small.keys, small.table), slots)


def test_old_ground_is_forgotten_by_distance() -> None:
    rng = np.random.default_rng(0)
    m = GaussianMap(1.0, reach=30.0)
    sizes = []
    for k in range(150):
        m.insert(rng.uniform(-20, 20, (2000, 3)).astype(np.float32), at(2.0 * k, 0.0, 0.0))
        sizes.append(len(m))
    slots = live_slots(m)
    centres = np.array([cell_of(int(m.keys[s])) for s in slots]) + 0.5
    away = np.linalg.norm(centres - [298.0, 0.0, 0.0], axis=1)
    # The hand passes the whole pool every few scans: stragglers are a few scans behind.
    assert away.max() < 30.0 + 40.0
    assert max(sizes[75:]) < 1.2 * np.mean(sizes[75:])
    assert int(m.pool[gaussians.USED]) < 1.5 * max(sizes)
    np.testing.assert_array_equal(find_all(m.keys[slots], m.keys, m.table), slots)


def test_eviction_looks_at_two_voxels_per_voxel_touched() -> None:
    rng = np.random.default_rng(0)
    m = GaussianMap(1.0, reach=30.0)
    m.insert(rng.uniform(-20, 20, (3000, 3)).astype(np.float32), np.eye(4))
    full = len(m)
    far = at(1000.0, 0.0, 0.0)
    one = np.zeros((1, 3), np.float32)
    m.insert(one, far)
    assert full + 1 - 2 <= len(m) <= full + 1
    for _ in range(full):
        m.insert(one, far)
    assert len(m) == 1
    assert (m.table >= 0).sum() == 1


@given(st.integers(0, 2**31), st.integers(20, 60))
@settings(max_examples=25)
def test_lookups_survive_any_order_of_insertion_and_eviction(seed: int, steps: int) -> None:
    """A table of 256 entries up to a quarter full, so that chains form; freed entries must not cut them."""
    rng = np.random.default_rng(seed)
    m = GaussianMap(1.0, reach=4.0, capacity=64)
    position = np.zeros(3)
    for _ in range(steps):
        position += rng.normal(0, 2.0, 3)
        m.insert(rng.uniform(-2.3, 2.3, (rng.integers(1, 12), 3)).astype(np.float32), at(*position))
        slots = live_slots(m)
        assert len(m) == len(slots) == (m.table >= 0).sum()
        np.testing.assert_array_equal(find_all(m.keys[slots], m.keys, m.table), slots)
        used, freed = int(m.pool[gaussians.USED]), int(m.pool[gaussians.FREED])
        assert used - freed == len(slots)
        assert set(m.free[:freed].tolist()) | set(slots.tolist()) == set(range(used))
    absent = np.array([pack(500 + i, 7, -3) for i in range(50)])
    assert (find_all(absent, m.keys, m.table) == -1).all()


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_coarser_voxels_hold_the_exact_moments(factor: int) -> None:
    points = surfaces(3)
    m = GaussianMap(0.5, count_cap=1e9)
    m.insert(points, np.eye(4))
    coarse = m.coarsen(factor)
    assert coarse.size == 0.5 * factor
    reference = VoxelMap(0.5 * factor, cap=1e9)
    reference.insert(points, np.eye(3), np.zeros(3))
    assert_same_voxels(coarse, reference)
    used = coarse.keys >= 0
    np.testing.assert_array_equal(coarse.refreshed[used], coarse.moments[used, 0])


def test_coarsening_an_empty_map_gives_an_empty_map() -> None:
    assert len(GaussianMap(0.8).coarsen(3)) == 0
