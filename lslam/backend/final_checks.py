"""Checks of the final poses: what fixes, control points and the map say of each other once the graph is solved."""

from __future__ import annotations

from collections.abc import Sequence as Many
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.backend.fix_faults import Fixes
from lslam.geometry import geodesy, se3
from lslam.keyframes.store import KeyframeStore
from lslam.maps.crispness import crispness
from lslam.types.cloud import ArrayCloud
from lslam.types.gnss import Georeference
from lslam.types.manual import ControlPoint

Floats = NDArray[np.float64]

# Times thicker than without them a map contradicts what holds the poses: repeated sampling changes it by a hundredth.
THICKER = 1.15
# Points of all keyframes, and neighbourhoods, of that comparison.
POINTS, SAMPLES = 400_000, 20_000
# Sigmas by which fixes and control points may disagree.
APART_SIGMAS = 4.0
# From the median absolute deviation to one sigma.
MAD = 1.4826


def thicker_map(store: KeyframeStore, without: Floats, final: Floats, held_by: str) -> tuple[str, dict[str, Any]]:
    """A sentence where planes are thicker with the `final` poses (K, 4, 4) than `without` what holds them; and both, m."""
    before, after = (_thickness(store, poses) for poses in (without, final))
    if before is None or after is None:
        return "", {}
    facts = {"planes_without_m": round(before, 4), "planes_m": round(after, 4)}
    if after <= THICKER * before:
        return "", facts
    return (
        f"{held_by}: planes of the keyframes are {after / before:.1f} times as thick where the trajectory follows them, "
        f"{after:.3f} m in place of {before:.3f} m without: they contradict the scans"
    ), facts


def _thickness(store: KeyframeStore, poses: Floats) -> float | None:
    """m, of planes of the keyframes' points at `poses`."""
    clouds = [store.points(k) for k in range(len(poses))]
    step = 1 + sum(map(len, clouds)) // POINTS
    points = np.concatenate([se3.apply(T, cloud[::step]) for T, cloud in zip(poses, clouds, strict=True)])
    variance = crispness(ArrayCloud.of(points), samples=SAMPLES).plane_variance
    return None if variance is None else float(np.sqrt(variance))


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
    said = []
    if aside > APART_SIGMAS * sigma_aside:
        said.append(f"{aside:.1f} m aside (one sigma {sigma_aside:.2g} m)")
    if abs(middle[2]) > APART_SIGMAS * sigma[2]:
        said.append(f"{abs(middle[2]):.1f} m {'above' if middle[2] > 0 else 'below'} (one sigma {sigma[2]:.2g} m)")
    if not said:
        return ""
    return (
        f"GNSS: fixes and control points disagree: the fixes lie {' and '.join(said)} of where the points put the run; are CRS, "
        "geoid and datum right?"
    )


def redundancy(surveyed: Floats, seen: Floats) -> tuple[str, dict[str, Any]]:
    """A sentence about two points, which nothing checks, with the scale between them and odometry; nothing about more.

    surveyed, seen : (N, 3) m, of the points by their survey and by odometry
    """
    if len(surveyed) != 2:
        return "", {}
    there, here = (float(np.linalg.norm(places[1] - places[0])) for places in (surveyed, seen))
    if here <= 0:
        return "", {}
    scale = there / here
    return (
        f"control points: two have no redundancy, nothing but odometry checks them: they lie {there:.2f} m apart, {scale:.4f} "
        "times as far as odometry has them"
    ), {"redundancy": 0, "scale_to_odometry": round(scale, 5)}
