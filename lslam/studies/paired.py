"""Statistics over seeds and sequences: means with their mean_and_std, and paired comparisons with a reference."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from lslam.core.types.comparison import PairedComparison, RunScore, SeedStatistics, SummaryRow

TIE_M = 0.01
FEWEST_PAIRS = 6
ALIGNMENTS = ("se3", "origin", "posyaw", "sim3", "none")
_LEAST_M = 1e-6  # an exact trajectory has no logarithm


def summarise(runs: Sequence[RunScore]) -> list[SummaryRow]:
    """One row per sequence and method in the order they appear; only usable runs count in the values."""
    groups: dict[tuple[str, str], list[RunScore]] = {}
    for run in runs:
        groups.setdefault((run.sequence, run.method), []).append(run)
    rows = []
    for (sequence, method), members in groups.items():
        usable = [run for run in members if run.is_usable]
        keys = dict.fromkeys(key for run in usable for key in run.values)
        values = {key: mean_and_std([run.values[key] for run in usable if key in run.values]) for key in keys}
        note = next((run.note for run in usable if run.note), "")
        alone = all(run.jobs == 1 for run in usable)
        degraded = sum(run.status == "degraded" for run in usable)
        rows.append(
            SummaryRow(sequence, method, len(members), len(members) - len(usable), values, note, alone, degraded)
        )
    return rows


def mean_and_std(values: Sequence[float]) -> SeedStatistics:
    """Mean and sample standard deviation of at least one value.

    >>> mean_and_std([1.0, 3.0])
    SeedStatistics(mean=2.0, std=1.4142135623730951, n=2)
    """
    array = np.asarray(values, np.float64)
    std = float(np.std(array, ddof=1)) if len(array) > 1 else float("nan")
    return SeedStatistics(float(np.mean(array)), std, len(array))


def compare_pairs(
    runs: Sequence[RunScore], methods: Sequence[str], more: Iterable[tuple[str, str]] = ()
) -> list[PairedComparison]:
    """Every method but the first against the first, over runs of the same sequence and seed that have a ground truth.

    more : further pairs (method, reference), such as a method with and without the IMU
    A method that does not depend on the seed of a recording has one run there, which meets every seed of the other.
    """
    if not methods:
        return []
    sides = dict.fromkeys([*((method, methods[0]) for method in methods[1:]), *more])
    table = {(run.sequence, run.method, run.seed): run for run in runs}
    seeds = {(run.sequence, run.seed): None for run in runs}
    out = []
    for method, reference in sides:
        pairs = []
        for sequence, seed in seeds:
            a, b = (_run_of(table, sequence, name, seed) for name in (reference, method))
            # One run each that meets all seeds: count it once.
            if a is not None and b is not None and seed in (a.seed, b.seed):
                pairs.append((a, b))
        out.append(_judge(method, reference, pairs))
    return out


def _run_of(table: dict[tuple[str, str, int], RunScore], sequence: str, method: str, seed: int) -> RunScore | None:
    """Run of a method with this seed, or its only run on the sequence, which stands for all seeds."""
    own = table.get((sequence, method, seed))
    if own is not None:
        return own
    others = [run for (s, m, _), run in table.items() if (s, m) == (sequence, method)]
    return others[0] if len(others) == 1 else None


def _judge(method: str, reference: str, pairs: list[tuple[RunScore, RunScore]]) -> PairedComparison:
    """Compare a method with the reference: mean ratio of errors, wins, ties and losses, and p of the signed-rank test."""
    wins = ties = losses = 0
    logs = []
    for of_reference, of_method in pairs:
        if not (of_reference.is_usable and of_method.is_usable):
            wins += of_method.is_usable
            losses += of_reference.is_usable
            continue
        errors = _errors(of_reference, of_method)
        if errors is None:
            continue
        a, b = errors
        logs.append(np.log(max(b, _LEAST_M) / max(a, _LEAST_M)))
        ties += abs(a - b) <= TIE_M
        wins += b < a - TIE_M
        losses += b > a + TIE_M
    ratio = float(np.exp(np.mean(logs))) if logs else float("nan")
    p, note = _signed_rank(np.array(logs))
    return PairedComparison(method, reference, len(logs), ratio, wins, ties, losses, p, note)


def _errors(a: RunScore, b: RunScore) -> tuple[float, float] | None:
    """ATE rmse of both, m, under the first alignment that both have; None without ground truth."""
    for name in ALIGNMENTS:
        key = f"ate.{name}"
        if key in a.values and key in b.values:
            return a.values[key], b.values[key]
    return None


def _signed_rank(logs: np.ndarray) -> tuple[float, str]:
    """Two-sided p-value that the log ratios are symmetric about zero; nan, with the reason, for too few pairs."""
    if len(logs) < FEWEST_PAIRS:
        return float("nan"), "n too small"
    if not np.any(logs):
        return 1.0, "all equal"
    from scipy.stats import wilcoxon

    return float(wilcoxon(logs).pvalue), ""
