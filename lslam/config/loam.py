"""Section `loam`: edges and planes along the rings, and how they are matched."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from lslam.config.section import Section


class LoamConfig(Section):
    """Features of LOAM and LeGO-LOAM. Numbers are the papers' own unless the description says more."""

    regions: int = Field(6, ge=1, description="parts of a ring with equally many points, each with its own features")
    max_edge_points: int = Field(2, ge=1, description="sharp edges per region")
    max_less_edge_points: int = Field(20, ge=1, description="edges per region, the sharp ones included")
    max_planar_points: int = Field(4, ge=1, description="planar points per region")
    edge_curvature: float = Field(
        1.0, gt=0, description="an edge's curvature, equation 2.21, over the angle between beams; a right angle has 2.7"
    )
    planar_curvature: float = Field(0.5, gt=0, description="likewise, above which nothing is planar")
    edge_noise: float = Field(
        4.0, gt=0, description="likewise, over what the noise of the ranges makes, which is measured in each scan"
    )
    edge_sigma: float = Field(
        0.15, gt=0, description="m; of an edge across itself: it lies anywhere between two beams, and silhouettes move"
    )
    occlusion: float = Field(0.3, gt=0, description="m; a jump in range from beam to beam that hides what is behind")
    parallel_deg: float = Field(
        80.0, gt=0, lt=90, description="deg; angle of incidence above which a surface is parallel to the beam"
    )
    grid_step: float = Field(0.2, ge=0, description="m; grid of the less planar points, 0 keeps all")
    feature_map_voxel: float = Field(
        1.0, gt=0, description="m; voxels of the feature map; those of planes are 1.5 times `grid_step` at least"
    )
    ground_angle_deg: float = Field(
        10.0, gt=0, lt=90, description="deg; lego-loam: steepest ground against the dominant plane"
    )
    segment_angle_deg: float = Field(
        60.0, gt=0, lt=90, description="deg; lego-loam: neighbours whose line makes more with the beam belong together"
    )
    segment_points: int = Field(30, ge=1, description="lego-loam: smaller clusters are clutter, unless")
    small_segment_points: int = Field(5, ge=1, description="lego-loam: they have so many points")
    small_segment_rings: int = Field(3, ge=1, description="lego-loam: on so many rings, as poles have")
    pieces: int = Field(
        3,
        ge=1,
        description="loam-livox: parts of a sweep, each registered by itself; 1: the motion prior deskews it whole",
    )
    matching: Literal["one-to-many", "one-to-one"] = Field(
        "one-to-many",
        description="scan to scan: a feature matches the line or plane through several of the other scan's, or the nearest alone",
    )

    @model_validator(mode="after")
    def _check(self) -> LoamConfig:
        if self.max_less_edge_points < self.max_edge_points:
            raise ValueError(
                f"max_less_edge_points = {self.max_less_edge_points} must be at least max_edge_points = "
                f"{self.max_edge_points}"
            )
        if self.planar_curvature > self.edge_curvature:
            raise ValueError(
                f"planar_curvature = {self.planar_curvature} must not exceed edge_curvature = {self.edge_curvature}"
            )
        return self
