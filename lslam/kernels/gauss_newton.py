"""One Gauss-Newton step from normal equations, with a guard on unobserved directions; and the bound that trims matches."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.facts import INFORMATION, LEVER, MATCHED, POPULATION
from lslam.kernels.jit import inline, inline_with_arrays, kernel
from lslam.kernels.linalg import eigen, extent, rotate_left
from lslam.kernels.linearisation import Pose, Sums
from lslam.kernels.surface_information import solve_on_surfaces

Floats = NDArray[np.float64]
Limits = tuple[float, float, float]

# A direction flagged as degenerate is still stepped in until its information is below this part of the threshold: normals with
# errors of a degree look like 3e-4 of the information.
UNSEEN = 0.3
# Of the largest eigenvalue: less is what rounding leaves of none.
ROUNDING = 1e-12


@inline_with_arrays
def solve_observed(H: Floats, g: Floats, facts: Floats, weak_share: float, least: float, unseen: float, d: Floats,
                   weak: Floats) -> int:  # fmt: skip
    """Step d = -inv(H) g in the directions the points observe; returns how many they do not, as unit rows of `weak`.

    Rotations are scaled by the rms lever arm, which makes the six eigenvalues comparable; a direction is unobserved when
    it holds less than `weak_share` of the total information or less than `least`, 1/m2, and not followed below `unseen`
    times that.
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
    none = ROUNDING * extent(values)[1]
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
    """The lower triangle from the upper."""
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
    """Move R and t by the step d, whose translation and rotation are given; False when it is not finite."""
    if not (np.isfinite(move) and np.isfinite(turn)):
        return False
    # A step beyond the kernel's width leaves the region where its correspondences mean anything.
    limit = 2.0 * max(scale, 0.5)
    if move > limit:
        for i in range(6):
            d[i] *= limit / move
    t[0] += d[0]
    t[1] += d[1]
    t[2] += d[2]
    rotate_left(R, d[3], d[4], d[5])
    return True


@inline
def scale_by_population(H: Floats, S: Floats, g: Floats, facts: Floats) -> None:
    """What weighs points against each other, divided by its mean: the information stays that of the points."""
    w = facts[MATCHED] / max(facts[POPULATION], 1e-300)
    for i in range(6):
        g[i] *= w
        for j in range(6):
            H[i, j] *= w
            S[i, j] *= w
    facts[INFORMATION] *= w
    facts[LEVER] *= w


@inline_with_arrays
def within(allowed: Floats, H: Floats) -> Floats:
    """H (6, 6) as seen by the directions on which `allowed` (6, 6) projects; where it has no rows, all are."""
    if len(allowed) == 0:
        return H
    A = np.zeros((6, 6))
    for i in range(6):
        for k in range(6):
            for m in range(6):
                for j in range(6):
                    A[i, j] += allowed[i, k] * H[k, m] * allowed[m, j]
    return A


@inline
def make_whole(sums: Sums) -> None:
    """The sums of a linearisation, scaled by what it weighed, and H from its upper triangle."""
    H, S, g, facts = sums
    if facts[POPULATION] > 0.0:
        scale_by_population(H, S, g, facts)
    mirror(H)


@kernel
def step(pose: Pose, sums: Sums, scale: float, limits: Limits, allowed: Floats, d: Floats,
         weak: Floats) -> tuple[bool, int, float, float]:  # fmt: skip
    """Move the pose by one guarded step, left in d (6,): whether it could, how many directions are unobserved, which are
    rows of `weak` (6, 6), and the translation, m, and rotation, rad, of the step.

    limits : `weak_share`, `least` and `unseen` of `solve_observed`
    allowed : projector on the directions that may be stepped in; no rows: on all
    H comes with its upper triangle and leaves whole.
    """
    R, t = pose
    H, _, g, facts = sums
    make_whole(sums)
    # What the projector takes away has no eigenvalue left, so that the step never looks along it in g.
    count = solve_observed(within(allowed, H), g, facts, limits[0], limits[1], limits[2], d, weak)
    move, turn = step_norms(d)
    return move_by(d, move, turn, scale, R, t), count, move, turn


@kernel
def step_on_surfaces(pose: Pose, sums: Sums, scale: float, limits: Limits, allowed: Floats, d: Floats,
                     weak: Floats) -> tuple[bool, int, float, float]:  # fmt: skip
    """As `step`, where S tells what is observed; a kernel of its own, which runs of other residuals need not compile."""
    R, t = pose
    H, S, g, facts = sums
    make_whole(sums)
    mirror(S)
    count = solve_on_surfaces(within(allowed, H), within(allowed, S), g, facts, limits[0], limits[1], d, weak)
    move, turn = step_norms(d)
    return move_by(d, move, turn, scale, R, t), count, move, turn


@kernel
def trimmed(away2: Floats, share: float, gate2: float) -> float:
    """Squared distance up to which the nearest `share` of the matched points lie, `gate2` at most.

    Unmatched points have a negative distance. Bisection: no copy, no sort, and the same for any order of the points.
    """
    if share >= 1.0:
        return gate2
    high = 0.0
    total = 0
    for a in away2:
        if 0.0 <= a <= gate2:
            total += 1
            high = max(high, a)
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        count = 0
        for a in away2:
            if 0.0 <= a <= middle:
                count += 1
        if count >= share * total:
            high = middle
        else:
            low = middle
    return high
