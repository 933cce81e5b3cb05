"""Pose graphs as g2o text: VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX.

g2o's error of an edge is inv(Z) inv(X_a) X_b as (translation, vector part of the quaternion): its information is in the
axes of b and, of rotations, per half angle, which is four times that per angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lslam.core.geometry import noise, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.constraint import Constraint
from lslam.io.formats.atomic import write_text

_UPPER = np.triu_indices(6)
# From gtsam's order of `noise.to_body` (rotation first) to g2o's, and from rad to the quaternion's vector part.
_ORDER = np.array([3, 4, 5, 0, 1, 2])
_HALF = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])


def write_g2o(path: Path, poses: Floats, constraints: Sequence[Constraint]) -> None:
    """Write poses (K, 4, 4), m, as vertices 0..K-1, the first one fixed, and constraints as edges.

    Raises OutputError when the file cannot be written.
    """
    lines = [f"VERTEX_SE3:QUAT {k} {_pose_text(pose)}" for k, pose in enumerate(poses)]
    lines += ["FIX 0"] if len(poses) else []
    for c in constraints:
        body = noise.to_body(c.covariance, c.T_a_b)[np.ix_(_ORDER, _ORDER)] * np.outer(_HALF, _HALF)
        information = np.linalg.inv(body)
        values = " ".join(f"{v:.9g}" for v in (0.5 * (information + information.T))[_UPPER])
        lines.append(f"EDGE_SE3:QUAT {c.a} {c.b} {_pose_text(c.T_a_b)} {values}")
    write_text(path, "\n".join(lines) + "\n")


def _pose_text(T: Floats) -> str:
    return " ".join(f"{v:.12g}" for v in (*T[:3, 3], *so3.to_quaternion(T[:3, :3])))
