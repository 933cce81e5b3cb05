"""What is wrong with the fixes of a run beside single outliers: their clock, their sigmas, the datum of their heights."""

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
from lslam.backend.graph.gnss_alignment import GnssAlignment, align
from lslam.core.geometry.se3 import poses_at, turns_between
from lslam.core.types.arrays import Bools, Floats, Longs
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
    is_stated : whether the sigmas are those of the recording
    is_refuted : whether fixes scatter by more than was stated, east or north; the sigmas are those of their scatter
    """

    stamps_ns: Longs
    positions: Floats
    sigmas: Floats
    antenna: Floats
    slack: Floats
    origin: Floats
    given: int
    is_stated: bool
    is_refuted: bool = False

    @property
    def has_height(self) -> Bools:
        """(F,) whether the height counts."""
        return np.asarray(self.sigmas[:, 2] < NO_HEIGHT)


@dataclass(frozen=True)
class Faults:
    """Sentences about what is wrong, and the same for the manifest."""

    problems: tuple[str, ...] = ()
    facts: dict[str, Any] | None = None

    def and_another(self, problem: str, **facts: Any) -> Faults:
        """With one more."""
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
    """The fixes with the stamps that the scans would have given them."""
    return replace(stream, stamps_ns=stream.stamps_ns + round(1e9 * offset.seconds))


def clock_said(offset: ClockOffset) -> str:
    """A sentence about a wrong clock."""
    late = offset.seconds < 0
    return (
        f"GNSS: fixes are stamped {abs(offset.seconds):.2f} s {'late' if late else 'early'} (one sigma {offset.sigma:.2g} s): "
        f"there they move as odometry does, and are taken {abs(offset.seconds):.2f} s {'earlier' if late else 'later'}"
    )


def with_actual_sigmas(
    fixes: Fixes, level: Floats, largest: float, probability: float, faults: Faults
) -> tuple[Fixes, Faults]:
    """The fixes with the sigmas of their scatter where they state less, up to the `largest`, m: beyond they are no fixes."""
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
    return replace(fixes, sigmas=sigmas, is_refuted=is_refuted), faults.and_another(text, fix_sigma_m=facts)


def _kinds(sigmas: Floats) -> list[Bools]:
    """Which of the fixes state alike, by their sigmas (F,): a receiver says one thing of a fixed solution, another of a float."""
    ordered = np.sort(sigmas)
    edges, begin = [], 0
    for at in (np.flatnonzero(ordered[1:] > SIGMA_RATIO * ordered[:-1]) + 1).tolist():
        if min(at - begin, len(ordered) - at) >= FEWEST:
            edges.append(ordered[at])
            begin = at
    kind = np.searchsorted(edges, sigmas, "right")
    return [kind == k for k in range(len(edges) + 1)]


def aligned(
    fixes: Fixes, up: Floats, up_sigma: float, min_fixes: int, faults: Faults
) -> tuple[GnssAlignment | None, Fixes, Faults]:
    """The alignment, and the fixes without the heights that are of another datum than most: east and north stay."""

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
    east, north, up = sigmas.tolist()
    return f"{east:.2f}, {north:.2f} and {up:.2f}"
