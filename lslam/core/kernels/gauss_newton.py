"""One Gauss-Newton step from normal equations, with a guard on unobserved directions.

The prior that joins these as one more measurement, and the bound that trims matches.
"""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import inline, inline_with_arrays, kernel
from lslam.core.kernels.linalg import eigen, extent, rotate_in_place
from lslam.core.kernels.linearisation import INFORMATION, LEVER, MATCHED, POPULATION, Pose, Sums, Width
from lslam.core.kernels.residuals import solve_on_surfaces

Limits = tuple[float, float, float]

# A degenerate direction is still estimated until its information is below this part of the threshold: errors of a degree in the
# normals alone give a direction that nothing observes 3e-4 of the information.
UNSEEN_SHARE = 0.3
# Part of the largest eigenvalue below which an eigenvalue is an error of rounding.
ROUNDING_SHARE = 1e-12


@inline_with_arrays
def solve_guarded_step(
    H: Floats, g: Floats, facts: Floats, weak_share: float, least: float, unseen: float, d: Floats, weak: Floats
) -> int:
    """Step d = -inv(H) g, (6,) m and rad, in the observed directions; returns the number of degenerate ones, rows of `weak`.

    Rotations are scaled by the rms lever arm, m, which makes the six eigenvalues comparable. A direction is degenerate when
    its eigenvalue is less than `weak_share` of the total information or less than `least`, 1/m2. It is excluded from the step
    below `unseen` times that threshold: solution remapping (Zhang, Kaess and Singh 2016).
    """
    lever = math.sqrt(max(facts[LEVER] / max(facts[INFORMATION], 1e-300), 1e-6))
    A = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            A[i, j] = H[i, j] * (1.0 if i < 3 else 1.0 / lever) * (1.0 if j < 3 else 1.0 / lever)
    values, vectors = eigen(A)
    d[:] = 0.0
    count = 0
    needed = max(weak_share * facts[INFORMATION], least)
    none = ROUNDING_SHARE * extent(values)[1]
    for k in range(6):
        if values[k] <= needed or values[k] <= none:
            for i in range(6):
                weak[count, i] = vectors[i, k]
            count += 1
            if values[k] <= unseen * needed or values[k] <= none:
                continue
        dot = 0.0
        for i in range(6):
            dot += vectors[i, k] * g[i] * (1.0 if i < 3 else 1.0 / lever)
        for i in range(6):
            d[i] -= vectors[i, k] * dot / values[k] * (1.0 if i < 3 else 1.0 / lever)
    return count


@inline
def mirror(H: Floats) -> None:
    """Copy the upper triangle of H (6, 6) into the lower one, in place."""
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]


@inline
def step_norms(d: Floats) -> tuple[float, float]:
    """Translation, m, and rotation, rad, of an update (6,)."""
    return (
        math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]),
        math.sqrt(d[3] * d[3] + d[4] * d[4] + d[5] * d[5]),
    )


@inline
def move_by(d: Floats, move: float, turn: float, scale: float, R: Floats, t: Floats) -> bool:
    """Move R and t by the step d (6,), bounded by the kernel's width `scale`, m; False when the step is not finite.

    move, turn : norms of the translation, m, and the rotation, rad, of d
    """
    if not (np.isfinite(move) and np.isfinite(turn)):
        return False
    # Correspondences are not valid beyond a step of the kernel's width.
    limit = 2.0 * max(scale, 0.5)
    if move > limit:
        for i in range(6):
            d[i] *= limit / move
    t[0] += d[0]
    t[1] += d[1]
    t[2] += d[2]
    rotate_in_place(R, d[3], d[4], d[5])
    return True


@inline
def scale_by_population(H: Floats, S: Floats, g: Floats, facts: Floats) -> None:
    """Divide H, S, g and the information by the mean relative weight, so that H is the information of the points."""
    w = facts[MATCHED] / max(facts[POPULATION], 1e-300)
    for i in range(6):
        g[i] *= w
        for j in range(6):
            H[i, j] *= w
            S[i, j] *= w
    facts[INFORMATION] *= w
    facts[LEVER] *= w


@inline_with_arrays
def within(projector: Floats, H: Floats) -> Floats:
    """Projected information A H A (6, 6), A = `projector` (6, 6); H itself for a projector without rows."""
    if len(projector) == 0:
        return H
    A = np.zeros((6, 6))
    for i in range(6):
        for k in range(6):
            for m in range(6):
                for j in range(6):
                    A[i, j] += projector[i, k] * H[k, m] * projector[m, j]
    return A


@inline
def make_whole(sums: Sums) -> None:
    """Divide the sums of a linearisation by the mean relative weight of its points; fill in H's lower triangle."""
    H, S, g, facts = sums
    if facts[POPULATION] > 0.0:
        scale_by_population(H, S, g, facts)
    mirror(H)


@kernel
def step(
    pose: Pose, sums: Sums, scale: float, limits: Limits, projector: Floats, d: Floats, weak: Floats
) -> tuple[bool, int, float, float]:
    """Move the pose by one step in the observed directions, and write the step to d (6,), m and rad.

    sums : of a linearisation; of H only the upper triangle is needed, the lower one is filled in
    scale : width of the robust kernel, m
    limits : `weak_share`, `least` and `unseen` of `solve_guarded_step`
    projector : (6, 6) on the directions that may be estimated; (0, 6) allows all
    weak : (6, 6), whose first rows become the degenerate directions

    Returns whether the step is finite, the number of degenerate directions, and the step's translation, m, and rotation, rad.
    """
    R, t = pose
    H, _, g, facts = sums
    make_whole(sums)
    # Directions that the projector excludes have eigenvalue 0, so that their part of g does not enter the step.
    count = solve_guarded_step(within(projector, H), g, facts, limits[0], limits[1], limits[2], d, weak)
    move, turn = step_norms(d)
    return move_by(d, move, turn, scale, R, t), count, move, turn


@kernel
def step_on_surfaces(
    pose: Pose, sums: Sums, scale: float, limits: Limits, projector: Floats, d: Floats, weak: Floats
) -> tuple[bool, int, float, float]:
    """As `step`, which explains the arguments, with degenerate directions by S.

    It is a separate kernel, so that runs of other residuals need not compile it.
    """
    R, t = pose
    H, S, g, facts = sums
    make_whole(sums)
    mirror(S)
    count = solve_on_surfaces(within(projector, H), within(projector, S), g, facts, limits[0], limits[1], d, weak)
    move, turn = step_norms(d)
    return move_by(d, move, turn, scale, R, t), count, move, turn


@kernel
def trimming_distance2(distance2: Floats, share: float, gate2: float) -> float:
    """Quantile `share` of the squared distances `distance2` (S,), m2, of the matched points within `gate2`.

    Unmatched points have a negative distance. Bisection needs no copy and no sort, and is independent of the points' order.
    """
    if share >= 1.0:
        return gate2
    high = 0.0
    total = 0
    for a in distance2:
        if 0.0 <= a <= gate2:
            total += 1
            high = max(high, a)
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        count = 0
        for a in distance2:
            if 0.0 <= a <= middle:
                count += 1
        if count >= share * total:
            high = middle
        else:
            low = middle
    return high


@kernel
def linearise_prior(
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
