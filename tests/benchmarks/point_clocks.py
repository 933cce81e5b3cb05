"""Clocks of points without times: simulated drives whose points lie in other orders, told right, left alone, or wrong.

    python tests/benchmarks/point_clocks.py [--seeds 1-5] [--motions distorted,standing] [--scenarios walk] [--orders half,crop]

A VLP-16 turns twenty times a second. A drive of 26 scans is taken distorted and compensated; standing, its first scan comes back
with other noise. A clock is right when the times of at most 6 % of the points are off by more than a twentieth of a sweep, apart
from one offset for all. None may be wrong; left alone is as before.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from lslam.core.config.input import PreprocessConfig
from lslam.core.types.scan import Scan
from lslam.odometry.frontend.point_times import with_point_times
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

COUNT, SECONDS = 26, 0.1
LIDAR = replace(LIDARS["vlp16"], columns=900)
MOTIONS = ("distorted", "compensated", "standing")
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


@dataclass
class Drive:
    """A drive of which each scan is made once, with the times that its points have or would have."""

    scenario: str
    seed: int
    motion: str

    def __post_init__(self) -> None:
        self.simulated = simulate(
            self.scenario, seed=self.seed, lidar=LIDAR, count=COUNT, motion_compensated=self.motion != "distorted"
        )
        self._scans: dict[int, Scan] = {}

    def scan(self, index: int) -> Scan:
        if index not in self._scans:
            scan = self.simulated.scan(0 if self.motion == "standing" else index)
            if scan.times is None:
                turned = -np.arctan2(scan.points[:, 1], scan.points[:, 0]) - np.radians(LIDAR.start_deg)
                scan = replace(scan, times=(SECONDS * np.mod(turned / (2 * np.pi), 1)).astype(np.float32))
            if self.motion == "standing":
                far = np.linalg.norm(scan.points, axis=1, keepdims=True)
                noise = np.random.default_rng((4, index)).normal(0, LIDAR.range_noise, far.shape)
                scan = replace(scan, points=(scan.points * (1 + noise / far)).astype(np.float32))
            self._scans[index] = replace(scan, index=index, stamp_ns=int(self.simulated.stamps_ns[index]))
        return self._scans[index]


class Twin:
    """A drive whose scans lie in another order and have neither times nor rings."""

    motion_compensated: bool | None = None

    def __init__(self, drive: Drive, order: Callable[[Scan], Scan]) -> None:
        self._drive, self._order = drive, order
        self.notes: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._drive.simulated, name)

    def __len__(self) -> int:
        return COUNT

    def timed(self, index: int) -> Scan:
        return self._order(self._drive.scan(index))

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
    parser.add_argument("--motions", default=",".join(MOTIONS))
    parser.add_argument("--orders", default=",".join(ORDERS))
    given = parser.parse_args()
    first, _, last = given.seeds.partition("-")
    counts: Counter[tuple[str, ...]] = Counter()
    seeds = range(int(first), int(last or first) + 1)
    for motion, seed, scenario in product(given.motions.split(","), seeds, given.scenarios.split(",")):
        drive = Drive(scenario, seed, motion)
        for name in given.orders.split(","):
            told, note = outcome(Twin(drive, ORDERS[name]), motion)
            counts.update(((motion, scenario, told), (motion, name, told), (motion, "all", told)))
            print(f"{scenario:<10} {seed} {motion:<12} {name:<14} {told:<11} {note}", flush=True)
    for key, count in sorted(counts.items()):
        print(*(f"{word:<14}" for word in key), count)


def _times(scan: Scan) -> Any:
    assert scan.times is not None
    return scan.times


def _chance(scan: Scan) -> np.random.Generator:
    return np.random.default_rng((3, scan.index))


if __name__ == "__main__":
    main()
