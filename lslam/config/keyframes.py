"""Section `keyframes`: which scans stand for their surroundings."""

from __future__ import annotations

from pydantic import Field

from lslam.config.section import Section


class KeyframesConfig(Section):
    """When a scan becomes a keyframe, and what is kept of it."""

    distance: float = Field(2.0, gt=0, description="m; way since the last keyframe")
    angle_deg: float = Field(15.0, gt=0, description="deg; turn since the last keyframe")
    voxel: float = Field(0.3, ge=0.05, description="m; one averaged point per voxel is kept of a keyframe's scan")
    deflate: int = Field(
        1,
        ge=0,
        le=9,
        description="how much the clouds on disk are packed: 0 not at all, quickest, twice the size; 9 most",
    )
    submap_size: int = Field(5, ge=1, description="keyframes whose clouds make one submap, about the one in the middle")
