"""Section `input`: which scans are read."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field, field_validator

from lslam.config.section import Section

RINGS = re.compile(r"(auto|field|order)|(rows|elevation)(?::([1-9]\d{0,2}))?")


class InputConfig(Section):
    """Which scans of the sequence are used, and how strict the run is about them."""

    start: int = Field(0, ge=0, description="first scan used")
    count: int | None = Field(None, ge=1, description="number of scans used; all when absent")
    skip_frames: int = Field(1, ge=1, description="use every n-th scan")
    threads: int = Field(2, ge=1, description="1: everything in turn; 2 and more: the next scan is read meanwhile")
    strict: bool = Field(False, description="every degradation is a failed gate: exit 4")
    vertical_correction_deg: float | None = Field(
        None, description="rotation of KITTI HDL-64E points about p x z; absent: the reader knows"
    )
    level: Literal["auto", "gravity", "ground", "none"] = Field(
        "auto",
        description="what makes z of the world up: gravity as an IMU measures it, the ground under the first scan, or "
        "nothing; auto: gravity with the IMU, else nothing",
    )
    rings: str = Field(
        "auto", description="how rings are found: auto, field, order (of the file), rows[:N] or elevation[:N]"
    )

    @field_validator("rings")
    @classmethod
    def _check_rings(cls, value: str) -> str:
        if RINGS.fullmatch(value) is None:
            raise ValueError("auto, field, order, rows[:N] or elevation[:N] is needed")
        return value
