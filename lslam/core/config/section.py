"""What every configuration section shares."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A frozen section: unknown keys are errors, values are checked, and nothing changes after the start of a run."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)

    def changed(self, since: Section | None = None) -> list[str]:
        """Keys whose values differ from those of `since`, None: from the defaults, in the order of the section."""
        fields = type(self).model_fields
        before = {key: field.get_default() if since is None else getattr(since, key) for key, field in fields.items()}
        return [key for key in fields if getattr(self, key) != before[key]]

    def require_order(self, low: str, high: str) -> None:
        """Raise ValueError unless the value of key `low` lies below that of `high`."""
        a, b = getattr(self, low), getattr(self, high)
        if not a < b:
            raise ValueError(f"{low} = {a} must be less than {high} = {b}")
