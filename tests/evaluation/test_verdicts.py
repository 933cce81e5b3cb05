"""Verdicts on studies of known truth, kind by kind: each follows the data, and is undecided where they do not decide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import nan
from typing import Any, get_args

import numpy as np
import pytest
from study_rows import Formula, by_seed, outcome, rows_of, verdict

from lslam.core.config.study import Kind
from lslam.core.types.study import FindingVerdict, StudyRow

SKIPS = range(1, 21)
DISTANCES = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
GRID = (0.1, 0.3, 0.5, 0.8, 1.0, 1.5, 2.0, 3.0, 5.0)
LAWS = ("linear", "inverse", "product")


@dataclass(frozen=True)
class Case:
    """A statement of one kind: studies in which it is right, wrong, and hidden by the scatter of the seeds."""

    values: tuple[float, ...]
    right: list[StudyRow]
    wrong: list[StudyRow]
    hidden: list[StudyRow]
    more: dict[str, Any] = field(default_factory=dict)

    def judged(self, kind: str, rows: list[StudyRow]) -> FindingVerdict:
        return verdict(rows, kind, *self.values, **self.more)


def lost_beyond(last_good: dict[int, int]) -> list[StudyRow]:
    """Each seed is lost beyond its own value."""
    return by_seed(
        rows_of(SKIPS, seeds=list(last_good)), lambda v, s: {"status": "diverged"} if v > last_good[s] else {}
    )


def distances(below: dict[int, float], edge: float = 0.2) -> list[StudyRow]:
    """An error of 0.5 m from `edge` on, and of each seed's own below."""
    rows = rows_of(DISTANCES, "imu.inlier_distance", noise=0.02)
    return by_seed(rows, lambda v, s: {"thesis_rmse": below[s]} if v < edge else {})


def valley(at: float, factor: Callable[[float, int], float] = lambda v, s: 1.0) -> list[StudyRow]:
    return by_seed(
        rows_of(GRID, "loam.grid_step"), lambda v, s: {"thesis_rmse": (0.2 + 0.1 * (v - at) ** 2) * factor(v, s)}
    )


def stages(scan: dict[int, float], rest: dict[int, float]) -> list[StudyRow]:
    """What each seed's stages take of ms over the value."""
    return by_seed(
        rows_of(GRID, "loam.grid_step", seeds=list(scan)),
        lambda v, s: {"stages_ms": {"scan": 20 + scan[s] / v, "map": 20 + rest[s] / v}},
    )


def times(
    time: Callable[[float, float], float],
    noise: float = 0.02,
    skips: Sequence[int] = (1, 2, 4, 7),
    shares: Sequence[float] = (0.1, 0.4, 0.7, 1.0),
) -> list[StudyRow]:
    """Total times over every n-th scan and a share."""
    made = [
        rows_of(skips, total=lambda v, s=share: time(v, s), noise=noise, at={"preprocess.random_share": share})  # type: ignore[misc]
        for share in shares
    ]
    return [row for rows in made for row in rows]


def scattered(v: float, seed: int) -> float:
    return float(np.exp(np.random.default_rng([seed, round(10 * v)]).standard_normal()))


def both(with_imu: Formula, without: Formula) -> list[StudyRow]:
    """Errors with the IMU and without."""
    return rows_of(SKIPS, error=without, noise=0.02) + rows_of(SKIPS, error=with_imu, noise=0.02, uses_imu=True)


def of_seeds(change: Callable[[float, int], float]) -> list[StudyRow]:
    """Errors of 0.3 + 0.05 v without the IMU, and with it a change of each seed's own."""
    with_imu = by_seed(rows_of(SKIPS, uses_imu=True), lambda v, s: {"thesis_rmse": 0.3 + 0.05 * v + change(v, s - 1)})
    return rows_of(SKIPS, error=lambda v: 0.3 + 0.05 * v) + with_imu


BELOW = {0: 0.9, 1: 0.95, 2: 1.0}
OF_ERROR = {"of": "translation"}
RISING = rows_of(SKIPS, error=lambda v: 0.1 + 0.05 * v, noise=0.02)
FALLING = rows_of(SKIPS, error=lambda v: 0.1 + 1 / v, noise=0.02)
# One seed falls, one stays, one rises.
PARTED = by_seed(rows_of(SKIPS), lambda v, s: {"thesis_rmse": 0.5 * (1 + 0.1 * v) ** (s - 1)})
GENTLE, STEEP = (lambda v: 0.3 + 0.02 * v), (lambda v: 0.3 + 0.05 * v)
ONE_BELOW = {0: 2.5, 1: 0.5, 2: 0.3}
CASES = {
    "diverges_beyond": Case(
        (7,), lost_beyond({0: 7, 1: 7, 2: 8}), lost_beyond({0: 12, 1: 13, 2: 12}), lost_beyond({0: 3, 1: 7, 2: 14})
    ),
    "holds_up_to": Case((20,), rows_of(SKIPS), lost_beyond({0: 9, 1: 11, 2: 20}), lost_beyond({0: 12, 1: 20})),
    "best_between": Case((1, 2), valley(1.5), valley(4), valley(1.5, scattered), {"of": "translation"}),
    "largest_between": Case(
        (1, 2),
        rows_of(GRID, "loam.grid_step", total=lambda v: 10 / (1 + (v - 1.5) ** 2), noise=0.02),
        rows_of(GRID, "loam.grid_step", total=lambda v: 10 * v, noise=0.02),
        rows_of(GRID, "loam.grid_step", total=lambda v: 10 / (1 + 0.1 * (v - 1.5) ** 2), noise=0.3),
        {"of": "total_time"},
    ),
    "elbow_at": Case((0.2,), distances(BELOW), distances(BELOW, 0.7), distances({0: 2.5, 1: 0.8, 2: 0.3})),
    "good_from": Case((0.2,), distances(BELOW), distances(BELOW, 0.7), distances(ONE_BELOW)),
    "matters_little": Case(
        (1.5,),
        rows_of(SKIPS, error=lambda v: 0.5 + 0.005 * v, noise=0.02),
        rows_of(SKIPS, error=lambda v: 0.1 * v, noise=0.02),
        by_seed(rows_of(SKIPS), lambda v, s: {"thesis_rmse": 0.5 * (1 + 0.1 * v) ** (s - 1)}),
        {"of": "translation"},
    ),
    "linear": Case(
        (),
        rows_of(SKIPS, total=lambda v: 5 + 2 * v, noise=0.02),
        rows_of(SKIPS, total=lambda v: 5 + 0.05 * (v - 10) ** 2, noise=0.02),
        rows_of(SKIPS, total=lambda v: 5 + 2 * v, noise=0.6),
    ),
    "inverse": Case(
        (),
        rows_of(SKIPS, total=lambda v: 46.82 / v, noise=0.02),
        rows_of(SKIPS, total=lambda v: 5 + 2 * v, noise=0.02),
        rows_of(range(10, 21), total=lambda v: 46.82 / v, noise=0.3),
    ),
    "product": Case(
        (),
        times(lambda x, y: 152 * y / x),
        times(lambda x, y: 5 + x + y),
        times(lambda x, y: 152 * y / x, 0.3, (4, 5, 6, 7), (0.7, 0.8, 0.9, 1.0)),
    ),
    "acts_only_on": Case(
        (),
        stages({0: 5.0, 1: 6.0, 2: 5.0}, {0: 0.1, 1: 0.0, 2: 0.1}),
        stages({0: 5.0, 1: 6.0, 2: 5.0}, {0: 5.0, 1: 4.0, 2: 5.0}),
        stages({0: 50.0, 1: 3.0}, {0: 0.0, 1: 6.0}),
        {"stages": ["scan"]},
    ),
    "rises": Case((), RISING, FALLING, PARTED, OF_ERROR),
    "falls": Case((), FALLING, RISING, PARTED, OF_ERROR),
    "imu_lowers": Case(
        (), both(lambda v: 0.3, lambda v: 0.5), both(lambda v: 0.5, lambda v: 0.3), of_seeds(lambda v, s: 0.1 * s), OF_ERROR
    ),
    "imu_flattens": Case((), both(GENTLE, STEEP), both(STEEP, GENTLE), of_seeds(lambda v, s: 0.02 * v * s), OF_ERROR),
    "imu_steepens": Case((), both(STEEP, GENTLE), both(GENTLE, STEEP), of_seeds(lambda v, s: 0.02 * v * s), OF_ERROR),
}  # fmt: skip


def test_every_kind_has_its_case() -> None:
    assert set(CASES) == set(get_args(Kind))


@pytest.mark.parametrize("kind", CASES)
def test_right_statement_is_confirmed_wrong_one_refuted_and_what_scatter_hides_undecided(kind: str) -> None:
    case = CASES[kind]
    found = {name: case.judged(kind, getattr(case, name)) for name in ("right", "wrong", "hidden")}
    assert {name: v.outcome for name, v in found.items()} == {
        "right": "confirmed", "wrong": "refuted", "hidden": "undecided",
    }, found  # fmt: skip


@pytest.mark.parametrize("kind", CASES)
def test_one_seed_confirms_only_laws_whose_values_scatter_by_themselves(kind: str) -> None:
    case = CASES[kind]
    expected = "confirmed" if kind in LAWS else "undecided"
    assert case.judged(kind, [row for row in case.right if row.seed == 0]).outcome == expected


@pytest.mark.parametrize("kind", CASES)
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_nothing_that_varies_confirms_nothing_but_that_it_holds_and_matters_little(kind: str, noise: float) -> None:
    rows = times(lambda x, y: 10.0, noise) if kind == "product" else rows_of(GRID, "loam.grid_step", noise=noise)
    if kind == "holds_up_to":
        assert CASES[kind].judged(kind, rows).outcome == "undecided"
        return
    expected = {"confirmed"} if kind == "matters_little" and noise else {"refuted", "undecided"}
    assert CASES[kind].judged(kind, rows).outcome in expected


@pytest.mark.parametrize("kind", sorted(set(CASES) - {*LAWS, "acts_only_on", "largest_between"}))
def test_runs_without_an_error_decide_nothing_about_errors(kind: str) -> None:
    """As without ground truth: that the method did not say it is lost is no evidence that it holds."""
    case = CASES[kind]
    none = by_seed(case.right, lambda v, s: {"thesis_rmse": nan})
    found = case.judged(kind, none)
    assert (found.outcome, "no run has an error" in found.numbers) == ("undecided", True)
    half_lost = by_seed(none, lambda v, s: {"status": "diverged"} if v > 7 else {})
    assert case.judged(kind, half_lost).outcome == "undecided"


@pytest.mark.parametrize("kind", CASES)
def test_method_of_which_no_run_ended_leaves_what_is_said_of_all_undecided(kind: str) -> None:
    case = CASES[kind]
    failed = [replace(row, method="loam", status="crashed", stages_ms={}) for row in case.right]
    assert case.judged(kind, case.right + failed).outcome == "undecided"
    assert verdict(case.right + failed, kind, *case.values, method="thesis-icp", **case.more).outcome == "confirmed"


@pytest.mark.parametrize(
    ("kind", "values"), [("diverges_beyond", [1]), ("best_between", [0, 1]), ("good_from", [0]), ("linear", [])]
)
def test_words_are_no_places_on_an_axis(kind: str, values: list[float]) -> None:
    words = rows_of(["a", "b", "c", "d", "e", "f", "g"], "preprocess.downsample", error=lambda v: 0.5, noise=0.02)
    found = verdict(words, kind, *values)
    assert found.outcome == "undecided"
    assert found.numbers == "preprocess.downsample is not a number"
    assert outcome(words, "matters_little", 1.5, of="translation") == "confirmed"


def test_times_of_runs_that_shared_the_machine_decide_nothing() -> None:
    rows = rows_of(SKIPS, total=lambda v: 46.82 / v, noise=0.02, is_timing_comparable=False)
    found = verdict(rows, "inverse")
    assert found.outcome == "undecided"
    assert "shared the machine" in found.numbers
    assert outcome(rows, "matters_little", 1.5, of="translation") == "confirmed"
    flat = rows_of(SKIPS, is_timing_comparable=False)
    assert outcome(flat, "matters_little", 1.5, of="total_time") == "undecided"
    alone = rows_of(SKIPS, total=lambda v: 46.82 / v)
    failed = replace(alone[0], seed=3, status="failed", is_timing_comparable=False)
    assert outcome([*alone, failed], "inverse") == "confirmed"


def test_curves_that_disagree_leave_it_undecided_unless_the_finding_names_one() -> None:
    rows = rows_of(SKIPS, diverges=lambda v: v > 7) + rows_of(SKIPS, uses_imu=True)
    both = verdict(rows, "holds_up_to", 20)
    assert both.outcome == "undecided"
    assert both.sentence == (
        "undecided: So it is; here thesis-icp: it diverges from 8 on; thesis-icp+imu: nothing diverges up to 20"
    )
    assert outcome(rows, "holds_up_to", 20, imu=True) == "confirmed"
    assert outcome(rows, "holds_up_to", 20, imu=False) == "refuted"
    assert outcome(rows, "holds_up_to", 20, method="loam") == "undecided"


def test_finding_at_a_value_of_the_other_parameter() -> None:
    near = rows_of(DISTANCES, "imu.inlier_distance", at={"input.skip_frames": 4}, error=lambda v: 0.5 + 2 * (v < 0.2))
    far = rows_of(DISTANCES, "imu.inlier_distance", at={"input.skip_frames": 20}, error=lambda v: 0.5 + 2 * (v < 1))
    assert outcome(near + far, "elbow_at", 1.0, at={"input.skip_frames": 20}) == "confirmed"
    assert outcome(near + far, "elbow_at", 1.0, at={"input.skip_frames": 4}) == "refuted"


@pytest.mark.parametrize("kind", ["diverges_beyond", "holds_up_to", "good_from"])
def test_study_without_a_usable_run_decides_nothing(kind: str) -> None:
    rows = [replace(row, status="failed", reason="no data", stages_ms={}) for row in rows_of(SKIPS)]
    assert outcome(rows, kind, 5) == "undecided"


def test_what_the_imu_does_asks_for_the_same_runs_without_it() -> None:
    rows = both(lambda v: 0.3, lambda v: 0.5)
    for other in (rows[:30] + rows[60:], [replace(row, seed=row.seed + row.uses_imu) for row in rows], rows[60:]):
        found = verdict(other, "imu_lowers", of="translation")
        assert (found.outcome, found.numbers) == ("undecided", "the same was not run without the IMU")
    shared = [replace(row, is_timing_comparable=False) for row in rows]
    assert "shared the machine" in verdict(shared, "imu_lowers", of="time_per_scan").numbers


def test_a_trend_says_by_how_much() -> None:
    assert verdict(RISING, "rises", of="translation").numbers.startswith("translation of the upper half")
    few = [row for row in RISING if row.parameters["input.skip_frames"] in (1, 20)]
    assert verdict(few, "rises", of="translation").outcome == "undecided"
    lost = by_seed(FALLING, lambda v, s: {"status": "diverged"} if v > 10 else {})
    assert verdict(lost, "rises", of="translation").outcome == "undecided"
