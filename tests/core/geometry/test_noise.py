"""Covariances in gtsam's order, against sampled poses."""

from __future__ import annotations

import numpy as np

from lslam.core.geometry import noise, se3, so3

RNG = np.random.default_rng(4)
T = se3.exp(np.array([3.0, -2.0, 1.0, 0.4, -0.9, 1.7]))
SIGMAS = np.array([3e-3, 1e-3, 7e-3, 2e-3, 5e-3, 1e-3])
MIX = np.linalg.qr(RNG.normal(size=(6, 6)))[0]
COVARIANCE = MIX @ np.diag(SIGMAS**2) @ MIX.T


def disturbed(samples: int) -> np.ndarray:
    """Poses drawn around T in this house's order."""
    d = RNG.multivariate_normal(np.zeros(6), COVARIANCE, samples)
    return se3.make(so3.exp(d[:, 3:]) @ T[:3, :3], T[:3, 3] + d[:, :3])


def test_order_is_that_of_sampled_body_twists() -> None:
    twists = se3.log(se3.inverse(T) @ disturbed(40_000))
    sampled = np.cov(np.concatenate([twists[:, 3:], twists[:, :3]], axis=1).T)
    np.testing.assert_allclose(noise.to_body(COVARIANCE, T), sampled, atol=0.03 * SIGMAS.max() ** 2)


def test_gtsam_agrees_on_the_order() -> None:
    import gtsam

    poses = disturbed(20_000)
    origin = gtsam.Pose3(T)
    twists = np.array([origin.localCoordinates(gtsam.Pose3(pose)) for pose in poses])
    np.testing.assert_allclose(noise.to_body(COVARIANCE, T), np.cov(twists.T), atol=0.03 * SIGMAS.max() ** 2)


def test_there_and_back() -> None:
    poses = np.stack([T, np.eye(4), se3.inverse(T)])
    stack = np.stack([COVARIANCE, 2 * COVARIANCE, 3 * COVARIANCE])
    np.testing.assert_allclose(noise.from_body(noise.to_body(stack, poses), poses), stack, atol=1e-18)


def test_transport_is_that_of_sampled_poses() -> None:
    step = np.array([4.0, -1.0, 2.0])
    ahead = disturbed(40_000) @ se3.make(np.eye(3), T[:3, :3].T @ step)
    sampled = np.cov((ahead[:, :3, 3] - ahead[:, :3, 3].mean(0)).T)
    carried = noise.transport(COVARIANCE, step)[:3, :3]
    np.testing.assert_allclose(carried, sampled, atol=0.03 * carried.max())


def test_rotation_of_axes_keeps_the_spectrum() -> None:
    turned = noise.rotate(COVARIANCE, T[:3, :3])
    np.testing.assert_allclose(np.linalg.eigvalsh(turned[:3, :3]), np.linalg.eigvalsh(COVARIANCE[:3, :3]), rtol=1e-9)
    np.testing.assert_allclose(turned[:3, 3:], T[:3, :3] @ COVARIANCE[:3, 3:] @ T[:3, :3].T, atol=1e-18)
