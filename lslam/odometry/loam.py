"""Methods `loam-odom`, `loam`, `floam` and `lego-loam`: edges and planar points, scan to scan, on the feature map, or both."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import StageClock
from lslam.odometry.base import MapMethod
from lslam.odometry.feature_policies import feature_policies
from lslam.odometry.feature_solver import joint_step, two_steps
from lslam.odometry.feature_target import FeatureTarget, LoamVariant
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.features import FeaturePoints, Features, extract_features
from lslam.registration.preprocessing.segments import lego_features
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult

VARIANTS = {
    "loam-odom": LoamVariant(joint_step, with_map=False),
    "loam": LoamVariant(joint_step, with_map=True),
    "floam": LoamVariant(None, with_map=True),
    "lego-loam": LoamVariant(two_steps, with_map=True, with_less_planes=True),
}


def create(config: Config) -> Loam:
    """Create the variant that `odometry.method` names."""
    method = config.odometry.method
    return (LegoLoam if method == "lego-loam" else Loam)(config, VARIANTS[method])


class Loam(MapMethod):
    """Registers edges and planar points on the last scan, on the feature map, or on one after the other."""

    needs_rings = True
    deskew = "features by the motion prior, and again by the motion that registration finds"

    def __init__(self, config: Config, variant: LoamVariant) -> None:
        self.config, self.variant = config, variant
        # From scan to scan no spot is remembered, on which the sensor could have come to rest.
        switches = {} if variant.with_map else {"at_rest": False}
        policies = feature_policies(config.recovery.model_copy(update=switches))
        target = FeatureTarget(config, variant)
        registration = Registration(config.registration, config.preprocess, target=target, policies=policies)
        super().__init__(registration, is_scan_to_scan=not variant.with_map)

    def prepare(self, scan: Scan) -> Features:
        """Edges and planar points. Raises InputError for a scan without usable rings."""
        return extract_features(scan, self.config.loam, self.config.preprocess)

    def features_of(self, prepared: Features, motion: MotionPrior) -> Features:
        """The features as seen from the pose at the stamp, the sensor having moved as `motion` says."""
        return deskew_features(prepared, motion) if self.has_sweep(prepared, motion) else prepared

    def has_sweep(self, prepared: Features, motion: MotionPrior) -> bool:
        """Whether there is a motion within the sweep to take out, and times to do so by."""
        return self.config.preprocess.deskew and prepared.planes.times is not None and len(motion.times) > 1

    def register(self, scan: Scan, prepared: Features, prior: MotionPrior, is_near: bool = False) -> RegistrationResult:
        """Register features on the last scan, on the feature map, or on one after the other, as the variant says."""
        clock = StageClock()
        with clock.stage("deskew"):
            features = self.features_of(prepared, prior)
        if features is prepared:
            del clock.seconds["deskew"]
        result = self.registration.locate(features, prior.pose, is_near, self.information_of(prior), clock=clock)
        return replace(result, map_age=self.map_age, stages=clock.seconds)

    def warm_up(self) -> None:
        """Compile or load every kernel by registering a synthetic room with a temporary copy, from a good and a bad start."""
        trial = type(self)(self.config, self.variant)
        room = _room()
        prior = MotionPrior.at_once(np.eye(4))
        for scan in (room, room, room.select(np.arange(0, len(room), 3))):
            prepared = trial.prepare(scan)
            trial.update(scan, prior, trial.register(scan, prepared, prior))


class LegoLoam(Loam):
    """LOAM on what the segmentation of the range image leaves: ground and clusters first, then scan to scan in two steps.

    Shan and Englot 2018, "LeGO-LOAM: Lightweight and ground-optimized lidar odometry and mapping on variable terrain". Edges
    come from clusters off the ground, planar points from the ground; z, roll and pitch are found from these, then x, y and yaw
    from those. Its mapping takes the less planar points of ground and clusters, as the paper's does.
    """

    def prepare(self, scan: Scan) -> Features:
        """Edges off the ground, planar points on it, clutter left out. Raises InputError for a scan without usable rings."""
        features, _ = lego_features(scan, self.config.loam, self.config.preprocess)
        return features


# What is registered, and what is entered into the map where that went well: deskewed together, once either is asked for.
_TOGETHER = (("edges", "planes"), ("less_edges", "less_planes", "neither"))


def deskew_features(features: Features, prior: MotionPrior) -> Features:
    """The features as seen from the pose at the stamp.

    Points are deskewed when first read, those for the map only once the map takes them.
    """
    parts: dict[str, FeaturePoints] = {}
    for names in _TOGETHER:
        group = _SweepFeatures([getattr(features, name) for name in names], prior)
        parts.update({name: _SweepPart(group, k) for k, name in enumerate(names)})
    return Features(**parts, labels=features.labels)


class _SweepFeatures:
    """Parts of a scan's features (edges, planar points, ...) that are deskewed together by `prior` when first needed."""

    def __init__(self, parts: list[FeaturePoints], prior: MotionPrior) -> None:
        self.parts, self._prior = parts, prior

    @cached_property
    def points(self) -> list[Floats]:
        """Points (M, 3), m, of each part, as seen from the pose at the stamp."""
        times = [part.times for part in self.parts if part.times is not None]
        points = np.concatenate([part.points for part in self.parts])
        moved = deskew_points(points, np.concatenate(times), self._prior)
        return np.split(moved, np.cumsum([len(part) for part in self.parts])[:-1])


class _SweepPart(FeaturePoints):
    """One part of a scan's features, whose points are deskewed when they are first read."""

    _group: _SweepFeatures
    _k: int

    def __init__(self, group: _SweepFeatures, k: int) -> None:
        own = group.parts[k]
        self.__dict__.update(rings=own.rings, times=own.times, _group=group, _k=k)

    def __len__(self) -> int:
        return len(self.rings)

    @cached_property
    def points(self) -> Floats:
        """(M, 3) m, as seen from the pose at the stamp."""
        return self._group.points[self._k]


def _room() -> Scan:
    """Synthetic scan of 16 rings, from the middle of a box-shaped room."""
    azimuth, elevation = np.linspace(-np.pi, np.pi, 900, endpoint=False), np.linspace(-0.3, 0.3, 16)
    a, e = np.meshgrid(azimuth, elevation)
    beams = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    reach = np.min(np.array([9.0, 7.0, 1.5]) / np.maximum(np.abs(beams), 1e-9), axis=1)
    rings = np.repeat(np.arange(16, dtype=np.uint16), len(azimuth))
    return Scan((beams * reach[:, None]).astype(np.float32), 0, 0, rings=rings)
