"""The residuals by name: the kernel of each, compiled when it is asked for, and what it reads of the map."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from lslam.config.registration import Residual
from lslam.registration.gaussian_map import GaussianMap

# The loop of steps stands once in each: with the residual as its argument, one loop would be compiled anew for every
# residual that is handed to it and kept by no cache. What the loops share is inlined from `gauss_newton`.
KERNELS = {
    "plane": ("lslam.kernels.gauss_newton", "align"),
    "point": ("lslam.kernels.point_residual", "align_point"),
    "gicp": ("lslam.kernels.gicp_residual", "align_gicp"),
    "vgicp": ("lslam.kernels.vgicp_residual", "align_vgicp"),
    "ndt": ("lslam.kernels.ndt_residual", "align_ndt"),
}
NEEDS_COVARIANCE = frozenset({"gicp", "vgicp"})


def kernel_of(residual: Residual) -> Callable[..., Any]:
    """The kernel that aligns by this residual, called as `gauss_newton.align`."""
    module, name = KERNELS[residual]
    return getattr(import_module(module), name)  # type: ignore[no-any-return]


def voxels_of(residual: Residual, target: GaussianMap) -> tuple[Any, ...]:
    """The arrays of a map that its kernel takes after the voxel size."""
    if residual == "ndt":
        return target.shapes(), target.keys, target.table
    if residual == "vgicp":
        return target.planes, target.refreshed, target.keys, target.table
    return target.planes, target.keys, target.table
