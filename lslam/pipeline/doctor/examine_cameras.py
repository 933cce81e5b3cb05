"""Calibration of cameras against the scans: edges of depth against edges of images (Levinson and Thrun 2013)."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.errors import InputError
from lslam.core.geometry import portable, se3
from lslam.core.geometry.se3 import ContinuousMotion
from lslam.core.printable import count_of
from lslam.core.types.camera import Camera, Image, cameras_of
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.odometry.frontend.inertial_start import first_poses
from lslam.pipeline.doctor import Facts, Findings
from lslam.registration.preprocessing.deskew import deskew_points, knots_over
from lslam.registration.preprocessing.views import with_rings

log = logging.getLogger("lslam")
_SCANS, _IMAGES, _FEWEST = 60, 20, 4
# Looked at: shifts up to an angle, and times up to some way about the stamps, in steps.
_WIDEST_RAD, _FARTHEST_S, _STEP_S = np.radians(2.0), 0.1, 0.01
# A range that jumps between two beams by so many times what lies between them is an edge: of a surface, it would be met at 6 deg.
_JUMP = 10.0
_SURE = 3.0  # standard deviations


@dataclass(frozen=True)
class Offset:
    """Where edges of images lie against edges of depth: right and down, pixels, and later, s; one standard deviation of each.

    beams : what lies between two beams, right and down, pixels: edges of depth are not known better
    """

    pixels: Floats
    time_s: float
    pixels_sigma: Floats
    time_sigma_s: float
    images: int
    beams: Floats


def examine_cameras(sequence: Sequence, findings: Findings) -> list[Facts]:
    """Facts about each camera, with its offset in the first scans, which are registered for it.

    sequence : with per-point times. Raises InputError where there is no camera, as `cameras_of`.
    """
    cameras = cameras_of(sequence)
    log.info(
        "registering the first %d scans to compare edges of depth with edges of images", min(_SCANS, len(sequence))
    )
    seconds = float(np.clip(_SCANS / sequence.rate_hz, 0.5, 60))
    first = first_poses(sequence, Config.model_validate({"imu": {"start_s": seconds}}), None)
    motion = ContinuousMotion([(first.stamps_ns, first.poses)])
    try:
        ringed = with_rings(sequence)
    except InputError as error:
        findings.add("camera-rings", f"cameras cannot be checked: {error}")
        return [_facts(camera, None) for camera in cameras]
    facts = []
    for camera in cameras:
        offset = offset_of(camera, ringed, first.stamps_ns, motion)
        facts.append(_facts(camera, offset))
        if offset is not None:
            _judge(camera.name, offset, findings)
    return facts


def _facts(camera: Camera, offset: Offset | None) -> Facts:
    """JSON-ready facts about a camera and its measured offset."""
    steps = np.diff(camera.stamps_ns)
    return {
        "name": camera.name,
        "images": len(camera.stamps_ns),
        "size": list(camera.lens.size),
        "model": camera.lens.model,
        "rate_hz": float(1e9 / np.median(steps)) if len(steps) else None,
        "offset": None
        if offset is None
        else {
            "images": offset.images,
            "right_down_px": offset.pixels.tolist(),
            "right_down_sigma_px": offset.pixels_sigma.tolist(),
            "beams_px": offset.beams.tolist(),
            "later_s": offset.time_s,
            "later_sigma_s": offset.time_sigma_s,
        },
    }


def _judge(name: str, offset: Offset, findings: Findings) -> None:
    """Add findings where the offset of a camera in pixels or in time is significant."""
    if np.any(np.abs(offset.pixels) > np.maximum(_SURE * offset.pixels_sigma, np.maximum(offset.beams, 1.0))):
        right, down = offset.pixels
        findings.add(
            "camera-pixels",
            f"camera {name}: edges of its images lie {right:+.1f} px right of and {down:+.1f} px below those of depth",
            "look at its extrinsics (T_lidar_camera) and intrinsics",
        )
    if abs(offset.time_s) > max(_SURE * offset.time_sigma_s, _STEP_S):
        findings.add(
            "camera-clock",
            f"camera {name}: its images fit the scans {abs(offset.time_s):.3f} s "
            f"{'later' if offset.time_s > 0 else 'earlier'} than their stamps say",
            f"time_offset_s = {offset.time_s:.3f} in its table of sequence.toml",
        )


def offset_of(camera: Camera, sequence: Sequence, stamps_ns: Longs, motion: ContinuousMotion) -> Offset | None:
    """Offset of a camera, from images during the scans with `stamps_ns` (N,) along `motion`; None with too few usable images.

    For each image the edges of depth in the scan of its time are shifted by pixels, and by the motion in some time, to where
    the image has most edges. The standard deviations are those of leaving out one image (jackknife).
    """
    spare = round(1e9 * _FARTHEST_S)
    usable = np.flatnonzero((camera.stamps_ns >= stamps_ns[0] + spare) & (camera.stamps_ns <= stamps_ns[-1] - spare))
    some = (
        usable[np.unique(np.linspace(0, len(usable) - 1, min(_IMAGES, len(usable))).astype(int))]
        if len(usable)
        else usable
    )
    reach = max(round(camera.lens.intrinsics[0] * _WIDEST_RAD), 1)
    tables: list[Floats] = []
    beams: list[Floats] = []
    for k in some.tolist():
        try:
            image = camera.image(k)
            scan = sequence.scan(int(np.searchsorted(sequence.stamps_ns, camera.stamps_ns[k], side="right")) - 1)
        except InputError:
            continue
        points, weights = depth_edges(scan)
        if len(points):
            beams.append(beam_spacing(scan))
            edges = _in_world(scan, points, motion)
            tables.append(_scores(camera, int(camera.stamps_ns[k]), image, edges, weights, motion, reach))
    if len(tables) < _FEWEST:
        return None
    scores = np.stack(tables)
    whole = _peak(scores.sum(0), reach)
    without = np.array([_peak(scores.sum(0) - one, reach) for one in scores])
    sigma = np.sqrt((len(scores) - 1) / len(scores) * ((without - without.mean(0)) ** 2).sum(0))
    apart = np.median(beams, axis=0) * np.array(camera.lens.intrinsics[:2])
    return Offset(whole[1:], float(whole[0]), sigma[1:], float(sigma[0]), len(scores), apart)


def beam_spacing(scan: Scan) -> Floats:
    """Angles (2,), rad, between neighbouring beams of a ring, and between neighbouring rings."""
    assert scan.rings is not None
    points = scan.points.astype(np.float64)
    azimuth = portable.arctan2(points[:, 1], points[:, 0])
    rise = portable.arctan2(points[:, 2], portable.hypot(points[:, 0], points[:, 1]))
    order = np.lexsort((azimuth, scan.rings))
    step = np.diff(azimuth[order])[np.diff(scan.rings[order].astype(int)) == 0]
    levels = np.sort([float(np.median(rise[scan.rings == ring])) for ring in np.unique(scan.rings)])
    return np.array([np.median(values) if len(values) else 0.0 for values in (step, np.diff(levels))])


def depth_edges(scan: Scan) -> tuple[NDArray[np.intp], Floats]:
    """Indices (N,) of points behind which the range jumps to the next beam of their ring, and jump / range (N,), at most 1."""
    assert scan.rings is not None
    r = np.linalg.norm(scan.points, axis=1).astype(np.float64)
    azimuth = portable.arctan2(scan.points[:, 1].astype(np.float64), scan.points[:, 0].astype(np.float64))
    order = np.lexsort((azimuth, scan.rings))
    order = order[r[order] > 0]
    step, same = np.diff(azimuth[order]), np.diff(scan.rings[order].astype(int)) == 0
    usual = float(np.median(step[same])) if same.any() else 0.0
    beside = same & (step < 2.5 * usual)  # neither was lost between them
    jump = np.diff(r[order])
    depth = np.zeros(len(order))
    np.maximum.at(depth, np.flatnonzero(beside), jump[beside])
    np.maximum.at(depth, np.flatnonzero(beside) + 1, -jump[beside])
    share = depth / r[order]
    kept = np.flatnonzero(share > _JUMP * usual)
    return order[kept], np.minimum(share[kept], 1.0)


def _in_world(scan: Scan, points: NDArray[np.intp], motion: ContinuousMotion) -> Floats:
    """Points (N, 3) of a scan, world, m, each from the pose of its time."""
    times = knots_over(scan.span) if scan.times is not None else np.zeros(1)
    poses = motion.at(scan.stamp_ns + np.round(1e9 * times).astype(np.int64))[0]
    prior = MotionPrior(times, poses) if len(times) > 1 else MotionPrior.at_once(poses[0])
    moved = deskew_points(scan.points, scan.times, prior)[points]
    return se3.apply(motion.at(np.array([scan.stamp_ns]))[0][0], moved.astype(np.float64))


def _scores(
    camera: Camera, stamp_ns: int, image: Image, edges: Floats, weights: Floats, motion: ContinuousMotion, reach: int
) -> Floats:
    """Mean strength of the image's edges at the edges of depth (T, 2R+1, 2R+1), by time, rows and columns of the shift.

    edges, weights : (N, 3), m, world, and (N,) of the edges of depth; reach : R, the largest shift, pixels
    """
    from scipy.ndimage import gaussian_gradient_magnitude

    from lslam.maps.kernels.views import project_all, shifted_means

    strength = gaussian_gradient_magnitude(image.mean(axis=2), 1.0)
    # A bright edge is no better an edge than a dim one.
    strength = np.minimum(strength / max(float(np.quantile(strength, 0.98)), 1e-6), 1.0).astype(np.float32)
    times = np.round(1e9 * _times()).astype(np.int64)
    out: Floats = np.zeros((len(times), 2 * reach + 1, 2 * reach + 1))
    pixels = np.empty((len(edges), 2))
    for row, T_world_lidar in zip(out, motion.at(stamp_ns + times)[0], strict=True):
        T_world_camera = portable.product(T_world_lidar, camera.T_lidar_camera)
        project_all(se3.apply(se3.inverse(T_world_camera), edges), camera.lens.parameters, pixels)
        shifted_means(strength, pixels, weights, row)
    return out


def _times() -> Floats:
    """Time shifts to try, s."""
    steps = round(_FARTHEST_S / _STEP_S)
    return np.asarray(_STEP_S * np.arange(-steps, steps + 1), np.float64)


def _peak(scores: Floats, reach: int) -> Floats:
    """Time, s, and shift right and down, pixels, (3,) of the highest score, between the steps by a parabola on each axis.

    scores, reach : as in `_scores`
    """
    i, row, column = (int(n) for n in np.unravel_index(int(np.argmax(scores)), scores.shape))
    fine = []
    for k, line in ((i, scores[:, row, column]), (row, scores[i, :, column]), (column, scores[i, row])):
        between = 0.0
        if 0 < k < len(line) - 1:
            a, b, c = line[k - 1 : k + 2]
            between = 0.5 * (a - c) / (a - 2 * b + c) if a - 2 * b + c < 0 else 0.0
        fine.append(k + between)
    time, down, right = fine
    return np.array([_STEP_S * time - _FARTHEST_S, right - reach, down - reach])


def sentence_of(facts: Facts) -> str:
    """Sentence about a camera, from its facts."""
    rate = "" if facts["rate_hz"] is None else f", {facts['rate_hz']:.1f} Hz"
    width, height = facts["size"]
    text = f"{facts['name']}: {count_of(facts['images'], 'image')} of {width} x {height}{rate}, {facts['model']}"
    offset = facts["offset"]
    if offset is None:
        return f"{text}; edges of depth and of images could not be compared"
    (right, down), (sigma_r, sigma_d) = offset["right_down_px"], offset["right_down_sigma_px"]
    return (
        f"{text}; edges of {offset['images']} images against those of depth: {right:+.1f} +- {sigma_r:.1f} px right, "
        f"{down:+.1f} +- {sigma_d:.1f} px down, {offset['later_s']:+.3f} +- {offset['later_sigma_s']:.3f} s later; beams lie "
        f"{offset['beams_px'][0]:.1f} and {offset['beams_px'][1]:.1f} px apart"
    )
