"""Findings of studies as data: each kind takes its own numbers."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from lslam.core.config.study import ExpectedFinding


def test_finding_reads_what_a_study_file_says() -> None:
    finding = ExpectedFinding.model_validate(
        {"text": "best 1..2 m", "kind": "best_between", "values": [1, 2], "imu": False, "at": {"input.skip_frames": 4}}
    )
    assert finding.values == (1.0, 2.0)
    assert finding.of == "efficiency"
    assert finding.at == {"input.skip_frames": 4.0}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"kind": "best_between", "values": [1]}, "best_between takes 2 values, not 1"),
        ({"kind": "best_between", "values": [2, 1]}, "2 must not lie above 1"),
        ({"kind": "linear", "values": [0.9, 0.8]}, "linear takes 0 or 1 values, not 2"),
        ({"kind": "linear", "values": [1.5]}, "R2 of 1.5 must lie between 0 and 1"),
        ({"kind": "matters_little", "values": [0.5]}, "the ratio 0.5 must lie above 1"),
        ({"kind": "acts_only_on"}, "acts_only_on names its stages"),
        ({"kind": "good_from", "values": [1], "stages": ["map"]}, "and no other kind does"),
    ],
)
def test_numbers_that_do_not_fit_the_kind_are_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        ExpectedFinding.model_validate({"text": "so it is", **wrong})
