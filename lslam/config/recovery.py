"""Section `recovery`: what is tried when a registration from the motion prior is not enough."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from lslam.config.section import Section


class RecoveryConfig(Section):
    """One switch per policy; `posed_by` in scans.csv names the one that acted."""

    coarse_to_fine: bool = Field(
        True,
        description="align with coarse planes from metres off where a scan fails, corrects its prior by much or is new",
    )
    start_search: bool = Field(
        True, description="seek the first steps within `registration.start_reach`, told by the points above the ground"
    )
    at_rest: bool = Field(
        True,
        description="hold a sensor that stood, where fewer things must have moved for that than for its own motion",
    )
    less_planar: bool = Field(
        True, description="LOAM methods: less planar points in place of features that are few or leave a direction open"
    )
    fallback: Literal["none", "all-points"] = Field(
        "none", description="who poses a scan that LOAM's features hold badly: nobody, or `icp` on all its points"
    )


# Of methods whose filter, smoother or window bridges a scan.
NO_RECOVERY = RecoveryConfig(
    coarse_to_fine=False, start_search=False, at_rest=False, less_planar=False, fallback="none"
)


def rest_alone(recovery: RecoveryConfig) -> RecoveryConfig:
    """No policy but `at_rest`, as configured: of a filter, whose IMU cannot tell standing from a steady motion."""
    return NO_RECOVERY.model_copy(update={"at_rest": recovery.at_rest})
