"""A sensitivity study evaluated: means over seeds, divergence, optimum, laws and verdicts (Girolimetto, section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lslam.evaluation.curves import curves_of, divergence, lost_above, median_over_seeds, optimum, over_seeds
from lslam.evaluation.laws import FEWEST, fit_law, law_over
from lslam.evaluation.verdicts import judge
from lslam.types.study import Curve, CurveResult, Floats, Interval, Law, LawKind, StudyResult, StudyRow

if TYPE_CHECKING:
    from lslam.config.finding import ExpectedFinding

SKIP = "input.skip_frames"
EFFICIENCIES = ("efficiency", "total_efficiency")


def evaluate_study(rows: Sequence[StudyRow], findings: Sequence[ExpectedFinding] = ()) -> list[StudyResult]:
    """One result per study, sequence and studied parameter, in the order they appear in `rows`; runs beside belong to all."""
    groups: dict[tuple[str, str, str], list[StudyRow]] = {}
    for row in rows:
        if not row.is_beside:
            groups.setdefault((row.study, row.sequence, next(iter(row.parameters), "")), []).append(row)
    out = []
    for (study, sequence, parameter), group in groups.items():
        beside = [row for row in rows if row.is_beside and (row.study, row.sequence) == (study, sequence)]
        mine = [finding for finding in findings if finding.parameter in ("", parameter)]
        out.append(_evaluate(group, beside, mine))
    return out


def _evaluate(rows: Sequence[StudyRow], beside: Sequence[StudyRow], findings: Sequence[ExpectedFinding]) -> StudyResult:
    limit = lost_above(rows)
    results = tuple(_result(curve) for curve in curves_of(rows, limit))
    products = _products(results)
    return StudyResult(
        study=rows[0].study,
        sequence=rows[0].sequence,
        parameters=tuple(dict.fromkeys(name for row in rows for name in row.parameters)),
        results=results,
        products=products,
        verdicts=tuple(judge(finding, results, products) for finding in findings),
        beside=tuple(row for row in beside if row.is_usable),
        failed=tuple(row for row in (*rows, *beside) if not row.is_usable),
        lost_above=limit,
        metric=rows[0].metric,
    )


def _result(curve: Curve) -> CurveResult:
    tables = {
        name: table if name in EFFICIENCIES else np.where(curve.lost, np.nan, table)
        for name, table in curve.quantities.items()
    }
    means = {name: over_seeds(table) for name, table in tables.items()}
    medians = {name: median_over_seeds(table) for name, table in tables.items()}
    law, no_law = _law_of(curve, means["total_time"])
    return CurveResult(
        curve=curve,
        means=means,
        medians=medians,
        stage_means={name: over_seeds(np.where(curve.lost, np.nan, table)) for name, table in curve.stages.items()},
        divergence=divergence(curve),
        optimum=optimum(curve.values, medians["efficiency"]),
        law=law,
        no_law=no_law,
    )


def _law_of(curve: Curve, times: Interval) -> tuple[Law | None, str]:
    """The law of total time: inverse over skipped scans, a line over any other number."""
    if curve.words:
        return None, f"{curve.parameter} is not a number"
    kind: LawKind = "inverse" if curve.parameter == SKIP else "linear"
    law = law_over(kind, curve, times)
    return law, "" if law else f"no law from {int((times.n > 0).sum())} values, {FEWEST} are needed"


def _products(results: Sequence[CurveResult]) -> dict[str, Law]:
    """Laws a y / x by series, of studies of skipped scans (x) and another number (y)."""
    groups: dict[str, list[tuple[Floats, ...]]] = {}
    names: tuple[str, ...] = ()
    for result in results:
        curve = result.curve
        if len(curve.at) != 1 or curve.words or SKIP not in (curve.parameter, curve.at[0][0]):
            continue
        key, other = curve.at[0]
        if isinstance(other, (bool, str)):
            continue
        over, second = result.means["total_time"], np.full(len(curve.values), float(other))
        is_skip = curve.parameter == SKIP
        names = (SKIP, key) if is_skip else (SKIP, curve.parameter)
        points = np.stack([curve.values, second] if is_skip else [second, curve.values], 1)
        groups.setdefault(curve.series, []).append((points, over.mean, over.n.astype(np.float64), over.std))
    laws = {}
    for series, parts in groups.items():
        points, times, runs, scatter = (np.concatenate(column) for column in zip(*parts, strict=True))
        laws[series] = fit_law("product", names, points, times, runs, scatter=scatter)
    return {series: law for series, law in laws.items() if law is not None}
