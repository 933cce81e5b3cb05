"""Two hypotheses about scans that fail: bad ones, or a map that ends; decided by what follows, in the order of the scans."""

from __future__ import annotations

import numpy as np

from lslam.core.config import Config
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.frontend.segments import SegmentTracker, TrackedScan
from lslam.odometry.frontend.tracker import ScanInput, Tracker

INITIAL = 3


class Scripted(Tracker):
    """Registers the scans whose share of agreeing points is given, in percent, and no others."""

    def __init__(self, shares: dict[int, int], x: float = 0.0) -> None:
        super().__init__(create_odometry(Config()))
        self.shares, self.x = shares, x

    def track(self, loaded: ScanInput) -> ScanResult:
        share = self.shares.get(loaded.index)
        pose = np.eye(4)
        pose[0, 3] = self.x
        status = "bridged" if share is None else "ok"
        return ScanResult(loaded.index, loaded.stamp_ns, pose, status, source_points=100, inliers=share or 0)  # type: ignore[arg-type]


def tracked(
    old: dict[int, int], *new: dict[int, int], count: int, unread: tuple[int, ...] = ()
) -> list[list[TrackedScan]]:
    """What is decided with each scan, and at the end; `new` are the maps that are begun, in turn."""
    begun = iter(new)
    tracker = SegmentTracker(Scripted(old), lambda pose: Scripted(next(begun), pose[0, 3] + 1), INITIAL)
    scan = Scan(np.ones((3, 3), np.float32), 0, 0)
    every = [ScanInput(i, i, None if i in unread else scan) for i in range(count)]
    out = [tracker.decide(loaded, tracker.present.track(loaded)) for loaded in every]
    return [*out, tracker.decide(None, None)]


def outcomes(decided: list[list[TrackedScan]]) -> list[tuple[int, str, int]]:
    return [(t.result.index, t.result.status, t.result.segment) for now in decided for t in now]


def all_of(*scans: int, share: int = 90) -> dict[int, int]:
    return dict.fromkeys(scans, share)


def test_nothing_is_begun_while_scans_are_registered() -> None:
    assert [len(now) for now in tracked(all_of(*range(5)), count=5)] == [1, 1, 1, 1, 1, 0]


def test_a_map_that_holds_again_has_the_word() -> None:
    decided = tracked(all_of(0, 3, 4), all_of(1, 2, 3), count=5)
    assert [len(now) for now in decided] == [1, 0, 0, 3, 1, 0], "open until the old map tells"
    assert outcomes(decided) == [(0, "ok", 0), (1, "bridged", 0), (2, "bridged", 0), (3, "ok", 0), (4, "ok", 0)]


def test_more_scans_than_initialise_a_map_are_a_new_segment_of_the_map_that_they_agree_on() -> None:
    decided = tracked(all_of(0), all_of(*range(1, 7)), count=6)
    assert [len(now) for now in decided] == [1, 0, 0, 0, 4, 1, 0]
    assert outcomes(decided)[1:] == [(i, "ok", 1) for i in range(1, 6)]
    assert decided[-2][0].result.T_world_lidar[0, 3] == 1.0, "it begins where the old map expected the scan"


def test_a_pose_that_fewer_points_hold_than_on_the_new_map_is_no_return_to_the_old_one() -> None:
    worse = tracked(all_of(0) | all_of(2, 3, share=40), all_of(1, 2, 3), count=4)
    assert outcomes(worse)[1:] == [(1, "ok", 1), (2, "ok", 1), (3, "ok", 1)]
    alike = tracked(all_of(0) | all_of(2, 3, share=80), all_of(1, 2, 3), count=4)
    assert outcomes(alike)[1:] == [(1, "bridged", 0), (2, "ok", 0), (3, "ok", 0)]


def test_scans_that_agree_on_nothing_are_bridged_one_by_one() -> None:
    decided = tracked(all_of(0), *[all_of(i) for i in range(1, 6)], count=6)
    assert [len(now) for now in decided] == [1, 0, 1, 1, 1, 1, 1]
    assert outcomes(decided)[1:] == [(i, "bridged", 0) for i in range(1, 6)]


def test_a_scan_that_cannot_be_read_decides_for_the_old_map() -> None:
    decided = tracked(all_of(0), all_of(1, 2), all_of(4, 5, 6, 7), count=8, unread=(3,))
    assert outcomes(decided)[1:] == [(i, "bridged", 0) for i in (1, 2, 3)] + [(i, "ok", 1) for i in (4, 5, 6, 7)]
