"""What every configuration section shares."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A frozen section: unknown keys are errors, values are checked, and nothing changes after the start of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)
