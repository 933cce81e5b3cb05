"""Time per scan out of a run's timing.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import InputError
from lslam.evaluation.timing import read_timing, read_timing_rows
from lslam.pipeline.outputs import timing_text

GOOD = "index,stamp_ns,read,register,total\n" + "".join(
    f"{k},{k * 10**8},0.01,{0.001 * k},{0.01 + 0.001 * k}\n" for k in range(101)
)


def test_stages_and_limit(tmp_path: Path) -> None:
    (tmp_path / "timing.csv").write_text(GOOD)
    timing = read_timing(tmp_path / "timing.csv")
    assert timing.scans == 101
    assert list(timing.stages) == ["read", "register"]
    assert timing.stages["register"].median == pytest.approx(0.05)
    assert timing.stages["register"].p95 == pytest.approx(0.095)
    assert timing.total.max == pytest.approx(0.11)
    assert timing.stages["read"].share + timing.stages["register"].share == pytest.approx(1)
    assert timing.period == pytest.approx(0.1)
    assert timing.over_limit == 10


def test_two_scans_have_a_period_and_one_has_none(tmp_path: Path) -> None:
    (tmp_path / "timing.csv").write_text("index,stamp_ns,total\n0,0,0.3\n1,200000000,0.1\n")
    timing = read_timing(tmp_path / "timing.csv")
    assert (timing.period, timing.over_limit) == (0.2, 1)
    (tmp_path / "timing.csv").write_text("index,stamp_ns,total\n0,0,0.3\n")
    alone = read_timing(tmp_path / "timing.csv")
    assert (alone.period, alone.over_limit) == (None, 0)


def test_what_is_done_after_odometry_stands_beside_the_total(tmp_path: Path) -> None:
    back_end = {0: {"loops": 0.25}, 2: {"loops": 0.5, "graph": 7.0}}
    text = timing_text([0, 1, 2], [0, 10**8, 2 * 10**8], ["register"], np.full((3, 1), 0.01), back_end)
    (tmp_path / "timing.csv").write_text(text)
    rows = read_timing_rows(tmp_path / "timing.csv")
    np.testing.assert_allclose(rows.total, 0.01)
    assert list(rows.stages) == ["register"]
    np.testing.assert_allclose(rows.back_end["loops"], [0.25, 0.0, 0.5])
    np.testing.assert_allclose(rows.back_end["graph"], [0.0, 0.0, 7.0])
    assert read_timing(tmp_path / "timing.csv").over_limit == 0


def test_scan_is_a_stage_beside_an_index_and_a_number_without(tmp_path: Path) -> None:
    (tmp_path / "timing.csv").write_text("index,scan,map,total\n0,0.25,0.5,0.75\n1,0.25,0.5,0.75\n")
    timing = read_timing(tmp_path / "timing.csv")
    assert {name: stage.mean for name, stage in timing.stages.items()} == {"scan": 0.25, "map": 0.5}
    (tmp_path / "timing.csv").write_text("scan,map\n0,0.5\n1,0.5\n")
    assert list(read_timing(tmp_path / "timing.csv").stages) == ["map"]


def test_total_is_the_sum_when_absent(tmp_path: Path) -> None:
    (tmp_path / "timing.csv").write_text("scan,a,b\n0,1,2\n1,3,4\n")
    timing = read_timing(tmp_path / "timing.csv")
    assert timing.total.mean == 5
    assert timing.period is None


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "no scans"),
        ("index,total\n", "no scans"),
        ("index,total\n0,fast\n", "line 2: not a number"),
        ("index,total\n0\n", "line 2: 1 columns"),
        ("index,total\n0,nan\n", "NaN"),
        ("index,stamp_ns\n0,1\n", "neither"),
    ],
)
def test_invalid_timing_files_are_errors_with_a_reason(text: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "timing.csv").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_timing(tmp_path / "timing.csv")


def test_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_timing(tmp_path / "timing.csv")
