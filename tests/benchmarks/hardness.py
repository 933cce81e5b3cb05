"""Is a simulated drive as hard as a recorded one? Map entropy, plane thickness, inliers of `icp`, rotation of three methods.

    python tests/benchmarks/hardness.py [--scenarios urban,urban-hard] [--seeds 100-104] [--scans 154]
        [--set key=value] [--write docs/results.md]
    python tests/benchmarks/hardness.py --recordings FOLDER      KITTI's drive 0005 as well, and ratios to it

The map is that of `icp`'s own poses, points 2 to 80 m away averaged over voxels of `--voxel` m; entropy and plane thickness
(the root of the mean plane variance) are those of Razlaw et al. 2015 over neighbourhoods of 0.5 m. The inliers are the mean
share of a scan's source points within the final kernel. Rotation RPE: every scan with the first one at least 10 m further
on, rmse. Drive 0005's reference is OXTS, whose yaw is late by 14 ms and jumps once: .2 deg that all methods share, where a
simulation's truth is exact. So the rotation between two methods stands beside it, which asks no reference. All scans are
untwisted, the recording's along icp's trajectory, the simulated ones exactly. Scans/s is
two threads tracing, as `lslam simulate` does, and CPU is what one scan costs them together.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray
from peers import drive
from recorded import untwisted
from scores import rotation_rpe

from lslam import Registration
from lslam.core.config import Config
from lslam.core.geometry import se3
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.maps.crispness import crispness
from lslam.maps.merge import MapMerger
from lslam.odometry import create_odometry
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
Scans = list[NDArray[np.float32]]

METHODS = ("icp", "kiss-icp", "small-gicp")
PAIRS = ((0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class Hardness:
    """The figures of one clip: entropy, nats; thickness, m; inliers, a share; rotation of each method and between two, deg.

    traced : scans/s; cpu : s of a scan
    """

    entropy: float
    thickness: float
    inliers: float
    rotation: tuple[float, ...]
    between: tuple[float, ...]
    traced: float = float("nan")
    cpu: float = float("nan")

    @property
    def values(self) -> Floats:
        return np.array([self.entropy, self.thickness, self.inliers, *self.rotation, *self.between])

    @property
    def order(self) -> str:
        return " < ".join(METHODS[i] for i in np.argsort(self.rotation))


def measure(scans: Scans, truth: Floats, voxel: float, *speed: float) -> Hardness:
    create_odometry(Config()).warm_up()
    registration = Registration()
    results = [registration.register(points) for points in scans]
    poses = np.stack([result.T_world_lidar for result in results])
    merger = MapMerger(voxel)
    for points, pose in zip(scans, poses, strict=True):
        merger.add(points, pose)
    score = crispness(merger.result())
    assert score.entropy is not None
    assert score.plane_variance is not None
    inliers = float(np.mean([result.agreement for result in results[1:]]))
    found = [poses, *(drive(method, scans)[0] for method in METHODS[1:])]
    rotation = tuple(rotation_rpe(estimate, truth) for estimate in found)
    between = tuple(rotation_rpe(found[a], found[b]) for a, b in PAIRS)
    return Hardness(score.entropy, float(np.sqrt(score.plane_variance)), inliers, rotation, between, *speed)


def recorded(folder: Path, count: int) -> tuple[Scans, Floats]:
    path = folder / "2011_09_26" / "2011_09_26_drive_0005_sync"
    sequence = open_sequence(path)
    count = min(count, len(sequence))
    truth = read_trajectory(path / "reference_lidar.tum").poses[:count]
    return [scan.points for scan in untwisted(sequence)[:count]], se3.relative(truth[0], truth)


def simulated(scenario: str, seed: int, count: int, settings: list[str]) -> tuple[Scans, Floats, float, float]:
    line = simulate(scenario, seed=seed, count=count + 1, motion_compensated=True, settings=settings)
    line.scan(0)
    began, used = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(2) as pool:
        scans = [scan.points for scan in pool.map(line.scan, range(count))]
    seconds, cpu = time.perf_counter() - began, time.process_time() - used
    truth = line.vehicle.poses(line.stamps_ns[:count] / 1e9)
    return scans, se3.relative(truth[0], truth), count / seconds, cpu / count


def row(name: str, found: Hardness) -> None:
    e, t, i, *r = found.values
    rotation = " ".join(f"{v:10.3f}" for v in r)
    print(
        f"{name:24} {e:8.3f} {1e3 * t:9.1f} {i:8.3f} {rotation} {found.traced:8.1f} {1e3 * found.cpu:7.0f}   {found.order}",
        flush=True,
    )


def ratios(found: Hardness, real: Hardness) -> None:
    ratio = found.values / real.values
    # Entropy is a logarithm: what compares is a ratio of volumes, its cube root one of lengths.
    ratio[0] = np.exp((found.entropy - real.entropy) / 3)
    e, t, i, *r = ratio
    print(f"{'  over the recording':24} {e:8.2f} {t:9.2f} {i:8.2f} " + " ".join(f"{v:10.2f}" for v in r), flush=True)


def shown(name: str, found: list[Hardness]) -> list[str]:
    """A row of the document: medians and ranges over the seeds, or what the one recording has."""
    values = np.stack([f.values for f in found])
    values[:, 1] *= 1e3
    middle, least, most = np.median(values, axis=0), values.min(axis=0), values.max(axis=0)
    digits = [2, 1, *(3,) * (len(middle) - 2)]
    if len(found) == 1:
        return [name, *(f"{v:.{d}f}" for v, d in zip(middle, digits, strict=True))]
    return [
        name,
        *(f"{v:.{d}f} ({a:.{d}f} to {b:.{d}f})" for v, a, b, d in zip(middle, least, most, digits, strict=True)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--scenarios", default="urban,urban-hard")
    parser.add_argument("--scans", type=int, default=154)
    parser.add_argument("--voxel", type=float, default=0.2)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    tables.offer(parser)
    args = parser.parse_args()
    names = [*METHODS, *(f"{METHODS[a][:5]}/{METHODS[b][:5]}" for a, b in PAIRS)]
    print(
        f"{'clip':24} {'entropy':>8} {'plane mm':>9} {'inliers':>8} " + " ".join(f"{m:>10}" for m in names)
        + f" {'scans/s':>8} {'CPU ms':>7}   rotation over 10 m, deg"
    )  # fmt: skip
    real, rows, seeds = None, [], tables.numbers(args.seeds)
    if args.recordings is not None:
        scans, truth = recorded(args.recordings, args.scans)
        real = measure(scans, truth, args.voxel)
        row("KITTI 0005", real)
        rows.append(shown("drive 0005, against OXTS", [real]))
    for scenario in filter(None, args.scenarios.split(",")):
        found = []
        for seed in seeds:
            scans, truth, *speed = simulated(scenario, seed, args.scans, args.settings)
            found.append(measure(scans, truth, args.voxel, *speed))
            row(f"{scenario} {seed}", found[-1])
            if real is not None:
                ratios(found[-1], real)
        rows.append(shown(scenario, found))
    caption = (
        f"{args.scans} scans, untwisted; median (range) of {tables.seeds_named(seeds)}. Map of `icp`'s own poses: entropy, "
        "nats, planes, mm; inliers of `icp`; rotation, deg, each scan with the first one at least 10 m on: of methods against "
        "the truth, and between two of them, which asks no reference."
    )
    header = [
        "clip",
        "entropy",
        "planes, mm",
        "inliers",
        *METHODS,
        *(f"{METHODS[a]} to {METHODS[b]}" for a, b in PAIRS),
    ]
    tables.table("hardness", caption, header, rows, args.write)


if __name__ == "__main__":
    main()
