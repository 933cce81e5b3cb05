"""Robust rigid alignment of a trajectory with GNSS fixes, and what is wrong with these beside single outliers.

Roll about a straight street and the tilt of a short path are not observable from fixes: the world's up direction is a
measurement beside them, which they outweigh as soon as the geometry allows it. Faults of fixes are in their clock, their sigmas,
and the datum of their heights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lslam.backend.graph.fix_errors import (
    FEWEST,
    NO_HEIGHT,
    ClockOffset,
    actual_sigmas,
    agreeing_heights,
    clock_offset,
    height_levels,
    rough_residuals,
)
from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.geometry import se3, so3
from lslam.core.geometry.noise import quantile
from lslam.core.geometry.se3 import poses_at, turns_between
from lslam.core.types.gnss import GnssStream

# Fixes that heights alone reject, at least, as a share of all.
REJECTED_SHARE = 0.05
# Times as large as the next smaller one, a stated sigma is of another kind of fixes.
SIGMA_RATIO = 4.0
# Share of the heights from which those left out are as plausible.
AMBIGUOUS = 0.4


@dataclass(frozen=True)
class Fixes:
    """The usable fixes of a run, m, and odometry's positions of the antenna.

    stamps_ns : (F,); positions : (F, 3) east, north, up from `origin` (3,) lat, lon, height; sigmas : (F, 3)
    antenna : (F, 3) in the world of odometry; slack : (F,) one sigma of odometry's drift
    has_stated_sigmas : whether the sigmas are those of the recording
    is_overconfident : whether fixes scatter by more than was stated, east or north; the sigmas are those of their scatter
    """

    stamps_ns: Longs
    positions: Floats
    sigmas: Floats
    antenna: Floats
    slack: Floats
    origin: Floats
    count: int
    has_stated_sigmas: bool
    is_overconfident: bool = False

    @property
    def has_height(self) -> Bools:
        """(F,) whether the height counts."""
        return np.asarray(self.sigmas[:, 2] < NO_HEIGHT)


@dataclass(frozen=True)
class Faults:
    """Faults of the fixes in sentences, and as values for the manifest."""

    problems: tuple[str, ...] = ()
    facts: dict[str, Any] | None = None

    def and_another(self, problem: str, **facts: Any) -> Faults:
        """The faults with one more: its sentence and its facts for the manifest."""
        return Faults((*self.problems, problem), {**(self.facts or {}), **facts})


def clock_of(fixes: Fixes, stamps_ns: Longs, poses: Floats, arm: Floats, level: Floats) -> ClockOffset | None:
    """The offset of the fixes' stamps against those of the scans, `stamps_ns` (N,), of `poses` (N, 4, 4); None where unclear.

    arm : (3,) of the antenna; level : (3, 3) of the poses' world
    """
    start, turns = int(stamps_ns[0]), turns_between(poses[:-1], poses[1:])

    def antenna_at(seconds: Floats) -> Floats:
        at = start + np.round(1e9 * seconds).astype(np.int64)
        inside = (at >= stamps_ns[0]) & (at <= stamps_ns[-1])
        poses_there = poses_at(stamps_ns, poses, np.clip(at, stamps_ns[0], stamps_ns[-1]), turns)
        places = (np.einsum("nij,j->ni", poses_there[:, :3, :3], arm) + poses_there[:, :3, 3]) @ level.T
        return np.where(inside[:, None], places, np.nan)

    seconds = np.asarray(1e-9 * (fixes.stamps_ns - start), np.float64)
    offset = clock_offset(seconds, fixes.positions, antenna_at)
    return offset if offset is not None and offset.is_clear else None


def on_clock_of_scans(stream: GnssStream, offset: ClockOffset) -> GnssStream:
    """The fixes with their stamps on the clock of the scans, by the offset."""
    return replace(stream, stamps_ns=stream.stamps_ns + round(1e9 * offset.seconds))


def describe_clock(offset: ClockOffset) -> str:
    """A sentence about a wrong clock."""
    late = offset.seconds < 0
    return (
        f"GNSS: fixes are stamped {abs(offset.seconds):.2f} s {'late' if late else 'early'} (one sigma {offset.sigma:.2g} s): "
        f"there they move as odometry does, and are taken {abs(offset.seconds):.2f} s {'earlier' if late else 'later'}"
    )


def with_actual_sigmas(
    fixes: Fixes, level: Floats, largest: float, probability: float, faults: Faults
) -> tuple[Fixes, Faults]:
    """The fixes with larger sigmas where they scatter by significantly more than stated, and the faults with a sentence on that.

    Sigmas are left as stated where the scatter would make them larger than `largest`, m: those are no fixes.
    level : (3, 3) rotation that makes the trajectory level; probability : of the test for significance
    """
    seconds = 1e-9 * (fixes.stamps_ns - fixes.stamps_ns[0])
    rough = rough_residuals(seconds, fixes.antenna @ level.T, fixes.positions)
    factors = np.ones_like(fixes.sigmas)
    for own in _kinds(fixes.sigmas[:, 0]):
        found = actual_sigmas(seconds[own], rough[own], fixes.sigmas[own], probability)
        if found is not None and float(np.median(fixes.sigmas[own, :2] * found[:2], axis=0).max()) <= largest:
            factors[own] = found
    wrong = (factors > 1.0).any(axis=1)
    if not wrong.any():
        return fixes, faults
    sigmas = fixes.sigmas * factors
    stated, actual = np.median(fixes.sigmas[wrong], axis=0), np.median(sigmas[wrong], axis=0)
    which = "fixes" if wrong.all() else f"{np.count_nonzero(wrong)} of {len(sigmas)} fixes"
    text = (
        f"GNSS: {which} state {_axes(stated)} m (east, north, up) and scatter by {_axes(actual)} m where odometry is smooth: "
        "they are weighted by their scatter"
    )
    facts = {"stated": np.round(stated, 3).tolist(), "scatter": np.round(actual, 3).tolist()}
    is_refuted = bool((factors[:, :2] > 1.0).any())
    return replace(fixes, sigmas=sigmas, is_overconfident=is_refuted), faults.and_another(text, fix_sigma_m=facts)


def _kinds(sigmas: Floats) -> list[Bools]:
    """Masks (F,) of fixes with similar stated sigmas (F,): receivers state other sigmas for fixed than for float solutions."""
    ordered = np.sort(sigmas)
    edges, begin = [], 0
    for at in (np.flatnonzero(ordered[1:] > SIGMA_RATIO * ordered[:-1]) + 1).tolist():
        if min(at - begin, len(ordered) - at) >= FEWEST:
            edges.append(ordered[at])
            begin = at
    kind = np.searchsorted(edges, sigmas, "right")
    return [kind == k for k in range(len(edges) + 1)]


def align_fixes(
    fixes: Fixes, up: Floats, up_sigma: float, min_fixes: int, faults: Faults
) -> tuple[GnssAlignment | None, Fixes, Faults]:
    """Alignment, None if too few fixes agree, the fixes, without heights of a deviating datum, and sentences on faults.

    up, up_sigma : (3,) unit vector in the trajectory's world, rad; min_fixes : that must agree
    """

    def fit(of: Fixes) -> GnssAlignment | None:
        return align(of.antenna, of.positions, of.sigmas, of.slack, up, up_sigma, min_fixes)

    alignment = fit(fixes)
    flat = replace(fixes, sigmas=np.column_stack([fixes.sigmas[:, :2], np.full(len(fixes.sigmas), NO_HEIGHT)]))
    level = alignment if alignment is not None and alignment.inliers.all() else fit(flat)
    if level is None:
        return alignment, fixes, faults
    agrees = agreeing_heights(height_levels(level.residuals[:, 2], fixes.sigmas[:, 2]), fixes.sigmas[:, 2])
    has_jump = not agrees.all()
    gained = int(level.inliers.sum()) - (0 if alignment is None else int(alignment.inliers.sum()))
    if not has_jump and gained >= max(3, REJECTED_SHARE * len(fixes.stamps_ns)):
        way = np.linalg.norm(fixes.antenna - np.median(fixes.antenna, axis=0), axis=1)
        judged = np.hypot(np.hypot(fixes.sigmas[:, 2], fixes.slack), min(up_sigma, float(np.deg2rad(2.0))) * way)
        agrees = agreeing_heights(level.residuals[:, 2], judged)
    without = replace(flat, sigmas=np.where(agrees[:, None], fixes.sigmas, flat.sigmas))
    again = None if agrees.all() else fit(without)
    if again is None or (not has_jump and alignment is not None and again.inliers.sum() <= alignment.inliers.sum()):
        return alignment, fixes, faults
    wrong, off = np.flatnonzero(~agrees), again.residuals[:, 2]
    if has_jump:
        off = height_levels(off, fixes.sigmas[:, 2])
        if not off.any():
            return alignment, fixes, faults  # the tilt of the first alignment made it
    step = float(np.median(off[wrong]) - np.median(off[agrees]))
    at = wrong[0] if wrong[0] > 0 else wrong[-1]
    since = f"{'from' if wrong[0] > 0 else 'until'} {(fixes.stamps_ns[at] - fixes.stamps_ns[0]) * 1e-9:.1f} s after the first"
    text = (
        f"GNSS: the heights of {len(wrong)} of {len(off)} fixes are {abs(step):.1f} m {'above' if step > 0 else 'below'} the "
        f"others, {since}, "
        "where odometry does not climb: they are left out, east and north count"
    )
    if len(wrong) >= AMBIGUOUS * len(off):
        text += "; they may as well be the right ones"
    return again, without, faults.and_another(text, heights_left_out=len(wrong))


def _axes(sigmas: Floats) -> str:
    """Sigmas (3,), m, as text."""
    east, north, up = sigmas.tolist()
    return f"{east:.2f}, {north:.2f} and {up:.2f}"


# RANSAC samples, and the least distance of a pair as a share of the largest.
TRIALS, APART_SHARE = 500, 0.5
# Least share of inliers.
MAJORITY_SHARE = 0.5


@dataclass(frozen=True)
class GnssAlignment:
    """T_enu_world (4, 4); inliers : (F,) bool; residuals : (F, 3) m, east, north, up, of fixes minus trajectory."""

    T_enu_world: Floats
    inliers: Bools
    residuals: Floats


def align(
    antenna: Floats, fixes: Floats, sigmas: Floats, slack: Floats, up: Floats, up_sigma: float, min_fixes: int
) -> GnssAlignment | None:
    """Fit the antenna's positions in the world to its fixes; None with fewer than `min_fixes` or half of them as inliers.

    antenna : (F, 3) m, in the world of the trajectory; fixes : (F, 3) m, east, north, up; sigmas : (F, 3) m
    slack : (F,) m, one sigma of odometry's drift at each, in the inlier test
    up : (3,) unit, up in the world of the trajectory; up_sigma : rad
    """
    if len(antenna) < max(min_fixes, 2):
        return None
    level = so3.least_rotation(up, np.array([0.0, 0.0, 1.0]))
    a = antenna @ level.T
    judged = np.sqrt(sigmas**2 + slack[:, None] ** 2 + _tilt_sigmas(a - np.median(a, axis=0), up_sigma) ** 2)
    T = _consensus(a, fixes, judged)
    if T is None:
        return None
    # Repeated, since outliers of the first fit may be inliers of the refined one.
    for _ in range(3):
        inliers = _fits(T, a, fixes, judged)
        if inliers.sum() < max(min_fixes, MAJORITY_SHARE * len(a)):
            return None
        T = fit_pose(T, a[inliers], fixes[inliers], judged[inliers], up_sigma)
    T_enu_world = T @ se3.make(level, np.zeros(3))
    return GnssAlignment(T_enu_world, inliers, fixes - se3.apply(T_enu_world, antenna))


def _tilt_sigmas(a: Floats, up_sigma: float) -> Floats:
    """(F, 3) m by which a tilt of one sigma moves points `a` (F, 3): mostly vertically.

    A single sigma for all axes would accept a fix off to the side by an eleventh of the way.
    """
    way, height = np.linalg.norm(a[:, :2], axis=1), np.abs(a[:, 2])
    side = up_sigma * height + 0.5 * up_sigma**2 * way
    return np.column_stack([side, side, up_sigma * way])


def _consensus(a: Floats, fixes: Floats, sigmas: Floats) -> Floats | None:
    """Pose (4, 4) by RANSAC over pairs of fixes (heading and position); None without a pair far enough apart."""
    rng = np.random.default_rng(0)
    reach = float(np.linalg.norm(a[:, :2] - np.median(a[:, :2], axis=0), axis=1).max())
    best: Floats | None = None
    most = (0, 0.0)
    for i, j in rng.integers(0, len(a), (TRIALS, 2)):
        own, other = a[j] - a[i], fixes[j] - fixes[i]
        away = float(np.hypot(own[0], own[1]))
        if away < max(APART_SHARE * reach, 0.5) or not np.isfinite(other).all():
            continue
        R = so3.exp(np.array([0.0, 0.0, np.arctan2(other[1], other[0]) - np.arctan2(own[1], own[0])]))
        T = se3.make(R, 0.5 * (fixes[i] + fixes[j]) - R @ (0.5 * (a[i] + a[j])))
        # The hypothesis has the noise of two fixes.
        count = int(_fits(T, a, fixes, np.sqrt(3) * sigmas).sum())
        # Of equals the farther pair, whose heading is more accurate.
        if (count, away) > most:
            best, most = T, (count, away)
    return best


def _fits(T: Floats, a: Floats, fixes: Floats, sigmas: Floats) -> Bools:
    """(F,) whether fixes (F, 3) are inliers: within a chi-square limit of the points `a` (F, 3) moved by T (4, 4).

    sigmas : (F, 3) m
    """
    with np.errstate(invalid="ignore"):
        whitened = ((fixes - se3.apply(T, a)) / sigmas) ** 2
    return np.asarray(np.nan_to_num(whitened.sum(1), nan=np.inf) <= quantile(0.999, 3))


def fit_pose(T: Floats, a: Floats, fixes: Floats, sigmas: Floats, up_sigma: float) -> Floats:
    """Robust least squares, from T (4, 4), of the pose that maps `a` (F, 3) to `fixes` (F, 3), with sigmas (F, 3), m.

    up_sigma : rad, sigma of the prior that the axis z of `a` is vertical
    """
    from scipy.optimize import least_squares

    centre = a.mean(0)

    def move(x: Floats) -> Floats:
        R = so3.exp(x[3:]) @ T[:3, :3]
        t = se3.apply(T, centre[None])[0] + x[:3] - R @ centre
        return se3.make(R, t)

    def errors(x: Floats) -> Floats:
        M = move(x)
        tilt = M[:2, :3] @ np.array([0.0, 0.0, 1.0]) / up_sigma
        return np.concatenate([((fixes - se3.apply(M, a)) / sigmas).ravel(), tilt])

    return move(np.asarray(least_squares(errors, np.zeros(6), loss="soft_l1").x))
