"""The HDL-64E correction against Rodrigues' formula in float64 and against kiss-icp's own."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels.transform import rotate_up

ANGLE = math.radians(0.205)


def points(n: int = 400) -> NDArray[np.float32]:
    return np.random.default_rng(3).normal(0, 25, (n, 3)).astype(np.float32)


def lifted(p: NDArray[np.float32], angle: float = ANGLE) -> NDArray[np.float32]:
    out = p.copy()
    rotate_up(out, math.sin(angle), math.cos(angle))
    return out


@pytest.mark.parametrize("angle", [ANGLE, -0.3, 1.0])
def test_vertical_correction_is_the_rotation_about_p_cross_z(angle: float) -> None:
    p = points()
    axis = np.cross(p.astype(np.float64), [0.0, 0.0, 1.0])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    expected = np.einsum("nij,nj->ni", so3.exp(angle * axis), p.astype(np.float64))
    np.testing.assert_allclose(lifted(p, angle), expected, atol=2e-5)


def test_vertical_correction_agrees_with_kiss_icp() -> None:
    pybind = pytest.importorskip("kiss_icp.pybind.kiss_icp_pybind")
    p = points()
    theirs = np.asarray(pybind._correct_kitti_scan(pybind._Vector3dVector(p.astype(np.float64))))
    np.testing.assert_allclose(lifted(p), theirs, atol=2e-5)
    assert (lifted(p)[:, 2] > p[:, 2]).mean() > 0.9


def test_points_without_an_axis_stay_and_nan_stays() -> None:
    p = np.array([[0, 0, 0], [0, 0, 5], [np.nan, 1, 2]], np.float32)
    out = lifted(p)
    np.testing.assert_array_equal(out[:2], p[:2])
    assert np.isnan(out[2, 0])
