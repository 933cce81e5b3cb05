"""What the motion that KITTI's raw `sync` scans hold does to every method: drive 0005 with it left in and taken out.

    python tests/benchmarks/untwisting.py FOLDER_WITH_UNPACKED_RECORDINGS [--write docs/results.md]

Rotation over 10 m, to OXTS (as its stamps say, and read `--late` s earlier) and to `icp`, which asks no reference.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray
from recorded import PLACES
from scores import rotation_rpe

from lslam.core.config import load_config
from lslam.core.geometry.se3 import poses_at
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.run import run

METHODS = "icp,gicp,vgicp,ndt,icp-point,loam,floam,loam-odom"


def poses_of(path: Path, method: str, is_left_in: bool) -> NDArray[np.float64]:
    """(N, 4, 4) of the odometry alone."""
    sequence = open_sequence(path, motion_compensated=is_left_in)
    words = [f"odometry.method={method}", "loops.use=false", "map.write=false"]
    return run(sequence, load_config(settings=words, environ={})).trajectory.poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--late", type=float, default=0.014, help="s by which OXTS is late")
    tables.offer(parser, None)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    path, methods = args.recordings / PLACES["KITTI raw 0005"], args.methods.split(",")
    truth = read_trajectory(path / "reference_lidar.tum")
    late = replace(truth, poses=poses_at(truth.stamps_ns, truth.poses, truth.stamps_ns - round(1e9 * args.late)))
    rows = []
    for name, is_left_in in (("left in", True), ("taken out", False)):
        found = {method: poses_of(path, method, is_left_in) for method in methods}
        others = {
            "OXTS": truth.poses,
            f"OXTS {1e3 * args.late:.0f} ms earlier": late.poses,
            methods[0]: found[methods[0]],
        }
        for other, reference in others.items():
            values = [rotation_rpe(found[method], reference) for method in methods]
            rows.append(
                [
                    f"{name}: to {other}",
                    *("" if method == other else f"{v:.3f}" for method, v in zip(methods, values, strict=True)),
                ]
            )
            print(rows[-1], flush=True)
    caption = "KITTI raw 0005, 154 scans: rotation, deg, each scan with the first one at least 10 m on, rmse."
    tables.table("untwisting", caption, ["motion", *methods], rows, args.write)


if __name__ == "__main__":
    main()
