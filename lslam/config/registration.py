"""Section `registration`: scan against local map."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from lslam.config.section import Section

# A name of the table `registration.residuals.RESIDUALS`, which this layer does not know: `check_config` looks there.
Residual = str


class RegistrationConfig(Section):
    """The local map of Gaussian voxels and the robust Gauss-Newton solver."""

    residual: Residual | None = Field(
        None,
        description="how a point is measured against the map: point to point, point to plane, plane to plane, "
        "distribution to distribution, NDT score; absent: what the method is named after, of icp the plane",
    )
    neighbourhood: Literal["voxel", "knn"] = Field(
        "voxel",
        description="`gicp` and `vgicp`: a point's surface is that of its scan in the voxel around, where several rings make "
        "one, or of its twenty nearest neighbours, as in the paper",
    )
    target: Literal["map", "submap", "keyframe", "scan"] = Field(
        "map",
        description="registered against a map of all scans near by, of the keyframes around, of the last keyframes, or "
        "the last scan alone",
    )
    keyframes: int = Field(10, ge=1, description="`target = keyframe`: how many")
    keyframe_m: float = Field(2.0, gt=0, description="m; so far from the newest of them a new one is made")
    keyframe_deg: float = Field(15.0, gt=0, description="deg; or turned by so much")
    inlier_distance: float | None = Field(
        None,
        gt=0,
        description="m; correspondences beyond are rejected and the kernel stays this wide; absent: it opens as wide as "
        "the motion prior was lately wrong and narrows from step to step",
    )
    inlier_ratio: float = Field(
        1.0, gt=0, le=1, description="share of the correspondences kept, nearest first (trimmed ICP); 1 keeps all"
    )
    voxel_size: float = Field(
        0.8,
        gt=0,
        description="m; voxels of the local map, eight are searched per point; for `point`, which is matched to "
        "their means, 5/8 of it",
    )
    min_points: int = Field(6, ge=4, description="points a voxel needs before it is matched")
    planarity: float = Field(0.3, gt=0, lt=1, description="(l1 - l0) / l2 above which a voxel is a plane")
    count_cap: float = Field(200, gt=10, description="points a voxel remembers; older ones fade")
    sigma: float = Field(0.03, gt=0, description="m; noise of a point, ranging and calibration together")
    blob_weight: float = Field(0.5, ge=0, description="weight of voxels that are no plane; 0 leaves them out")
    kernel_max: float = Field(1.0, gt=0, description="m; widest Geman-McClure kernel, where annealing starts")
    kernel_min: float = Field(0.15, gt=0, description="m; width at which annealing ends: five sigma")
    kernel_decay: float = Field(0.5, gt=0, lt=1, description="factor of the width from step to step")
    max_iterations: int = Field(
        10,
        ge=1,
        description="Gauss-Newton steps per scan; three times as many for `point` and `ndt`, which converge slowly",
    )
    start_scans: int = Field(5, ge=1, description="first scans, registered coarse to fine because the speed is unknown")
    start_reach: float = Field(
        12.0,
        ge=0,
        description="m; how far the sensor may have moved between the first two scans, 40 m/s at every third scan of "
        "10 Hz; 0: not searched for",
    )
    start_iterations: int = Field(40, ge=1, description="steps of each stage while starting or recovering")
    coarse_factor: int = Field(3, ge=2, description="coarse voxels are this many times larger")
    coarse_kernel: float = Field(5.0, gt=0, description="m; where coarse annealing starts: the capture range")
    coarse_decay: float = Field(0.85, gt=0, lt=1, description="factor of the width per coarse step")
    recover_m: float = Field(0.3, gt=0, description="m; a correction beyond this is checked coarse to fine")
    recover_deg: float = Field(3.0, gt=0, description="deg; likewise for rotation")
    min_overlap: float = Field(
        0.05, ge=0, le=1, description="share of points that found a voxel below which a scan fails"
    )
    min_agreement: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="a scan fails when the share of its points on the map's surfaces drops below this part of what it "
        "was lately, at the start of what the first scan has on its own surfaces, as when the sensor was carried elsewhere; "
        "0 switches it off",
    )
    max_jump_m: float = Field(6.0, gt=0, description="m; a correction of the motion prior beyond this fails")
    max_jump_deg: float = Field(45.0, gt=0, description="deg; likewise for rotation")
    weak_share: float = Field(
        1e-3,
        ge=0,
        lt=1,
        description="share of the information below which a direction counts as unobserved; below a third of it (in LOAM "
        "methods: at once) it keeps the motion prior",
    )

    @model_validator(mode="after")
    def _check(self) -> RegistrationConfig:
        self.require_order("kernel_min", "kernel_max")
        return self
