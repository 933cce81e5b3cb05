"""How honest the covariances of poses are: the normalised estimation error squared (NEES) per degree of freedom.

    python tests/benchmarks/nees.py [--first 100] [--scans 300] [--modes odometry,loops,imu,gnss,osm]
        [--write docs/results.md]

One row a drive, each with a seed of its own: e^T inv(C) e / 6, the mean over all poses but the first. One is honest, below it
the covariances are pessimistic, above it optimistic. Odometry, loops and IMU are compared from the first pose on, GNSS and OSM
on the Earth; OSM, which knows nothing of heights, by east, north and heading, on maps that are as wrong as maps are: 1 to 3 m
off as a whole, single houses beside that.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.errors import LslamError
from lslam.core.geometry import geodesy, se3, so3
from lslam.pipeline.run import RunOutcome, run
from lslam.simulation.osm_extract import MapFaults, write_extracts
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.sensors import ORIGIN, GnssModel

Floats = NDArray[np.float64]

# Scenario, LiDAR, and whether its sensor can close loops within the scans; the seeds count up from the first.
DRIVES = [
    ("block", "hdl64"), ("block", "vlp16"), ("street", "vlp16"), ("urban", "hdl64"), ("urban", "os1-32"),
    ("residential", "os1-32"), ("motorway", "hdl64"), ("motorway", "vlp16"), ("carpark", "vlp16"), ("corridor", "vlp16"),
]  # fmt: skip
MODES: dict[str, dict[str, object]] = {
    "odometry": {"loops.use": False},
    "loops": {},
    "imu": {"loops.use": False, "imu.use": True},
    "gnss": {"loops.use": False, "gnss.mode": "graph"},
    "osm": {"loops.use": False},
}
# m, by which a map is often off as a whole.
OFFSET = (1.0, 3.0)
# Of position and rotation, what is judged: all where nothing is said.
HELD = {"osm": [0, 1, 5]}


def errors(outcome: RunOutcome, drive: SimulatedDrive) -> tuple[Floats, Floats]:
    """(N, 6) position, m, and rotation, rad, off the truth, world axes; and (N, 6, 6) what the run claims of them."""
    record, truth = outcome.record, drive.ground_truth
    assert truth is not None
    assert record.trajectory.covariances is not None
    found, C = record.trajectory.poses, record.trajectory.covariances
    place = record.georeference
    if place is not None and place.method != "fit":
        found, real = place.T_enu_world @ found, drive.T_city_world @ truth.poses
        found[:, :3, 3] = geodesy.to_local(geodesy.from_local(found[:, :3, 3], place.origin), ORIGIN)
        turned = place.T_enu_world[:3, :3]
    else:
        T = truth.poses[0] @ se3.inverse(found[0])
        found, real, turned = T @ found, truth.poses, T[:3, :3]
    e = np.concatenate(
        [found[:, :3, 3] - real[:, :3, 3], so3.log(found[:, :3, :3] @ np.swapaxes(real[:, :3, :3], 1, 2))], 1
    )
    R = np.kron(np.eye(2), turned)
    return e, R @ C @ R.T


def nees(e: Floats, C: Floats) -> float:
    """Mean over errors (N, D) of e^T inv(C) e / D."""
    return float(np.mean(np.einsum("ni,ni->n", e, np.linalg.solve(C, e[..., None])[..., 0])) / e.shape[1])


def configured(mode: str, drive: SimulatedDrive, seed: int, folder: Path) -> Config:
    words = dict(MODES[mode])
    if mode == "osm":
        rng = np.random.default_rng(seed)
        faults = MapFaults(offset=rng.uniform(*OFFSET))
        extracts = write_extracts(folder, drive.city, ORIGIN, rng, faults)
        first = geodesy.from_local(drive.T_city_world[None, :3, 3], ORIGIN)[0]
        heading = 90.0 - np.degrees(so3.euler_rpy(drive.T_city_world[:3, :3])[2])
        words |= {
            "osm.extract": str(extracts.perturbed),
            "osm.origin": [float(v) for v in first],
            "osm.heading_deg": float(heading),
        }
    return Config.model_validate(nested(words))


def nested(words: dict[str, object]) -> dict[str, dict[str, object]]:
    sections: dict[str, dict[str, object]] = {}
    for key, value in words.items():
        section, name = key.split(".")
        sections.setdefault(section, {})[name] = value
    return sections


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--scans", type=int, default=250)
    parser.add_argument("--modes", default=",".join(MODES))
    parser.add_argument("--drives", default=",".join(str(k) for k in range(len(DRIVES))))
    tables.offer(parser, None)
    args = parser.parse_args()
    print(f"{'drive':28} {'mode':9} {'NEES':>8} {'place':>8} {'turn':>8} {'end, m':>8} {'sigma, m':>9}")
    per: dict[str, list[float]] = {}
    for k in (int(v) for v in args.drives.split(",")):
        scenario, lidar = DRIVES[k]
        drive = simulate(
            scenario, seed=args.first + k, lidar=lidar, count=args.scans, motion_compensated=False, imu="icm20948",
            gnss=GnssModel(),
        )  # fmt: skip
        for mode in args.modes.split(","):
            name = f"{scenario} {lidar} {args.first + k}"
            with tempfile.TemporaryDirectory() as folder:
                try:
                    outcome = run(drive, configured(mode, drive, args.first + k, Path(folder)))
                except LslamError as error:
                    print(f"{name:28} {mode:9} {error}", flush=True)
                    continue
            e, C = errors(outcome, drive)
            e, C, held = e[1:], C[1:], HELD.get(mode, list(range(6)))
            whole, place, turn = (
                nees(e[:, s], C[:, s][:, :, s]) for s in (held, [k for k in held if k < 3], [k for k in held if k > 2])
            )
            per.setdefault(mode, []).append(whole)
            end, sigma = np.linalg.norm(e[-1, :3]), np.sqrt(np.trace(C[-1, :3, :3]))
            print(f"{name:28} {mode:9} {whole:8.2f} {place:8.2f} {turn:8.2f} {end:8.3f} {sigma:9.3f}", flush=True)
    chosen = [int(v) for v in args.drives.split(",")]
    drives, seeds = ", ".join(" ".join(DRIVES[k]) for k in chosen), [args.first + k for k in chosen]
    caption = (
        f"NEES of the poses per degree of freedom, 1 is honest, more is optimistic: {len(chosen)} drives of {args.scans} "
        f"distorted scans, {tables.seeds_named(seeds)} ({drives}); odometry, loops and IMU from the first pose on, fixes and "
        "buildings on the Earth, maps 1 to 3 m off."
    )
    rows = [
        [mode, f"{np.median(values):.2f}", f"{min(values):.2f}", f"{max(values):.2f}", str(len(values))]
        for mode, values in per.items()
    ]
    tables.table("nees", caption, ["with", "median", "least", "greatest", "drives"], rows, args.write)


if __name__ == "__main__":
    main()
