"""Method `kiss-icp`: a thin adapter on the kiss-icp package with its own preprocessing and defaults."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.extras import importing
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.base import Traits
from lslam.registration.preprocessing.prepare import gate_points
from lslam.registration.voxel_target import MIN_SOURCE_POINTS


def create(config: Config) -> Kiss:
    """Create the baseline with kiss-icp's defaults.

    Of `preprocess` it follows the farthest range if the user changed it, the ego box, `remove_ground` and `denoise`.
    """
    return Kiss(config.preprocess, has_user_range="range_max" in config.preprocess.model_fields_set)


class Kiss(Traits):
    """Runs kiss-icp with its authors' settings: it predicts, deskews and down-samples by itself and ignores the motion prior.

    With deskewing, kiss-icp's pose is that of the scan's end: it is moved to the scan's stamp. Compensated scans
    have one instant and are not moved.
    """

    deskew = "by kiss-icp, in scans that have per-point times"
    ignores_prior = True

    def __init__(self, preprocess: PreprocessConfig, has_user_range: bool) -> None:
        with importing("kiss-icp", "it has no wheel for Python 3.14 and later, else: pip install kiss-icp"):
            from kiss_icp.config import KISSConfig
            from kiss_icp.kiss_icp import KissICP
        config = KISSConfig()
        if has_user_range:
            config.data.max_range = preprocess.range_max
        if config.mapping.voxel_size is None:
            config.mapping.voxel_size = float(config.data.max_range / 100.0)
        self._config, self._make = config, KissICP
        takes_out = preprocess.ego_box is not None or preprocess.remove_ground or preprocess.denoise
        self._taking_out = preprocess if takes_out else None
        self._with_deskew: bool | None = None
        self._kiss: Any = None
        self._registered = 0
        self._step = np.zeros(6)
        self._T_world_kiss = np.eye(4)

    def prepare(self, scan: Scan) -> tuple[Any, Any]:
        """Finite points (N, 3) as float64, and their times scaled to 0..1; no times if the scan has none."""
        if self._taking_out is not None:
            scan = scan.select(gate_points(scan.points, self._taking_out))
        finite = np.isfinite(scan.points).all(axis=1)
        points = scan.points[finite].astype(np.float64)
        if scan.times is None or not len(points):
            return points, np.zeros(0)
        times = scan.times[finite].astype(np.float64)
        span = float(times.max() - times.min())
        return points, (times - times.min()) / span if span > 0 else np.zeros(0)

    def register(self, scan: Scan, prepared: tuple[Any, Any], prior: MotionPrior) -> ScanResult:
        """Register one scan by kiss-icp; `bridged` by the prior where too few points are in its range."""
        points, times = prepared
        # Of a scan without points in its range the package says its own prediction, and nothing else.
        usable = int((np.einsum("ij,ij->i", points, points) < self._config.data.max_range**2).sum())
        if usable < MIN_SOURCE_POINTS:
            reason = f"{usable} usable points, {MIN_SOURCE_POINTS} needed"
            return ScanResult(scan.index, scan.stamp_ns, prior.pose, "bridged", reason, converged=False)
        if self._kiss is None:
            # The choice is made once: a sequence has per-point times or has not.
            self._with_deskew = len(times) > 0
            self._config.data.deskew = self._with_deskew
            self._kiss = self._make(self._config)
        began = time.perf_counter()
        _, source = self._kiss.register_frame(points, times if len(times) else np.zeros(len(points)))
        pose = np.asarray(self._kiss.last_pose, np.float64).copy()
        if self._with_deskew:
            pose = self._at_stamp(pose, np.asarray(self._kiss.last_delta, np.float64), scan.span.stamp_share)
        took = time.perf_counter() - began
        pose = se3.normalise(pose) if np.isfinite(pose).all() else pose
        return ScanResult(scan.index, scan.stamp_ns, pose, source_points=len(source), stages={"register": took})

    def _at_stamp(self, pose: Floats, delta: Floats, share: float) -> Floats:
        """Pose at the scan's stamp, at `share` (0..1) of its sweep, in the world of the first scan's stamp.

        `pose` is kiss-icp's newest, `delta` its motion since the one before: the start of a scan is the end of the one
        before. But kiss-icp has no motion to deskew its first two scans: their poses belong to the middle, and there
        its world begins.
        """
        self._registered += 1
        if self._registered == 1:
            return pose
        if self._registered == 2:
            self._step = se3.log(delta)
            self._T_world_kiss = se3.exp((0.5 - share) * self._step)
        before = self._T_world_kiss @ pose @ se3.inverse(delta)
        since = (0.5 + share) * self._step if self._registered <= 3 else share * se3.log(delta)
        return np.asarray(before @ se3.exp(since))
