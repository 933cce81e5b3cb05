"""Diagnosis of recordings: a list of findings, each with advice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

Facts = dict[str, Any]


@dataclass(frozen=True)
class Finding:
    """One fault of a recording.

    code : for scripts, for example `imu-accel-unit`; what : the fault with its numbers; way_out : what to do about it
    """

    code: str
    what: str
    way_out: str = ""

    def __str__(self) -> str:
        return f"{self.what}: {self.way_out}" if self.way_out else self.what


def plural(count: int, noun: str, several: str = "") -> str:
    """Count with its noun: `1 gap`, `2 gaps`."""
    return f"{count} {noun if count == 1 else several or noun + 's'}"
