"""When sweeps begin and end, by as few of the first scans as tell it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stub_sequences import sample

from lslam.core.types.scan import Scan, Span
from lslam.odometry.frontend.register_scans import sweep_of


@pytest.mark.parametrize(
    ("is_compensated", "seconds", "span", "reads"),
    [
        (True, (None, 0.1, 0.1), None, [0]),
        (False, (None, None, None, None), None, [0, 1, 2]),
        (False, (None, 0.09, 0.1), 0.09, [0, 1]),
        (True, (0.01, 0.1, 0.1), 0.1, [0, 1]),  # the end of a sweep alone
        (True, (0.1, 0.1), 0.1, [0]),
    ],
)
def test_no_scan_is_read_that_does_not_decide(
    is_compensated: bool, seconds: tuple[float | None, ...], span: float | None, reads: list[int]
) -> None:
    stub = replace(sample(len(seconds)), motion_compensated=is_compensated)
    for index, last in enumerate(seconds):
        scan = stub.scans[index]
        assert isinstance(scan, Scan)
        times = None if last is None else np.linspace(0, last, len(scan), dtype=np.float32)
        stub.scans[index] = replace(scan, times=times)
    found = sweep_of(stub)
    assert found == (None if span is None else Span(0.0, float(np.float32(span))))
    assert stub.reads == reads
