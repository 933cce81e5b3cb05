"""The rules of one method, each off or otherwise, one at a time: which of them its accuracy needs.

    python tests/benchmarks/method_ablation.py ct-icp [--seeds 100-104] [--scans 60] [--scenarios "walk from=60,corridor"]

Drives are uncompensated, as in `tight.py`; `saturation` is of `quadrotor`, whole.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np
import tables
from tight import cell, one
from traced import Traced

from lslam.core.geometry import se3
from lslam.core.types.imu import ImuStream
from lslam.core.types.trajectory import Trajectory
from lslam.odometry import ct_icp, elastic, lips, loam_livox, plane_factors, plane_segmentation, plane_window
from lslam.odometry.ct_icp import LastSweep
from lslam.odometry.elastic import NOTHING
from lslam.odometry.inertial import imu_cleaning
from lslam.odometry.inertial.constant_velocity import Course
from lslam.odometry.inertial.filter import FilterMotion
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.lio_mapping import LioMapping
from lslam.simulation.scenarios import SimulatedDrive, simulate

Patch = tuple[object, str, Any]


@dataclass(frozen=True)
class Ablation:
    """methods, scenarios, lidar, imu : what is run; variants : what is patched, by name

    A scenario may have words behind it: what `simulate` takes, as `speed=30`; `from=60`, the first scan; `scans=500`.
    """

    methods: tuple[str, ...]
    scenarios: tuple[str, ...]
    variants: dict[str, tuple[Patch, ...]]
    lidar: str = "vlp16"
    imu: str | None = "icm20948"
    whole: bool = False


class Later(Traced):
    """A drive from a scan on, which nothing is known of before."""

    def __init__(self, drive: SimulatedDrive, first: int) -> None:
        assert drive.ground_truth is not None
        self._drive, self.stamps_ns, poses = drive, drive.stamps_ns[first:], drive.ground_truth.poses[first:]
        self._scans = [replace(drive.scan(i), index=i - first) for i in range(first, len(drive))]
        self.ground_truth = Trajectory(self.stamps_ns, se3.relative(poses[0], poses), "lidar")


def driven(words: str, seed: int, count: int | None, ablation: Ablation) -> Traced:
    """The drive of a scenario and the words behind it."""
    scenario, *given = words.split()
    values: dict[str, Any] = {key: float(value) for key, _, value in (word.partition("=") for word in given)}
    first, count = int(values.pop("from", 0)), int(values.pop("scans", count or 0)) or None
    count = count and first + count
    values |= {"lidar": ablation.lidar, "imu": ablation.imu, "count": count, "motion_compensated": False}
    return Later(simulate(scenario, seed=seed, **values), first)


fill_saturation = imu_cleaning.fill_saturation
constraints = LastSweep.constraints


def as_read(imu: ImuStream, notes: list[str]) -> ImuStream:
    """Nothing is looked for."""
    return imu


def doubted(imu: ImuStream, notes: list[str]) -> ImuStream:
    """What is cut off is trusted the less, and not filled in."""
    return replace(fill_saturation(imu, notes), accel=imu.accel, gyro=imu.gyro)


def trusted(imu: ImuStream, notes: list[str]) -> ImuStream:
    """It is filled in and trusted as any other reading."""
    return replace(fill_saturation(imu, notes), clipping_sigma=None)


def without(**changes: Any) -> Callable[..., Any]:
    """The constraints of a sweep, some of them otherwise."""
    return lambda self, *args: replace(constraints(self, *args), **changes)


def small_voxels_only(self: plane_segmentation.PlaneExtractor, cells: Any, sizes: list[Any]) -> Any:
    return regions(self, cells, sizes[:1])


regions = plane_segmentation.PlaneExtractor._regions

ABLATIONS = {
    "saturation": Ablation(
        ("fast-lio2", "icp+imu.use=true"), ("quadrotor",),
        {
            "all of it": ((imu_cleaning, "fill_saturation", as_read),),
            "filling in": ((imu_cleaning, "fill_saturation", doubted),),
            "its sigma": ((imu_cleaning, "fill_saturation", trusted),),
            "deskewing again": ((FilterMotion, "refine", lambda self, prior, stamp_ns, pose: (
                prior if prior.covariance is not None else InertialMotion.refine(self, prior, stamp_ns, pose)
            )),),
            "HIDDEN 0.25": ((imu_cleaning, "HIDDEN_RANGE_SHARE", 0.25),),
            "HIDDEN 1": ((imu_cleaning, "HIDDEN_RANGE_SHARE", 1.0),),
            "FORGOTTEN 0.1": ((imu_cleaning, "FORGOTTEN_S", 0.1),),
            "FORGOTTEN 0.4": ((imu_cleaning, "FORGOTTEN_S", 0.4),),
        },
        whole=True,
    ),
    "ct-icp": Ablation(
        ("ct-icp",), ("walk", "urban", "residential"),
        {
            "skew": ((LastSweep, "constraints", without(skew=np.zeros(6), skew_information=1e12 * np.eye(6))),),
            "location": ((LastSweep, "constraints", without(location=NOTHING, since=0.0)),),
            "velocity": ((LastSweep, "constraints", without(velocity=NOTHING)),),
            "both": ((LastSweep, "constraints", without(location=NOTHING, since=0.0, velocity=NOTHING)),),
            "MISS_RATIO 1/3": ((ct_icp, "MISS_RATIO", 1 / 3),),
            "MISS_RATIO 1/12": ((ct_icp, "MISS_RATIO", 1 / 12),),
            "LAG 1": ((ct_icp, "LAG_RATIO", 1.0),),
            "FORGETTING_FACTOR 0": ((ct_icp, "FORGETTING_FACTOR", 0.0),),
            "FORGETTING_FACTOR 0.95": ((ct_icp, "FORGETTING_FACTOR", 0.95),),
            "LEAST_CHANGE 1e-4": ((ct_icp, "LEAST_CHANGE", 1e-4),),
            "LEAST_SKEW 1e-3": ((elastic, "LEAST_SKEW", 1e-3), (ct_icp, "LEAST_SKEW", 1e-3)),
        },
        imu=None,
    ),
    "course": Ablation(
        ("icp", "ct-icp"), ("walk", "street", "motorway"), {"course": ((Course, "at", lambda self, *args: None),)}, imu=None,
    ),
    "lips": Ablation(
        ("lips",), ("walk", "urban"),
        {
            "KNOWN_SHARE": ((lips, "KNOWN_SHARE", 0.0),),
            "HUBER_SIGMAS": ((plane_factors, "HUBER_SIGMAS", 1e9),),
            "GATE_CHI2": ((plane_window, "GATE_CHI2", 1e9),),
            "ALIKE 20 deg": ((plane_window, "ALIKE", 0.94),),
            "CLOSE 2 m": ((plane_window, "CLOSE", 2.0),),
            "BOXES_APART_M": ((plane_window, "BOXES_APART_M", 1e9),),
            "wide voxels": ((plane_segmentation.PlaneExtractor, "_regions", small_voxels_only),),
            "MIXED_RATIO": ((plane_segmentation, "MIXED_RATIO", 1e9),),
            "COMMON": ((lips, "PlaneExtractor", lambda: plane_segmentation.PlaneExtractor(common_m=0.0, common_rad=0.0)),),
        },
    ),
    "lio-mapping": Ablation(
        ("lio-mapping",), ("walk", "urban", "residential", "corridor"),
        {
            "late entry": ((LioMapping, "insert", lambda self, stamp_ns, prior, result: (
                self.registration.update(result)
            )),),
        },
    ),
    "loam-livox": Ablation(
        ("loam-livox", "loam-livox+loam.pieces=1"), ("urban", "residential", "walk"),
        {
            "SLOPE_SHARE 0": ((loam_livox, "SLOPE_SHARE", 0.0),),
            "SLOPE_SHARE 1": ((loam_livox, "SLOPE_SHARE", 1.0),),
            "INLIER_SHARE": ((loam_livox, "LIVOX", replace(loam_livox.LIVOX, inlier_ratio=1.0)),),
        },
        lidar="livox", imu=None,
    ),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=list(ABLATIONS))
    parser.add_argument("--scans", type=int, default=60)
    parser.add_argument("--scenarios", help="those of the ablation, comma-separated; default: all")
    parser.add_argument("--only", help="variants, comma-separated; default: all")
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    ablation, seeds = ABLATIONS[args.what], tables.numbers(args.seeds)
    if args.scenarios:
        ablation = replace(ablation, scenarios=tuple(args.scenarios.split(",")))
    names = args.only.split(",") if args.only else list(ablation.variants)
    variants: dict[str, tuple[Patch, ...]] = {"nothing": ()} | {name: ablation.variants[name] for name in names}
    count = None if ablation.whole else args.scans
    columns = [(s, m) for s in ablation.scenarios for m in ablation.methods]
    runs: dict[tuple[str, str, str], list[dict[str, Any]]] = {(v, *c): [] for v in variants for c in columns}
    for seed in seeds:
        for scenario in ablation.scenarios:
            drive = driven(scenario, seed, count, ablation)
            length = float(drive.ground_truth.path_lengths[-1])
            for name, patches in variants.items():
                for method in ablation.methods:
                    with ExitStack() as stack:
                        for patch in patches:
                            stack.enter_context(mock.patch.object(*patch))
                        run = one(drive, method) | {"length": length}
                    runs[name, scenario, method].append(run)
                    print(seed, scenario, f"{name:18} {method:20}", run.get("ate"), run["status"], flush=True)
    caption = (
        f"{args.what}: ATE se3, m, median / worst of {tables.seeds_named(seeds)}, {count or 'all'} scans of "
        f"{ablation.lidar}{f' and {ablation.imu}' if ablation.imu else ''}; lost: off by a twentieth of the path or without a "
        "result, silently where the run did not say `degraded` either."
    )
    heads = [s if len(ablation.methods) == 1 else f"{s} {m}" for s, m in columns]
    rows = [[name, *(cell(runs[name, *c]) for c in columns)] for name in variants]
    tables.table(f"ablation-{args.what}", caption, ["without, or with", *heads], rows, args.write)


if __name__ == "__main__":
    main()
