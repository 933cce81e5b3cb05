"""Section `input`: which scans are read."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field, field_validator

from lslam.config.section import Section
from lslam.machine import available_cores

RINGS = re.compile(r"(auto|field|order)|(rows|elevation)(?::([1-9]\d{0,2}))?")


class ScanRange(Section):
    """Which scans of one sequence are used; what is absent stays as the configuration says."""

    start: int | None = Field(None, ge=0, description="first scan used of this sequence, absent: input.start")
    count: int | None = Field(None, ge=1, description="number of scans used of it, absent: input.count")
    skip_frames: int | None = Field(None, ge=1, description="use every n-th scan of it, absent: input.skip_frames")

    @property
    def own(self) -> dict[str, int]:
        """What is given, by key of the section `input`.

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
        if RINGS.fullmatch(value) is None:
            raise ValueError("auto, field, order, rows[:N] or elevation[:N] is needed")
        return value
