"""Diagnosis of recordings: a list of findings, each with advice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Facts = dict[str, Any]


@dataclass(frozen=True)
class Finding:
    """Fault of a recording: `code` for scripts, as `imu-accel-unit`; `what`, with its numbers; `way_out`, a remedy."""

    code: str
    what: str
    way_out: str = ""

    def __str__(self) -> str:
        return f"{self.what}: {self.way_out}" if self.way_out else self.what


class Findings(list[Finding]):
    """Faults of a recording, in the order in which they are found."""

    def add(self, code: str, what: str, way_out: str = "") -> None:
        """Append a finding."""
        self.append(Finding(code, what, way_out))
