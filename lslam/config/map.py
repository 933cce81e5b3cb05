"""Section `map`: the merged map."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from lslam.config.section import Section


class MapConfig(Section):
    """The merged map that a run writes."""

    write: bool = Field(True, description="write the merged map")
    write_features: bool = Field(
        False, description="write feature_map.ply, edges and planar points, of methods that have features"
    )
    voxel: float = Field(0.2, ge=0.01, description="m; one averaged point per voxel")
    format: Literal["ply", "pcd"] = Field("ply", description="file format")
    range_min: float = Field(2.0, ge=0, description="m; nearer points are left out")
    range_max: float = Field(80.0, gt=0, description="m; farther points are left out")

    @model_validator(mode="after")
    def _check(self) -> MapConfig:
        self.require_order("range_min", "range_max")
        return self
