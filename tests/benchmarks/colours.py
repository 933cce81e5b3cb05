"""Colours of map points against the surfaces that they are of, on simulated drives with a camera.

    python tests/benchmarks/colours.py [--seeds 321-325] [--drives urban,walk] [--write docs/results.md]

The true surface of a map point is that of most of the scan points in its voxel. A point is right if its colour is nearer to
that of its surface, in the mean exposure, than to that of any other. Leaves are foliage, crowns and hedges, where a pixel shows
several things.
"""

from __future__ import annotations

import argparse
import logging
import time
from typing import NamedTuple

import numpy as np
import tables
from traced import Traced, run_on

from lslam.core.config import Config, load_config
from lslam.core.geometry import se3
from lslam.maps.colour import GREY
from lslam.pipeline.further_passes import colour_map
from lslam.pipeline.map_pass import build_map, scan_poser
from lslam.simulation import lidar
from lslam.simulation.camera import COLOURS, SimulatedCamera
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import Surface

# Scenario, sensor, scans, and settings of the map.
DRIVES: dict[str, tuple[str, str, int, tuple[str, ...]]] = {
    "urban, cleaned": ("urban", "hdl64", 40, ("map.clean=true",)),
    "urban": ("urban", "hdl64", 40, ()),
    "residential, cleaned": ("residential", "hdl64", 40, ("map.clean=true",)),
    "walk": ("walk", "os1-64", 40, ()),
}
LEAVES = (Surface.FOLIAGE, Surface.CROWN, Surface.HEDGE)


class Score(NamedTuple):
    """Shares of the points: seen in images; of those right, all of them and without leaves. And s per image."""

    seen: float
    right: float
    solid: float
    s_per_image: float


class FilmedDrive(Traced):
    """A traced drive with its camera, whose images are rendered once."""

    def __init__(self, scenario: str, model: str, count: int, seed: int) -> None:
        drive = simulate(scenario, seed=seed, lidar=model, count=count)
        super().__init__(drive)
        self.film = SimulatedCamera(drive)
        images = [self.film.image(k) for k in range(len(self.film))]
        self._camera = self.film.camera
        object.__setattr__(self._camera, "load", images.__getitem__)

    def cameras(self) -> list[object]:
        return [self._camera]


def scored(drive: FilmedDrive, settings: tuple[str, ...]) -> Score:
    results = run_on(drive, "map.write=false", "loops.use=false").record.results
    config = load_config(settings=settings, environ={})
    merged = build_map(drive, results, config).cloud  # type: ignore[arg-type]
    begin = time.perf_counter()
    coloured, _ = colour_map(merged, drive, results, config)  # type: ignore[arg-type]
    spent = time.perf_counter() - begin
    points = np.concatenate([block.points for block in merged.blocks()])
    colours = coloured.colours
    truth = surfaces_of(drive, results, config, points)
    level = np.exp(np.log(drive.film.gains).mean())
    palette = np.clip(level * COLOURS, 0, 255)
    apart = np.abs(colours[:, None].astype(float) - palette).sum(2)
    seen = ~(colours == GREY).all(1)
    solid = seen & ~np.isin(truth, LEAVES)
    right = apart[np.arange(len(truth)), truth] <= apart.min(1)
    return Score(seen.mean(), right[seen].mean(), right[solid].mean(), spent / len(drive.film))


def surfaces_of(drive: FilmedDrive, results: list, config: Config, points: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
    """(M,) the surface of most of the scan points in the voxel of each map point."""
    keys = voxel_keys(points, config.map.voxel)
    order = np.argsort(keys)
    counts = np.zeros((len(points), len(Surface)), np.int32)
    poser = scan_poser(results, config)
    for k in range(len(drive)):
        scan = drive.scan(k)
        posed = poser(scan)
        if posed is None:
            continue
        r = np.linalg.norm(posed.points, axis=1)
        inside = (r >= config.map.range_min) & (r <= config.map.range_max)
        own = voxel_keys(se3.apply(posed.T_world_lidar, posed.points[inside].astype(float)), config.map.voxel)
        at = np.minimum(np.searchsorted(keys, own, sorter=order), len(keys) - 1)
        same = keys[order[at]] == own
        np.add.at(counts, (order[at[same]], scan.labels[inside][same]), 1)
    return np.asarray(counts.argmax(1))


def voxel_keys(points: np.ndarray, voxel: float) -> np.ndarray:
    return np.asarray(np.floor(points / voxel).astype(np.int64) @ np.array([1 << 42, 1 << 21, 1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", default=";".join(DRIVES), help="names with semicolons between them")
    tables.offer(parser, "321-325")
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    # Points are labelled by their surfaces, whether they move or not.
    lidar.LABELS[:] = np.arange(len(Surface))
    seeds = tables.numbers(args.seeds)
    scores: dict[str, list[Score]] = {}
    drives: dict[tuple[str, int], FilmedDrive] = {}
    for seed in seeds:
        for name in args.drives.split(";"):
            scenario, model, count, settings = DRIVES[name]
            if (scenario, seed) not in drives:
                drives = {(scenario, seed): FilmedDrive(scenario, model, count, seed)}
            scores.setdefault(name, []).append(scored(drives[scenario, seed], settings))
            print(name, seed, *(f"{value:.4f}" for value in scores[name][-1]), flush=True)
    rows = []
    for name, runs in scores.items():
        seen, right, solid, spent = (np.array(column) for column in zip(*runs, strict=True))
        shares = [f"{100 * np.median(s):.1f} / {100 * s.min():.1f}" for s in (seen, right, solid)]
        rows.append([name, *shares, f"{np.median(spent):.2f}"])
    caption = (
        f"{tables.seeds_named(seeds)}, median / worst, map voxels of 0.2 m, poses of `icp`, images of 400 x 300 pixels: points "
        "that an image shows, % of the map; of these those in the colour of their surface, %, all and without leaves; and s per "
        "image."
    )
    tables.table("colours", caption, ["drive", "seen", "right", "without leaves", "time"], rows, args.write)


if __name__ == "__main__":
    main()
