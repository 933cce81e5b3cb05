"""`icp` on all points of the scans whose features are few or poorly constrained."""

from __future__ import annotations

from dataclasses import replace

from lslam.core.config.odometry import RegistrationConfig
from lslam.core.types.arrays import Floats
from lslam.core.types.state import Stateful
from lslam.registration.attempt import Attempt
from lslam.registration.history import History
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult
from lslam.registration.start_search import best_by_non_ground

# In `pose_source`.
ALL_POINTS = "all-points"
# Well constrained scans in a row, two seconds at 10 Hz, after which the map of all points is dropped.
CONSTRAINED_SCANS = 20


class AllPoints(Stateful):
    """A map of all points, kept while it is needed.

    voxel_size : m, of that map
    """

    STATE = ("_icp", "_fed")

    def __init__(self, config: RegistrationConfig, voxel_size: float) -> None:
        plain = {
            "residual": None,
            "target": "map",
            "inlier_distance": None,
            "inlier_ratio": 1.0,
            "voxel_size": voxel_size,
        }
        self._config = config.model_copy(update=plain)
        # `icp` by default settings, updated from the first poorly constrained scan on.
        self._icp = Registration(self._config)
        self._fed = CONSTRAINED_SCANS

    def locate(self, attempt: Attempt) -> RegistrationResult:
        """The scan's points registered by `icp` on those of the scans that were registered last."""
        icp = self._of_recent(attempt.history)
        return icp.locate(prepare_points(attempt.points.cloud, icp.preprocess), attempt.T_prior)

    def confirm(self, attempt: Attempt, T_start: Floats, result: RegistrationResult) -> RegistrationResult:
        """The result, unless many more non-ground points are inliers elsewhere: few rings slide along a road."""
        icp = self._of_recent(attempt.history)
        points = prepare_points(attempt.points.cloud, icp.preprocess)
        better = best_by_non_ground(icp.attempt(points, T_start), result)
        return result if better is result else attempt.credit(better, ALL_POINTS)

    def instead(
        self, attempt: Attempt, by_features: RegistrationResult, own: RegistrationResult | None
    ) -> RegistrationResult:
        """The pose by `icp` on a map of all points, unless it fails; directions degenerate by features stay flagged.

        Few rings at speed leave so few features that one outlier misleads them by metres.
        own : the result of `locate`, if there is one already
        """
        if self._fed >= CONSTRAINED_SCANS:
            self._icp = self._of_recent(attempt.history)
        self._fed = 0
        if own is None:
            points = prepare_points(attempt.points.cloud, self._icp.preprocess)
            own = self._icp.locate(points, attempt.T_prior)
        if not own.ok:
            return by_features
        degenerate = own.degenerate if len(own.degenerate) else by_features.degenerate
        return replace(
            own, degenerate=degenerate, pose_source=ALL_POINTS, replaced=by_features, points=None, detail=own
        )

    def enter(self, result: RegistrationResult) -> None:
        """While it is needed, enter a scan into the map, and adapt `icp` by its own result of the scan, if there is one."""
        if self._fed >= CONSTRAINED_SCANS:
            return
        self._fed += 1
        own = result.detail if result.replaced is not None else None
        if own is None:
            points = prepare_points(result.points.cloud, self._icp.preprocess)
            own, is_rejected = RegistrationResult(result.T_world_lidar, points=points), True
        else:
            is_rejected = result.is_rejected
        self._icp.update(replace(own, T_world_lidar=result.T_world_lidar, is_rejected=is_rejected))

    def _of_recent(self, history: History) -> Registration:
        """`icp` with all points of the scans that were registered last in its map."""
        icp = Registration(self._config)
        for points, T_world_lidar in history.recent:
            icp.update(RegistrationResult(T_world_lidar, points=prepare_points(points, icp.preprocess)))
        return icp
