"""Means, spreads and paired statistics against numbers worked out by other means."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from lslam.core.types.comparison import RunScore
from lslam.studies.paired import compare_pairs, summarise


def run(sequence: str, method: str, seed: int, ate: float | None, status: str = "done", **more: float) -> RunScore:
    values = {} if ate is None else {"ate.se3": ate}
    return RunScore(sequence, method, seed, Path(), status, values=values | more)


def both(errors: list[tuple[float, float]]) -> list[RunScore]:
    """Pairs (a, b) as runs of methods `a` and `b`, seed by seed."""
    return [run("s", m, seed, e[k]) for seed, e in enumerate(errors) for k, m in enumerate("ab")]


def test_mean_and_sample_deviation_over_the_runs_that_count() -> None:
    rows = summarise([run("s", "a", 0, 1.0), run("s", "a", 1, 4.0), run("s", "a", 2, 99.0, "diverged")])
    (row,) = rows
    assert (row.runs, row.failed) == (3, 1)
    assert row.values["ate.se3"].mean == 2.5
    assert row.values["ate.se3"].std == pytest.approx(3 / math.sqrt(2))
    assert row.values["ate.se3"].n == 2
    assert math.isnan(summarise([run("s", "a", 0, 1.0)])[0].values["ate.se3"].std)


def test_ratio_is_the_geometric_mean_and_a_centimetre_is_a_tie() -> None:
    (pair,) = compare_pairs(both([(1.0, 2.0), (0.5, 0.25), (0.1, 0.109), (0.109, 0.1), (0.1, 0.111)]), ("a", "b"))
    assert pair.ratio == pytest.approx((2 * 0.5 * 1.11) ** 0.2)
    assert (pair.n, pair.wins, pair.ties, pair.losses) == (5, 1, 2, 2)
    assert math.isnan(pair.p)
    assert pair.note == "n too small"


def exact_signed_rank(logs: np.ndarray) -> float:
    """Two-sided p by going through every sign: the test's definition for values without ties."""
    ranks = np.abs(logs).argsort().argsort() + 1.0
    seen = ranks[logs > 0].sum()
    middle = ranks.sum() / 2
    sums = [
        sum(r for r, s in zip(ranks, signs, strict=True) if s) for signs in itertools.product((0, 1), repeat=len(logs))
    ]
    return float(np.mean([abs(s - middle) >= abs(seen - middle) - 1e-9 for s in sums]))


@pytest.mark.parametrize("seed", [0, 1])
def test_wilcoxon_is_the_enumeration_of_all_signs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    errors = [(a, a * b) for a, b in zip(rng.uniform(0.1, 9, 7), np.exp(rng.normal(0.4, 0.5, 7)), strict=True)]
    (pair,) = compare_pairs(both(errors), ("a", "b"))
    assert pair.p == pytest.approx(exact_signed_rank(np.log([b / a for a, b in errors])))
    assert pair.note == ""


def test_equal_runs_differ_in_nothing() -> None:
    (pair,) = compare_pairs(both([(0.3, 0.3)] * 6), ("a", "b"))
    assert (pair.ratio, pair.p, pair.ties) == (1.0, 1.0, 6)


def test_a_failure_is_lost_and_leaves_no_ratio() -> None:
    runs = [
        run("s", "a", 0, 1.0),
        run("s", "b", 0, None, "crashed"),
        run("s", "a", 1, None, "failed"),
        run("s", "b", 1, 1.0),
    ]
    (pair,) = compare_pairs(runs, ("a", "b"))
    assert (pair.n, pair.wins, pair.losses) == (0, 1, 1)
    assert math.isnan(pair.ratio)


def test_a_diverged_run_is_no_win_however_small_its_error() -> None:
    (pair,) = compare_pairs([run("s", "a", 0, 1.0), run("s", "b", 0, 0.001, "diverged")], ("a", "b"))
    assert (pair.n, pair.wins, pair.losses) == (0, 0, 1)


def test_a_method_that_does_not_draw_meets_every_seed_of_one_that_does() -> None:
    runs = [run("s", "a", 0, 1.0), *(run("s", "b", seed, 2.0 + seed) for seed in range(3))]
    assert compare_pairs(runs, ("a", "b"))[0].n == 3
    assert compare_pairs(runs, ("b", "a"))[0].n == 3


def test_a_method_with_the_imu_is_also_held_against_itself_without() -> None:
    runs = [run("s", m, 0, e) for m, e in (("a", 1.0), ("b", 8.0), ("b+imu", 2.0))]
    against = compare_pairs(runs, ("a", "b", "b+imu"), [("b+imu", "b")])
    assert [(p.method, p.reference, p.ratio) for p in against] == [
        ("b", "a", pytest.approx(8.0)), ("b+imu", "a", pytest.approx(2.0)), ("b+imu", "b", pytest.approx(0.25)),
    ]  # fmt: skip
    # Where the reference is the method itself, once is enough.
    assert len(compare_pairs(runs, ("b", "b+imu"), [("b+imu", "b")])) == 1


def test_pairs_are_of_one_alignment() -> None:
    straight = RunScore("s", "b", 0, Path(), "done", values={"ate.origin": 3.0})
    of_a = RunScore("s", "a", 0, Path(), "done", values={"ate.se3": 100.0, "ate.origin": 1.0})
    assert compare_pairs([of_a, straight], ("a", "b"))[0].ratio == pytest.approx(3.0)
