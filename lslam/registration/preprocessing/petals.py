"""A scan whose pattern does not repeat -> edges and planes along its lines, in the order of firing (Lin and Zhang 2020)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.arrays import Bools, Floats
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import LoamConfig
from lslam.core.errors import InputError
from lslam.core.kernels.linearisation import RARE_SIGMAS, SIGNIFICANT_SIGMAS
from lslam.core.types.scan import NO_RING, Scan
from lslam.registration.kernels import curvature, petals
from lslam.registration.kernels.curvature import WIDEST_STEP
from lslam.registration.preprocessing.features import (
    EDGE_CURVATURE,
    MAY_BE_EDGE,
    OCCLUSION_M,
    PARALLEL_DEG,
    PLANAR_CURVATURE,
    Features,
    RingWalk,
    curvature_noise,
    gather_features,
)
from lslam.registration.preprocessing.prepare import gate_points

# A line goes on over so many usual steps: one lost return is bridged where two prisms move the beam fastest.
_GAP_STEPS = 4.0
# A line has turned once it has come back by so many usual steps: more than the noise of the angles.
_TURN_STEPS = 2.0
# Of the view, from its middle to its rim: beyond lies the fringe, where lines bend (17 of 19.2 deg, authors' code).
_FRINGE = 17.0 / 19.2
# Standard deviations of the logarithm of intensity over squared range, beyond which it is too high or too low.
_STRAY = 3.0
# Step of reflectivity over the sum of both sides: one is twice as bright as the other.
_CONTRAST = 1.0 / 3.0
# Curvature of a right angle over two neighbours on each side, in terms of that over five.
_SHORTER = (petals.PETAL_SIDE * (petals.PETAL_SIDE + 1) / (2 * petals.PETAL_SIDE + 1)) / (
    curvature.SIDE_POINTS * (curvature.SIDE_POINTS + 1) / (2 * curvature.SIDE_POINTS + 1)
)


def petal_features(scan: Scan, config: LoamConfig | None = None, gate: PreprocessConfig | None = None) -> Features:
    """Edges and planes of a scan by their curvature along the lines that its lasers draw, and edges of reflectivity.

    The `rings` of the scan, where it has them, say which laser measured a point; else one measured all. The features' `rings`
    count lines. Points are taken in the order of their times, or of the file.

    Raises
    ------
    InputError : neighbours in that order are too far apart to lie on one surface
    """
    config = config or LoamConfig()
    walk = walk_lines(scan, gate or PreprocessConfig())
    slope = np.tan(np.radians(PARALLEL_DEG))
    brightness = _brightness(scan, walk)
    curved, bend, contrast, breaks = petals.smoothness(
        walk.points,
        walk.ranges,
        walk.starts,
        _left_out(walk, brightness),
        brightness,
        OCCLUSION_M,
        slope * walk.step,
        np.sin(np.radians(PARALLEL_DEG)),
    )
    may_be, noise = np.full(len(walk.order), 7, np.uint8), curvature_noise(walk.ranges, petals.PETAL_SIDE)
    limits, usual = (config.max_edge_points, config.max_less_edge_points), _SHORTER * walk.step
    labels = curvature.pick(
        curved,
        bend,
        walk.ranges,
        breaks,
        may_be,
        walk.starts,
        1,
        (*limits, config.max_planar_points),
        EDGE_CURVATURE * usual,
        PLANAR_CURVATURE * usual,
        RARE_SIGMAS * noise,
        SIGNIFICANT_SIGMAS * noise,
    )
    if len(brightness):
        may_be.fill(MAY_BE_EDGE)
        painted = curvature.pick(
            contrast, contrast, walk.ranges, breaks, may_be, walk.starts, 1, (*limits, 0), _CONTRAST, 0.0, 0.0, 0.0
        )
        labels = np.where(painted > 0, np.maximum(labels, painted), labels)
    lines = np.zeros(len(scan), np.uint16)
    lines[walk.order] = np.repeat(np.arange(len(walk.starts) - 1), np.diff(walk.starts))
    return gather_features(replace(scan, rings=lines), walk, labels, config.grid_step)


def walk_lines(scan: Scan, gate: PreprocessConfig) -> RingWalk:
    """The gated points of a scan laser after laser in the order of firing, cut into lines. Raises InputError as above."""
    lasers = np.zeros(len(scan), np.uint16) if scan.rings is None else scan.rings
    in_range = gate_points(scan.points, gate)
    order, starts = curvature.into_rings(lasers, in_range[lasers[in_range] != NO_RING])
    if scan.times is not None:
        order = order[np.lexsort((scan.times[order], lasers[order]))]
    points, ranges, steps, step, _, _ = curvature.walk(scan.points, order, starts)
    if step > WIDEST_STEP and len(order) > len(starts):
        raise InputError(
            f"scan {scan.index}: neighbours in the order of firing are more than {np.degrees(WIDEST_STEP):.0f} deg apart, so "
            "they lie on no common surface (points out of order, or several lasers as one): use --rings to tell the lasers "
            "apart, or --method icp"
        )
    step = min(step, WIDEST_STEP)
    lines = petals.cut_lines(points, steps, starts, _GAP_STEPS * step, _TURN_STEPS * step)
    return RingWalk(order, lines, points, ranges, steps, step)


def _brightness(scan: Scan, walk: RingWalk) -> Floats:
    """Intensities (K,) along the walk; (0,) where there are none, or the same for all points."""
    if scan.intensity is None or not len(walk.order):
        return np.zeros(0)
    intensity = np.nan_to_num(scan.intensity[walk.order].astype(np.float64), posinf=0.0, neginf=0.0)
    return intensity if intensity.max() > intensity.min() else np.zeros(0)


def _left_out(walk: RingWalk, brightness: Floats) -> Bools:
    """Which points (K,) lie near the fringe of the view, or are too bright or too dark for a good range."""
    out = np.zeros(len(walk.order), np.bool_)
    if not len(out):
        return out
    x, y, z = walk.points.T
    # A view all around has no fringe.
    if (x > 0).all():
        across, up = (np.abs(np.arctan2(side, x)) for side in (y, z))
        rims = [max(float(angle.max()), 1e-9) for angle in (across, up)]
        out |= np.hypot(across / rims[0], up / rims[1]) > _FRINGE
    if len(brightness):
        is_lit = brightness > 0
        level = np.log(brightness[is_lit] / walk.ranges[is_lit] ** 2)
        off = np.abs(level - np.median(level))
        out[~is_lit] = True
        out[np.flatnonzero(is_lit)[off > _STRAY * 1.4826 * np.median(off)]] = True
    return out
