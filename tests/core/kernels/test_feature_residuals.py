"""Edges and planar points on one earlier scan: counterparts by brute force, normal equations by NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from numpy_features import Match, gradient, match_edge, match_plane, match_point, nearest, normal_equations

from lslam.core.geometry import se3, so3
from lslam.core.kernels import linearisation as at
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.voxel import OFFSET
from lslam.odometry.feature_map import no_counterparts
from lslam.odometry.kernels import feature_grid, feature_residuals
from lslam.registration.gaussian_map import GaussianMap

Floats = NDArray[np.float64]
SIZE, REACH, VARIANCE = 1.0, 2.0, 4e-4
# rad2; four degrees.
UNSURE = 5e-3


@dataclass
class Scene:
    """Points with rings in a grid, the same in the world frame, source points and a pose."""

    grid: tuple[NDArray, ...]  # type: ignore[type-arg]
    world: Floats
    rings: NDArray[np.int64]
    source: Floats
    R: Floats
    t: Floats
    kept: feature_grid.Matches | None = None

    def matches(self, kind: str) -> list[Match]:
        x = self.source @ self.R.T + self.t
        if kind == "point":
            found = [match_point(s, y, self.world, REACH, VARIANCE) for s, y in zip(self.source, x, strict=True)]
        else:
            match = match_edge if kind == "edge" else match_plane
            found = [match(s, y, self.world, self.rings, REACH, VARIANCE) for s, y in zip(self.source, x, strict=True)]
        return [m for m in found if m is not None]

    def search(self) -> feature_grid.Matches:
        """A search that remembers nothing, or the one that is kept."""
        return no_counterparts(len(self.source)) if self.kept is None else self.kept

    def linearise(self, kind: str, c: float) -> tuple[Floats, Floats, Floats]:
        if kind == "plane":
            return self.linearise_planes(c, np.zeros_like(self.world))[:3]
        H, S, g, facts = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
        feature_residuals.linearise_edges(
            (self.source,), self.grid, (SIZE, REACH, VARIANCE, kind != "point"), self.search(),
            (self.R, self.t), (c, c, np.inf), (H, S, g, facts),
        )  # fmt: skip
        np.testing.assert_array_equal(S, H)
        return whole(H), g, facts

    def linearise_planes(self, c: float, normals: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        H, S, g, facts = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
        feature_residuals.linearise_planes(
            (self.source,), (*self.grid, normals), (SIZE, REACH, VARIANCE, True), self.search(), (self.R, self.t),
            (c, c, np.inf), (H, S, g, facts),
        )  # fmt: skip
        return whole(H), g, facts, whole(S)


def whole(H: Floats) -> Floats:
    return np.asarray(np.triu(H) + np.triu(H, 1).T)


def make_scene(seed: int, n: int = 700) -> Scene:
    """A sparse cloud: some source points find a neighbour at once, some only shells away, some none."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-6, -6, -1], [6, 6, 2], (n, 3))
    rings = np.sort(rng.integers(0, 12, n)).astype(np.uint16)
    T = se3.make(so3.exp(np.array([0.1, -0.05, 1.0])), np.array([40.0, -25.0, 3.0]))
    grid = feature_grid.build(points, rings, np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), SIZE)
    source = np.concatenate([rng.uniform([-6, -6, -1], [6, 6, 2], (60, 3)), rng.uniform(-9, 9, (60, 3))])
    off = T @ se3.exp(rng.normal(0, 0.05, 6))
    return Scene(
        grid, grid[0], grid[1].astype(np.int64), source, np.ascontiguousarray(off[:3, :3]), off[:3, 3].copy()
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(0)


@kernel
def search(x: Floats, size: float, limit: float, ring: int, nearby: int, skipped: int, points: Floats,
           rings: NDArray[np.uint16], starts: NDArray[np.int32], keys: NDArray[np.int64],
           table: NDArray[np.int32]) -> tuple[int, float, float]:  # fmt: skip
    return feature_grid.nearest(
        x[0], x[1], x[2], size, limit, ring, nearby, skipped, points, rings, starts, keys, table
    )


def test_the_grid_keeps_every_point_with_its_ring() -> None:
    rng = np.random.default_rng(3)
    points, rings = rng.uniform(-9, 9, (500, 3)), rng.integers(0, 64, 500).astype(np.uint16)
    world, world_rings, starts, keys, _ = feature_grid.build(points, rings, np.eye(3), np.zeros(3), SIZE)
    expected = sorted(map(tuple, np.column_stack([points, rings])))
    assert sorted(map(tuple, np.column_stack([world, world_rings]))) == expected
    cells = np.floor(world / SIZE).astype(np.int64) + OFFSET
    for c, key in enumerate(keys):
        inside = cells[starts[c] : starts[c + 1]]
        assert len(inside)
        assert {(x << 42) | (y << 21) | z for x, y, z in inside.tolist()} == {int(key)}


@pytest.mark.parametrize("limit", [0.3, 1.0, 2.0, 2.7])
def test_nearest_is_that_of_brute_force(scene: Scene, limit: float) -> None:
    rng = np.random.default_rng(1)
    found = 0
    for x in scene.source @ scene.R.T + scene.t:
        ring, j = int(rng.integers(0, 12)), int(rng.integers(0, len(scene.world)))
        away = np.abs(scene.rings - ring)
        own = (away == 0) & (np.arange(len(away)) != j)
        for nearby, allowed in ((-1, away >= 0), (0, own), (2, (away > 0) & (away <= 2))):
            k, d2, next_d2 = search(x, SIZE, limit, ring, nearby, j, *scene.grid)
            expected = nearest(x, scene.world, allowed, limit)
            assert k == expected
            if k >= 0:
                found += 1
                assert d2 == pytest.approx(float(np.sum((scene.world[k] - x) ** 2)))
                others = allowed & (np.arange(len(away)) != k)
                second = np.sum((scene.world[others] - x) ** 2, axis=1).min(initial=limit**2)
                assert next_d2 == pytest.approx(second)
    assert 0 < found < 3 * len(scene.source)


@pytest.mark.parametrize("x", [[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0], [0, -1e300, 0]])
def test_a_point_that_is_not_finite_has_no_neighbour(scene: Scene, x: list[float]) -> None:
    assert search(np.array(x, np.float64), SIZE, REACH, 0, -1, -1, *scene.grid)[0] == -1


@pytest.mark.parametrize("kind", ["edge", "plane", "point"])
@pytest.mark.parametrize("c", [0.05, 0.4, 5.0])
def test_normal_equations_are_those_of_numpy(scene: Scene, kind: str, c: float) -> None:
    found = scene.matches(kind)
    H, g, facts = scene.linearise(kind, c)
    expected_H, expected_g, expected_facts = normal_equations(found, scene.R, scene.t, c)
    assert 20 < len(found) < len(scene.source)
    np.testing.assert_allclose(H, expected_H, atol=1e-6 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, atol=1e-6 * np.abs(expected_g).max())
    np.testing.assert_allclose(facts, expected_facts, rtol=1e-6)


@pytest.mark.parametrize("kind", ["edge", "plane", "point"])
@pytest.mark.parametrize("c", [0.2, 2.0])
def test_gradient_is_that_of_the_robust_cost(scene: Scene, kind: str, c: float) -> None:
    _, g, _ = scene.linearise(kind, c)
    numeric = gradient(scene.matches(kind), scene.R, scene.t, c)
    np.testing.assert_allclose(g, numeric, atol=1e-6 * np.abs(numeric).max())


def test_a_plane_moves_the_pose_along_the_normal_of_its_surface_where_that_is_known(scene: Scene) -> None:
    rng = np.random.default_rng(5)
    normals = rng.normal(size=scene.world.shape)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    unknown = rng.random(len(normals)) < 0.4
    normals[unknown] = 0.0
    H, g, facts, S = scene.linearise_planes(0.4, normals)
    expected_H, expected_g, expected_S = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
    seen = set()
    for m in scene.matches("plane"):
        u = normals[np.flatnonzero((scene.world == m.p).all(axis=1))[0]]
        n = m.A[0]
        along = n if not u.any() else np.sign(n @ u) * u
        rotated = scene.R @ m.s
        j = np.concatenate([along, np.cross(rotated, along)])
        w = m.robust(scene.R, scene.t, 0.4) / m.variance
        expected_H += w * np.outer(j, j)
        expected_g += w * j * m.residual(scene.R, scene.t)[0]
        is_sure = bool(u.any()) or m.waver < UNSURE
        expected_S += w * np.outer(j, j) * is_sure
        seen.add((bool(u.any()), is_sure))
    assert seen == {(True, True), (False, True), (False, False)}
    np.testing.assert_allclose(H, expected_H, atol=1e-6 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, atol=1e-6 * np.abs(expected_g).max())
    np.testing.assert_allclose(S, expected_S, atol=1e-6 * np.abs(expected_S).max())
    np.testing.assert_allclose(facts, scene.linearise("plane", 0.4)[2], rtol=1e-12)


def normals_around(points: Floats, voxels: GaussianMap, thick: float, waver: float) -> Floats:
    normals = np.zeros_like(points)
    feature_residuals.add_normals(points, voxels.size, thick, waver, voxels.planes, voxels.keys, voxels.table, normals)
    return normals


def test_normals_around_points_are_those_of_flat_voxels_alone() -> None:
    rng = np.random.default_rng(2)
    floor = np.column_stack([rng.uniform(0.1, 1.9, (60, 2)), rng.normal(1.0, 0.01, 60)])
    wall = floor[:20, [2, 1, 0]]
    corner = np.concatenate([floor[20:], wall]) + np.array([4.0, 0.0, 0.0])
    line = np.column_stack([np.linspace(8.1, 9.9, 30), np.full(30, 1.0), rng.normal(1.0, 0.01, 30)])
    points = np.concatenate([floor, corner, line, [[20.0, 1.0, 1.0]]])
    voxels = GaussianMap(2.0)
    voxels.insert(points.astype(np.float32), np.eye(4))
    normals = normals_around(points, voxels, 0.1**2, 1.0)
    np.testing.assert_allclose(np.abs(normals[:60, 2]), 1.0, atol=1e-3)
    assert not normals[60:].any()
    thick = normals_around(points, voxels, 9.0, 1.0)
    assert thick[60:120].any(), "two surfaces in one voxel would pass for one, were it not for their thickness"
    assert not normals_around(points, voxels, 0.1**2, 1e-9).any(), "no normal is as sure as that"


def test_points_in_line_make_no_plane_and_points_of_one_ring_no_line() -> None:
    line = np.column_stack([np.arange(0.0, 4.0, 0.2), np.zeros(20), np.zeros(20)])
    source = line[::3] + np.array([0.05, 0.02, 0.1])
    for rings in (np.zeros(20, np.uint16), np.arange(20, dtype=np.uint16) // 10):
        grid = feature_grid.build(line, rings, np.eye(3), np.zeros(3), SIZE)
        s = Scene(grid, grid[0], grid[1].astype(np.int64), source, np.eye(3), np.zeros(3))
        assert s.linearise("plane", 1.0)[2][at.MATCHED] == 0
        assert s.linearise("edge", 1.0)[2][at.MATCHED] == len(s.matches("edge"))
        assert s.linearise("point", 1.0)[2][at.MATCHED] == len(source)
    one_ring = feature_grid.build(line, np.zeros(20, np.uint16), np.eye(3), np.zeros(3), SIZE)
    s = Scene(one_ring, one_ring[0], one_ring[1].astype(np.int64), source, np.eye(3), np.zeros(3))
    assert s.linearise("edge", 1.0)[2][at.MATCHED] == 0


@pytest.mark.parametrize("kind", ["edge", "plane", "point"])
def test_counterparts_that_are_remembered_are_those_of_a_new_search(kind: str) -> None:
    """Steps from far below the gap between two points to far above it, and back, with another alignment in between."""
    scene = make_scene(5)
    kept = no_counterparts(len(scene.source))
    remembering = replace(scene, kept=kept)
    rng, reused = np.random.default_rng(6), 0
    for step in (0.0, 1e-4, 1e-2, 0.05, 0.3, 2.0, 1e-2, 1e-3):
        move = rng.normal(0, step, 3)
        scene, remembering = replace(scene, t=scene.t + move), replace(remembering, t=remembering.t + move)
        before = kept[1].copy()
        for own, expected in zip(remembering.linearise(kind, 0.4), scene.linearise(kind, 0.4), strict=True):
            np.testing.assert_array_equal(own, expected)
        reused += int((kept[1][:, 0] == before[:, 0]).all(axis=1).sum()) if step else 0
    assert reused > len(scene.source)


def test_an_empty_scan_and_an_empty_target_match_nothing(scene: Scene) -> None:
    none = feature_grid.build(np.zeros((0, 3)), np.zeros(0, np.uint16), np.eye(3), np.zeros(3), SIZE)
    for grid, source in ((none, scene.source), (scene.grid, np.zeros((0, 3)))):
        s = Scene(grid, grid[0], grid[1].astype(np.int64), source, scene.R, scene.t)
        for kind in ("edge", "plane", "point"):
            H, g, facts = s.linearise(kind, 1.0)
            assert not H.any()
            assert not g.any()
            assert not facts.any()
