"""Four drives of one town by four sensors merged, and one of another town refused.

    python tests/benchmarks/sessions.py [--seeds 100,101] [--scenario residential-hard] [--folder DIR] [--write docs/results.md]

For each seed: an HDL-64, then a VLP-16 and an OS1-32 on the other lane in the opposite direction, and an OS1-64 that begins
elsewhere, each with other traffic and noise; a fifth drive is of the town of seed + 1000. The error over sessions is that of all
poses in the common frame against the truth in the town, aligned once by a rigid transform (se3).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import tables
from numpy.typing import NDArray

import lslam
from lslam.core.config import load_config
from lslam.core.geometry import se3
from lslam.core.geometry.se3 import umeyama
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.pipeline.merged_folder import merge_into
from lslam.pipeline.watch import Watch
from lslam.simulation.record import record
from lslam.simulation.routes import FIRST_VISIT, Visit
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
DRIVES = (
    ("map", "hdl64", FIRST_VISIT),
    ("new", "vlp16", Visit(1, is_reversed=True, shift=120.0)),
    ("third", "os1-64", Visit(2, shift=300.0)),
    ("fourth", "os1-32", Visit(3, is_reversed=True, shift=50.0)),
)
FOREIGN = 1000


def run_of(root: Path, name: str, scenario: str, seed: int, lidar: str, visit: Visit) -> tuple[Path, Floats]:
    """A run of a recording, both made once, and the true poses (N, 4, 4) in the town."""
    folder = root / f"{name}-{scenario}-{seed}"
    drive = simulate(scenario, seed=seed, lidar=lidar, visit=visit)
    if not (folder / "poses" / "00.txt").exists():
        record(drive, folder, resume=(folder / "sequences" / "00.part").exists())
    if not (folder / "single" / "report.html").exists():
        lslam.run(folder, load_config(None, ["map.write=false"]), out=folder / "single", overwrite=True)
    return folder / "single", drive.city_poses


def ate(est: list[Floats], true: list[Floats]) -> float:
    """m, se3, of positions (N, 3) of all sessions together."""
    p, q = np.concatenate(est), np.concatenate(true)
    T, _, _ = umeyama(p, q)
    return float(np.sqrt(((se3.apply(T, p) - q) ** 2).sum(axis=1).mean()))


def one_seed(root: Path, scenario: str, seed: int) -> dict[str, Any]:
    runs = [run_of(root, name, scenario, seed, lidar, visit) for name, lidar, visit in DRIVES]
    foreign = run_of(root, "foreign", scenario, seed + FOREIGN, "vlp16", FIRST_VISIT)
    single = [ate([read_trajectory(run / "trajectory.tum", "tum").positions], [true[:, :3, 3]]) for run, true in runs]
    out = root / f"town-{scenario}-{seed}"
    began = time.process_time()
    folders = [_named(root, name, run) for (name, *_), (run, _) in zip(DRIVES, runs, strict=True)]
    folders.append(_named(root, "foreign", foreign[0]))
    manifest = merge_into(folders, out, load_config(None, ["map.write=false"]), Watch(), overwrite=True)
    cpu = time.process_time() - began
    true = {folder.name: poses[:, :3, 3] for folder, (_, poses) in zip(folders, runs, strict=False)}
    names = [one["name"] for one in manifest["sessions"]]
    est = [read_trajectory(out / "sessions" / f"{name}.tum", "tum").positions for name in names]
    merged = ate(est, [true[name] for name in names])
    print(
        f"{scenario} {seed}: single {np.round(single, 4).tolist()}, all {merged:.4f} m, {names}, {cpu:.0f} s CPU",
        flush=True,
    )
    return {
        "single": single,
        "merged": merged,
        "names": names,
        "out": [one["name"] for one in manifest["left_out"]],
        "cpu": cpu,
    }


def _named(root: Path, name: str, run: Path) -> Path:
    """The run by the name of its drive."""
    link = root / "runs" / run.parent.name
    link.parent.mkdir(exist_ok=True)
    if not link.exists():
        link.symlink_to(run, target_is_directory=True)
    return link


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="residential-hard")
    parser.add_argument("--folder", type=Path, help="keeps recordings and runs; default: a temporary one")
    tables.offer(parser)
    args = parser.parse_args()
    seeds = tables.numbers(args.seeds)
    with tempfile.TemporaryDirectory() as temporary:
        root = args.folder or Path(temporary)
        found = [one_seed(root, args.scenario, seed) for seed in seeds]
    rows = [
        [str(seed), f"{min(one['single']):.4f}", f"{max(one['single']):.4f}", f"{one['merged']:.4f}",
         f"{one['merged'] / min(one['single']):.2f}", str(len(one["names"])), ", ".join(n.split("-")[0] for n in one["out"]),
         f"{one['cpu']:.0f}"]
        for seed, one in zip(seeds, found, strict=True)
    ]  # fmt: skip
    caption = (
        f"{args.scenario}, {tables.seeds_named(seeds)}: drives of one town by an HDL-64, a VLP-16, an OS1-64 and an OS1-32, two "
        "of them in the opposite direction, and one of another town. ATE se3, m: the best and the worst session alone, and all "
        "poses of all sessions aligned once."
    )
    header = [
        "seed",
        "best alone",
        "worst alone",
        "all merged",
        "merged / best",
        "merged sessions",
        "left out",
        "CPU, s",
    ]
    tables.table("sessions", caption, header, rows, args.write)


if __name__ == "__main__":
    main()
