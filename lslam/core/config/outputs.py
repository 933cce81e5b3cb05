"""Sections `map`, `eval` and `report`: what a run writes, and how it is scored."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from lslam.core.config.input import Section

ATTRIBUTES = ("time", "scan", "ring", "range", "observations", "class")
FINEST_M = 0.01


def parse_attributes(value: Any) -> tuple[str, ...]:
    """Attributes of points from a list, or from text separated by commas. Raises ValueError for unknown ones.

    >>> parse_attributes("time, ring")
    ('time', 'ring')
    """
    words = value.split(",") if isinstance(value, str) else value if isinstance(value, list | tuple) else [value]
    names = tuple(dict.fromkeys(str(word).strip() for word in words if word != ""))
    for name in names:
        if name not in ATTRIBUTES:
            raise ValueError(f"{name!r} is no attribute of points: {', '.join(ATTRIBUTES)} are")
    return names


class MapConfig(Section):
    """The merged map that a run writes."""

    write: bool = Field(True, description="write the merged map")
    write_features: bool = Field(
        False, description="write feature_map.ply, edges and planar points, of methods that have features"
    )
    voxel: float = Field(0.2, ge=0, description="m; one averaged point per voxel; 0 keeps every point")
    attributes: Annotated[tuple[str, ...], BeforeValidator(parse_attributes)] = Field(
        (),
        description="of each point: time, scan, ring, range, observations, class; in a voxel those of the observation nearest to "
        "the sensor",
    )
    format: Literal["ply", "pcd", "las", "laz"] = Field(
        "ply", description="file format; las and laz are in map coordinates when the run is georeferenced"
    )
    range_min: float = Field(2.0, ge=0, description="m; nearer points are left out")
    range_max: float = Field(80.0, gt=0, description="m; farther points are left out")
    clean: bool = Field(False, description="take out what moves: points that other scans see through")
    colour: bool = Field(False, description="take the colours of the points from the images of the recording's cameras")
    occupancy: bool = Field(
        False,
        description="write occupancy.npz and .ply, cells that beams ended in or passed, and floor_plan.png and .yaml",
    )
    occupancy_voxel: float = Field(0.4, ge=0.02, description="m; edge of an occupancy cell")
    occupancy_range: float = Field(40.0, gt=0, description="m; beams are followed so far")
    denoise: bool = Field(False, description="take out points far from their neighbours (statistical outlier removal)")
    mesh: bool = Field(False, description="write map_mesh.ply, a surface through the points (Poisson)")
    ego_box: tuple[float, float, float, float, float, float] | None = Field(
        None,
        description="m; x_min, x_max, y_min, y_max, z_min, z_max in the LiDAR frame: points inside are left out; "
        "`preprocess.ego_box` where absent",
    )
    crop: tuple[float, ...] | None = Field(
        None,
        description="m; x_min, x_max, y_min, y_max and perhaps z_min, z_max of the world: points outside are left out",
    )

    @model_validator(mode="after")
    def _check(self) -> MapConfig:
        """Raise ValueError for limits in the wrong order, invalid boxes, and keys that need voxels without them."""
        self.require_order("range_min", "range_max")
        self.require_order("range_min", "occupancy_range")
        if 0 < self.voxel < FINEST_M:
            raise ValueError(f"voxel = {self.voxel:g} must be {FINEST_M:g} m or more, or 0 for every point")
        if self.voxel == 0 and (self.mesh or self.denoise or self.colour):
            raise ValueError("voxel = 0 keeps every point, and mesh, denoise and colour need voxels: set one")
        require_box("ego_box", self.ego_box)
        if self.crop is not None and len(self.crop) not in (4, 6):
            raise ValueError(f"crop = {list(self.crop)} must be x_min, x_max, y_min, y_max and perhaps z_min, z_max")
        require_box("crop", self.crop)
        return self

    @property
    def crop_box(self) -> tuple[float, ...] | None:
        """`crop` with heights, whatever was given."""
        return self.crop if self.crop is None or len(self.crop) == 6 else (*self.crop, -math.inf, math.inf)


def require_box(name: str, box: tuple[float, ...] | None) -> None:
    """Raise ValueError unless every minimum of a box lies below its maximum."""
    if box is not None and not all(low < high for low, high in zip(box[::2], box[1::2], strict=True)):
        raise ValueError(f"{name} = {list(box)} must be pairs of a smaller and a larger number")


Align = Literal["none", "origin", "se3", "sim3", "posyaw"]


class EvalConfig(Section):
    """Recipes of the numbers; every number is printed beside its recipe."""

    align: tuple[Align, ...] = Field(("se3", "origin"), min_length=1, description="ATE alignments")
    delta: tuple[str, ...] = Field(
        ("1scan/consecutive", "10m/all"),
        description="RPE: number, unit scan|m|s, / pair rule consecutive|all",
    )
    max_diff: float = Field(0.01, gt=0, description="s; largest stamp difference of a matched pair")
    time_offset: float | Literal["auto"] = Field(0.0, description="s; added to the estimate's stamps, or auto")
    frame: str = Field(
        "lidar",
        description="body whose poses are scored: lidar, imu, cam0, or a frame of /tf_static or sequence.toml, as base_link",
    )
    metrics: tuple[str, ...] = Field(
        (), description="shown beside ATE, RPE and KITTI drift: thesis for those of the theses"
    )

    @field_validator("metrics", mode="before")
    @classmethod
    def _as_list(cls, words: Any) -> Any:
        """One word is a list of one."""
        return (words,) if isinstance(words, str) else words


class ReportConfig(Section):
    """The HTML report."""

    html: bool = Field(True, description="write report.html")
