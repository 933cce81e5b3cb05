"""ATE: how far the aligned estimate lies from the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.errors import UsageError, nearest
from lslam.evaluation.results import ALIGNMENTS, AbsoluteError
from lslam.evaluation.statistics import describe, percent_of_length
from lslam.geometry import se3, so3, umeyama

Floats = NDArray[np.float64]


def absolute_error(estimate: Floats, truth: Floats, alignment: str) -> AbsoluteError:
    """ATE of matched poses (N, 4, 4), N >= 1, under `alignment`; z of the ground truth's world is up.

    Agrees with evo's APE (translation part, rotation angle) for none, origin, se3 and sim3.
    Raises UsageError for an unknown alignment.
    """
    T, scale, note = align(estimate, truth, alignment)
    if note:
        empty = np.zeros((0, 3))
        return AbsoluteError(
            alignment, False, note, None, None, None, None, float("nan"), T, scale, empty, np.zeros(0), empty
        )
    positions = scale * estimate[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    errors = positions - truth[:, :3, 3]
    turned = np.swapaxes(T[:3, :3] @ estimate[:, :3, :3], -1, -2) @ truth[:, :3, :3]
    # Printed matrices are rotations to six digits only; the angle of the nearest rotation is what is meant.
    angles = np.rad2deg(so3.angle(so3.normalise(turned)))
    translation = describe(np.linalg.norm(errors, axis=1))
    return AbsoluteError(
        alignment=alignment,
        available=True,
        note="",
        translation=translation,
        rotation_deg=describe(angles),
        horizontal=describe(np.linalg.norm(errors[:, :2], axis=1)),
        vertical=describe(np.abs(errors[:, 2])),
        percent_of_length=percent_of_length(translation.rmse, truth) if translation else float("nan"),
        T_gt_est=T,
        scale=scale,
        errors=errors,
        rotation_errors_deg=angles,
        aligned_positions=positions,
    )


def align(estimate: Floats, truth: Floats, alignment: str) -> tuple[Floats, float, str]:
    """Transform (4, 4), scale, and a note that is not empty when the alignment is not determined."""
    if alignment not in ALIGNMENTS:
        raise UsageError(f"no alignment {alignment!r}; {nearest(alignment, ALIGNMENTS)}")
    p, q = estimate[:, :3, 3], truth[:, :3, 3]
    if alignment == "none":
        return np.eye(4), 1.0, ""
    if alignment == "origin":
        return np.asarray(truth[0] @ se3.inverse(estimate[0])), 1.0, ""
    if len(p) < 3:
        return np.eye(4), 1.0, f"n/a ({len(p)} poses)"
    if alignment == "posyaw":
        return _position_and_yaw(p, q)
    T, scale, is_determined = umeyama.align(p, q, with_scale=alignment == "sim3")
    return (T, scale, "") if is_determined else (np.eye(4), 1.0, "n/a (collinear)")


def _position_and_yaw(p: Floats, q: Floats) -> tuple[Floats, float, str]:
    """The four unknowns that gravity leaves open (Zhang and Scaramuzza 2018, section IV)."""
    a, b = p - p.mean(0), q - q.mean(0)
    sine = float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))
    cosine = float(np.sum(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    if np.hypot(sine, cosine) <= 1e-12 * max(float(np.sum(b * b)), 1e-12):
        return np.eye(4), 1.0, "n/a (no horizontal motion)"
    R = so3.exp(np.array([0.0, 0.0, np.arctan2(sine, cosine)]))
    return se3.make(R, q.mean(0) - R @ p.mean(0)), 1.0, ""
