"""Methods `loam-odom`, `loam` and `floam`: edges and planar points, scan to scan, on the feature map, or both."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from lslam.config.config import Config
from lslam.config.recovery import RecoveryConfig
from lslam.odometry.base import Registered
from lslam.odometry.feature_map import FeatureKeyframes
from lslam.odometry.feature_registration import FeatureRegistration
from lslam.odometry.feature_steps import ScanStep, joint_step
from lslam.odometry.scan_outcome import of_registration
from lslam.preprocessing.deskew import deskew_points
from lslam.preprocessing.features import FeaturePoints, Features, extract_features
from lslam.registration.uncertainty import PoseUncertainty
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult
from lslam.types.stage_clock import StageClock
from lslam.types.state import Stateful


@dataclass(frozen=True)
class LoamVariant:
    """What makes a method of the family.

    scan_step : how a scan is registered on the one before; None leaves that out
    with_map : whether the pose is found, or refined, on a feature map
    with_less_planes : whether the map is matched with the less planar points in place of the planar ones
    inlier_ratio : share of the correspondences with the map, the nearest, that have a say
    """

    scan_step: ScanStep | None
    with_map: bool
    with_less_planes: bool = False
    inlier_ratio: float = 1.0


VARIANTS = {
    "loam-odom": LoamVariant(joint_step, with_map=False),
    "loam": LoamVariant(joint_step, with_map=True),
    "floam": LoamVariant(None, with_map=True),
}


def create(config: Config) -> Loam:
    """The variant that `odometry.method` names."""
    return Loam(config, VARIANTS[config.odometry.method])


class Loam(Stateful):
    """Adapter from scans and motion priors to `FeatureRegistration`.

    The detail of a scan that was registered: its features, deskewed, and what the registration found.
    """

    needs_rings = True
    deskew = "features by the motion prior, and again by the motion that registration finds"
    STATE: ClassVar[tuple[str, ...]] = ("registration", "_uncertainty")

    def __init__(self, config: Config, variant: LoamVariant) -> None:
        self.config, self.variant = config, variant
        self.restart()

    def restart(self) -> None:
        """No scan seen, an empty feature map."""
        c, v = self.config, self.variant
        self.registration = FeatureRegistration(
            c.registration, c.loam, scan_step=v.scan_step, with_map=v.with_map, with_less_planes=v.with_less_planes,
            reach=1.2 * c.preprocess.range_max, recovery=self.recovery, keyframes=self._fresh_keyframes(),
            inlier_ratio=v.inlier_ratio,
        )  # fmt: skip
        self._uncertainty = self._fresh_uncertainty()

    @property
    def recovery(self) -> RecoveryConfig:
        """What is tried where features are not enough."""
        return self.config.recovery

    def _fresh_uncertainty(self) -> PoseUncertainty:
        return PoseUncertainty(is_scan_to_scan=not self.variant.with_map)

    def _fresh_keyframes(self) -> FeatureKeyframes | None:
        """What chooses the scans of the feature map; None enters all."""
        return None

    def prepare(self, scan: Scan) -> Features:
        """Edges and planar points. Raises InputError for a scan without usable rings."""
        return extract_features(scan, self.config.loam, self.config.preprocess)

    def features_of(self, prepared: Features, motion: MotionPrior) -> Features:
        """The features as seen from the pose at the stamp, the sensor having moved as `motion` says."""
        return deskewed(prepared, motion) if self.is_swept(prepared, motion) else prepared

    def is_swept(self, prepared: Features, motion: MotionPrior) -> bool:
        """Whether there is a motion within the sweep to take out, and times to do so by."""
        return self.config.preprocess.deskew and prepared.planes.times is not None and len(motion.times) > 1

    def register(self, scan: Scan, prepared: Features, prior: MotionPrior) -> Registered:
        """Align with the scan before, with the feature map, or with one after the other."""
        return self._align(scan, prepared, prior)

    def register_near(self, scan: Scan, prepared: Features, prior: MotionPrior, found: Registered) -> Registered:
        """As `register`, from the prior alone."""
        near = self._align(scan, prepared, prior, is_near=True)
        features, located = near.detail
        return near if located.ok else replace(near, detail=(features, found.detail[1]))

    def _align(self, scan: Scan, prepared: Features, prior: MotionPrior, is_near: bool = False) -> Registered:
        clock = StageClock()
        with clock.stage("deskew"):
            features = self.features_of(prepared, prior)
        if features is prepared:
            del clock.seconds["deskew"]
        located = self.registration.locate(features, prior.pose, clock, is_near)
        return Registered(of_registration(scan, located, self._uncertainty.map_age, clock.seconds), (features, located))

    def update(self, prior: MotionPrior, found: Registered) -> ScanResult:
        """Enter the scan where its result puts it: into the feature map, and as what the next one is registered on."""
        clock = StageClock()
        with clock.stage("update"):
            features, located = found.detail
            located = located.decided(found.result)
            self.registration.update(features, located)
            result = self._uncertainty.stamped(found.result, located, prior)
        return replace(result, stages={**result.stages, **clock.seconds})

    def warm_up(self) -> None:
        """Register a small room with a throw-away copy, well and badly: every kernel is compiled or loaded."""
        trial = type(self)(self.config, self.variant)
        room = _room()
        prior = MotionPrior.at_once(np.eye(4))
        for scan in (room, room, room.select(np.arange(0, len(room), 3))):
            prepared = trial.prepare(scan)
            trial.update(prior, trial.register(scan, prepared, prior))


def deskewed(features: Features, prior: MotionPrior) -> Features:
    """The features as seen from the pose at the stamp."""

    def moved(part: FeaturePoints) -> FeaturePoints:
        return replace(part, points=deskew_points(part.points, part.times, prior))

    return replace(
        features,
        edges=moved(features.edges),
        less_edges=moved(features.less_edges),
        planes=moved(features.planes),
        less_planes=moved(features.less_planes),
        neither=moved(features.neither),
    )


def _room() -> Scan:
    """Sixteen rings in a box of a room with four corners, as a sensor in its middle sees it."""
    azimuth, elevation = np.linspace(-np.pi, np.pi, 900, endpoint=False), np.linspace(-0.3, 0.3, 16)
    a, e = np.meshgrid(azimuth, elevation)
    beams = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    reach = np.min(np.array([9.0, 7.0, 1.5]) / np.maximum(np.abs(beams), 1e-9), axis=1)
    rings = np.repeat(np.arange(16, dtype=np.uint16), len(azimuth))
    return Scan((beams * reach[:, None]).astype(np.float32), 0, 0, rings=rings)
