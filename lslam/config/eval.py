"""Section `eval`: how a trajectory is scored against ground truth."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator

from lslam.config.section import Section

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
    metrics: tuple[str, ...] = Field(
        (), description="shown beside ATE, RPE and KITTI drift: thesis for those of the theses"
    )

    @field_validator("metrics", mode="before")
    @classmethod
    def _listed(cls, words: Any) -> Any:
        """One word is a list of one."""
        return (words,) if isinstance(words, str) else words
