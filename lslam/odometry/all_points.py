"""`icp` as fallback of LOAM's features: all points of a scan, where features are few or poorly constrained."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.registration import RegistrationConfig
from lslam.preprocessing.features import Features
from lslam.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.recovery.policies import RecoveringRegistration
from lslam.recovery.start_search import held_by_non_ground
from lslam.registration.acceptance import correction
from lslam.registration.registration import Registration
from lslam.registration.solver import RegistrationResult
from lslam.types.state import Stateful

Floats = NDArray[np.float64]

# In `posed_by`.
ALL_POINTS = "all-points"
# Well constrained scans in a row, two seconds at 10 Hz, after which the map of all points is dropped.
FED = 20


@dataclass(frozen=True)
class _Asked:
    """The result of `icp` on a scan's points, and that of the features before."""

    features: Features
    points: PreparedPoints
    found: RegistrationResult
    by_features: RegistrationResult


class AllPoints(Stateful):
    """Keeps the points of the scans registered last, and a map of all points while it is needed.

    Parameters
    ----------
    voxel_size : m, of the map of all points
    """

    STATE = ("_recent", "_icp", "_fed")

    def __init__(self, config: RegistrationConfig, voxel_size: float) -> None:
        plain = {
            "residual": None, "target": "map", "inlier_distance": None, "inlier_ratio": 1.0, "voxel_size": voxel_size,
        }  # fmt: skip
        self._config = config.model_copy(update=plain)
        # All points and the poses of the scans that were registered last.
        self._recent: tuple[tuple[NDArray[np.float32], Floats], ...] = ()
        # `icp` by default settings, updated from the first poorly constrained scan on.
        self._icp: Registration = RecoveringRegistration(self._config)
        self._fed = FED
        # Of the scan located last, when all its points were registered.
        self._asked: _Asked | None = None

    def locate(self, features: Features, T_prior: Floats) -> RegistrationResult:
        """Where `icp` finds all points on those of the scans that were registered last."""
        icp = self._of_recent()
        return icp.locate(prepare_points(_points(features), icp.preprocess), T_prior)

    def held(
        self, features: Features, T_start: Floats, T_prior: Floats, found: RegistrationResult
    ) -> RegistrationResult:
        """The result, unless many more non-ground points are inliers elsewhere: few rings slide along a road."""
        icp = self._of_recent()
        points = prepare_points(_points(features), icp.preprocess)
        held = held_by_non_ground(icp, points, T_start, found)
        if held is found:
            return found
        return replace(held, prior_error=correction(T_prior, held.T_world_lidar), posed_by=ALL_POINTS)

    def fallback(
        self, features: Features, T_prior: Floats, starved: RegistrationResult, known: RegistrationResult | None
    ) -> RegistrationResult:
        """The pose by `icp` on a map of all points, unless it fails; directions degenerate by features stay flagged.

        Few rings at speed leave so few features that one outlier misleads them by metres.
        known : the result of `locate`, if there is one already
        """
        if self._fed >= FED:
            self._icp = self._of_recent()
        self._fed = 0
        points = prepare_points(_points(features), self._icp.preprocess)
        found = self._icp.locate(points, T_prior) if known is None else known
        self._asked = _Asked(features, points, found, starved)
        if not found.ok:
            return starved
        flagged = found.degenerate if len(found.degenerate) else starved.degenerate
        return replace(found, degenerate=flagged, posed_by=ALL_POINTS)

    def update(self, features: Features, result: RegistrationResult) -> None:
        """Keep all points of a registered scan; adapt `icp` by its own result of the scan, if there is one."""
        self._recent = (*self._recent, (_points(features), result.T_world_lidar))[-self._config.start_scans :]
        if self._fed >= FED:
            return
        self._fed += 1
        asked = self._asked_of(features)
        if asked is not None:
            points = asked.points
            found = replace(asked.found, T_world_lidar=result.T_world_lidar, is_denied=result.is_denied)
        else:
            points = prepare_points(_points(features), self._icp.preprocess)
            found = RegistrationResult(result.T_world_lidar, is_denied=True)
        self._icp.update(points, found)

    def by_features(self, features: Features, result: RegistrationResult) -> RegistrationResult:
        """The features' own result of a scan: `result` where there was no fallback."""
        asked = self._asked_of(features)
        return result if asked is None else asked.by_features

    def _asked_of(self, features: Features) -> _Asked | None:
        """The result of all points on this scan, where there is one and it did not fail."""
        asked = self._asked
        return asked if asked is not None and asked.features is features and asked.found.ok else None

    def _of_recent(self) -> Registration:
        """`icp` with all points of the scans that were registered last in its map."""
        icp = RecoveringRegistration(self._config)
        for points, T_world_lidar in self._recent:
            icp.update(prepare_points(points, icp.preprocess), RegistrationResult(T_world_lidar))
        return icp


def _points(features: Features) -> NDArray[np.float32]:
    parts = (features.less_planes, features.planes, features.less_edges, features.neither)
    return np.concatenate([part.points for part in parts], dtype=np.float32)
