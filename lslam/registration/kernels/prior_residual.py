"""The residual of a pose to its prior, which joins the normal equations of a scan as one more measurement."""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.linearisation import MATCHED, POPULATION, Pose, Sums, Width


@kernel
def linearise(
    points: Floats,
    target: tuple[Floats, Floats, Floats],
    settings: float,
    search: float,
    pose: Pose,
    width: Width,
    sums: Sums,
) -> None:
    """Add the prior R0 (3, 3), t0 (3,) with its information (6, 6), world axes, to H and g, see `linearisation`.

    The residual is t - t0, m, and the rotation vector of R R0^T, rad. Its Jacobian is approximated by the identity, which is
    valid for a prior with an error of a few degrees. The information is multiplied by the mean relative weight of the points,
    by which all sums are divided at the end of a linearisation.
    """
    R0, t0, information = target
    R, t = pose
    H, _, g, facts = sums
    away = np.empty(6)
    D = np.zeros((3, 3))
    for i in range(3):
        away[i] = t[i] - t0[i]
        for j in range(3):
            for k in range(3):
                D[i, j] += R[i, k] * R0[j, k]
    away[3], away[4], away[5] = D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]
    # The norm of the vector is twice the sine of the angle.
    sine = 0.5 * np.sqrt(away[3] * away[3] + away[4] * away[4] + away[5] * away[5])
    cosine = 0.5 * (D[0, 0] + D[1, 1] + D[2, 2] - 1.0)
    stretch = 0.5 if sine < 1e-9 else 0.5 * np.arctan2(sine, cosine) / sine
    for i in range(3, 6):
        away[i] *= stretch
    share = facts[POPULATION] / facts[MATCHED] if facts[POPULATION] > 0.0 and facts[MATCHED] > 0.0 else 1.0
    for i in range(6):
        for j in range(6):
            g[i] += share * information[i, j] * away[j]
            if j >= i:
                H[i, j] += share * information[i, j]
