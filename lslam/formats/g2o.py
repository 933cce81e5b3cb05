"""Pose graphs as g2o text: VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX.

g2o's error of an edge is inv(Z) inv(X_a) X_b as (translation, vector part of the quaternion): its information is in the
axes of b and, of rotations, per half angle, which is four times that per angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.atomic import write_text
from lslam.geometry import noise, se3, so3
from lslam.types.constraint import Constraint, ConstraintKind

Floats = NDArray[np.float64]

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


def read_g2o(path: Path) -> tuple[Floats, list[Constraint]]:
    """Poses (K, 4, 4) in the order of their numbers, and the edges between them; an edge of neighbours is odometry.

    Other kinds of lines are passed over. Raises InputError naming the line when one is not as it should be.
    """
    poses: dict[int, Floats] = {}
    edges: list[tuple[int, int, Floats, Floats]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"pose graph {path} cannot be read: {cause(error)}") from None
    for number, line in enumerate(lines, 1):
        tag, *fields = line.split() or [""]
        try:
            if tag == "VERTEX_SE3:QUAT":
                poses[int(fields[0])] = _pose_of(_numbers(fields[1:], 7))
            elif tag == "EDGE_SE3:QUAT":
                values = _numbers(fields[2:], 28)
                edges.append((int(fields[0]), int(fields[1]), _pose_of(values[:7]), _information(values[7:])))
        except (ValueError, IndexError, np.linalg.LinAlgError) as error:
            raise InputError(f"{path}, line {number}: not a {tag} of g2o: {error}") from None
    place = {name: k for k, name in enumerate(sorted(poses))}
    constraints = []
    for a, b, T, information in edges:
        if a not in place or b not in place:
            raise InputError(f"{path}: an edge joins vertices {a} and {b}, of which one is missing")
        body = (np.linalg.inv(information) / np.outer(_HALF, _HALF))[np.ix_(_ORDER, _ORDER)]
        kind: ConstraintKind = "odometry" if abs(place[b] - place[a]) == 1 else "loop"
        constraints.append(Constraint(place[a], place[b], T, noise.from_body(body, T), kind))
    stacked = np.stack([poses[name] for name in sorted(poses)]) if poses else np.zeros((0, 4, 4))
    return stacked, constraints


def _pose_text(T: Floats) -> str:
    return " ".join(f"{v:.12g}" for v in (*T[:3, 3], *so3.to_quaternion(T[:3, :3])))


def _pose_of(values: Floats) -> Floats:
    if np.linalg.norm(values[3:7]) < 1e-6:
        raise ValueError("a quaternion of length 0")
    return se3.make(so3.from_quaternion(values[3:7]), values[:3])


def _information(values: Floats) -> Floats:
    matrix = np.zeros((6, 6))
    matrix[_UPPER] = values
    matrix = matrix + np.triu(matrix, 1).T
    np.linalg.cholesky(matrix)  # raises LinAlgError when it is no information at all
    return matrix


def _numbers(fields: list[str], count: int) -> Floats:
    if len(fields) != count:
        raise ValueError(f"{len(fields)} numbers where {count} belong")
    values = np.array([float(field) for field in fields])
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    return values
