"""When a sweep begins and ends, and where in it the stamp lies."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan, Span


@pytest.mark.parametrize(
    ("passed", "instant"),
    [(0.0, "scan_start"), (0.2, "scan_start"), (0.3, "scan_middle"), (0.5, "scan_middle"), (0.7, "scan_middle"),
     (0.8, "scan_end"), (1.0, "scan_end")],
)  # fmt: skip
def test_the_stamp_lies_at_the_start_the_middle_or_the_end_whichever_is_nearest(passed: float, instant: str) -> None:
    span = Span(-0.1 * passed, 0.1 * (1 - passed))
    assert span.seconds == pytest.approx(0.1)
    assert span.stamp_share == pytest.approx(passed)
    assert span.instant == instant


def test_a_scan_of_one_instant_takes_no_time_and_starts_at_its_stamp() -> None:
    assert (Span().seconds, Span().stamp_share, Span().instant) == (0.0, 0.0, "scan_start")
    points = np.zeros((2, 3), np.float32)
    assert Scan(points, 0, 0).span == Scan(points[:0], 0, 0, None, np.zeros(0, np.float32)).span == Span()


@pytest.mark.parametrize(("times", "span"), [([0.02, 0.07], (0.0, 0.07)), ([-0.07, -0.02], (-0.07, 0.0))])
def test_the_stamp_is_always_within(times: list[float], span: tuple[float, float]) -> None:
    swept = Scan(np.zeros((2, 3), np.float32), 0, 0, None, np.array(times, np.float32))
    np.testing.assert_allclose(swept.span, span, atol=1e-8)


@pytest.mark.parametrize("begin", [0.0, -0.05, -0.04, -0.1])
def test_the_pose_of_a_prior_is_that_at_the_stamp(begin: float) -> None:
    times = begin + np.linspace(0.0, 0.1, 33)
    T, velocity = se3.exp(np.array([3.0, 1.0, 0.0, 0.1, 0.0, 2.0])), np.array([10.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    prior = MotionPrior(times, T @ se3.exp(times[:, None] * velocity))
    # Between two knots translation runs straight: 10 m/s times 1 rad/s, over 3 ms.
    np.testing.assert_allclose(prior.pose, T, atol=10 * 1 * (0.1 / 32) ** 2 / 8 * 1.1)
    assert prior.span_s == pytest.approx(0.1)
