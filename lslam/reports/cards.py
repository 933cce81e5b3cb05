"""Tiles of a run's page: six numbers at most that somebody acts on. Everything else stands in the sections below."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lslam.core.geometry import se3
from lslam.core.printable import count_of, metres
from lslam.core.types.run_record import RunRecord
from lslam.evaluation.evaluate import shown_metrics
from lslam.reports.facts import RunFacts

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation


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
    """The first number against ground truth; without, what the run was checked by; empty where nothing checks it."""
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
    """(K,) m between where the final poses have the far end of each closed loop and where its registration put it."""
    left = []
    for loop in record.loops:
        if loop.is_accepted and loop.constraint is not None:
            a, b = record.trajectory.poses[record.keyframe_scans[[loop.constraint.a, loop.constraint.b]]]
            left.append(float(np.linalg.norm((se3.relative(a, b) - loop.constraint.T_a_b)[:3, 3])))
    return np.array(left)


def map_cards(record: RunRecord) -> list[Card]:
    """How sharp the run's own map is; of a drive in an old map, what differs there."""
    found = record.manifest.get("localization", {}).get("differences")
    if found is not None and "map" not in record.manifest:
        return [Card(f"{found['gone']} + {found['not_in_the_map']}", "", "things gone + not in the map")]
    crispness = record.crispness
    if crispness is None or crispness.plane_variance is None:
        return []
    return [Card(f"{100 * crispness.plane_variance**0.5:.1f}", "cm", "thickness of planes in the map")]
