"""Verdicts on studies whose laws, stages and small effects are known: each turns when the data do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from study_rows import by_seed, outcome, rows_of, verdict

SKIPS = range(1, 21)
GRID = (0.1, 0.3, 0.5, 0.8, 1.0, 1.5, 2.0, 3.0, 5.0)


def test_little_influence() -> None:
    flat = rows_of(SKIPS, error=lambda v: 0.5 + 0.005 * v)
    assert outcome(flat, "matters_little", 1.5, of="translation") == "confirmed"
    assert outcome(rows_of(SKIPS, error=lambda v: 0.1 * v), "matters_little", 1.5, of="translation") == "refuted"
    lost = verdict(rows_of(SKIPS, diverges=lambda v: v == 5), "matters_little", 1.5, of="translation")
    assert lost.outcome == "refuted"
    assert "diverges at 5" in lost.numbers
    assert outcome(rows_of([1, 2]), "matters_little", 1.5) == "undecided"


def test_laws() -> None:
    hyperbola = rows_of(SKIPS, total=lambda v: 46.82 / v, noise=0.02)
    line = rows_of(SKIPS, total=lambda v: 5 + 2 * v, noise=0.02)
    assert outcome(hyperbola, "inverse") == "confirmed"
    assert outcome(hyperbola, "linear") == "refuted"
    assert outcome(line, "inverse") == "refuted"
    assert outcome(line, "linear") == "confirmed"
    assert outcome(hyperbola[:15], "inverse") == "undecided"
    assert "R2 1.000" in verdict(rows_of(SKIPS, total=lambda v: 46.82 / v), "inverse", 0.99).numbers


def test_product_law() -> None:
    rows, sums = [], []
    for share in (0.1, 0.5, 1.0):
        more: dict[str, Any] = {"at": {"preprocess.random_share": share}, "noise": 0.02}
        rows += rows_of([1, 2, 4], total=lambda v, ds=share: 152 * ds / v, **more)
        sums += rows_of([1, 2, 4], total=lambda v, ds=share: 5 + ds + v, **more)
    assert outcome(rows, "product") == "confirmed"
    assert outcome(sums, "product") == "refuted"
    assert outcome(rows[:9], "product") == "undecided"


def test_stage_that_a_parameter_acts_on() -> None:
    on_scan = rows_of(GRID, "loam.grid_step", stages=lambda v: {"scan": 50 / v, "map": 20.0, "keyframe": 90 / v})
    on_both = rows_of(GRID, "loam.grid_step", stages=lambda v: {"scan": 50 / v, "map": 50 / v})
    assert outcome(on_scan, "acts_only_on", stages=["scan"]) == "confirmed"
    assert outcome(on_scan, "acts_only_on", stages=["scan", "recover"]) == "confirmed"
    assert outcome(on_scan, "acts_only_on", stages=["map"]) == "refuted"
    assert outcome(on_both, "acts_only_on", stages=["scan"]) == "refuted"
    assert outcome(rows_of(GRID, "loam.grid_step"), "acts_only_on", stages=["register"]) == "undecided"
    hardly = rows_of(GRID, "loam.grid_step", stages=lambda v: {"scan": 50 + v, "map": 20.0})
    assert outcome(hardly, "acts_only_on", stages=["scan"]) == "undecided"
    assert "no stage maps was timed" in verdict(on_scan, "acts_only_on", stages=["maps"]).numbers


def test_little_influence_is_not_stated_of_values_without_result_or_of_a_key_without_effect() -> None:
    rows = rows_of(SKIPS, error=lambda v: 0.5 + 0.005 * v)
    gone = [replace(r, status="crashed") if r.parameters["input.skip_frames"] > 15 else r for r in rows]
    found = verdict(gone, "matters_little", 1.5, of="translation")
    assert (found.outcome, "nothing is known at 16, 17" in found.numbers) == ("undecided", True)
    same = verdict(rows_of(SKIPS), "matters_little", 1.5, of="translation")
    assert (same.outcome, "the parameter was not in use" in same.numbers) == ("undecided", True)
    seeds = by_seed(rows_of(SKIPS), lambda v, s: {"thesis_rmse": 0.5 + s})
    assert outcome(seeds, "matters_little", 1.5, of="translation") == "undecided", "seeds differ, values do not"
    first = by_seed(rows_of(SKIPS), lambda v, s: {"thesis_rmse": 0.5 + 0.001 * v * (s > 0)})
    assert outcome(first, "matters_little", 1.5, of="translation") == "confirmed", "one seed alone shows nothing"
    one = [replace(r, status="diverged") if r.parameters["input.skip_frames"] == 5 else r for r in rows if not r.seed]
    assert outcome(one, "matters_little", 1.5, of="translation") == "undecided", "one lost run may be bad luck"


def test_one_value_whose_seeds_scatter_leaves_little_influence_open() -> None:
    """At 20 they err by 0.3 to 1 m, and by half a metre elsewhere: medians are near, and nobody knows."""
    wild = by_seed(rows_of(SKIPS), lambda v, s: {"thesis_rmse": 0.5 + 0.001 * v + (v == 20) * (-0.2, 0.0, 0.5)[s % 3]})
    assert outcome(wild, "matters_little", 1.5, of="translation") == "undecided"
    calm = by_seed(rows_of(SKIPS), lambda v, s: {"thesis_rmse": 0.5 + 0.001 * v})
    assert outcome(calm, "matters_little", 1.5, of="translation") == "confirmed"


def test_laws_that_cannot_be_told_apart_are_undecided() -> None:
    narrow = rows_of(range(20, 27), total=lambda v: 100 / v)
    assert outcome(narrow, "inverse") == "confirmed"
    found = verdict(narrow, "linear")
    assert found.outcome == "undecided"
    assert "but a / x fits as well" in found.numbers


def test_a_product_needs_both_parameters_to_vary() -> None:
    rows = rows_of(SKIPS, total=lambda v: 50 / v, at={"preprocess.random_share": 0.5})
    found = verdict(rows, "product")
    assert found.outcome == "undecided"
    assert "but a / x fits as well" in found.numbers


def test_a_misfit_of_unknown_scatter_refutes_no_law() -> None:
    curved = rows_of(SKIPS, total=lambda v: 5 + 0.05 * (v - 10) ** 2, noise=0.02)
    assert outcome(curved, "linear") == "refuted"
    assert outcome([r for r in curved if r.seed == 0], "linear") == "undecided"


def test_a_stage_that_some_values_do_without_counts_as_no_time() -> None:
    rows = rows_of(
        GRID, "loam.grid_step", stages=lambda v: {"scan": 20 + v, "map": 20.0} | ({"recover": 40.0} if v < 0.5 else {})
    )
    found = verdict(rows, "acts_only_on", stages=["scan"])
    assert found.outcome == "refuted"
    assert "recover by 40" in found.numbers


def test_stages_of_two_values_are_too_few() -> None:
    rows = rows_of([1, 2], "loam.grid_step", stages=lambda v: {"scan": 50 / v, "map": 20.0})
    assert outcome(rows, "acts_only_on", stages=["scan"]) == "undecided"
