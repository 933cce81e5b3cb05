"""Section `registration`: scan against local map."""

from __future__ import annotations

from pydantic import Field

from lslam.config.section import Section


class RegistrationConfig(Section):
    """The local map of Gaussian voxels and the robust Gauss-Newton solver."""

    voxel_size: float = Field(0.8, gt=0, description="m; voxels of the local map")
    max_iterations: int = Field(10, ge=1, description="Gauss-Newton steps per scan")
