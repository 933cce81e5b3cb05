"""The residuals by name. A new one is a kernel file and a line here; nothing heavy is imported before it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any

from lslam.core.errors import UsageError, nearest

if TYPE_CHECKING:
    from lslam.registration.gaussian_map import GaussianMap
    from lslam.registration.preprocessing.prepare import PreparedPoints

Arrays = tuple[Any, ...]


def _alone(points: PreparedPoints, sigma: float) -> Arrays:
    """The source points (S, 3), m."""
    return (points.source,)


def _with_scatter(points: PreparedPoints, sigma: float) -> Arrays:
    """The source points (S, 3), m, and the covariance (S, 6), m2, of the raw points that each is the mean of."""
    return points.source, points.scatter


def _with_gaps(points: PreparedPoints, sigma: float) -> Arrays:
    """The source points (S, 3), m, and the gap (S,) between rings at each, m; 0 where it was not computed."""
    from numpy import zeros

    return points.source, zeros(len(points.source)) if points.gaps is None else points.gaps


def _with_covariance(points: PreparedPoints, sigma: float) -> Arrays:
    """The source points (S, 3), m, and the covariance (S, 6), m2, of the surface at each, computed here if the points lack it.

    sigma : m, of a surface along its normal
    """
    from lslam.registration.gaussian_map import source_covariance

    if points.covariance is not None:
        return points.source, points.covariance
    return points.source, source_covariance(points.source, points.map_points, sigma**2)


def _planes(target: GaussianMap) -> Arrays:
    """Planes of the voxels, with their hash table."""
    return target.planes, target.keys, target.table


def _counted_planes(target: GaussianMap) -> Arrays:
    """Planes of the voxels and the number of points of each, with their hash table."""
    return target.planes, target.refreshed, target.keys, target.table


def _shapes(target: GaussianMap) -> Arrays:
    """Full Gaussians of the voxels, with their hash table."""
    return target.shapes(), target.keys, target.table


# The mean of a non-planar voxel lies where rings do, which it stands across: along the sensor's axis it is known to a ring's
# gap, five or six times worse than the points scatter.
WEIGHT_ALONG_AXIS = 0.03
# Weight of voxels that are no plane: they know less than they say.
NON_PLANAR_WEIGHT = 0.5


@dataclass(frozen=True)
class ResidualKind:
    """What one residual is.

    module, function : its compiled `linearise`, see `core.kernels.linearisation`; imported when it is asked for
    points : source points, and what it takes of each, by the noise of a point, m
    voxels : what it takes of a map
    by_surfaces : whether S of its sums tells which directions are observed: its matrices are full
    is_wide : whether voxels of the wide levels tell it something: a mean does not
    non_planar_weight : of voxels that are no plane; 0 leaves them out
    axial_weight : part of that weight along the sensor's axis
    voxel_share : of the voxel size: a voxel's mean stands for one point of its surface, its plane for all
    times_steps : of the steps: a point is drawn to where its match is, not to where the surfaces meet, and the score of a
        normal distribution has no pull on points a few sigma away, so that those near by turn the sensor a little with each
    """

    module: str
    function: str
    points: Callable[[PreparedPoints, float], Arrays] = _with_scatter
    voxels: Callable[[GaussianMap], Arrays] = _planes
    by_surfaces: bool = False
    is_wide: bool = True
    non_planar_weight: float = NON_PLANAR_WEIGHT
    axial_weight: float = WEIGHT_ALONG_AXIS
    voxel_share: float = 1.0
    times_steps: int = 1

    @property
    def needs_covariance(self) -> bool:
        """Whether it takes the covariance about each source point."""
        return self.points is _with_covariance

    @property
    def needs_gaps(self) -> bool:
        """Whether it takes the gap between the rings at each source point."""
        return self.points is _with_gaps

    @cached_property
    def linearise(self) -> Callable[..., None]:
        """The kernel."""
        return getattr(import_module(self.module), self.function)  # type: ignore[no-any-return]


PLANE = ResidualKind("lslam.core.kernels.residuals", "linearise")
RESIDUALS = {
    "plane": PLANE,
    "point": ResidualKind(
        "lslam.registration.kernels.point_residual",
        "linearise_point",
        _with_gaps,
        is_wide=False,
        voxel_share=0.625,
        times_steps=3,
    ),
    "gicp": ResidualKind(
        "lslam.registration.kernels.gicp_residual", "linearise_gicp", _with_covariance, by_surfaces=True
    ),
    "vgicp": ResidualKind(
        "lslam.registration.kernels.gicp_residual",
        "linearise_vgicp",
        _with_covariance,
        _counted_planes,
        by_surfaces=True,
    ),
    "ndt": ResidualKind(
        "lslam.registration.kernels.ndt_residual", "linearise_ndt", _alone, _shapes, by_surfaces=True, times_steps=3
    ),
}
# Point to point in small voxels that pass for no planes, where all axes count alike; nothing that a user chooses.
MEANS = replace(PLANE, is_wide=False, non_planar_weight=1.0, axial_weight=1.0)
# Point to plane where planes alone are asked.
PLANES_ALONE = replace(PLANE, non_planar_weight=0.0)


def find_residual(name: str) -> ResidualKind:
    """The residual of that name. Raises UsageError with the nearest one when there is none."""
    if name not in RESIDUALS:
        raise UsageError(f"no residual {name!r}; {nearest(name, list(RESIDUALS))}")
    return RESIDUALS[name]
