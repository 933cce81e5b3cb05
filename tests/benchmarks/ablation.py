"""Every recovery policy, and what the map asks of its voxels, switched off one at a time: which rows need it.

    python tests/benchmarks/ablation.py [--recordings FOLDER] [--seeds 100,101] [--rows hdl64,vlp16,os1-16] [--without breadth]

Recordings are those of ../shared/data with all rings, every second and every fourth. Drives are simulated with compensated
scans: standing 2.5 s before they drive off, and moving from the first scan. A run is lost when its error, the first pose on
the first true pose, exceeds a twentieth of the path. `acted` counts scans that a policy posed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import numpy as np
from accuracy import Case, ate, rotation_rpe
from sparse import length, origin, thinned

from lslam.config.recovery import RecoveryConfig
from lslam.config.registration import RegistrationConfig
from lslam.errors import UsageError
from lslam.recovery import non_ground, start_search
from lslam.recovery.policies import RecoveringRegistration
from lslam.registration import local_map
from lslam.simulation.scenarios import simulate

Make = Callable[[], RecoveringRegistration]
Patch = tuple[object, str, object]

SPEEDS = {"motorway": (5.0, 30.0), "carpark": (5.0, 12.0), "street": (5.0, 12.0)}
SLOW = ("urban", "residential", "corridor", "walk", "block", "closed", "climbing")
SCANS = 100
# Scans as `--skip-frames 2` leaves them: three times as far apart.
THIRDS = ("street", "corridor", "urban")


def _with(**recovery: bool) -> Make:
    return lambda: RecoveringRegistration(recovery=RecoveryConfig(**recovery))


WITHOUT: dict[str, tuple[Make, tuple[Patch, ...]]] = {
    "-": (RecoveringRegistration, ()),
    "breadth": (RecoveringRegistration, ((local_map, "BREADTH", 0.0),)),
    "wide voxels": (RecoveringRegistration, ((local_map, "WIDE", ()),)),
    "blobs": (lambda: RecoveringRegistration(RegistrationConfig(blob_weight=0.0)), ()),
    "coarse-to-fine": (_with(coarse_to_fine=False), ()),
    "start search": (_with(start_search=False), ()),
    "HIGH": (RecoveringRegistration, ((non_ground, "HIGH", 0.3),)),
    "CLEARLY": (RecoveringRegistration, ((start_search, "CLEARLY", 1.0),)),
    "MUCH": (RecoveringRegistration, ((start_search, "MUCH", 1.0),)),
    "agreement": (lambda: RecoveringRegistration(RegistrationConfig(min_agreement=0.0)), ()),
}


def drives(lidars: list[str], seeds: list[int]) -> Iterator[Case]:
    for scenario in (*SPEEDS, *SLOW):
        for speed in SPEEDS.get(scenario, (None,)):
            for stands in (2.5, 0.0):
                for lidar in lidars:
                    for seed in seeds:
                        start = {} if speed is None else {"speed": speed, "start_speed": 0.0 if stands else speed}
                        try:
                            line = simulate(
                                scenario, seed=seed, lidar=lidar, count=SCANS, static_start=stands,
                                motion_compensated=True, **start,
                            )  # fmt: skip
                        except UsageError:
                            # A drone does not stand.
                            continue
                        name = f"{scenario} {speed or 0:g} {'standing' if stands else 'moving'} {lidar} {seed}"
                        yield name, [line.scan(i).points for i in range(SCANS)], line.ground_truth.poses
                        if scenario in THIRDS and not stands:
                            every = range(0, SCANS, 3)
                            yield f"{name} thirds", [line.scan(i).points for i in every], line.ground_truth.poses[::3]


def row(name: str, case: Case) -> tuple[float, float, float, int, Counter[str]]:
    """ATE origin and se3, m, rotation over 10 m, deg, failed scans, and who posed."""
    _, scans, truth = case
    make, patches = WITHOUT[name]
    poses, acted, failed = [], Counter[str](), 0
    with ExitStack() as stack:
        for patch in patches:
            stack.enter_context(mock.patch.object(*patch))
        registration = make()
        for points in scans:
            result = registration.register(points)
            poses.append(result.T_world_lidar)
            failed += not result.ok
            acted[result.posed_by] += bool(result.posed_by)
    found = np.stack(poses)
    return origin(found, truth), ate(found, truth), rotation_rpe(found, truth), failed, +acted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--seeds", default="100,101")
    parser.add_argument("--rows", default="hdl64,vlp16,os1-32")
    parser.add_argument("--without", default=",".join(name for name in WITHOUT if name != "-"))
    args = parser.parse_args()
    cases = (
        thinned(args.recordings)
        if args.recordings
        else drives(args.rows.split(","), [int(v) for v in args.seeds.split(",")])
    )
    names, lost, worse = ["-", *args.without.split(",")], Counter[str](), Counter[str]()
    print(f"{'case':38} {'without':15} {'origin m':>9} {'se3 m':>8} {'deg/10 m':>9} {'failed':>7}  acted")
    for case in cases:
        whole = 0.0
        for name in names:
            start, shape, turn, failed, acted = row(name, case)
            is_lost = start > 0.05 * length(case[2]) and not args.recordings
            whole = shape if name == "-" else whole
            lost[name] += is_lost
            worse[name] += shape > max(1.5 * whole, whole + 0.01)
            if name == "-" or is_lost or shape > max(1.1 * whole, whole + 0.002):
                who = ", ".join(f"{k} {v}" for k, v in acted.items())
                print(f"{case[0]:38} {name:15} {start:9.3f} {shape:8.4f} {turn:9.3f} {failed:7d}  {who}", flush=True)
    print("lost without: " + ", ".join(f"{name} {lost[name]}" for name in names))
    print("shape worse by half and a centimetre: " + ", ".join(f"{name} {worse[name]}" for name in names[1:]))


if __name__ == "__main__":
    main()
