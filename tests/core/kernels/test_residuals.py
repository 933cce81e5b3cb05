"""The normal equations of scan points on Gaussian voxels: gradient, Hessian and correspondences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from numpy_voxels import Match, VoxelMap, matches

from lslam.core.geometry import so3
from lslam.core.kernels import linearisation as at
from lslam.core.kernels import residuals
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import Correspondences
from lslam.registration.preprocessing.prepare import PreparedPoints

Floats = NDArray[np.float64]
SIZE, SIGMA2, BLOB, ALONG = 0.8, 9e-4, 0.5, 0.03
# A normal that is off by two sigma.
TILT = 2.0**2


@dataclass
class Scene:
    """A map, the same in NumPy, and points that lie beside it at a pose that is a little off."""

    target: GaussianMap
    reference: VoxelMap
    points: PreparedPoints
    R: Floats
    t: Floats

    def matches(self, non_planar_weight: float = BLOB, along: float = ALONG) -> list[Match]:
        p = self.points
        return matches(
            self.reference, p.source, p.scatter, self.R, self.t, SIGMA2, non_planar_weight, TILT, along
        )  # fmt: skip


def surfaces(rng: np.random.Generator, n: int) -> Floats:
    """Floor, two walls and a bush."""
    return np.concatenate(
        [
            np.column_stack([rng.uniform(-6, 6, (n, 2)), rng.normal(-1.5, 0.01, n)]),
            np.column_stack([rng.uniform(-6, 6, n), rng.normal(5.0, 0.02, n), rng.uniform(-1.5, 3, n)]),
            np.column_stack([rng.normal(6.0, 0.02, n), rng.uniform(-6, 5, n), rng.uniform(-1.5, 3, n)]),
            rng.normal(0, 0.5, (n // 3, 3)) + np.array([-4.0, -4.0, 0.5]),
        ]
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(0)
    cloud = surfaces(rng, 1500).astype(np.float32)
    shift = np.array([40.0, -25.0, 3.0])
    target, reference = GaussianMap(SIZE), VoxelMap(SIZE)
    T = np.eye(4)
    T[:3, 3] = shift
    target.insert(cloud, T)
    reference.insert(cloud, np.eye(3), shift)
    R, t = so3.exp(np.array([0.01, -0.02, 0.05])), shift + np.array([0.1, -0.07, 0.05])
    source = surfaces(rng, 60) @ R
    source[::40] += 30.0
    spread = rng.normal(0, 0.05, (len(source), 6, 3))
    scatter = np.stack([np.cov(s.T)[np.triu_indices(3)] for s in spread])
    return Scene(target, reference, PreparedPoints(cloud, source, scatter, len(cloud)), R, t)


def linearise(
    s: Scene, R: Floats, t: Floats, c: float, blob: float = BLOB, gate2: float = np.inf,
    matches: Correspondences | None = None, plane: float = 1.0,
    along: float = ALONG,
) -> tuple[Floats, Floats, Floats]:  # fmt: skip
    m, matches = s.target, Correspondences(len(s.points.source)) if matches is None else matches
    matches.clear()
    H, S, g, facts = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
    residuals.linearise(
        (s.points.source, s.points.scatter), (m.planes, m.keys, m.table), (m.size, SIGMA2, plane, blob, along, False),
        matches.search(m), (R, t), (c, c, gate2), (H, S, g, facts),
    )  # fmt: skip
    np.testing.assert_array_equal(S, 0.0)
    # The kernel fills the upper triangle.
    return np.triu(H) + np.triu(H, 1).T, g, facts


def moved(R: Floats, t: Floats, d: Floats) -> tuple[Floats, Floats]:
    return so3.exp(d[3:]) @ R, t + d[:3]


@pytest.mark.parametrize("c", [0.05, 0.2, 1.0, 5.0])
@pytest.mark.parametrize("blob", [0.0, BLOB])
def test_gradient_is_that_of_the_robust_cost(scene: Scene, c: float, blob: float) -> None:
    found = scene.matches(blob)
    _, g, facts = linearise(scene, scene.R, scene.t, c, blob)
    assert facts[at.MATCHED] == len(found)
    assert {m.normal is None for m in found} == ({True, False} if blob else {False})
    h = 1e-5
    numeric = np.empty(6)
    for k in range(6):
        d = np.zeros(6)
        d[k] = h
        forward = sum(m.cost(*moved(scene.R, scene.t, d), c) for m in found)
        backward = sum(m.cost(*moved(scene.R, scene.t, -d), c) for m in found)
        numeric[k] = (forward - backward) / (2 * h)
    np.testing.assert_allclose(g, numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("along", [ALONG, 1.0])
@pytest.mark.parametrize("c", [0.05, 0.5, 5.0])
def test_normal_equations_are_those_of_numpy(scene: Scene, c: float, along: float) -> None:
    """Blobs count little along the sensor's axis, or, where they stand for points, as much as across."""
    H, g, facts = linearise(scene, scene.R, scene.t, c, along=along)
    expected_H, expected_g = np.zeros((6, 6)), np.zeros(6)
    information, inliers, lever = 0.0, 0, 0.0
    for m in scene.matches(along=along):
        r, J = m.rows(scene.R, scene.t)
        w = m.information(scene.R, scene.t, c)
        expected_H += w * J.T @ J
        expected_g += w * J.T @ r
        # One for a plane, and for a blob what its three axes tell of the place.
        told = float((J[:, :3] ** 2).sum())
        information += w * told
        inliers += float(r @ r) < c * c
        lever += w * told * float(m.point @ m.point)
    np.testing.assert_allclose(H, expected_H, rtol=1e-6, atol=1e-6 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, atol=1e-6 * np.abs(expected_g).max())
    np.testing.assert_array_equal(H, H.T)
    assert facts[at.INFORMATION] == pytest.approx(information, rel=1e-6)
    assert facts[at.INLIERS] == inliers > 0
    assert facts[at.LEVER] == pytest.approx(lever, rel=1e-6)


@pytest.mark.parametrize("gate", [0.02, 0.1])
def test_matches_beyond_the_gate_are_counted_without_weight(scene: Scene, gate: float) -> None:
    H, _, facts = linearise(scene, scene.R, scene.t, 0.5, gate2=gate**2)
    expected = np.zeros((6, 6))
    kept = [m for m in scene.matches() if m.distance2(scene.R, scene.t) <= gate**2]
    for m in kept:
        _, J = m.rows(scene.R, scene.t)
        expected += m.information(scene.R, scene.t, 0.5) * J.T @ J
    np.testing.assert_allclose(H, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert facts[at.MATCHED] == len(scene.matches()) > len(kept) > 0


def test_rmse_facts_are_those_of_the_planes(scene: Scene) -> None:
    _, _, facts = linearise(scene, scene.R, scene.t, 0.3)
    planes = [m for m in scene.matches() if m.normal is not None]
    r2 = np.array([m.distance2(scene.R, scene.t) for m in planes])
    robust = (0.09 / (0.09 + r2)) ** 2
    assert facts[at.SQUARED] == pytest.approx(float(robust @ r2), rel=1e-6)
    assert facts[at.ROBUST] == pytest.approx(float(robust.sum()), rel=1e-6)


@pytest.mark.parametrize("step", [1e-3, 0.02, 0.05])
def test_the_cached_search_gives_the_same_result(scene: Scene, step: float) -> None:
    n = len(scene.points.source)
    matches = Correspondences(n)
    cells, _, chosen, asked, _, _ = matches.search(scene.target)
    asked.fill(np.inf)  # nothing was asked yet
    rng = np.random.default_rng(1)
    R, t = scene.R, scene.t
    same_octant = same_nearest = 0
    for _ in range(12):
        before, place = cells.copy(), asked[:, :3].copy()
        remembered = linearise(scene, R, t, 0.5, matches=matches)
        same_octant += int((before == cells).sum())
        same_nearest += int(((place == asked[:, :3]).all(axis=1) & (chosen[:, 0] >= 0)).sum())
        for a, b in zip(remembered, linearise(scene, R, t, 0.5), strict=True):
            np.testing.assert_array_equal(a, b)
        R, t = moved(R, t, rng.normal(0, step, 6))
    assert 0 < same_nearest < same_octant < 12 * n


def test_points_do_not_observe_directions_in_their_plane() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-6, 6, (9000, 2)), np.full(9000, 0.3)]).astype(np.float32)
    target = GaussianMap(SIZE)
    target.insert(floor, np.eye(4))
    source = floor[::50].astype(np.float64) + np.array([0.2, 0.1, 0.02])
    s = Scene(
        target, VoxelMap(SIZE), PreparedPoints(floor, source, np.zeros((len(source), 6)), 1), np.eye(3), np.zeros(3)
    )
    H, g, _ = linearise(s, s.R, s.t, 1.0, blob=0.0)
    assert abs(g[2]) > 1.0
    np.testing.assert_allclose(g[[0, 1, 5]], 0.0, atol=1e-6 * abs(g[2]))
    np.testing.assert_allclose(H[[0, 1, 5]], 0.0, atol=1e-6 * H[2, 2])


@pytest.mark.parametrize("where", [np.nan, np.inf, 1e9, -1e300])
def test_a_pose_far_off_matches_nothing(scene: Scene, where: float) -> None:
    H, g, facts = linearise(scene, scene.R, np.array([where, 0.0, 0.0]), 1.0)
    np.testing.assert_array_equal(H, 0.0)
    np.testing.assert_array_equal(g, 0.0)
    np.testing.assert_array_equal(facts, 0.0)


def test_an_empty_map_and_an_empty_scan_match_nothing(scene: Scene) -> None:
    empty = Scene(GaussianMap(SIZE), VoxelMap(SIZE), scene.points, scene.R, scene.t)
    assert linearise(empty, scene.R, scene.t, 1.0)[2].tolist() == [0.0] * at.COUNT
    none = PreparedPoints(np.zeros((0, 3), np.float32), np.zeros((0, 3)), np.zeros((0, 6)), 0)
    H, _, facts = linearise(Scene(scene.target, scene.reference, none, scene.R, scene.t), scene.R, scene.t, 1.0)
    assert facts.tolist() == [0.0] * at.COUNT
    np.testing.assert_array_equal(H, 0.0)


def test_planes_and_volumes_have_their_configured_weights(scene: Scene) -> None:
    """H is a sum over both: a quarter of the planes' part and all of the blobs'."""
    H, planes = (linearise(scene, scene.R, scene.t, 0.5, blob)[0] for blob in (BLOB, 0.0))
    quarter = linearise(scene, scene.R, scene.t, 0.5, BLOB, plane=0.25)[0]
    np.testing.assert_allclose(quarter, H - 0.75 * planes, rtol=1e-9, atol=1e-9 * np.abs(H).max())


def test_a_coarser_map_serves_the_points_that_found_no_plane(scene: Scene) -> None:
    """Two calls with one list of done points add up to each point matched once, at the finest map that has a plane."""
    matches, sums = (
        Correspondences(len(scene.points.source)),
        (np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)),
    )
    fine, coarse = scene.target, scene.target.coarsen(3)
    counts = []
    for m in (fine, coarse):
        residuals.linearise(
            (scene.points.source, scene.points.scatter), (m.planes, m.keys, m.table), (m.size, SIGMA2, 1.0, 0.0, ALONG, False),
            matches.search(), (scene.R, scene.t), (0.5, 0.5, np.inf), sums,
        )  # fmt: skip
        counts.append(sums[3][at.MATCHED])
        assert matches.is_done.sum() == counts[-1]
    _, _, alone = linearise(scene, scene.R, scene.t, 0.5, 0.0)
    assert counts[0] == alone[at.MATCHED]
    assert counts[1] > counts[0]
