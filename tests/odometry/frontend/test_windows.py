"""Windows of scans that are tracked again along their course: where motion bends within sweeps, and nowhere else."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from stub_sequences import Stub, decided_by

from lslam.core.config import Config, load_config
from lslam.core.geometry import se3, so3
from lslam.io.formats.state_files import read_state, write_state
from lslam.odometry import create_odometry
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.segments import SegmentTracker, TrackedScan
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.frontend.windows import WINDOW_SCANS, WindowTracker
from lslam.odometry.inertial.constant_velocity import ConstantVelocity, Course
from lslam.registration.local_map import surroundings_m
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import SimulatedDrive, simulate

Floats = NDArray[np.float64]
COUNT = WINDOW_SCANS + 8


def configured(method: str = "icp", *settings: str) -> Config:
    return load_config(None, [f"odometry.method={method}", *settings], {})


@cache
def drive(scenario: str) -> SimulatedDrive:
    lidar = dataclasses.replace(LIDARS["vlp16"], columns=900)
    return simulate(scenario, lidar=lidar, count=COUNT, motion_compensated=False, seed=2)


@cache
def scans(scenario: str, method: str = "icp") -> tuple[ScanInput, ...]:
    made = drive(scenario)
    loaded = [made.scan(i) for i in range(COUNT)]
    stub = Stub(loaded, None, made.calibration, motion_compensated=False)  # type: ignore[arg-type]
    return tuple(read_ahead(stub, create_odometry(configured(method)).prepare, 1))


def windows_of(config: Config, *, is_windowed: bool = True) -> WindowTracker:
    def begin(pose: Floats) -> Tracker:
        return Tracker(create_odometry(config), motion=ConstantVelocity(pose))

    # One scan that initialises a map: none is registered again on a map of later ones.
    tracker = SegmentTracker(Tracker(create_odometry(config)), begin, initial_scans=1)
    windows = WindowTracker(tracker, None, config.registration.sigma, surroundings_m(config.registration))
    windows.is_windowed = windows.is_windowed and is_windowed
    return windows


def tracked(windows: WindowTracker, loaded: tuple[ScanInput, ...]) -> Iterator[list[TrackedScan]]:
    yield from decided_by(windows, chain(loaded, (None,)))


def poses_of(decided: list[list[TrackedScan]]) -> Floats:
    return np.stack([t.result.T_world_lidar for now in decided for t in now])


@cache
def walked(*, is_windowed: bool) -> list[list[TrackedScan]]:
    return list(tracked(windows_of(configured(), is_windowed=is_windowed), scans("walk")))


def turn_error_deg(poses: Floats, scenario: str) -> float:
    """Root mean square error of the turns from scan to scan."""
    made = drive(scenario)
    true = made.vehicle.poses(np.array([made.scan(i).stamp_ns for i in range(len(poses))]) * 1e-9)
    wrong = se3.relative(se3.relative(true[:-1], true[1:]), se3.relative(poses[:-1], poses[1:]))
    return float(np.degrees(np.sqrt(np.mean(so3.angle(wrong[:, :3, :3]) ** 2))))


def test_each_scan_is_decided_once_and_in_order_with_its_window() -> None:
    decided = walked(is_windowed=True)
    assert [len(now) for now in decided] == [*[0] * (WINDOW_SCANS - 1), WINDOW_SCANS, *[0] * 8, 8]
    assert [t.result.index for now in decided for t in now] == list(range(COUNT))
    assert all(t.has_both_sides for now in decided for t in now)


def test_a_walk_turns_as_it_did() -> None:
    along, alone = (walked(is_windowed=on) for on in (True, False))
    assert [len(now) for now in alone] == [*[1] * COUNT, 0]
    # Over seeds 0 to 4 at most 0.6.
    assert turn_error_deg(poses_of(along), "walk") < 0.7 * turn_error_deg(poses_of(alone), "walk")


@pytest.mark.parametrize("method", ["icp", "loam"])
def test_what_moves_evenly_or_cannot_follow_keeps_its_bytes(method: str) -> None:
    scenario = "street" if method == "icp" else "walk"
    along, alone = (
        list(tracked(windows_of(configured(method), is_windowed=on), scans(scenario, method))) for on in (True, False)
    )
    assert not any(t.has_both_sides for now in along for t in now)
    np.testing.assert_array_equal(poses_of(along), poses_of(alone))


@pytest.mark.parametrize("left_off", [7, WINDOW_SCANS, WINDOW_SCANS + 5])
def test_a_run_goes_on_from_where_its_window_began(tmp_path: Path, left_off: int) -> None:
    whole = poses_of(walked(is_windowed=True))
    windows = windows_of(configured())
    known = [t for now in decided_by(windows, scans("walk")[:left_off]) for t in now]
    write_state(tmp_path / "state.npz", windows.state())
    other = windows_of(configured())
    other.restore(read_state(tmp_path / "state.npz", STATE_CLASSES))
    rest = poses_of(list(tracked(other, scans("walk")[len(known) :])))
    np.testing.assert_array_equal(rest, whole[len(known) :])


def test_a_window_stays_as_it_was_where_fewer_points_agree_along_its_course(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = poses_of(walked(is_windowed=False))
    at, turn = Course.at, np.linspace(0.0, 3.0, 33)[:, None] * np.eye(6)[5]

    def wrong(course: Course, stamp_ns: int, times: Floats) -> Floats | None:
        told = at(course, stamp_ns, times)
        return None if told is None else np.asarray(told @ se3.exp(turn))

    monkeypatch.setattr(Course, "at", wrong)
    decided = list(tracked(windows_of(configured()), scans("walk")))
    assert [t.result.index for now in decided for t in now] == list(range(COUNT))
    assert not any(t.has_both_sides for now in decided for t in now)
    np.testing.assert_array_equal(poses_of(decided), alone)


def test_scans_that_cannot_be_read_are_no_part_of_the_course() -> None:
    """One of them stamped so near the scan before that the middle of that one's sweep lies within its own."""
    good, k = scans("walk"), 9
    stamp_ns = good[k].stamp_ns - 60_000_000
    unread = ScanInput(good[k].index, stamp_ns, None)
    decided = list(tracked(windows_of(configured()), (*good[:k], unread, *good[k + 1 :])))
    results = [t.result for now in decided for t in now]
    assert [r.status for r in results] == ["skipped" if i == k else "ok" for i in range(COUNT)]
    assert [t.has_both_sides for now in decided for t in now] == [True] * COUNT


def test_scans_of_one_instant_are_decided_as_they_come() -> None:
    at_once = tuple(replace(loaded, scan=replace(loaded.scan, times=None)) for loaded in scans("walk") if loaded.scan)
    assert [len(now) for now in tracked(windows_of(configured()), at_once[:6])] == [*[1] * 6, 0]
