"""Method `loam-livox`: LOAM for patterns that do not repeat and a small view, the sweep in pieces (Lin and Zhang 2020)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import StageClock
from lslam.odometry.feature_target import LoamVariant
from lslam.odometry.loam import Loam, deskew_features
from lslam.registration.acceptance import correction, failure
from lslam.registration.preprocessing.features import FeaturePoints, Features
from lslam.registration.preprocessing.petals import petal_features
from lslam.registration.result import RegistrationResult

# Of the correspondences, the nearest, that have a say: a fifth is dropped as outliers (section IV-C).
INLIER_SHARE = 0.8
# Part of the slope over the pieces that is the sensor's motion, not noise of thirds of a scan.
SLOPE_SHARE = 0.5
LIVOX = LoamVariant(None, with_map=True, with_less_planes=True, inlier_ratio=INLIER_SHARE)


def create(config: Config) -> LoamLivox:
    """Create the method from the configuration."""
    return LoamLivox(config, LIVOX)


class LoamLivox(Loam):
    """Registers each piece of a sweep on the feature map by itself; the motion within the sweep follows from them."""

    deskew = "by the pieces of a sweep, each of them by the motion prior"

    def __init__(self, config: Config, variant: LoamVariant) -> None:
        # As in the paper, nothing is tried beside the pieces: coarse planes slide along what a small view holds.
        quiet = config.recovery.model_copy(
            update={"coarse_to_fine": False, "start_search": False, "less_planar": False}
        )
        super().__init__(config.model_copy(update={"recovery": quiet}), variant)
        # Lines come as they are recorded, unless somebody says how the lasers are told apart.
        self.needs_rings = config.input.rings != "auto"

    def prepare(self, scan: Scan) -> Features:
        """Edges and planar points along the lines. Raises InputError for points that are not in the order of firing."""
        return petal_features(scan, self.config.loam, self.config.preprocess)

    def register(self, scan: Scan, prepared: Features, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        """Register piece after piece, each from the pose of the last; as a whole if the sweep takes no time."""
        count = self.config.loam.pieces
        if is_near or count < 2 or len(self.registration.target) == 0 or not self.has_sweep(prepared, prior):
            return super().register(scan, prepared, prior, is_near)
        clock = StageClock()
        with clock.stage("deskew"):
            features = deskew_features(prepared, prior)
        borders = np.linspace(*scan.span, count + 1)
        middles = (borders[:-1] + borders[1:]) / 2
        pieces: list[RegistrationResult] = []
        pose = prior.pose
        for k in range(count):
            piece = between(features, borders[k], borders[k + 1] if k + 1 < count else np.inf)
            pieces.append(self.registration.locate(piece, pose, clock=clock))
            pose = pieces[-1].T_world_lidar if pieces[-1].ok else pose
        result, sweep = join(pieces, middles, prior)
        with clock.stage("deskew"):
            features = deskew_features(prepared, sweep)
        return replace(result, points=features, sweep=sweep, map_age=self.map_age, stages=clock.seconds)


def between(features: Features, begin: float, end: float) -> Features:
    """The features measured from `begin` to before `end`, s from the stamp."""

    def part(points: FeaturePoints) -> FeaturePoints:
        assert points.times is not None
        within = (points.times >= begin) & (points.times < end)
        return FeaturePoints(points.points[within], points.rings[within], points.times[within])

    return features.each(part)


def join(
    pieces: list[RegistrationResult], middles: Floats, prior: MotionPrior
) -> tuple[RegistrationResult, MotionPrior]:
    """The registrations of the pieces as one result of the scan, and the motion over its sweep.

    Each piece estimates the pose at the stamp, assuming the prior's motion. Their differences are unpredicted motion and noise:
    the sweep is corrected by a least-squares line through them, with `SLOPE_SHARE` of its slope. A scan fails when half
    of its pieces do.

    middles : s from the stamp
    """
    good = [k for k, result in enumerate(pieces) if result.ok]
    offered = sum(result.source_points for result in pieces)
    if 2 * len(good) <= len(pieces):
        reason = next(result.reason for result in pieces if not result.ok)
        return failure(prior.pose, offered, reason), prior
    parts = [pieces[k] for k in good]
    base = parts[len(parts) // 2].T_world_lidar
    off = np.stack([se3.log(se3.relative(base, part.T_world_lidar)) for part in parts])

    def at(times: Floats) -> Floats:
        return np.asarray(base @ se3.exp(line_weights(middles[good], times) @ off))

    sweep = replace(prior, poses=se3.normalise(at(prior.times) @ se3.relative(prior.pose, prior.poses)))
    pose = se3.normalise(at(np.zeros(1))[0])
    shares = line_weights(middles[good], np.zeros(1))[0]
    located = replace(
        parts[len(parts) // 2],
        T_world_lidar=pose,
        covariance=_combine(parts, shares),
        source_points=offered,
        matched=sum(part.matched for part in parts),
        inliers=sum(part.inliers for part in parts),
        iterations=sum(result.iterations for result in pieces),
        converged=all(part.converged for part in parts),
        rmse=float(np.sqrt(np.mean([part.rmse**2 for part in parts]))),
        prior_error=correction(prior.pose, pose),
        pose_source=next((part.pose_source for part in parts if part.pose_source), ""),
        degenerate=min((part.degenerate for part in parts), key=len),
        feature_result=None,
        detail=None,
    )
    return located, sweep


def line_weights(at: Floats, times: Floats) -> Floats:
    """(T, N) what each of the values at the times `at` (N,), s, counts in the line through them at `times` (T,), s."""
    off = at - at.mean()
    return np.asarray(1.0 / len(at) + SLOPE_SHARE * np.outer(times - at.mean(), off) / (off @ off))


def _combine(parts: list[RegistrationResult], shares: Floats) -> Floats | None:
    """Covariance (6, 6) of the sum of independent poses that count by `shares`; None where one has none."""
    covariances = [part.covariance for part in parts if part.covariance is not None]
    if len(covariances) < len(parts):
        return None
    return np.asarray(np.einsum("k,kij->ij", shares**2, np.stack(covariances)))
