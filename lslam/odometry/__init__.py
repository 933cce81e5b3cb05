"""Odometry methods by name. A new method is one file and one line here; others register an entry point `lslam.methods`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, cast

from lslam.core.errors import UsageError
from lslam.core.extras import factory, require, summarise

if TYPE_CHECKING:
    from lslam.core.config.config import Config
    from lslam.odometry.base import Odometry

GROUP = "lslam.methods"
# name -> (module with `create(config) -> Odometry`, one line for people)
METHODS = {
    "icp": (
        "lslam.odometry.icp",
        "scan to map of Gaussian voxels, point to plane; own, deterministic, with covariances",
    ),
    "icp-point": ("lslam.odometry.icp", "likewise, point to point: each point to the nearest voxel mean; the classic"),
    "gicp": ("lslam.odometry.icp", "likewise, plane to plane: the scan's normals count too (Segal 2009)"),
    "vgicp": ("lslam.odometry.icp", "likewise, distribution to distribution over the voxels around (Koide 2021)"),
    "ndt": ("lslam.odometry.icp", "likewise, normal distributions transform: a score over the voxels (Magnusson 2009)"),
    "icp-svd": ("lslam.odometry.icp_svd", "the classic: point to point, scan to scan, closed form by SVD (Besl 1992)"),
    "fast-lio": (
        "lslam.odometry.fast_lio",
        "tightly coupled with the IMU: edges, planes and prior in one iterated Kalman filter (Xu 2021); needs an IMU",
    ),
    "fast-lio2": (
        "lslam.odometry.fast_lio",
        "tightly coupled with the IMU: points and prior in one iterated Kalman filter (Xu 2022); needs an IMU",
    ),
    "lio-sam": (
        "lslam.odometry.lio_sam",
        "tightly coupled with the IMU: features and preintegration in one factor graph (Shan 2020); needs an IMU",
    ),
    "lio-mapping": (
        "lslam.odometry.lio_mapping",
        "tightly coupled with the IMU: a window of scans and IMU states in one estimate (Ye 2019); needs an IMU",
    ),
    "lips": (
        "lslam.odometry.lips",
        "tightly coupled with the IMU: planes as landmarks, smoothed over a window (Geneva 2018); needs an IMU and planes",
    ),
    "dlo": ("lslam.odometry.dlo", "plane to plane, scan to scan, then to a submap of keyframes (Chen 2022)"),
    "ct-icp": (
        "lslam.odometry.ct_icp",
        "elastic sweeps: poses at begin and end of each, points placed at their own times in every step (Dellenbach 2022)",
    ),
    "loam-odom": ("lslam.odometry.loam", "edges and planar points, scan to scan: LOAM without its map"),
    "loam": ("lslam.odometry.loam", "LOAM: scan to scan, then refined on the feature map at every scan"),
    "floam": ("lslam.odometry.loam", "F-LOAM: motion prior, then scan to feature map in one stage"),
    "lego-loam": ("lslam.odometry.loam", "LeGO-LOAM: ground, clusters, two steps scan to scan, then feature map"),
    "loam-livox": (
        "lslam.odometry.loam_livox",
        "LOAM for Livox and other patterns without rings: by pieces of the sweep to the feature map (Lin 2020)",
    ),
    "kiss-icp": ("lslam.odometry.kiss", "the baseline: the kiss-icp package with its own preprocessing and defaults"),
    "small-gicp": ("lslam.odometry.small_gicp", "baseline: GICP of the small_gicp package on a local map of keyframes"),
    "poses": ("lslam.odometry.given", "somebody else's: the poses of a trajectory file, see `lslam run --poses`"),
    "open3d-gicp": ("lslam.odometry.open3d", "baseline: generalised ICP of Open3D, scan to scan"),
}


# Those whose scans have features, and so a feature map to write.
FEATURE_METHODS = ("loam-odom", "loam", "floam", "lego-loam", "loam-livox", "fast-lio")
# They predict by themselves whatever the IMU says, or have nothing to predict.
LIDAR_ONLY = ("kiss-icp", "poses")
# Of other people, to compare with.
BASELINES = ("kiss-icp", "small-gicp", "open3d-gicp")


class Coupling(StrEnum):
    """What a method does with an IMU."""

    LOOSE = "loose"
    TIGHT = "tight"
    NONE = "none"


@dataclass(frozen=True)
class ListedMethod:
    """A method as people choose it; is_baseline : it is a package of other people."""

    name: str
    summary: str
    coupling: Coupling
    is_baseline: bool = False


def coupling_of(method: str) -> Coupling:
    """How the method uses an IMU; for methods of other packages it predicts."""
    from lslam.core.config.odometry import TIGHTLY_COUPLED

    if method in TIGHTLY_COUPLED:
        return Coupling.TIGHT
    return Coupling.NONE if method in LIDAR_ONLY else Coupling.LOOSE


def listed_methods() -> list[ListedMethod]:
    """All methods in the order of the table, those of other packages last."""
    return [ListedMethod(name, text, coupling_of(name), name in BASELINES) for name, text in known_methods().items()]


def known_methods() -> dict[str, str]:
    """Names and one-line summaries, those of other packages included."""
    return summarise(GROUP, METHODS)


def require_method(name: str) -> None:
    """Raise UsageError with the nearest name when there is no such method."""
    require(GROUP, METHODS, name, "method")


def create_odometry(config: Config) -> Odometry:
    """Create the method that `odometry.method` names.

    Raises UsageError with the nearest name for an unknown method, and for one of another package that lacks `Traits`.
    """
    from lslam.odometry.base import Traits

    name = config.odometry.method
    odometry = cast("Odometry", factory(GROUP, METHODS, name, "method")(config))
    if lacking := [trait for trait in Traits.__annotations__ if not hasattr(odometry, trait)]:
        raise UsageError(
            f"method {name!r} declares no {', '.join(lacking)}: its class must inherit lslam.odometry.base.Traits"
        )
    return odometry
