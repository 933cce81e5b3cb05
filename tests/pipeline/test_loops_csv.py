"""loops.csv: what is written can be read back by anybody's CSV reader."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import OutputError
from lslam.core.types.constraint import Constraint, LoopCandidate
from lslam.pipeline.outputs import LOOP_COLUMNS, write_loops

SCANS = [0, 3, 6, 9, 12]
COVARIANCE = np.diag([0.01, 0.04, 0.01, 1e-6, 1e-6, np.deg2rad(0.5) ** 2])


def test_rows_say_what_became_of_each_candidate(tmp_path: Path) -> None:
    candidates = [
        LoopCandidate(
            0, 3, 1.25, 0.125, "accepted", "agreement", "", 0.05, 0.9, Constraint(0, 3, np.eye(4), COVARIANCE)
        ),
        LoopCandidate(1, 4, 7.0, float("nan"), "rejected", "ambiguity", 'twice, and "alike"'),
    ]
    write_loops(tmp_path / "loops.csv", candidates, SCANS)
    with (tmp_path / "loops.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert ",".join(rows[0]) == LOOP_COLUMNS
    assert rows[0]["scan_b"] == "9"
    assert rows[0]["verdict"] == "accepted"
    assert float(rows[0]["descriptor_distance"]) == 0.125
    assert float(rows[0]["sigma_m"]) == pytest.approx(0.2)
    assert float(rows[0]["sigma_deg"]) == pytest.approx(0.5)
    assert rows[1]["reason"] == 'twice, and "alike"'
    assert rows[1]["rmse_m"] == rows[1]["sigma_m"] == rows[1]["descriptor_distance"] == ""


def test_without_candidates_there_is_a_header(tmp_path: Path) -> None:
    write_loops(tmp_path / "loops.csv", [], [])
    assert (tmp_path / "loops.csv").read_text() == LOOP_COLUMNS + "\n"


def test_names_a_file_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"missing.loops\.csv"):
        write_loops(tmp_path / "missing" / "loops.csv", [], [])
