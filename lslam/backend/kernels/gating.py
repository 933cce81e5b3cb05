"""Gating by odometry's uncertainty: the older keyframes that may show the place of a newer one, see `loops.gating`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import inline, kernel


@inline
def largest_eigenvalue(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """Largest eigenvalue of the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]], in closed form (Smith 1961)."""
    mean = (a + d + f) / 3.0
    a, d, f = a - mean, d - mean, f - mean
    p = math.sqrt((a * a + d * d + f * f + 2.0 * (b * b + c * c + e * e)) / 6.0)
    if p < 1e-300:
        return mean
    half_det = 0.5 * (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)) / (p * p * p)
    return mean + 2.0 * p * math.cos(math.acos(min(max(half_det, -1.0), 1.0)) / 3.0)


@kernel
def gate(
    b: int,
    among: NDArray[np.int64],
    positions: Floats,
    distances: Floats,
    covariances: Floats,
    sums: Floats,
    squares: Floats,
    rates: tuple[float, float],
    bounds: tuple[float, float, float],
) -> NDArray[np.int64]:
    """Indices of the keyframes among `among`, in the same order, that lie within the gate about keyframe `b`.

    positions : (K, 3) world, m; distances : (K,) m travelled; covariances : (K, 6, 6) of the poses, or none
    sums, squares : (K + 1, 3), (K + 1,) cumulative sums of the positions and of their squared norms
    rates : drift in scale, m per m, and in heading, rad per m
    bounds : least distance travelled between two keyframes, m; distance that is always within the gate, m; sigmas of the gate
    """
    kept = np.empty(len(among), np.int64)
    count = 0
    per_m, turn_per_m = rates
    least, near, sigmas = bounds
    x, y, z = positions[b, 0], positions[b, 1], positions[b, 2]
    is_known = len(covariances) > 0
    D, E = np.zeros((3, 3)), np.empty((3, 3))
    for k in among:
        travelled = distances[b] - distances[k]
        if not travelled >= least:
            continue
        dx, dy, dz = x - positions[k, 0], y - positions[k, 1], z - positions[k, 2]
        away = math.sqrt(dx * dx + dy * dy + dz * dz)
        if away > near:
            n = b + 1 - k
            mean_dot = (
                x * (sums[b + 1, 0] - sums[k, 0])
                + y * (sums[b + 1, 1] - sums[k, 1])
                + z * (sums[b + 1, 2] - sums[k, 2])
            ) / n
            lever2 = max(x * x + y * y + z * z - 2.0 * mean_dot + (squares[b + 1] - squares[k]) / n, 0.0)
            reach2 = (per_m * travelled) ** 2 + (turn_per_m * travelled) ** 2 * lever2
            if is_known:
                S, C = covariances[b], covariances[k]
                # hat(d): an error of the older keyframe's rotation moves the newer one.
                D[0, 1], D[0, 2], D[1, 2] = -dz, dy, -dx
                D[1, 0], D[2, 0], D[2, 1] = dz, -dy, dx
                for i in range(3):
                    for j in range(3):
                        # (A C A^T) with A = [I, -D].
                        v = C[i, j]
                        for m in range(3):
                            v -= D[i, m] * C[3 + m, j] + C[i, 3 + m] * D[j, m]
                            for q in range(3):
                                v += D[i, m] * C[3 + m, 3 + q] * D[j, q]
                        E[i, j] = S[i, j] - v
                reach2 += max(
                    largest_eigenvalue(
                        E[0, 0],
                        0.5 * (E[0, 1] + E[1, 0]),
                        0.5 * (E[0, 2] + E[2, 0]),
                        E[1, 1],
                        0.5 * (E[1, 2] + E[2, 1]),
                        E[2, 2],
                    ),
                    0.0,
                )
            if away > near + sigmas * math.sqrt(reach2):
                continue
        kept[count] = k
        count += 1
    return kept[:count]
