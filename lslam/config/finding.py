"""What a study is expected to find: data beside the study, which its results confirm, refute or leave undecided."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from lslam.config.section import Section

Kind = Literal[
    "diverges_beyond", "holds_up_to", "best_between", "largest_between", "elbow_at", "good_from", "matters_little",
    "linear", "inverse", "product", "acts_only_on",
]  # fmt: skip
Quantity = Literal["translation", "angular", "time_per_scan", "total_time", "efficiency", "total_efficiency"]

# Smallest and largest number of `values` of each kind.
_COUNTS: dict[str, tuple[int, int]] = {
    "diverges_beyond": (1, 1), "holds_up_to": (1, 1), "best_between": (2, 2), "largest_between": (2, 2),
    "elbow_at": (1, 1), "good_from": (1, 1), "matters_little": (1, 1),
    "linear": (0, 1), "inverse": (0, 1), "product": (0, 1), "acts_only_on": (0, 0),
}  # fmt: skip
_LAWS = ("linear", "inverse", "product")


class ExpectedFinding(Section):
    """One `[[finding]]` of a study file.

    Kinds and their `values`, in the unit of the studied parameter unless said otherwise:
    diverges_beyond v : the last value that works is v; holds_up_to v : nothing diverges up to v
    best_between low, high : the best value of `of` lies there; largest_between low, high : its largest one; on either side
        some value is worse
    elbow_at v : just below v the error rises; good_from v : from v on it does not, and below it does somewhere
    matters_little r : the largest `of` is less than r times the smallest
    linear, inverse, product [r2] : total time is a x + b, a / x, a y / x with at least this R2 (0.95), and no other of them
        fits as well
    acts_only_on : of all stages of registration the parameter changes the time of `stages` only

    What differs by less than the seeds scatter is undecided.
    """

    text: str = Field(min_length=1, description="the finding in one sentence")
    kind: Kind = Field(description="what is expected, which says how it is judged")
    values: tuple[float, ...] = Field((), description="numbers of the kind, for example the two ends of a range")
    of: Quantity = Field("efficiency", description="what is best, largest or matters little")
    parameter: str = Field("", description="of several studied one at a time, the one it speaks of")
    method: str = Field("", description="judge runs of this method or preset only; empty: every one")
    imu: bool | None = Field(None, description="judge runs with, or without, the IMU only")
    at: dict[str, float] = Field(
        {}, description="of a two-way study: judge at these values of the other parameter only"
    )
    stages: tuple[str, ...] = Field((), description="acts_only_on: names of stages")
    source: str = Field("", description="where it is stated")

    @model_validator(mode="after")
    def _fit_kind(self) -> Self:
        least, most = _COUNTS[self.kind]
        if not least <= len(self.values) <= most:
            wanted = f"{least}" if least == most else f"{least} or {most}"
            raise ValueError(f"finding {self.kind} takes {wanted} values, not {len(self.values)}")
        if len(self.values) == 2 and self.values[0] > self.values[1]:
            raise ValueError(f"finding {self.kind}: {self.values[0]:g} must not lie above {self.values[1]:g}")
        if self.kind == "matters_little" and self.values[0] <= 1:
            raise ValueError(f"finding matters_little: the ratio {self.values[0]:g} must lie above 1")
        if self.kind in _LAWS and any(not 0 < value <= 1 for value in self.values):
            raise ValueError(f"finding {self.kind}: R2 of {self.values[0]:g} must lie between 0 and 1")
        if (self.kind == "acts_only_on") != bool(self.stages):
            raise ValueError("finding acts_only_on names its stages, and no other kind does")
        return self
