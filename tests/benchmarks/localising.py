"""Drives located in the map of another drive: the start from random scans, and the poses in the map's frame.

    python tests/benchmarks/localising.py [--seeds 100,101] [--starts 25] [--scenario residential-hard] [--folder DIR]
        [--write docs/results.md]

For each seed a town is driven by an HDL-64, and again by a VLP-16 in the opposite direction on the other lane from a shifted
start, with other traffic and noise. A start from keyframe k is a drive of the `KEYFRAMES` after it, of odometry's whole run. The
error of a pose is that to the truth in the map's frame, without alignment; the map's frame is aligned to the town by the poses of
its run (se3).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray

import lslam
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.localization.locate import PlaceFinder
from lslam.backend.localization.prior_map import PlaceSearch
from lslam.core.config import load_config
from lslam.core.geometry import se3
from lslam.core.geometry.se3 import umeyama
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.pipeline.map_tiles import read_prior_map
from lslam.simulation.record import record
from lslam.simulation.routes import FIRST_VISIT, Visit
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]
# m from which on a start is wrong; keyframes of a drive from a random start, some 25 m.
WRONG_M, KEYFRAMES = 0.5, 12
SETTINGS = ("report.html=false",)


class PartOfRun(KeyframeStore):
    """So many keyframes from one on, as a run that began there would have them."""

    def __init__(self, store: KeyframeStore, first: int, count: int) -> None:
        super().__init__()
        self._whole, self._first = store, first
        chosen = store.keyframes[first : first + count]
        T, way = se3.inverse(chosen[0].T_world_lidar), chosen[0].distance
        self.keyframes = [
            replace(k, number=n, T_world_lidar=T @ k.T_world_lidar, distance=k.distance - way)
            for n, k in enumerate(chosen)
        ]

    def points(self, number: int) -> NDArray[np.float32]:
        return self._whole.points(self._first + number)


def driven(
    folder: Path, scenario: str, seed: int, lidar: str, visit: Visit, count: int | None = None
) -> tuple[Path, Floats]:
    """A recording, made once, and its true poses (N, 4, 4) in the town."""
    drive = simulate(scenario, seed=seed, lidar=lidar, visit=visit, count=count)
    if not (folder / "poses" / "00.txt").exists():
        record(drive, folder, resume=(folder / "sequences" / "00.part").exists())
    return folder, drive.city_poses


def one_seed(root: Path, scenario: str, seed: int, starts: int) -> dict[str, list[float]]:
    """Errors and times of one town."""
    old, old_true = driven(root / f"map-{scenario}-{seed}", scenario, seed, "hdl64", FIRST_VISIT)
    new, new_true = driven(
        root / f"new-{scenario}-{seed}", scenario, seed, "vlp16", Visit(1, is_reversed=True, shift=120.0)
    )
    map_run, located = old / "run", new / "run"
    lslam.run(old, load_config(None, SETTINGS), out=map_run, overwrite=True)
    settings = [f'localize.map="{map_run}"', "loops.use=false", "map.write=false", *SETTINGS]
    began = time.process_time()
    record_of = lslam.run(new, load_config(None, settings), out=located, overwrite=True).record
    cpu = time.process_time() - began
    est = read_trajectory(map_run / "trajectory.tum", "tum").poses
    T_town_map, _, _ = umeyama(est[:, :3, 3], old_true[: len(est), :3, 3])
    truth = se3.inverse(T_town_map) @ new_true[: len(record_of.results)]
    away = np.linalg.norm(record_of.trajectory.positions - truth[:, :3, 3], axis=1)
    held = sum(fix.is_binding for fix in record_of.map_fixes) / len(away)
    found = _starts(map_run, located, truth, starts, seed)
    print(
        f"{scenario} {seed}: ATE {np.sqrt((away**2).mean()):.4f} m, held {held:.3f}, {len(found['start_m'])} starts",
        flush=True,
    )
    return {"ate": [float(np.sqrt((away**2).mean()))], "worst": [float(away.max())], "held": [held],
            "ms": [1e3 * cpu / len(away)], **found}  # fmt: skip


def _starts(map_run: Path, located: Path, truth: Floats, count: int, seed: int) -> dict[str, list[float]]:
    config = load_config(None, [])
    prior_map = read_prior_map(map_run, config.registration)
    search = PlaceSearch(prior_map, config.registration)
    store = KeyframeStore(located / "keyframes")
    rng = np.random.default_rng(seed)
    errors, seconds, refused = [], [], 0
    for first in rng.integers(0, len(store) - KEYFRAMES, count):
        part = PartOfRun(store, int(first), KEYFRAMES)
        began = time.process_time()
        start = PlaceFinder(search, part, config).find()
        seconds.append(time.process_time() - began)
        if start is None:
            refused += 1
            continue
        keyframe = start.vote.keyframe
        T = prior_map.T_map_level @ start.vote.T_level_odometry @ part.keyframes[keyframe].T_world_lidar
        errors.append(float(np.linalg.norm(T[:3, 3] - truth[store.keyframes[first + keyframe].scan, :3, 3])))
    return {"start_m": errors, "start_s": seconds, "refused": [float(refused)]}


def rows_of(found: Sequence[dict[str, list[float]]]) -> list[list[str]]:
    def pooled(name: str) -> list[float]:
        return [value for one in found for value in one[name]]

    starts, wrong = pooled("start_m"), sum(error > WRONG_M for error in pooled("start_m"))
    return [
        ["ATE in the map's frame, m", tables.spread(pooled("ate"), 3)],
        ["farthest pose, m", tables.spread(pooled("worst"), 3)],
        ["share of the scans that the map holds, least", f"{min(pooled('held')):.4f}"],
        ["CPU per scan, odometry and localisation, ms", tables.spread(pooled("ms"), 1)],
        ["starts right, wrong, refused", f"{len(starts) - wrong}, {wrong}, {int(sum(pooled('refused')))}"],
        ["error of a start, m", tables.spread(starts, 3)],
        ["CPU per start, s", tables.spread(pooled("start_s"), 1)],
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="residential-hard")
    parser.add_argument("--starts", type=int, default=25)
    parser.add_argument("--folder", type=Path, help="keeps recordings and runs; default: a temporary one")
    tables.offer(parser)
    args = parser.parse_args()
    seeds = tables.numbers(args.seeds)
    with tempfile.TemporaryDirectory() as temporary:
        root = args.folder or Path(temporary)
        found = [one_seed(root, args.scenario, seed, args.starts) for seed in seeds]
    caption = (
        f"{args.scenario}, {tables.seeds_named(seeds)}: a VLP-16 on the other lane in the opposite direction, with other "
        f"traffic and noise, in the map of an HDL-64; {args.starts} random starts a seed, drives of {KEYFRAMES} keyframes. "
        "Errors in the map's frame without alignment, median / worst."
    )
    tables.table("localising", caption, ["", "value"], rows_of(found), args.write)


if __name__ == "__main__":
    main()
