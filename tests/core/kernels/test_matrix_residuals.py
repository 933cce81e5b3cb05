"""Point to point, G-ICP, VGICP and NDT against NumPy and finite differences, source covariances included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from numpy_residuals import EXTENT2, GemanMcClure, Magnusson, Pair, disc_pairs, ndt_pairs, point_pairs
from numpy_voxels import VoxelMap

from lslam.core.geometry import so3
from lslam.core.kernels import linearisation as at
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.kernels.gicp_residual import source_discs
from lslam.registration.optimiser import Correspondences
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.residuals import RESIDUALS as TABLE

Floats = NDArray[np.float64]
SIZE, SIGMA2, BLOB = 0.8, 9e-4, 0.5
RESIDUALS = ("point", "gicp", "vgicp", "ndt")
# Squared metres beyond which pairs are rejected; infinite keeps all.
GATES = (np.inf, 0.01)


@dataclass
class Scene:
    """A map, the same in NumPy, and points with covariances beside it at a pose that is a little off."""

    target: GaussianMap
    reference: VoxelMap
    source: Floats
    covariance: Floats
    R: Floats
    t: Floats


@dataclass
class Sums:
    H: Floats
    g: Floats
    facts: Floats
    distance2: Floats
    S: Floats


def surfaces(rng: np.random.Generator, n: int) -> Floats:
    """Floor, two walls, a bush and a wire."""
    return np.concatenate(
        [
            np.column_stack([rng.uniform(-6, 6, (n, 2)), rng.normal(-1.5, 0.01, n)]),
            np.column_stack([rng.uniform(-6, 6, n), rng.normal(5.0, 0.02, n), rng.uniform(-1.5, 3, n)]),
            np.column_stack([rng.normal(6.0, 0.02, n), rng.uniform(-6, 5, n), rng.uniform(-1.5, 3, n)]),
            rng.normal(0, 0.5, (n // 3, 3)) + np.array([-4.0, -4.0, 0.5]),
            np.column_stack([rng.uniform(-6, 6, n // 4), rng.normal((0.0, 2.5), 0.01, (n // 4, 2))]),
        ]
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scene_of(SIZE)


def scene_of(size: float) -> Scene:
    rng = np.random.default_rng(0)
    cloud = surfaces(rng, 1500).astype(np.float32)
    shift = np.array([40.0, -25.0, 3.0])
    target, reference = GaussianMap(size), VoxelMap(size)
    T = np.eye(4)
    T[:3, 3] = shift
    target.insert(cloud, T)
    reference.insert(cloud, np.eye(3), shift)
    R, t = so3.exp(np.array([0.01, -0.02, 0.05])), shift + np.array([0.1, -0.07, 0.05])
    source = surfaces(rng, 60) @ R
    source[::40] += 30.0
    spread = rng.normal(0, rng.uniform(0.02, 0.8, (len(source), 1, 3)), (len(source), 8, 3))
    covariance = np.stack([np.cov(s.T)[np.triu_indices(3)] for s in spread])
    return Scene(target, reference, source, covariance, R, t)


def linearise(
    s: Scene,
    residual: str,
    c: float,
    gate2: float = np.inf,
    blob: float = BLOB,
    gap: float = 0.0,
    takes_all: bool = False,
    matches: Correspondences | None = None,
) -> Sums:
    n, kind, matches = len(s.source), TABLE[residual], matches or Correspondences(len(s.source))
    H, S, g, facts = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
    seen = PreparedPoints(
        s.source.astype(np.float32), s.source, np.zeros((n, 6)), n, covariance=s.covariance, gaps=np.full(n, gap)
    )
    kind.linearise(
        kind.points(seen, np.sqrt(SIGMA2)), kind.voxels(s.target),
        (s.target.size, SIGMA2, 1.0, blob, kind.axial_weight, takes_all),
        matches.search(s.target), (s.R, s.t), (c, 0.15, gate2), (H, S, g, facts),
    )  # fmt: skip
    return Sums(np.triu(H) + np.triu(H, 1).T, g, facts, matches.distance2, np.triu(S) + np.triu(S, 1).T)


def reference(s: Scene, residual: str, c: float, blob: float = BLOB) -> tuple[list[Pair], GemanMcClure | Magnusson]:
    if residual == "point":
        return point_pairs(s.reference, s.source, s.R, s.t, SIGMA2), GemanMcClure(c**2 + SIZE**2)
    if residual == "ndt":
        return ndt_pairs(s.reference, s.source, s.R, s.t), Magnusson(SIZE, (c / 0.15) ** 2)
    pairs = disc_pairs(s.reference, s.source, s.covariance, s.R, s.t, SIGMA2, blob, only_nearest=residual == "gicp")
    return pairs, GemanMcClure(c**2)


def close_to(s: Scene, pairs: list[Pair], gate2: float) -> list[Pair]:
    return [p for p in pairs if p.distance2(s.R, s.t) <= gate2]


@pytest.mark.parametrize("residual", RESIDUALS)
@pytest.mark.parametrize("c", [0.15, 1.0])
@pytest.mark.parametrize("gate2", GATES)
def test_gradient_is_that_of_the_cost(scene: Scene, residual: str, c: float, gate2: float) -> None:
    pairs, robust = reference(scene, residual, c)
    pairs = close_to(scene, pairs, gate2)
    numeric = np.empty(6)
    for k in range(6):
        values = []
        for h in (1e-5, -1e-5):
            d = np.zeros(6)
            d[k] = h
            values.append(sum(robust.cost(p, so3.exp(d[3:]) @ scene.R, scene.t + d[:3]) for p in pairs))
        numeric[k] = (values[0] - values[1]) / 2e-5
    found = linearise(scene, residual, c, gate2)
    np.testing.assert_allclose(found.g, numeric, atol=1e-6 * np.abs(numeric).max())
    assert np.abs(numeric).min() > 0


@pytest.mark.parametrize("residual", RESIDUALS)
@pytest.mark.parametrize("c", [0.15, 0.5, 5.0])
@pytest.mark.parametrize("gate2", GATES)
def test_normal_equations_are_those_of_numpy(scene: Scene, residual: str, c: float, gate2: float) -> None:
    pairs, robust = reference(scene, residual, c)
    H, S, g, information, lever = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), 0.0, 0.0
    for p in close_to(scene, pairs, gate2):
        w, J, r = robust.weight(p, scene.R, scene.t), p.jacobian(scene.R), scene.R @ p.point
        H += w * J.T @ p.M @ J
        S += w * p.surface(scene.R)
        g += w * J.T @ p.M @ p.error(scene.R, scene.t)
        information += w * float(np.trace(p.M))
        lever += w * float(np.trace(p.M)) * float(r @ r)
    found = linearise(scene, residual, c, gate2)
    np.testing.assert_allclose(found.H, H, rtol=1e-6, atol=1e-6 * np.abs(H).max())
    np.testing.assert_allclose(found.g, g, rtol=1e-6, atol=1e-6 * np.abs(g).max())
    if residual != "point":
        np.testing.assert_allclose(found.S, S, rtol=1e-6, atol=1e-6 * np.abs(S).max())
    assert found.facts[at.INFORMATION] == pytest.approx(information, rel=1e-6)
    assert found.facts[at.LEVER] == pytest.approx(lever, rel=1e-6)
    if residual == "vgicp":
        assert found.facts[at.POPULATION] == pytest.approx(sum(p.weight for p in pairs), rel=1e-9)


@pytest.mark.parametrize("residual", ["gicp", "vgicp"])
def test_discs_of_wide_voxels_are_as_wide_as_these(residual: str) -> None:
    test_normal_equations_are_those_of_numpy(scene_of(3 * SIZE), residual, 0.5, np.inf)


@pytest.mark.parametrize("residual", RESIDUALS)
def test_distances_and_counts_are_those_of_the_closest_pair(scene: Scene, residual: str) -> None:
    c = 0.3
    pairs, _ = reference(scene, residual, c)
    expected = np.full(len(scene.source), np.inf)
    for p in pairs:
        expected[p.index] = min(expected[p.index], p.distance2(scene.R, scene.t))
    found = linearise(scene, residual, c)
    is_matched = np.isfinite(expected)
    assert 0 < is_matched.sum() < len(expected)
    np.testing.assert_allclose(found.distance2[is_matched], expected[is_matched], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(found.distance2[~is_matched], -1.0)
    assert found.facts[at.MATCHED] == is_matched.sum()
    width2 = c**2 + SIZE**2 if residual == "point" else c**2
    assert found.facts[at.INLIERS] == (expected < width2).sum() > 0
    gated = linearise(scene, residual, c, 0.01)
    np.testing.assert_array_equal(gated.distance2, found.distance2)
    np.testing.assert_array_equal(gated.facts[[at.INLIERS, at.MATCHED]], found.facts[[at.INLIERS, at.MATCHED]])


def test_means_of_few_points_between_distant_rings_are_not_matched(scene: Scene) -> None:
    sparse, dense = np.array([[40.0, -25.0, 80.0]]), np.array([[40.0, -25.0, 90.0]])
    some = np.tile(np.eye(3) / 10, (2, 1)).astype(np.float32)
    target = GaussianMap(SIZE)
    for points in (some[:3] + sparse + 0.05, some + dense + 0.05):
        target.insert(points.astype(np.float32), np.eye(4))
    source = (np.vstack([sparse, dense]) - scene.t) @ scene.R
    few = Scene(target, scene.reference, source, scene.covariance[:2], scene.R, scene.t)
    assert linearise(few, "point", 1.0, gap=0.9 * SIZE).facts[at.MATCHED] == 2
    left = linearise(few, "point", 1.0, gap=1.1 * SIZE)
    assert left.facts[at.MATCHED] == 1
    assert left.distance2[0] == -1.0 < left.distance2[1]
    assert linearise(few, "point", 1.0, gap=1.1 * SIZE, takes_all=True).facts[at.MATCHED] == 2


@pytest.mark.parametrize("residual", ["gicp", "vgicp"])
def test_without_a_weight_volumes_are_not_matched(scene: Scene, residual: str) -> None:
    pairs, _ = reference(scene, residual, 0.5, blob=0.0)
    counted = linearise(scene, residual, 0.5, blob=0.0).facts[at.MATCHED]
    assert counted == len({p.index for p in pairs}) < linearise(scene, residual, 0.5).facts[at.MATCHED]


@pytest.mark.parametrize("residual", RESIDUALS)
@pytest.mark.parametrize("where", [np.nan, np.inf, 1e9])
def test_a_pose_far_off_matches_nothing(scene: Scene, residual: str, where: float) -> None:
    lost = Scene(scene.target, scene.reference, scene.source, scene.covariance, scene.R, np.array([where, 0.0, 0.0]))
    found = linearise(lost, residual, 1.0)
    for sums in (found.H, found.g, found.facts):
        np.testing.assert_array_equal(sums, 0.0)


@pytest.mark.parametrize("residual", RESIDUALS)
def test_a_search_goes_on_as_a_new_one_would(scene: Scene, residual: str) -> None:
    """Steps within octant cells and out of them: what was looked up before changes nothing."""
    matches, rng = Correspondences(len(scene.source)), np.random.default_rng(8)
    for step in (0.0, 1e-3, 0.05, 0.5, 1e-3):
        scene = replace(scene, t=scene.t + rng.normal(0, step, 3))
        matches.clear()
        went_on, new = (linearise(scene, residual, 0.4, matches=m) for m in (matches, None))
        for name in ("H", "g", "facts", "distance2", "S"):
            np.testing.assert_array_equal(getattr(went_on, name), getattr(new, name))


def test_ndt_ignores_voxels_whose_points_lie_on_a_line(scene: Scene) -> None:
    wire = np.column_stack([np.linspace(-5, 5, 50), np.zeros(50), np.full(50, 2.5)])
    source = (wire + np.array([40.0, -25.0, 3.0]) - scene.t) @ scene.R
    on_wire = Scene(scene.target, scene.reference, source, scene.covariance[:50], scene.R, scene.t)
    assert linearise(on_wire, "ndt", 1.0).facts[at.MATCHED] == 0
    assert linearise(on_wire, "point", 1.0).facts[at.MATCHED] == 50


def shapes_after(change: Callable[[GaussianMap], None]) -> Floats:
    """Full Gaussians of a map that was asked before `change` and after it."""
    m = GaussianMap(SIZE)
    m.insert(surfaces(np.random.default_rng(1), 400).astype(np.float32), np.eye(4))
    m.shapes()
    change(m)
    shapes, fresh = m.shapes().copy(), GaussianMap(SIZE)
    for name in ("moments", "planes", "keys", "refreshed", "table", "pool"):
        setattr(fresh, name, getattr(m, name))
    expected, live = fresh.shapes(), m.keys >= 0
    np.testing.assert_array_equal(shapes[live][:, [0, 1, 2, 9, 10]], expected[live][:, [0, 1, 2, 9, 10]])
    used = live & (expected[:, 9] > 0)
    np.testing.assert_array_equal(shapes[used], expected[used])
    return shapes[used]


def test_full_gaussians_follow_the_map() -> None:
    cloud = surfaces(np.random.default_rng(2), 900).astype(np.float32)

    def insert(m: GaussianMap) -> None:
        m.insert(cloud, np.eye(4))

    def replace(m: GaussianMap) -> None:
        m.clear()
        insert(m)

    kept, grown, replaced = shapes_after(lambda m: None), shapes_after(insert), shapes_after(replace)
    assert len(grown) > len(kept)
    assert len(replaced) < len(grown)
    assert not np.array_equal(grown[: len(kept)], kept)


def test_source_points_get_the_normal_of_their_scan_and_rings_get_none() -> None:
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(0, 4, (800, 2)), np.full(800, -1.5)])
    ring = np.column_stack([np.linspace(0.0, 4.0, 200), np.full(200, 7.5), np.full(200, 2.5)])
    scan = GaussianMap(1.0)
    scan.insert(np.concatenate([floor, ring]).astype(np.float32), np.eye(4))
    source = np.array([[1.5, 2.5, -1.5], [2.5, 7.5, 2.5], [50.0, 0.0, 0.0]])
    out = np.zeros((3, 6))
    assert source_discs(source, scan.size, scan.planes, scan.keys, scan.table, SIGMA2, out) == 1
    np.testing.assert_allclose(out[0], [EXTENT2, 0, 0, EXTENT2, 0, SIGMA2], atol=1e-9)
    np.testing.assert_array_equal(out[1:], 0.0)
