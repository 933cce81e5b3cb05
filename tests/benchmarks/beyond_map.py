"""A drive that leaves the map for half a kilometre and comes back with drift: with and without the search about the prediction.

    python tests/benchmarks/beyond_map.py [--seeds 100,101] [--percent 1] [--deg 1] [--folder DIR] [--write docs/results.md]

A town is driven once round by a VLP-16; the map is that of its first `FIRST` scans. Odometry is the truth with a drift at
constant rates. ATE is that of `origin`: in the map's frame, without alignment.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
import tables
from numpy.typing import NDArray

import lslam
from lslam.core.config import load_config
from lslam.core.geometry import se3, so3
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.trajectory_lines import write_tum
from lslam.pipeline.localise_pass import Reanchoring
from lslam.simulation.record import record
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
FIRST, SPEED = 120, 14.0
QUIET = ("report.html=false", "loops.use=false")


def drifted(poses: Floats, percent: float, deg: float) -> Floats:
    """(N, 4, 4), each step longer by so many % and turned by so many deg per 100 m."""
    out = [poses[0]]
    for step in se3.relative(poses[:-1], poses[1:]):
        way = float(np.linalg.norm(step[:3, 3]))
        off = se3.make(so3.exp(np.array([0.0, 0.0, np.deg2rad(deg) / 100 * way])), 0.01 * percent * step[:3, 3])
        out.append(se3.normalise(out[-1] @ step @ off))
    return np.stack(out)


def one_seed(root: Path, seed: int, percent: float, deg: float) -> list[tuple[int, float]]:
    """Scans that the map held and ATE, m, with and without the search."""
    drive = simulate("residential", seed=seed, lidar="vlp16", speed=SPEED)
    folder = root / f"beyond-{seed}"
    if not (folder / "poses" / "00.txt").exists():
        record(drive, folder)
        lslam.run(folder, load_config(None, [*QUIET, f"input.count={FIRST}"]), out=folder / "map")
    poses = drifted(drive.ground_truth.poses, percent, deg)
    write_tum(root / "drifted.tum", Trajectory(stamps_ns=drive.stamps_ns, poses=poses, frame="lidar"))
    settings = [
        *QUIET, "map.write=false", f"localize.map='{folder / 'map'}'", "localize.start=[0.0, 0.0, 0.0]", "odometry.method=poses",
        f"odometry.poses='{root / 'drifted.tum'}'",
    ]  # fmt: skip
    found = []
    for is_searched in (True, False):
        with mock.patch.object(Reanchoring, "__call__", Reanchoring.__call__ if is_searched else lambda *_: None):
            outcome = lslam.run(folder, load_config(None, settings))
        assert outcome.evaluation is not None
        error = outcome.evaluation.ate["origin"].translation
        assert error is not None
        found.append((sum(fix.is_binding for fix in outcome.record.map_fixes), error.rmse))
    print(seed, found, flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--percent", type=float, default=1.0)
    parser.add_argument("--deg", type=float, default=1.0, help="per 100 m")
    parser.add_argument("--folder", type=Path, help="keeps recordings and maps; default: a temporary one")
    tables.offer(parser)
    args = parser.parse_args()
    seeds = tables.numbers(args.seeds)
    with tempfile.TemporaryDirectory() as temporary:
        found = np.array([one_seed(args.folder or Path(temporary), seed, args.percent, args.deg) for seed in seeds])
    rows = [
        [name, f"{np.median(held):.0f} / {held.min():.0f}", f"{np.median(ate):.2f} / {ate.max():.2f}"]
        for name, (held, ate) in zip(("search", "none"), found.transpose(1, 2, 0), strict=True)
    ]
    caption = (
        f"residential, {tables.seeds_named(seeds)}: a VLP-16 in the map of the first {FIRST} scans of the same drive, odometry "
        f"with a steady drift of {args.percent:g} % and {args.deg:g} deg/100 m, median / worst."
    )
    tables.table("beyond-map", caption, ["about the prediction", "scans held", "ATE, m"], rows, args.write)


if __name__ == "__main__":
    main()
