"""Section `lio_mapping`: the sliding window of the method of that name."""

from __future__ import annotations

from pydantic import Field

from lslam.config.section import Section


class LioMappingConfig(Section):
    """How much of the past is estimated anew with every scan."""

    window: int = Field(
        7,
        ge=2,
        le=20,
        description="scans whose poses, velocities and biases are estimated together, the newest included",
    )
