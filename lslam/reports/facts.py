"""Numbers and sentences about a run from its record, for the summary on stdout and the HTML report.

The tiles of its page are six numbers at most that somebody acts on. Everything else stands in the sections below.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import se3
from lslam.core.printable import count_of, metres
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.evaluation.evaluate import shown_metrics
from lslam.evaluation.timing import StageTime, summarise

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation

DIRECTIONS = ("along x", "along y", "along z", "about x", "about y", "about z")


@dataclass(frozen=True)
class RunFacts:
    """Numbers of a run.

    status : the manifest's word: `done`, `degraded`, `diverged`, `interrupted`, `failed`; reasons : why, one sentence each
    registered, bridged, skipped : scans that were registered, that failed, that could not be read
    standing : scans of a sensor at rest, registered or not
    failures : scans that were bridged or skipped; degenerate : index of each pose with directions that its scan did not constrain
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
    failures: tuple[ScanResult, ...]
    degenerate: tuple[tuple[int, str], ...]
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
    failures = tuple(r for r in results if r.status != "ok")
    degenerate = tuple((r.index, describe(r.degenerate)) for r in results if len(r.degenerate))
    status, reasons = _status(record, bool(failures))
    steps = np.linalg.norm(np.diff(record.trajectory.positions, axis=0), axis=1)
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
        path_length=float(steps[np.isfinite(steps)].sum()),
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


def _status(record: RunRecord, has_failures: bool) -> tuple[str, tuple[str, ...]]:
    """Status in the manifest, else derived from the record."""
    reasons = [str(problem) for problem in record.problems]
    more = record.manifest.get("problems")
    if isinstance(more, (list, tuple)):
        reasons += [str(problem) for problem in more]
    if record.manifest.get("why"):
        reasons.append(str(record.manifest["why"]))
    word = record.manifest.get("status")
    if not isinstance(word, str) or not word:
        word = "degraded" if has_failures or reasons else "done"
    return word, tuple(dict.fromkeys(reasons))


@dataclass(frozen=True)
class Card:
    """A headline number."""

    value: str
    unit: str
    name: str


def run_cards(record: RunRecord, facts: RunFacts, evaluation: Evaluation | None) -> list[Card]:
    """Status of registration, path, error, doubtful scans, speed: those that are known."""
    held = sum(fix.is_binding for fix in record.map_fixes)
    registered = (
        Card(f"{held}/{len(record.map_fixes)}", "", "scans held by the map")
        if record.map_fixes
        else Card(f"{facts.registered}/{facts.scans}", "", "scans registered")
    )
    doubtful = sum(r.status != "ok" or r.may_be_elsewhere or len(r.degenerate) > 0 for r in record.results)
    cards = [registered, Card(f"{facts.path_length:.1f}", "m", f"path in {facts.duration:.1f} s")]
    cards += _error_card(record, evaluation)
    share = 100 * doubtful / max(facts.scans, 1)
    cards.append(Card(f"{share:.1f}", "%", "scans bridged, skipped or degenerate"))
    if facts.real_time_factor:
        cards.append(Card(f"{facts.real_time_factor:.1f}", "×", "real time"))
    return cards


def _error_card(record: RunRecord, evaluation: Evaluation | None) -> list[Card]:
    """Card of the first number against ground truth, else against control points, a map or loops; empty without any."""
    if evaluation is not None:
        scores = [Card(*card) for metric in shown_metrics(evaluation) for card in metric.cards(evaluation)]
        return scores[:1]
    control = record.manifest.get("graph", {}).get("control_points")
    if control is not None:
        name = f"rms at {count_of(control['count'], 'control point')}, horizontally"
        return [Card(metres(control["rms_horizontal_m"]), "m", name)]
    moves = [fix.innovation[0] for fix in record.map_fixes if fix.is_binding]
    if moves:
        return [Card(metres(float(np.median(moves))), "m", "correction by the map a scan, median")]
    residuals = loop_residuals(record)
    if len(residuals):
        return [Card(metres(float(np.median(residuals))), "m", f"left at {count_of(len(residuals), 'loop')}, median")]
    return []


def loop_residuals(record: RunRecord) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """(K,) m, distance at each closed loop between the newer keyframe's final position and that by the loop's registration."""
    left = []
    for loop in record.loops:
        if loop.is_accepted and loop.constraint is not None:
            a, b = record.trajectory.poses[record.keyframe_scans[[loop.constraint.a, loop.constraint.b]]]
            left.append(float(np.linalg.norm((se3.relative(a, b) - loop.constraint.T_a_b)[:3, 3])))
    return np.array(left)


def map_cards(record: RunRecord) -> list[Card]:
    """Card of the planes' thickness, cm, or, localised in a map, of the numbers of differences; none without scores."""
    found = record.manifest.get("localization", {}).get("differences")
    if found is not None and "map" not in record.manifest:
        return [Card(f"{found['gone']} + {found['not_in_the_map']}", "", "things gone + not in the map")]
    crispness = record.crispness
    if crispness is None or crispness.plane_variance is None:
        return []
    return [Card(f"{100 * crispness.plane_variance**0.5:.1f}", "cm", "thickness of planes in the map")]
