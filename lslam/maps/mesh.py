"""Open3D's filters for finished maps: outlier removal and surface reconstruction. The map must fit into memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Ints
from lslam.core.errors import InputError
from lslam.core.extras import importing_open3d
from lslam.core.types.cloud import ArrayCloud

NEIGHBOURS, DEVIATIONS = 20, 2.0
# Normals from so many neighbours; a surface farther than so many voxels from every point is made up and goes.
_FOR_NORMALS, _FARTHEST = 20, 2.0
_DEEPEST = 11


@dataclass(frozen=True)
class Mesh:
    """A surface: vertices (V, 3) float64, m; triangles (F, 3) int32, counter-clockwise seen from where the sensor was."""

    vertices: Floats
    triangles: Ints


def require_open3d() -> Any:
    """The open3d module. Raises InputError with instructions when it, or a library it needs, is missing."""
    with importing_open3d():
        import open3d
    return open3d


def denoise(cloud: ArrayCloud, neighbours: int = NEIGHBOURS, deviations: float = DEVIATIONS) -> ArrayCloud:
    """The cloud without points far from their neighbours: Open3D's statistical outlier removal.

    neighbours, deviations : a point is removed if its mean distance to `neighbours` exceeds the mean of all by `deviations`
        standard deviations; a smaller cloud stays as it is
    """
    package = require_open3d()
    if len(cloud) <= neighbours:
        return cloud
    _, kept = _points(package, cloud).remove_statistical_outlier(neighbours, deviations)
    index = np.sort(np.asarray(kept, np.int64))
    return cloud.select(index)


def surface(cloud: ArrayCloud, voxel: float, viewpoints: NDArray[Any]) -> Mesh:
    """A surface through the points: Poisson reconstruction (Kazhdan and Hoppe 2013), as fine as the map's voxels.

    voxel : edge of the map's voxels, m; viewpoints : (K, 3) positions of the sensor, m: normals look at the nearest
    Raises InputError for fewer points than a surface needs.
    """
    from scipy.spatial import cKDTree

    package = require_open3d()
    if len(cloud) < _FOR_NORMALS:
        raise InputError(f"a map of {len(cloud)} points has no surface: a mesh needs {_FOR_NORMALS} and more")
    points = _points(package, cloud)
    points.estimate_normals(package.geometry.KDTreeSearchParamKNN(_FOR_NORMALS))
    normals = np.array(points.normals)
    nearest = cKDTree(viewpoints).query(cloud.points)[1]
    away = np.einsum("ij,ij->i", normals, np.asarray(viewpoints)[nearest] - cloud.points) < 0
    normals[away] *= -1
    points.normals = package.utility.Vector3dVector(normals)
    extent = float(np.ptp(cloud.points, axis=0).max())
    depth = int(np.clip(np.ceil(np.log2(max(1.1 * extent / voxel, 2.0))), 4, _DEEPEST))
    # More threads would sum in another order each time.
    made, _ = package.geometry.TriangleMesh.create_from_point_cloud_poisson(points, depth=depth, n_threads=1)
    vertices, triangles = np.asarray(made.vertices), np.asarray(made.triangles, np.int32)
    real = cKDTree(cloud.points).query(vertices)[0] <= _FARTHEST * max(voxel, extent / 2**depth)
    triangles = triangles[real[triangles].all(1)]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return Mesh(np.ascontiguousarray(vertices[used]), renumbered.reshape(-1, 3).astype(np.int32))


def _points(package: Any, cloud: ArrayCloud) -> Any:
    """Open3D's point cloud of the points."""
    return package.geometry.PointCloud(package.utility.Vector3dVector(cloud.points))
