"""Sequences whose scans are read or traced once, for several runs on the same scans."""

from __future__ import annotations

from typing import Any

from lslam.core.config import load_config
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.pipeline.run import run
from lslam.pipeline.watch import RunOutcome
from lslam.simulation.scenarios import SimulatedDrive, simulate


class Traced:
    """A simulated drive, or a recording, whose scans are kept."""

    def __init__(self, drive: SimulatedDrive | Sequence) -> None:
        self._drive = drive
        self._scans = [drive.scan(i) for i in range(len(drive))]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drive, name)

    def __len__(self) -> int:
        return len(self._scans)

    def scan(self, index: int) -> Scan:
        return self._scans[index]


def traced(scenario: str, seed: int, **given: Any) -> Traced:
    """What `simulate` makes of the same words."""
    return Traced(simulate(scenario, seed=seed, **given))


def run_on(drive: Traced, *settings: str) -> RunOutcome:
    """A run in memory, without what a shell's environment may hold.

    Raises LslamError as `lslam run` does.
    """
    return run(drive, load_config(settings=settings, environ={}))  # type: ignore[arg-type]
