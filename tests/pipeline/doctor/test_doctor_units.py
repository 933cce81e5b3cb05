"""Stamps in a wrong unit are found by rates that no sensor has; sound recordings of any rate give no finding."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lslam.core.types.scan import Span
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.doctor import Finding, Findings
from lslam.pipeline.doctor.examine_positions import examine_units
from lslam.pipeline.doctor.inspect import inspect

SAMPLE = Path(__file__).parents[3] / "sample_data"
TIMES = [(1e3, "1,000 times too slow, as ms"), (1e6, "1,000,000 times too slow, as us"), (1e9, "too slow, as ns"),
         (1e-3, "1,000 times too fast, as us"), (1e-6, "1,000,000 times too fast, as ms")]  # fmt: skip


@pytest.fixture(scope="module")
def healthy() -> Sequence:
    return open_sequence(SAMPLE)


def spoilt(sequence: Sequence, **changes: Any) -> Any:
    other = copy(sequence)
    for name, value in changes.items():
        setattr(other, name, value)
    return other


def truth_of(sequence: Sequence, every_ns: int = 50_000_000, count: int = 180) -> Trajectory:
    stamps = np.arange(count, dtype=np.int64) * every_ns
    return Trajectory(stamps, np.tile(np.eye(4), (count, 1, 1)))


def units(sequence: Sequence, *arguments: object, **options: object) -> Findings:
    findings = Findings()
    examine_units(sequence, findings, *arguments, **options)  # type: ignore[arg-type]
    return findings


def only(findings: list[Finding]) -> Finding:
    [found] = findings
    return found


def test_nothing_is_wrong_with_the_sample(healthy: Sequence) -> None:
    assert units(healthy, healthy.ground_truth, sweep=Span(0.0, 0.1)) == []
    assert units(healthy, truth_of(healthy)) == []


@pytest.mark.parametrize(("factor", "said"), TIMES[:2] + TIMES[3:])
@pytest.mark.parametrize("is_stated", [True, False])
@pytest.mark.parametrize("hz", [5.0, 10.0, 20.0])
def test_scans(healthy: Sequence, factor: float, said: str, is_stated: bool, hz: float) -> None:
    stamps = np.round(np.arange(50) * 1e9 / hz * factor).astype(np.int64)
    other = spoilt(healthy, stamps_ns=stamps, rate_hz=hz if is_stated else hz / factor, imu=None, gnss=None)
    found = only(units(other))
    assert (found.code, said in found.what) == ("scan-unit", True)
    assert f"makes {hz:g} Hz of it" in found.way_out


@pytest.mark.parametrize("step_s", [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 4.0])
@pytest.mark.parametrize("rate_hz", [None, 10.0, 20.0])
def test_scans_that_are_few_or_many_are_no_unit(healthy: Sequence, step_s: float, rate_hz: float | None) -> None:
    """Every tenth scan of a recording, a fast sensor, one that is told to wait: also where another rate is stated."""
    stamps = np.round(np.arange(100) * step_s * 1e9).astype(np.int64)
    other = spoilt(healthy, stamps_ns=stamps, rate_hz=rate_hz or 1 / step_s, imu=None, gnss=None)
    assert units(other) == []


@pytest.mark.parametrize(("factor", "said"), TIMES)
@pytest.mark.parametrize("name", ["imu", "gnss"])
def test_streams(healthy: Sequence, name: str, factor: float, said: str) -> None:
    stream = getattr(healthy, name)
    # A clock that was off when all began, too.
    stamps = np.round(stream.stamps_ns * min(factor, 1e8)).astype(np.int64) + 10**9
    other = spoilt(healthy, **{name: replace(stream, stamps_ns=stamps)})
    if factor > 1e8:
        assert units(other) == [], "no unit is 1e8 times another"
        return
    found = only(units(other))
    assert (found.code, said in found.what) == (f"{name}-unit", True)
    assert units(other, with_imu=name != "imu", with_gnss=name != "gnss") == []


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_truth(healthy: Sequence, factor: float) -> None:
    truth = truth_of(healthy)
    wrong = replace(truth, stamps_ns=np.round(truth.stamps_ns * factor).astype(np.int64))
    assert only(units(healthy, wrong)).code == "truth-unit"
    assert units(healthy, replace(wrong, has_stamps=False)) == []
    # Of an hour, from which a few scans were cut, at the rate of a survey's.
    assert units(healthy, truth_of(healthy, 5_000_000, 720_000)) == []


def test_truth_at_the_scans_own_stamps_is_no_second_finding(healthy: Sequence) -> None:
    assert healthy.ground_truth is not None
    slow = spoilt(healthy, stamps_ns=healthy.stamps_ns * 1000)
    truth = replace(healthy.ground_truth, stamps_ns=slow.stamps_ns)
    assert [f.code for f in units(slow, truth)] == ["scan-unit"]


@pytest.mark.parametrize(("end_s", "is_unit"), [(100.0, True), (1e5, True), (1e-4, True), (0.1, False), (0.01, False)])
def test_point_times(healthy: Sequence, end_s: float, is_unit: bool) -> None:
    """A tenth of a sweep is what drivers send that cut it to pieces."""
    assert [f.code for f in units(healthy, sweep=Span(0.0, end_s))] == (["point-unit"] if is_unit else [])


def test_what_a_wrong_unit_brings_about_is_no_finding_of_its_own(healthy: Sequence) -> None:
    assert healthy.imu is not None
    late = replace(healthy.imu, stamps_ns=healthy.imu.stamps_ns * 1000 + 10**12)
    facts = inspect(spoilt(healthy, imu=late), samples=1)
    assert [f["code"] for f in facts["findings"]] == ["imu-unit"]
    assert facts["imu"]["turns"] is None
