"""Section `debug`: what makes a run worse on purpose, for tests of what repairs it."""

from __future__ import annotations

from pydantic import Field

from lslam.config.section import Section


class DebugConfig(Section):
    """Drift that is added to odometry before loops are looked for; the manifest says so loudly."""

    drift: bool = Field(False, description="let odometry run away as the next keys say: for experiments only")
    drift_percent: float = Field(1.0, ge=0, description="% of the way travelled, in one direction of the world")
    drift_deg_per_100m: float = Field(0.5, ge=0, description="deg of heading per 100 m travelled")
    drift_tilt_deg_per_100m: float = Field(0.0, ge=0, description="deg of roll and pitch per 100 m travelled, likewise")
    drift_seed: int = Field(0, ge=0, description="draws that direction and the side the heading turns to")
    drift_memory: float | None = Field(
        None, gt=0, description="m travelled over which both are forgotten and drawn anew; absent: they never change"
    )
