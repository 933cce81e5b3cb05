"""Edge voxels read as lines: the eigenvector by NumPy, normal equations by NumPy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from numpy_features import Match, gradient, normal_equations

from lslam.core.geometry import so3
from lslam.core.kernels import linearisation as at
from lslam.odometry.feature_map import MIN_LINE_POINTS
from lslam.odometry.kernels import lines
from lslam.registration.gaussian_map import FLOOR_M2, GaussianMap
from lslam.registration.optimiser import slots_of

Floats = NDArray[np.float64]
SIZE, SIGMA2 = 1.0, 1e-3
# A direction that is off by two sigma.
TILT = 2.0**2


class LineScene:
    """Poles and eaves in an edge map, with their points by voxel, and points beside them."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        poles = [np.column_stack([rng.normal(x, 0.02, 40), rng.normal(y, 0.02, 40), rng.uniform(-1, 3, 40)])
                 for x, y in rng.uniform(-8, 8, (12, 2))]  # fmt: skip
        eave = np.column_stack([rng.uniform(-8, 8, 160), rng.normal(6.0, 0.03, 160), rng.normal(2.7, 0.03, 160)])
        bush = rng.normal([4.0, -4.0, 0.5], 0.4, (80, 3))
        cloud = np.concatenate([*poles, eave, bush]).astype(np.float32)
        self.shift = np.array([30.0, -12.0, 2.0])
        T = np.eye(4)
        T[:3, 3] = self.shift
        self.target = GaussianMap(SIZE)
        self.target.insert(cloud, T)
        self.world = cloud.astype(np.float64) + self.shift
        n = len(self.target.keys)
        self.rows = np.zeros((n, 8)), np.full(n, -1, np.int64), np.zeros(n)
        self.R = so3.exp(np.array([0.01, -0.02, 0.03]))
        self.t = self.shift + np.array([0.05, -0.04, 0.06])
        self.source = np.concatenate([cloud[::7].astype(np.float64), rng.uniform(-9, 9, (20, 3))])

    def linearise(self, c: float) -> tuple[Floats, Floats, Floats]:
        m, n = self.target, len(self.source)
        H, S, g, facts = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
        lines.linearise_lines(
            (self.source,), (m.moments, m.keys, m.table, *self.rows), (SIZE, SIGMA2, float(MIN_LINE_POINTS), FLOOR_M2),
            (*slots_of(n), np.full(n, -1.0)), (self.R, self.t), (c, c, np.inf), (H, S, g, facts),
        )  # fmt: skip
        return np.triu(H) + np.triu(H, 1).T, g, facts

    def lines_by_numpy(self) -> dict[tuple[int, ...], tuple[Floats, Floats, float, float]]:
        """Mean, direction, variance across and of the direction, by voxel."""
        cells = np.floor(self.world / SIZE).astype(int)
        out = {}
        for cell in {tuple(c) for c in cells.tolist()}:
            inside = self.world[(cells == cell).all(axis=1)]
            if len(inside) < MIN_LINE_POINTS:
                continue
            values, vectors = np.linalg.eigh(np.cov(inside.T, bias=True))
            if values[2] < 3 * max(values[1], FLOOR_M2):
                continue
            across = (max(values[0], 0.0) + max(values[1], 0.0)) / 2 + FLOOR_M2
            out[cell] = inside.mean(axis=0), vectors[:, 2], across, across / (len(inside) * values[2])
        return out

    def matches(self) -> list[Match]:
        known = self.lines_by_numpy()
        found = []
        for s in self.source:
            x = self.R @ s + self.t
            corner = np.floor((x - 0.5 * SIZE) / SIZE).astype(int)
            near = [tuple((corner + d).tolist()) for d in np.ndindex(2, 2, 2)]
            choices = [known[c] for c in near if c in known]
            if not choices:
                continue
            mean, u, across, tilt = min(choices, key=lambda line: float(np.linalg.norm(x - line[0])))
            variance = across + SIGMA2 + TILT * tilt * float((x - mean) @ u) ** 2
            found.append(Match(s, mean, np.eye(3) - np.outer(u, u), variance))
        return found


@pytest.fixture(scope="module")
def scene() -> LineScene:
    return LineScene()


@pytest.mark.parametrize("c", [0.05, 0.3, 3.0])
def test_normal_equations_are_those_of_numpy(scene: LineScene, c: float) -> None:
    found = scene.matches()
    H, g, facts = scene.linearise(c)
    expected_H, expected_g, expected_facts = normal_equations(found, scene.R, scene.t, c)
    assert 30 < len(found) < len(scene.source)
    np.testing.assert_allclose(H, expected_H, atol=1e-6 * np.abs(expected_H).max())
    np.testing.assert_allclose(g, expected_g, atol=1e-6 * np.abs(expected_g).max())
    np.testing.assert_allclose(facts, expected_facts, rtol=1e-6)


@pytest.mark.parametrize("c", [0.05, 0.3, 3.0])
def test_gradient_is_that_of_the_robust_cost(scene: LineScene, c: float) -> None:
    numeric = gradient(scene.matches(), scene.R, scene.t, c)
    np.testing.assert_allclose(scene.linearise(c)[1], numeric, atol=1e-6 * np.abs(numeric).max())


def test_a_pole_observes_the_two_directions_across_itself() -> None:
    scene = LineScene()
    scene.source = np.column_stack([np.zeros(8), np.zeros(8), np.linspace(0, 0.7, 8)])
    scene.target = GaussianMap(SIZE)
    rng = np.random.default_rng(0)
    pole = np.column_stack([rng.normal(0.5, 1e-4, (200, 2)), rng.uniform(0, 1, 200)]).astype(np.float32)
    scene.target.insert(pole, np.eye(4))
    scene.R, scene.t = np.eye(3), np.array([0.45, 0.52, 0.0])
    H, g, facts = scene.linearise(1.0)
    assert facts[at.MATCHED] == 8
    assert H[2, 2] < 1e-4 * H[0, 0]
    assert g[0] / H[0, 0] == pytest.approx(-0.05, abs=2e-3)
    assert g[1] / H[1, 1] == pytest.approx(0.02, abs=2e-3)


def test_lines_follow_the_map_as_it_grows_and_as_slots_change_hands(scene: LineScene) -> None:
    """What was computed for a voxel is thrown away when it has more points, or when its slot belongs to another one."""
    fresh = LineScene()
    fresh.linearise(0.3)
    rng = np.random.default_rng(5)
    more = np.column_stack([rng.uniform(-8, 8, 300), rng.normal(6.1, 0.03, 300), rng.normal(2.5, 0.03, 300)])
    T = np.eye(4)
    T[:3, 3] = fresh.shift
    fresh.target.insert(more.astype(np.float32), T)
    kept = fresh.linearise(0.3)
    n = len(fresh.target.keys)
    fresh.rows = np.zeros((n, 8)), np.full(n, -1, np.int64), np.zeros(n)
    for a, b in zip(kept, fresh.linearise(0.3), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(kept[0], scene.linearise(0.3)[0])


def test_a_line_is_updated_when_its_voxel_is_full() -> None:
    """Its count comes back to the cap with every scan: what it held once is not all it will ever hold."""
    scene = LineScene()
    scene.target = GaussianMap(SIZE, count_cap=200)
    scene.R, scene.t = np.eye(3), np.zeros(3)
    scene.source = np.array([[0.5, 0.5, 0.5]])
    offsets = []
    for x in (0.5, 0.5, 0.6, 0.6):
        pole = np.column_stack([np.full(200, x), np.full(200, 0.5), np.linspace(0.01, 0.99, 200)])
        scene.target.insert(pole.astype(np.float32), np.eye(4))
        H, g, _ = scene.linearise(1.0)
        offsets.append(-g[0] / H[0, 0])
    slot = scene.target.moments[:, 0].argmax()
    assert scene.target.moments[slot, 0] == 200
    np.testing.assert_allclose(offsets, [0, 0, 0.05, 0.075], atol=1e-3)


def test_a_pose_that_is_not_finite_matches_nothing(scene: LineScene) -> None:
    t = scene.t
    scene.t = np.array([np.nan, 0.0, 0.0])
    H, _, facts = scene.linearise(1.0)
    scene.t = t
    assert not H.any()
    assert not facts.any()
