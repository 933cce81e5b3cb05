"""Alerts from made-up checks: several in a row, large ones, inconclusive ones, and poses that jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.types.scan_result import MotionCheck
from lslam.odometry.integrity.alerts import IN_A_ROW, alerts, open_throughout, stamp_faults

Floats = NDArray[np.float64]

SURE = np.array([0.005] * 3 + [0.0005] * 3)


def checks_of(ahead: list[float], **more: float) -> list[MotionCheck]:
    """Checks every five scans that find the sensor so many m farther ahead than claimed, a metre in half a second."""
    one = MotionCheck(0, 5, 0.5, shifted(1.0), shifted(1.0), SURE, agreement=0.8, claimed_agreement=0.8, usual=0.8)
    return [
        replace(one, first=5 * k, last=5 * k + 5, found_motion=shifted(1.0 + off), **more)  # type: ignore[arg-type]
        for k, off in enumerate(ahead)
    ]


def shifted(x: float) -> Floats:
    return se3.make(np.eye(3), np.array([x, 0.0, 0.0]))


def spans(checks: list[MotionCheck]) -> list[tuple[int, int]]:
    """First and last scan of each alert, of a sensor that stands."""
    count = checks[-1].last + 1
    found = alerts(checks, np.zeros((count, 3)), 100_000_000 * np.arange(count, dtype=np.int64))
    return [(alert.first, alert.last) for alert in found]


def test_checks_that_confirm_the_poses_raise_no_alert() -> None:
    assert spans(checks_of([0.01, -0.02, 0.0, 0.02] * 5)) == []


def test_consecutive_inconsistent_checks_raise_one_alert_over_all_of_them() -> None:
    around = [0.0] * 8
    assert spans(checks_of([*around, *[0.2] * (IN_A_ROW - 1), *around])) == []
    assert spans(checks_of([*around, *[0.2] * IN_A_ROW, *around])) == [(41, 60)]


def test_one_large_inconsistency_with_more_agreement_raises_an_alert() -> None:
    alone = [0.0] * 8 + [1.0] + [0.0] * 8
    assert spans(checks_of(alone)) == []
    assert spans(checks_of(alone, claimed_agreement=0.5)) == [(41, 45)]


def test_inconclusive_checks_neither_raise_nor_split_an_alert() -> None:
    checks = checks_of([0.0] * 8 + [0.2] * IN_A_ROW + [0.0] * 8)
    assert spans([replace(check, agreement=0.1) for check in checks]) == []
    vague = [
        replace(check, agreement=0.1) if k == 9 else check for k, check in enumerate(checks_of([0.0] * 8 + [0.2] * 5))
    ]
    assert spans(vague) == [(41, 65)]


def test_axes_that_are_inconsistent_together_make_one_alert_that_names_both() -> None:
    turned = shifted(1.3) @ se3.make(so3.exp(np.array([0, 0, np.deg2rad(1.0)])), np.zeros(3))
    checks = [replace(check, found_motion=turned) for check in checks_of([0.0] * 6)]
    (alert,) = alerts(checks, np.zeros((31, 3)), 100_000_000 * np.arange(31, dtype=np.int64))
    assert (alert.first, alert.last) == (1, 30)
    assert alert.why == (
        "beside the scan 0.5 s before, each moved by +0.30 m ahead and +1.00 deg of yaw more than its pose says"
    )


def test_a_break_over_which_nothing_confirms_the_motion_raises_an_alert() -> None:
    checks = checks_of([0.0] * 4)
    open_ahead = np.array([1.0, *SURE[1:]])
    for unsure in ({"sigma": open_ahead}, {"agreement": 0.1}, {"claimed_agreement": 0.3}):
        assert spans([*checks[:2], replace(checks[2], is_after_break=True, **unsure), checks[3]]) == [(11, 15)]  # type: ignore[arg-type]
    assert spans([*checks[:2], replace(checks[2], is_after_break=True), checks[3]]) == []


def test_standing_that_explains_as_much_as_moving_raises_an_alert_when_it_does_so_twice() -> None:
    checks = checks_of([0.0] * 8)
    still, on = shifted(0.0), shifted(2.0)
    assert spans([*checks[:3], replace(checks[3], rival=still), *checks[4:]]) == []
    assert spans([*checks[:3], *(replace(check, rival=on) for check in checks[3:6]), *checks[6:]]) == []
    assert spans([*checks[:3], *(replace(check, rival=still) for check in checks[3:5]), *checks[5:]]) == [(16, 25)]


def test_a_run_of_which_no_two_scans_tell_the_motion_raises_an_alert() -> None:
    ahead = np.array([1.0, 0.01, 0.01, *SURE[3:]])
    checks = [replace(check, sigma=ahead) for check in checks_of([0.0] * IN_A_ROW)]
    (alert,) = open_throughout(checks)
    assert (alert.first, alert.last) == (1, 5 * IN_A_ROW)
    assert open_throughout(checks[1:]) == []
    assert open_throughout([*checks, *checks_of([0.0])]) == []


def test_poses_that_begin_to_move_where_the_scans_leave_it_open_raise_an_alert() -> None:
    across = np.array([0.01, 1.0, 0.01, *SURE[3:]])
    checks = checks_of([0.0] * 8)
    on, sideways = shifted(1.0), shifted(1.0)
    sideways[1, 3] = -1.2

    def along(*claimed: Floats) -> list[MotionCheck]:
        parts = [
            replace(c, claimed_motion=T, found_motion=T, sigma=across)
            for c, T in zip(checks[3:], claimed, strict=False)
        ]
        return [*checks[:3], *parts, *checks[3 + len(parts) :]]

    assert spans(along(on, on, on)) == []
    assert spans(along(on, sideways, sideways)) == [(21, 30)]
    (alert,) = alerts(along(sideways), np.zeros((41, 3)), 100_000_000 * np.arange(41, dtype=np.int64))
    assert alert.why == "the scans leave open whether the sensor began to move by -1.20 m to the left, as its poses do"
    # What was on its way may go half a metre faster in each pair; what stood, or moves so at once, may not.
    faster = [shifted(1.4), shifted(1.8)]
    assert spans(along(*faster)) == []
    still = [replace(c, claimed_motion=shifted(0.0), found_motion=shifted(0.0)) for c in checks[:3]]
    assert spans([*still, *along(shifted(0.4), shifted(0.8))[3:]]) == [(21, 25)]
    # The same said by scans that tell it raises none; nor does what a pair of a fifth of the time would not tell.
    told = along(sideways, sideways)
    assert spans([*told[:3], *(replace(c, sigma=SURE) for c in told[3:5]), *told[5:]]) == []
    brief = replace(checks[2], seconds=0.1, claimed_motion=shifted(0.2), found_motion=shifted(0.2))
    assert spans([*checks[:2], brief, *told[3:5], *checks[5:]]) == []


def test_directions_that_empty_while_the_poses_stand_raise_an_alert() -> None:
    checks = checks_of([0.0] * 8)
    assert spans([replace(check, emptied_share=0.1) for check in checks]) == []
    assert spans([replace(check, emptied_share=0.4 if k > 3 else 0.0) for k, check in enumerate(checks)]) == [(21, 40)]


def test_poses_that_jump_raise_an_alert_without_any_check() -> None:
    positions = np.column_stack([np.arange(20.0), np.zeros(20), np.zeros(20)])
    stamps_ns = 100_000_000 * np.arange(20, dtype=np.int64)
    assert alerts([], positions, stamps_ns) == []
    positions[10:, 1] = 3.0
    (alert,) = alerts([], positions, stamps_ns)
    assert (alert.first, alert.last) == (9, 11)
    assert "the poses jump, by 3.0 m within 0.1 s" in alert.why
    assert stamp_faults(positions, stamps_ns) == ([], 0.0)
    # A segment that nothing ties to the others has a frame of its own.
    assert alerts([], positions, stamps_ns, (np.arange(20) < 10).astype(np.int64)) == []
    assert [a.first for a in alerts([], positions, stamps_ns, (np.arange(20) < 5).astype(np.int64))] == [9]


def test_poses_that_a_map_lets_go_by_and_by_raise_an_alert() -> None:
    # A corridor at 6 m/s whose first three scans were held in place: no step is off by half a metre, two together are.
    along = np.array([0.0, 0.0, 0.0, 0.32, 1.01, *(1.01 + 0.6 * np.arange(1, 16))])
    positions = np.column_stack([along, np.zeros(20), np.zeros(20)])
    stamps_ns = 100_000_000 * np.arange(20, dtype=np.int64)
    (alert,) = alerts([], positions, stamps_ns)
    assert (alert.first, alert.last) == (2, 4)
    assert "the poses jump, by 1.0 m within 0.2 s" in alert.why
    # Nothing slows down more than a car that brakes as hard as its tyres let it, twice over.
    braking = np.column_stack([20 * (t := 0.01 * np.arange(80)) - 9.0 * t**2, 0 * t, 0 * t])
    assert alerts([], braking, 10_000_000 * np.arange(80, dtype=np.int64)) == []


def test_stamps_that_jump_under_steady_poses_are_the_fault_of_the_clock() -> None:
    positions = np.column_stack([1.3 * np.arange(40.0), np.zeros(40), np.zeros(40)])
    jitter = np.zeros(40)
    jitter[[12, 13, 30]] = 0.03, -0.01, -0.045
    stamps_ns = np.round(1e9 * (0.1 * np.arange(40) + jitter)).astype(np.int64)
    assert alerts([], positions, stamps_ns) == []
    at, off_s = stamp_faults(positions, stamps_ns)
    assert {12, 30} <= set(at) <= {11, 12, 13, 14, 29, 30, 31}
    assert off_s == pytest.approx(0.045, abs=1e-6)
    # Poses out of order jump by any stamps; a scan that is missing makes no jump at all.
    swapped = positions.copy()
    swapped[[20, 21]] = swapped[[21, 20]]
    assert [(alert.first, alert.last) for alert in alerts([], swapped, stamps_ns)] == [(19, 23)]
    kept = np.delete(np.arange(40), [12, 13, 25, 30])
    assert stamp_faults(positions[kept], stamps_ns[kept]) == ([], 0.0)
