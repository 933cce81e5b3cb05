"""What the rounds of `speed.py` come to: median, p95 and ratios round by round, as rows of tables."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Which of ours is set beside which peer: the default beside all, the others beside the peer of their name.
RIVALS = {
    "icp": (
        "kiss-icp", "kiss-icp-python", "genz-icp", "genz-icp-outdoor", "rko-lio", "small-gicp", "small-gicp-scans",
        "small-vgicp", "open3d-gicp",
    ),
    "gicp": ("small-gicp", "small-gicp-scans", "open3d-gicp"),
    "vgicp": ("small-vgicp",),
}  # fmt: skip
# NDT and LOAM have no package with wheels: what was published, on other machines.
PUBLISHED = (
    ("ndt", "PCL's NDT", "496", "1", "KITTI 00, CPU not stated", "PointCloudLibrary/pcl, pull request 4277"),
    ("ndt", "NDT_OMP, kd-tree", "368; 76", "1; 16", "KITTI 00, CPU not stated", "likewise"),
    ("ndt", "NDT_OMP, direct", "73; 24", "1; 16", "KITTI 00, CPU not stated", "likewise"),
    ("loam", "A-LOAM", "151", "not stated", "KITTI, Core i7-8700, six cores", "README of wh200720041/floam"),
    ("floam", "F-LOAM", "59", "not stated", "KITTI, Core i7-8700, six cores", "likewise"),
)


@dataclass(frozen=True)
class Rounds:
    """Seconds of one method on one sequence: an array (scans, 2) per round, by the wall and by the CPU."""

    rounds: tuple[Floats, ...]
    threads: int

    def medians(self, clock: int) -> Floats:
        """(rounds,) s, of wall (0) or CPU (1)."""
        return np.array([np.median(seconds[:, clock]) for seconds in self.rounds])

    def tails(self) -> Floats:
        """(rounds,) s by the wall that 95 % of the scans stay below."""
        return np.array([np.percentile(seconds[:, 0], 95) for seconds in self.rounds])


def ratio(ours: Floats, theirs: Floats) -> str:
    """Ours over theirs, round by round: median, least and largest."""
    found = ours / theirs
    return f"{np.median(found):.2f} ({found.min():.2f} to {found.max():.2f})"


def ms(seconds: Floats) -> str:
    return f"{1e3 * np.median(seconds):.1f}"


def rows_of_times(name: str, found: dict[str, Rounds]) -> Iterable[list[str]]:
    """A row per method: ms by the wall, its tail, and ms by the CPU, medians over the rounds."""
    for method, r in found.items():
        wall, tails = r.medians(0), r.tails()
        shares = f"{np.median(tails / wall):.2f}"
        yield [name, method, str(r.threads), ms(wall), ms(tails), shares, ms(r.medians(1))]


def rows_of_ratios(name: str, found: dict[str, Rounds]) -> Iterable[list[str]]:
    """A row per pair of `RIVALS` that was measured: ours over the peer, below 1 where ours is faster."""
    for ours, peers in RIVALS.items():
        for peer in peers if ours in found else ():
            if peer in found:
                a, b = found[ours], found[peer]
                yield [name, ours, peer, *(ratio(a.medians(clock), b.medians(clock)) for clock in (0, 1))]


def rows_of_processes(name: str, found: dict[str, Floats]) -> Iterable[list[str]]:
    """A row per command, seconds (rounds, 2): wall and CPU, and the first command over it."""
    first = next(iter(found.values()))
    for command, seconds in found.items():
        ratios = ["", ""] if seconds is first else [ratio(first[:, k], seconds[:, k]) for k in (0, 1)]
        yield [name, command, *(f"{np.median(seconds[:, k]):.2f}" for k in (0, 1)), *ratios]


def rows_published(found: dict[str, dict[str, Rounds]]) -> Iterable[list[str]]:
    """A row per published time, with ours of this machine on the first sequence that has one; they are not set in relation."""
    for ours, system, time, threads, where, source in PUBLISHED:
        here = next((f"{ms(by[ours].medians(0))} ({name})" for name, by in found.items() if ours in by), "-")
        yield [ours, here, system, time, threads, where, source]
