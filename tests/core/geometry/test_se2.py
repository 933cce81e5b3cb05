"""Planar poses obey the laws of a group, and are those of the 3D poses seen from above."""

import numpy as np

from lslam.core.geometry import se2, se3, so3


def _poses(seed: int, count: int = 50) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.normal(scale=20, size=(count, 2)), rng.uniform(-np.pi, np.pi, count)])


def _near(a: np.ndarray, b: np.ndarray) -> bool:
    away = np.asarray(a) - np.asarray(b)
    away[..., 2] = se2.wrap(away[..., 2])
    return bool(np.abs(away).max() < 1e-10)


def test_poses_and_their_inverses_cancel_on_both_sides() -> None:
    a, b = _poses(1), _poses(2)
    assert _near(se2.compose(a, se2.inverse(a)), np.zeros_like(a))
    assert _near(se2.compose(se2.inverse(a), a), np.zeros_like(a))
    assert _near(se2.compose(a, se2.relative(a, b)), b)


def test_they_are_level_3d_poses_seen_from_above() -> None:
    for a, b in zip(_poses(3, 5), _poses(4, 5), strict=True):
        T = se2.to_se3(a) @ se2.to_se3(b)
        assert _near(se2.of_se3(T), se2.compose(a, b))
        points = np.array([[1.0, 2.0], [-3.0, 0.5]])
        assert np.allclose(se2.apply(a, points), se3.apply(se2.to_se3(a), np.c_[points, [0, 0]])[:, :2])


def test_tilt_leaves_the_heading() -> None:
    tilted = se2.to_se3(np.array([1.0, 2.0, 0.7])) @ se3.make(so3.exp(np.array([0.0, 0.2, 0.0])), np.zeros(3))
    assert np.allclose(se2.of_se3(tilted), [1.0, 2.0, 0.7])
