"""Checks of the final poses: what fixes, control points and the map say of each other once the graph is solved."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.backend.fix_faults import Fixes
from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.geometry import geodesy, se3
from lslam.core.geometry.noise import quantile
from lslam.core.types.arrays import Floats
from lslam.core.types.constraint import ControlPoint
from lslam.core.types.gnss import Georeference
from lslam.maps.crispness import plane_variances

# Points of all keyframes, neighbourhoods of that comparison, and parts of the drive whose noise is independent.
POINTS, SAMPLES, PARTS = 400_000, 20_000, 16
# Sigmas by which fixes and control points may disagree.
APART_SIGMAS = 4.0
# From the median absolute deviation to one sigma.
MAD = 1.4826


@dataclass(frozen=True)
class Thickening:
    """Thickness of planes, m, before and after poses were held, and the growth of its square in units of its noise."""

    before: float
    after: float
    sigmas: float

    def is_clear(self, probability: float) -> bool:
        """Whether planes got thicker, by more than chance and by a millimetre at the least that is written."""
        return self.sigmas > np.sqrt(quantile(probability, 1)) and round(self.after, 3) > round(self.before, 3)


def thickening(store: KeyframeStore, without: Floats, final: Floats) -> Thickening | None:
    """What the `final` poses (K, 4, 4) do to planes of the keyframes' points at the poses `without` (K, 4, 4).

    The same neighbourhoods are compared. Those of one part of the drive err together, so that parts give the noise.
    """
    (before, owner), (after, _) = (_plane_variances(store, poses) for poses in (without, final))
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return None
    part = np.unique(owner[both] * PARTS // len(final), return_inverse=True)[1]
    count, grown = np.bincount(part), np.bincount(part, (after - before)[both])
    mean = grown.sum() / count.sum()
    noise = np.sqrt(((grown - mean * count) ** 2).sum()) / count.sum()
    was, is_now = (float(np.sqrt(values[both].mean())) for values in (before, after))
    return Thickening(was, is_now, float(mean / max(noise, 1e-12)))


def thicker_map(change: Thickening | None, held_by: str, probability: float) -> tuple[str, dict[str, Any]]:
    """A sentence where planes are clearly thicker with what holds the poses than without; and both, m."""
    if change is None:
        return "", {}
    facts = {"planes_without_m": round(change.before, 4), "planes_m": round(change.after, 4)}
    if not change.is_clear(probability):
        return "", facts
    return (
        f"{held_by}: planes of the keyframes are {change.after / change.before:.2f} times as thick where the trajectory follows "
        f"them, {change.after:.3f} m in place of {change.before:.3f} m without, {change.sigmas:.1f} sigmas: they contradict the "
        "scans"
    ), facts


def _plane_variances(store: KeyframeStore, poses: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """(Q,) m2, variances about planes of the keyframes' points at `poses`, NaN where these are few; and (Q,) their keyframes."""
    clouds = [store.points(k) for k in range(len(poses))]
    step = 1 + sum(map(len, clouds)) // POINTS
    parts = [se3.apply(T, cloud[::step]) for T, cloud in zip(poses, clouds, strict=True)]
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    queries = slice(None, None, max(1, -(-len(owner) // SAMPLES)))
    return plane_variances(np.concatenate(parts), queries), owner[queries]


def fixes_against_points(fixes: Fixes, points: Many[ControlPoint], georeference: Georeference) -> str:
    """A sentence where the fixes lie elsewhere than the control points have put the run, horizontally or in height.

    fixes : with the antenna in the world of the final poses
    """
    places = geodesy.to_local(geodesy.from_local(fixes.positions, fixes.origin), georeference.origin)
    off = places - se3.apply(georeference.T_enu_world, fixes.antenna)
    off = off[np.isfinite(off).all(1) & (np.abs(off) < 1e6).all(1)]
    if not len(off):
        return ""
    middle = np.median(off, axis=0)
    scatter = MAD * np.median(np.abs(off - middle), axis=0)
    # Errors of fixes are correlated: many say no more than one.
    own = np.maximum(np.median(fixes.sigmas, axis=0), scatter)
    sigma = np.hypot(own, np.median([point.sigma for point in points], axis=0))
    aside, sigma_aside = float(np.hypot(*middle[:2])), float(sigma[:2].max())
    texts = []
    if aside > APART_SIGMAS * sigma_aside:
        texts.append(f"{aside:.1f} m aside (one sigma {sigma_aside:.2g} m)")
    if abs(middle[2]) > APART_SIGMAS * sigma[2]:
        texts.append(f"{abs(middle[2]):.1f} m {'above' if middle[2] > 0 else 'below'} (one sigma {sigma[2]:.2g} m)")
    if not texts:
        return ""
    return (
        f"GNSS: fixes and control points disagree: the fixes lie {' and '.join(texts)} of where the points put the run; are CRS, "
        "geoid and datum right?"
    )


def redundancy(surveyed: Floats, run: Floats, is_level: bool) -> tuple[str, dict[str, Any]]:
    """A sentence about points that nothing checks: two, with the scale between them and odometry, or the heights of three.

    surveyed, run : (N, 3) m, of the points by their survey and by odometry
    is_level : whether something else tells what is up
    """
    if len(surveyed) == 3 and not is_level:
        text = "the heights of three have no redundancy where no IMU tells what is up: a wrong one tilts the drive"
        return f"control points: {text}", {"height_redundancy": 0}
    if len(surveyed) != 2:
        return "", {}
    there, here = (float(np.linalg.norm(places[1] - places[0])) for places in (surveyed, run))
    if here <= 0:
        return "", {}
    scale = there / here
    return (
        f"control points: two have no redundancy, nothing but odometry checks them: they lie {there:.2f} m apart, {scale:.4f} "
        "times as far as odometry has them"
    ), {"redundancy": 0, "scale_to_odometry": round(scale, 5)}
