"""Clocks of points without times: simulated drives whose points lie in other orders, told right, left alone, or wrong.

    python tests/benchmarks/point_clocks.py [--seeds 1-5] [--scenarios walk,street,motorway] [--lidar vlp16] [--orders half,crop]

Each drive of 30 scans is taken distorted, compensated and standing. A clock is right when the times of at most 6 % of the points
are off by more than a twentieth of a sweep, apart from one offset for all. None may be wrong; left alone is as before.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lslam.config.preprocess import PreprocessConfig
from lslam.frontend.point_times import with_point_times
from lslam.simulation.lidar_models import LIDARS, LidarModel
from lslam.simulation.scenarios import simulate
from lslam.types.scan import Scan

COUNT, SECONDS = 30, 0.1
# Share of points that may be timed wrongly.
MOST_WRONG = 0.06


def columns_first(scan: Scan) -> Scan:
    return scan.select(np.lexsort((scan.rings, _times(scan).round(5))))


def rows_first(scan: Scan) -> Scan:
    return scan.select(np.lexsort((scan.times, scan.rings)))


def staggered(scan: Scan) -> Scan:
    """Every second ring reports its points some columns late."""
    assert scan.rings is not None
    return scan.select(np.lexsort((scan.rings, (_times(scan) + (scan.rings % 4) * 1.5e-3).round(5))))


def shuffled(scan: Scan) -> Scan:
    return scan.select(_chance(scan).permutation(len(scan)))


def half(scan: Scan) -> Scan:
    scan = columns_first(scan)
    return scan.select(_chance(scan).random(len(scan)) < 0.5)


def crop(scan: Scan) -> Scan:
    scan = columns_first(scan)
    return scan.select(np.abs(np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))) < 110)


def two_returns(scan: Scan) -> Scan:
    scan = columns_first(scan)
    twice = np.flatnonzero(_chance(scan).random(len(scan)) < 0.3)
    return scan.select(np.sort(np.concatenate([np.arange(len(scan)), twice])))


ORDERS: dict[str, Callable[[Scan], Scan]] = {
    order.__name__: order for order in (columns_first, rows_first, staggered, shuffled, half, crop, two_returns)
}


class Twin:
    """A drive whose scans lie in another order and have neither times nor rings; `is_standing` repeats the first scan."""

    motion_compensated: bool | None = None

    def __init__(self, drive: Any, lidar: LidarModel, order: Callable[[Scan], Scan], is_standing: bool) -> None:
        self._drive, self._lidar, self._order, self._is_standing = drive, lidar, order, is_standing
        self.notes: list[str] = []
        self._scans: dict[int, Scan] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drive, name)

    def __len__(self) -> int:
        return COUNT

    def timed(self, index: int) -> Scan:
        if index not in self._scans:
            scan = self._drive.scan(0 if self._is_standing else index)
            if scan.times is None:
                sense = -1 if self._lidar.clockwise else 1
                turned = sense * (np.arctan2(scan.points[:, 1], scan.points[:, 0]) - np.radians(self._lidar.start_deg))
                scan = replace(scan, times=(SECONDS * np.mod(turned / (2 * np.pi), 1)).astype(np.float32))
            self._scans[index] = replace(self._order(scan), index=index, stamp_ns=int(self.stamps_ns[index]))
        return self._scans[index]

    def scan(self, index: int) -> Scan:
        return replace(self.timed(index), times=None, rings=None)


def outcome(twin: Twin, motion: str) -> tuple[str, str]:
    """right, left alone or WRONG, and the note."""
    sequence: Any = with_point_times(twin, PreprocessConfig())  # type: ignore[arg-type]
    choice = getattr(sequence, "clock_choice", None)
    if choice is None or choice.verdict in ("unclear", "standing"):
        return "left alone", "" if choice is None else choice.sentence
    if choice.verdict == "compensated" or motion != "distorted":
        is_right = choice.verdict == "compensated" and motion == "compensated"
        return "right" if is_right else "WRONG", choice.sentence
    wrong = []
    for index in (3, 11, 19):
        off = sequence.scan(index).times - _times(twin.timed(index))
        wrong.append(float((np.abs(off - np.median(off)) > 0.05 * SECONDS).mean()))
    return "right" if max(wrong) <= MOST_WRONG else "WRONG", choice.sentence


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", default="1-5")
    parser.add_argument("--scenarios", default="walk,street,motorway")
    parser.add_argument("--orders", default=",".join(ORDERS))
    parser.add_argument("--lidar", default="vlp16")
    given = parser.parse_args()
    first, _, last = given.seeds.partition("-")
    lidar = LIDARS[given.lidar]
    counts: Counter[tuple[str, str]] = Counter()
    for scenario in given.scenarios.split(","):
        for seed in range(int(first), int(last or first) + 1):
            for motion in ("distorted", "compensated", "standing"):
                drive = simulate(
                    scenario, seed=seed, lidar=lidar, count=COUNT, motion_compensated=motion != "distorted"
                )
                for name in given.orders.split(","):
                    told, note = outcome(Twin(drive, lidar, ORDERS[name], motion == "standing"), motion)
                    counts[motion, told] += 1
                    print(f"{scenario:<10} {seed} {motion:<12} {name:<14} {told:<11} {note}", flush=True)
    for (motion, told), count in sorted(counts.items()):
        print(f"{motion:<12} {told:<11} {count}")


def _times(scan: Scan) -> Any:
    assert scan.times is not None
    return scan.times


def _chance(scan: Scan) -> np.random.Generator:
    return np.random.default_rng((3, scan.index))


if __name__ == "__main__":
    main()
