"""Numbers and sentences about a run from its record, for the summary on stdout and the HTML report."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.evaluation.timing import StageTime, summarise

DIRECTIONS = ("along x", "along y", "along z", "about x", "about y", "about z")


@dataclass(frozen=True)
class Failure:
    """A scan that was bridged or skipped, and the reason."""

    index: int
    status: str
    reason: str


@dataclass(frozen=True)
class Degeneracy:
    """A pose with directions that the scan did not constrain."""

    index: int
    directions: str


@dataclass(frozen=True)
class RunFacts:
    """Numbers of a run.

    status : the manifest's word: `done`, `degraded`, `diverged`, `interrupted`, `failed`; reasons : why, one sentence each
    registered, bridged, skipped : scans that were registered, followed the motion prior, could not be read
    standing : scans of a sensor at rest, registered or not
    stand_ins : number of scans by fallback that posed them in place of the method, in order of first use
    path_length : m; duration : s between the first and the last pose
    stages : in the order they ran; total : the sum of stages per scan
    over_limit : scans whose stages took longer than the real-time limit
    real_time_factor : recorded time per processing time, so 10 means ten times faster than the sensor; 0 when unknown
    """

    status: str
    reasons: tuple[str, ...]
    scans: int
    registered: int
    bridged: int
    skipped: int
    standing: int
    failures: tuple[Failure, ...]
    degenerate: tuple[Degeneracy, ...]
    stand_ins: dict[str, int]
    path_length: float
    duration: float
    stages: dict[str, StageTime]
    total: StageTime | None
    over_limit: int
    real_time_factor: float

    @property
    def posed_by(self) -> str:
        """Fallbacks that posed scans in place of the method, in words; empty when it posed them all."""
        said = ", ".join(f"{who} {count}" for who, count in self.stand_ins.items())
        return f"{said} of {self.scans} scans" if said else ""

    @property
    def is_flawless(self) -> bool:
        """Whether nothing went wrong."""
        return self.status in ("done", "ok") and not (self.reasons or self.failures or self.degenerate)


def run_facts(record: RunRecord) -> RunFacts:
    """Facts of a record; every number is finite, whatever the poses are."""
    results = record.results
    names, seconds = stage_matrix(results)
    totals = seconds.sum(1)
    limit = record.real_time_limit
    spent = float(totals.sum())
    failures = tuple(Failure(r.index, r.status, r.reason) for r in results if r.status != "ok")
    degenerate = tuple(Degeneracy(r.index, describe(r.degenerate)) for r in results if len(r.degenerate))
    status, reasons = _status(record, bool(failures))
    return RunFacts(
        status=status,
        reasons=reasons,
        scans=len(results),
        registered=sum(r.status == "ok" and not r.repeats_pose for r in results),
        bridged=sum(r.status == "bridged" for r in results),
        skipped=sum(r.status == "skipped" for r in results),
        standing=sum(r.is_stationary for r in results),
        failures=failures,
        degenerate=degenerate,
        stand_ins=dict(Counter(who for r in results if (who := r.poser(record.method)) != record.method)),
        path_length=_path_length(record),
        duration=float(record.trajectory.stamps_ns[-1] - record.trajectory.stamps_ns[0]) * 1e-9
        if len(record.trajectory)
        else 0.0,
        stages={name: summarise(seconds[:, i], spent) for i, name in enumerate(names)},
        total=summarise(totals, spent) if names else None,
        over_limit=int((totals > limit).sum()) if limit > 0 else 0,
        real_time_factor=limit * len(results) / spent if spent > 0 and limit > 0 else 0.0,
    )


def stage_matrix(results: list[ScanResult]) -> tuple[list[str], Floats]:
    """Names of all stages in order of appearance, and seconds (N, S); 0 where a scan has no such stage."""
    names: dict[str, int] = {}
    for result in results:
        for name in result.stages:
            names.setdefault(name, len(names))
    seconds = np.zeros((len(results), len(names)))
    for row, result in enumerate(results):
        for name, value in result.stages.items():
            seconds[row, names[name]] = value if np.isfinite(value) else 0.0
    return list(names), seconds


def describe(degenerate: NDArray[Any]) -> str:
    """Text of the main component of each unit twist (K, 6), world axes.

    >>> describe(np.array([[0.1, 0.99, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1.0]]))
    'along y, about z'
    """
    return ", ".join(DIRECTIONS[int(np.argmax(np.abs(twist)))] for twist in np.asarray(degenerate))


def _status(record: RunRecord, failed: bool) -> tuple[str, tuple[str, ...]]:
    """Status in the manifest, else derived from the record."""
    reasons = [str(problem) for problem in record.problems]
    more = record.manifest.get("problems")
    if isinstance(more, (list, tuple)):
        reasons += [str(problem) for problem in more]
    if record.manifest.get("why"):
        reasons.append(str(record.manifest["why"]))
    word = record.manifest.get("status")
    if not isinstance(word, str) or not word:
        word = "degraded" if failed or reasons else "done"
    return word, tuple(dict.fromkeys(reasons))


def _path_length(record: RunRecord) -> float:
    steps = np.linalg.norm(np.diff(record.trajectory.positions, axis=0), axis=1)
    return float(steps[np.isfinite(steps)].sum())
