"""What every section of the configuration shares; sections `input` and `preprocess`, of the scans that are read."""

from __future__ import annotations

import math
import re
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator

from lslam.core.labels import parse_classes
from lslam.core.machine import available_cores


class Section(BaseModel):
    """A frozen section: unknown keys are errors, values are checked, and nothing changes after the start of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)

    def changed_keys(self, since: Section | None = None) -> list[str]:
        """Keys whose values differ from those of `since`, None: from the defaults, in the order of the section."""
        fields = type(self).model_fields
        before = {key: field.get_default() if since is None else getattr(since, key) for key, field in fields.items()}
        return [key for key in fields if getattr(self, key) != before[key]]

    def require_order(self, low: str, high: str) -> None:
        """Raise ValueError unless the value of key `low` lies below that of `high`."""
        a, b = getattr(self, low), getattr(self, high)
        if not a < b:
            raise ValueError(f"{low} = {a} must be less than {high} = {b}")


RINGS = re.compile(r"(auto|field|order)|(rows|elevation)(?::([1-9]\d{0,2}))?")


class ScanRange(Section):
    """Which scans of one sequence are used; what is absent stays as the configuration says."""

    start: int | None = Field(None, ge=0, description="first scan used of this sequence, absent: input.start")
    count: int | None = Field(None, ge=1, description="number of scans used of it, absent: input.count")
    skip_frames: int | None = Field(None, ge=1, description="use every n-th scan of it, absent: input.skip_frames")

    @property
    def own(self) -> dict[str, int]:
        """The numbers that are set, by key of the section `input`.

        >>> ScanRange(count=5).own
        {'count': 5}
        """
        values = {key: getattr(self, key) for key in ScanRange.model_fields}
        return {key: value for key, value in values.items() if value is not None}

    @property
    def last(self) -> int:
        """Index of the last scan that it asks for."""
        return (self.start or 0) + ((self.count or 1) - 1) * (self.skip_frames or 1)


AS_CONFIGURED = ScanRange()
# More have nothing to do: scans are read one after the other.
MOST_WORKERS = 8


class InputConfig(Section):
    """Which scans of the sequence are used, and how strict the run is about them."""

    start: int = Field(0, ge=0, description="first scan used")
    count: int | None = Field(None, ge=1, description="number of scans used; all when absent")
    skip_frames: int = Field(1, ge=1, description="use every n-th scan")
    threads: int = Field(
        0, ge=0, description="0: as many as there are cores; 1: everything in turn; results do not depend on it"
    )
    strict: bool = Field(False, description="every degradation is a failed gate: exit 4")
    vertical_correction_deg: float | None = Field(
        None, description="deg; rotation of KITTI HDL-64E points about p x z; absent: the reader knows"
    )
    level: Literal["auto", "gravity", "ground", "none"] = Field(
        "auto",
        description="what makes z of the world up: gravity as an IMU measures it, the ground under the first scan, or "
        "nothing; auto: gravity with the IMU, else nothing",
    )
    rings: str = Field(
        "auto", description="how rings are found: auto, field, order (of the file), rows[:N] or elevation[:N]"
    )

    @property
    def workers(self) -> int:
        """Threads of `threads`, 1 or more."""
        return self.threads or min(available_cores(), MOST_WORKERS)

    @field_validator("rings")
    @classmethod
    def _check_rings(cls, value: str) -> str:
        """Raise ValueError for a value of `input.rings` that names no rule."""
        if RINGS.fullmatch(value) is None:
            raise ValueError("auto, field, order, rows[:N] or elevation[:N] is needed")
        return value


class PreprocessConfig(Section):
    """Range gate, what is taken out, and down-sampling."""

    range_min: float = Field(1.0, ge=0, description="m; nearer points hit the vehicle")
    range_max: float = Field(100.0, gt=0, description="m; far points hold the yaw")
    range_shape: Literal["sphere", "cylinder"] = Field("sphere", description="distance in space, or horizontal")
    ego_box: tuple[float, float, float, float, float, float] | None = Field(
        None,
        description="m; x_min, x_max, y_min, y_max, z_min, z_max in the LiDAR frame: points inside are dropped",
    )
    up: tuple[float, float, float] | None = Field(
        None,
        description="up in the LiDAR frame, of any length; absent: z, unless the IMU, or the ground under the first scans, is "
        "more than 45 deg off",
    )
    ring_gap_deg: float | None = Field(
        None, ge=0, description="deg; angle between neighbouring rings; absent: as the first scan shows; 0: unknown"
    )
    drop_labels: Annotated[tuple[str, ...], BeforeValidator(parse_classes)] = Field(
        (),
        description="classes of points that are left out of everything, by SemanticKITTI's names (moving: all that move), or "
        "by number where the recording has others; needs labels of points",
    )
    remove_ground: bool = Field(False, description="take out the points that lie on the ground")
    denoise: bool = Field(
        False, description="take out points far from their neighbours (statistical outlier removal): distant ones first"
    )
    skip_standing: bool = Field(
        False, description="while the sensor stands, repeat the pose instead of registering and mapping the scan"
    )
    deskew: bool = Field(True, description="take the motion within a scan out of it, where points have times")
    map_leaf: float = Field(0.3, gt=0, description="m; centroids of this grid feed the local map")
    least_line: float = Field(
        0.5,
        ge=0,
        description="share of the line of pulses that a surface leaves in a cell of `map_leaf` below which its points are "
        "of the air; where these fill a quarter of the cells (rain, snow, dust), they are left out of the map, and of `target` "
        "and `grid` source points; 0 keeps all",
    )
    downsample: Literal["target", "grid", "first", "random", "none"] = Field(
        "target",
        description="source points: centroids of a grid adapted to a target count, of a fixed grid, first point per "
        "voxel, random share, or all",
    )
    source_voxel: float = Field(1.0, gt=0, description="m; grid of the source points, where `target` starts")
    source_points_min: int = Field(4000, ge=50, description="`target`: fewer points make the grid finer")
    source_points_max: int = Field(6000, ge=100, description="`target`: more points make the grid coarser")
    random_share: float = Field(0.3, gt=0, le=1, description="`random`: share of points kept")
    seed: int = Field(0, ge=0, description="`random`: seed")

    @property
    def ring_gap(self) -> float:
        """rad between neighbouring rings; 0: unknown."""
        return math.radians(self.ring_gap_deg or 0.0)

    @model_validator(mode="after")
    def _check(self) -> PreprocessConfig:
        """Raise ValueError for limits in the wrong order, and for an invalid box or direction."""
        self.require_order("range_min", "range_max")
        self.require_order("source_points_min", "source_points_max")
        box = self.ego_box
        if box is not None and not (box[0] < box[1] and box[2] < box[3] and box[4] < box[5]):
            raise ValueError(f"ego_box = {list(box)} must be x_min, x_max, y_min, y_max, z_min, z_max")
        if self.up is not None and not 0.0 < sum(v * v for v in self.up) < float("inf"):
            raise ValueError(f"up = {list(self.up)} must be a direction: three finite numbers, not all 0")
        return self
