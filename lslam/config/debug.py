"""Section `debug`: what makes a run worse on purpose, for tests of what repairs it."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from lslam.config.section import Section


class DebugConfig(Section):
    """Drift that is added to odometry before loops are looked for; the manifest says so loudly."""

    drift: bool = Field(False, description="let odometry run away as the next keys say: for experiments only")
    drift_kind: Literal["rate", "random-walk", "recorded"] = Field(
        "rate",
        description="at rates that last, or for `drift_memory` only; at rates drawn anew at every step, of the same size after "
        "100 m; or as the odometry of a real run did",
    )
    drift_percent: float = Field(1.0, ge=0, description="%; of the way travelled, in one direction of the world")
    drift_deg_per_100m: float = Field(0.5, ge=0, description="deg/100 m; of heading, over the way travelled")
    drift_tilt_deg_per_100m: float = Field(0.0, ge=0, description="deg/100 m; of roll and pitch, likewise")
    drift_seed: int = Field(0, ge=0, description="draws that direction and the side the heading turns to")
    drift_memory: float | None = Field(
        None, gt=0, description="m; way over which both are forgotten and drawn anew; absent: they never change"
    )
    drift_estimate: str = Field(
        "",
        description="`recorded`: trajectory of that run, in any format that `eval` reads; where it ends its errors begin anew",
    )
    drift_truth: str = Field("", description="`recorded`: its ground truth")

    @model_validator(mode="after")
    def _check(self) -> Self:
        are_given = bool(self.drift_estimate), bool(self.drift_truth)
        if self.drift_kind == "recorded" and not all(are_given):
            raise ValueError(
                "drift_kind = recorded takes drift_estimate and drift_truth, the two trajectories of a real run"
            )
        if self.drift_kind != "recorded" and any(are_given):
            raise ValueError(f"drift_estimate and drift_truth are of drift_kind = recorded, not of {self.drift_kind}")
        if self.drift_kind != "rate" and self.drift_memory is not None:
            raise ValueError(f"drift_memory is of drift_kind = rate, not of {self.drift_kind}")
        return self
