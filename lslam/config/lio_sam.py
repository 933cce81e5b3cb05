"""Section `lio_sam`: the tightly coupled smoother of LIO-SAM."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from lslam.config.section import Section


class LioSamConfig(Section):
    """What `lio-sam` registers, and its smoother. Numbers are the paper's (Shan et al. 2020) or its implementation's."""

    features: Literal["loam", "points"] = Field(
        "loam",
        description="what is registered: edges and planar points along the rings, as in the paper, or all points",
    )
    keyframes: int = Field(25, ge=1, description="newest keyframes that make the local map")
    keyframe_m: float = Field(1.0, gt=0, description="m; moved so far since the last of them, or")
    keyframe_deg: float = Field(10.0, gt=0, description="deg; turned by so much, for a new one")
    reset_scans: int = Field(
        100, ge=2, description="scans after which the smoother's graph begins anew, with what it knows as its prior"
    )
    graph_imu: bool = Field(
        True,
        description="preintegrated IMU factors between the keyframes of the pose graph, with velocities and biases",
    )
