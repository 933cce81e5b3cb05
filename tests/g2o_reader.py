"""Pose graphs read from g2o text, to hold what is written against it: lslam itself writes them only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError, cause
from lslam.core.geometry import noise, se3, so3
from lslam.core.types.constraint import Constraint, ConstraintKind

Floats = NDArray[np.float64]
_UPPER = np.triu_indices(6)
# From g2o's order and the quaternion's vector part to rotation first and rad.
_ORDER = np.array([3, 4, 5, 0, 1, 2])
_HALF = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])


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
