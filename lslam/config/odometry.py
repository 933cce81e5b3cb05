"""Section `odometry`: the method, and what is kept and checked beside it."""

from __future__ import annotations

from pydantic import Field

from lslam.config.section import Section

# Methods whose estimate is of points and IMU together.
TIGHTLY_COUPLED = ("fast-lio2", "lio-sam", "lio-mapping", "lips")
# Of these, the ones that have no states for the device, the rotation of its extrinsics and its clock.
FIXED_DEVICE = ("lio-sam", "lio-mapping", "lips")


class OdometryConfig(Section):
    """Which method estimates the trajectory."""

    method: str = Field("icp", description="a name of `lslam methods`")
    poses: str = Field("", description="trajectory file whose poses method `poses` takes")
    preset: str = Field("", description="a name of `lslam config presets` or a TOML file: what the other keys stand on")
    checkpoint_s: float = Field(
        30.0, ge=0, description="s; a run that is killed goes on (--resume) from a checkpoint at most so old; 0: none"
    )
    integrity: bool = Field(
        True,
        description="compare pairs of scans beside the method, whatever it is, and say where they contradict its poses",
    )
