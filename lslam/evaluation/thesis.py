"""The numbers of the two theses behind lslam, by their own definitions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.evaluation.absolute import align
from lslam.evaluation.results import AxisErrors, Planar
from lslam.evaluation.statistics import percent_of_length
from lslam.geometry import so3

Floats = NDArray[np.float64]


def axis_errors(estimate: Floats, truth: Floats) -> AxisErrors:
    """First thesis, equations 2.14 and 2.15: errors per axis of poses (N, 4, 4) brought to the true start."""
    T, _, _ = align(estimate, truth, "origin")
    moved = T @ estimate
    e = moved[:, :3, 3] - truth[:, :3, 3]
    R_est, R_gt = so3.normalise(moved[:, :3, :3]), so3.normalise(truth[:, :3, :3])
    rpy = so3.euler_rpy(R_est) - so3.euler_rpy(R_gt)
    rpy_deg = np.rad2deg((rpy + np.pi) % (2 * np.pi) - np.pi)
    angular = np.rad2deg(so3.angle(R_est @ np.swapaxes(R_gt, -1, -2)))
    rmse = _rms(np.linalg.norm(e, axis=1))
    return AxisErrors(
        alignment="origin",
        thesis_rmse=_rms(e),
        rmse=rmse,
        max_error=float(np.linalg.norm(e, axis=1).max()),
        percent_of_length=percent_of_length(rmse, truth),
        xyz_rmse=(_rms(e[:, 0]), _rms(e[:, 1]), _rms(e[:, 2])),
        rpy_rmse_deg=(_rms(rpy_deg[:, 0]), _rms(rpy_deg[:, 1]), _rms(rpy_deg[:, 2])),
        angular_rmse_deg=_rms(angular),
        angular_max_deg=float(angular.max()),
        xyz=e,
        rpy_deg=rpy_deg,
        angular=angular,
    )


def planar(estimate: Floats, truth: Floats) -> Planar:
    """Second thesis, equations 4.2 to 4.7: SE(2) errors of poses (N, 4, 4), N >= 2, after a shared start and heading."""
    T, _, _ = align(estimate, truth, "origin")
    p, q = _flatten(T @ estimate), _flatten(truth)
    # The start is shared in the plane too: flattening a tilted start leaves a rest of yaw.
    p = _compose(q[0], _relative(p[0], p))
    ate = np.linalg.norm(_relative(q, p)[:, :2], axis=1)
    delta = _relative(_relative(q[:-1], q[1:]), _relative(p[:-1], p[1:]))
    translation = np.linalg.norm(delta[:, :2], axis=1)
    return Planar(
        ate_mean=float(ate.mean()),
        ate_std=float(ate.std()),
        rpe_translation_mean=float(translation.mean()),
        rpe_translation_std=float(translation.std()),
        rpe_rotation_mean=float(delta[:, 2].mean()),
        rpe_rotation_std=float(delta[:, 2].std()),
        spacing=float(np.linalg.norm(np.diff(q[:, :2], axis=0), axis=1).mean()),
    )


def _flatten(poses: Floats) -> Floats:
    """(N, 3) x, y, yaw."""
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return np.column_stack([poses[:, :2, 3], yaw])


def _relative(a: Floats, b: Floats) -> Floats:
    """inv(a) b of SE(2) poses (..., 3)."""
    d = b - a
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    turn = (d[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], turn], axis=-1)


def _compose(a: Floats, b: Floats) -> Floats:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.stack([a[0] + c * b[:, 0] - s * b[:, 1], a[1] + s * b[:, 0] + c * b[:, 1], a[2] + b[:, 2]], axis=-1)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
