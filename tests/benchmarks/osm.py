"""What OpenStreetMap brings, system by system and mode by mode, where everything is known: Del Tufo's tables 4.2 and 4.3.

    python tests/benchmarks/osm.py [--seeds 100-104] [--scans 150] [--map exact,perturbed] [--drift 3.0,2.0]
        [--kinds constant,wandering,random-walk] [--write docs/theses.md]
        [--modes none,hdl,thesis-baseline,thesis-improved,prior,rigid,non-rigid,two-level]
    lslam simulate residential --path poses/07.txt --out drives/seq07
    python tests/benchmarks/osm.py drives/*/sequences/00           or drives of one's own, with map.osm in them

Every run begins at the true start, without loops and with drift injected (% of the way, deg per 100 m), which lasts, wanders (is
drawn anew after 20 m) or walks at random; modes that are presets with their own odometry, the rest with ours. ATE is the thesis'
(planar, origin, mean and standard deviation), RPE between consecutive keyframes; buildings with the run begun at its true start:
median distance of their middles from the truth, of those held from two sides as on the map and corrected, across the wall of
those held from one. Times are ms per keyframe: to find walls, to match them with the whole map, with one building each, and of
the graph.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray

import lslam
from lslam.core.config import Config
from lslam.core.config.config import load_config
from lslam.core.geometry import geodesy, se2
from lslam.evaluation.thesis import planar
from lslam.evaluation.timing import read_timing_rows
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.osm.buildings_geojson import read_buildings_geojson
from lslam.osm.corrections import BUILDINGS_GEOJSON
from lslam.simulation.osm_extract import read_perturbation
from lslam.studies.subjects import Scene, simulate_once

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from building_errors import BuildingError, building_errors, map_errors

Floats = NDArray[np.float64]

SPACING = 2.0  # m between keyframes
PRESETS = ("hdl", "thesis-baseline", "thesis-improved")
MODES = ("none", *PRESETS, "prior", "rigid", "non-rigid", "two-level")
KINDS = {
    "constant": (),
    "wandering": ("debug.drift_memory=20",),
    "random-walk": ("debug.drift_kind=random-walk",),
}
# Of drift, map and mode.
Case = tuple[str, str, str]
STAGES = ("walls", "map match", "building match", "graph")


def true_poses(drive: Path) -> tuple[Floats, Floats]:
    """Poses T_enu_lidar of all scans of a simulated drive, and the origin of that frame."""
    world = tomllib.loads((drive / "truth" / "world.toml").read_text())
    poses = read_trajectory(drive / "truth" / "trajectory.tum").poses
    return np.array(world["T_enu_world"]) @ poses, np.array(world["origin_lat_lon_alt"])


def configured(drive: Path, args: argparse.Namespace, mode: str, which: str, kind: str, seed: int) -> Config:
    """The run of one line of the table."""
    poses, origin = true_poses(drive)
    start = geodesy.from_local(poses[:1, :3, 3], origin)[0]
    percent, deg = (float(v) for v in args.drift.split(","))
    settings = [f"input.count={args.scans}", "loops.use=false", "map.write=false", f"debug.drift_seed={seed}",
                f"debug.drift={str(percent > 0).lower()}", f"debug.drift_percent={percent}", *KINDS[kind],
                f"debug.drift_deg_per_100m={deg}"]  # fmt: skip
    if mode in PRESETS:
        settings += [f"odometry.preset={mode}"]
    if mode not in ("none", "hdl"):
        extract = drive / ("map.osm" if which == "exact" else "map_perturbed.osm")
        heading = 90.0 - np.degrees(se2.of_se3(poses[0])[2])
        settings += [f"osm.extract={extract}", f"osm.origin={start.tolist()}", f"osm.heading_deg={heading}",
                     "osm.start_heading_deg=5.0"]  # fmt: skip
        if mode not in PRESETS:
            settings += [f"osm.mode={mode}", "osm.start_radius=2.0", "osm.hold_start=true"]
    return load_config(settings=settings)


def buildings_of(folder: Path, drive: Path, which: str, found: Floats) -> list[BuildingError]:
    """Errors of a run's buildings; of the exact map the truth is that nothing moves."""
    if not (folder / BUILDINGS_GEOJSON).is_file():
        return []
    poses, origin = true_poses(drive)
    corrected = read_buildings_geojson(folder / BUILDINGS_GEOJSON)
    truth = {c.building.osm_id: np.zeros(3) for c in corrected.buildings}
    if which != "exact":
        exact = read_buildings(drive / "map.osm", origin)[1].buildings
        truth = map_errors(exact, read_perturbation(drive / "truth" / "map_perturbation.json"))
    first = geodesy.to_local(geodesy.from_local(found[:1, :3, 3], corrected.origin), origin)[0]
    return building_errors(corrected, truth, origin, (poses[0, :3, 3] - first)[:2])


@dataclass(frozen=True)
class Found:
    """What a run came to.

    ate, std, rpe : planar, from the start, m; turn : deg; two, one : errors of buildings held from two sides and one; spent :
    ms per keyframe of each of STAGES
    """

    ate: float
    std: float
    rpe: float
    turn: float
    two: list[BuildingError]
    one: list[BuildingError]
    spent: list[float]

    def row(self, name: str) -> str:
        two, one = self.two, self.one
        return (
            f"{name:50s} {self.ate:6.3f} ± {self.std:5.3f} {self.rpe:8.4f} {self.turn:8.4f}  {len(two):4d} "
            f"{_median([e.before for e in two])} {_median([e.after for e in two])} {len(one):4d} "
            f"{_median([e.across for e in one])} " + " ".join(f"{ms:7.1f}" for ms in self.spent)
        )


def found_by(folder: Path, drive: Path, which: str) -> Found:
    """One run, scored."""
    run = read_trajectory(folder / "trajectory.tum")
    poses, _ = true_poses(drive)
    real = poses[: len(run.poses)]
    whole = planar(run.poses, real)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(real[:, :2, 3], axis=0), axis=1))])
    kept = np.unique(np.searchsorted(way, np.arange(0.0, way[-1], SPACING)))
    steps = planar(run.poses[kept], real[kept])
    errors = [e for e in buildings_of(folder, drive, which, run.poses) if e.status == "seen"]
    rows = read_timing_rows(folder / "timing.csv").back_end
    return Found(
        whole.ate_mean,
        whole.ate_std,
        steps.rpe_translation_mean,
        float(np.degrees(steps.rpe_rotation_std)),
        [e for e in errors if e.sides == 2],
        [e for e in errors if e.sides == 1],
        [1e3 * rows.get(stage, np.zeros(1)).sum() / len(kept) for stage in STAGES],
    )


def _median(values: list[float]) -> str:
    return f"{np.median(values):7.3f}" if values else "      -"


def measured(args: argparse.Namespace, folder: Path) -> dict[Case, list[Found]]:
    """All runs, by kind of drift, map and mode."""
    drives = args.drives or [simulate_once(Scene("residential"), seed, folder) for seed in tables.numbers(args.seeds)]
    print(
        f"{'drive, drift, map, mode':50s} {'ATE, m':>14s} {'RPE, m':>8s} {'RPE, deg':>8s}  {'two':>4s} {'map, m':>7s} "
        f"{'run, m':>7s} {'one':>4s} {'run, m':>7s} {'walls':>7s} {'map':>7s} {'house':>7s} {'graph':>7s}"
    )
    found: dict[Case, list[Found]] = {}
    for seed, drive in enumerate(drives):
        for kind, mode in product(args.kinds.split(","), args.modes.split(",")):
            for which in args.map.split(",") if mode not in ("none", "hdl") else ["-"]:
                name = f"{drive.parent.parent.name}, {kind}, {which}, {mode}"
                config = configured(drive, args, mode, which, kind, seed)
                out = folder / name.replace(", ", "_")
                lslam.run(str(drive), config, out=out, overwrite=True)
                found.setdefault((kind, which, mode), []).append(found_by(out, drive, which))
                print(found[kind, which, mode][-1].row(name), flush=True)
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="*", type=Path, help="folders of simulated sequences, in place of --seeds")
    parser.add_argument("--scans", type=int, default=150)
    parser.add_argument("--modes", default=",".join(MODES))
    parser.add_argument("--map", default="exact,perturbed")
    parser.add_argument("--kinds", default="wandering,constant", help="of drift")
    parser.add_argument("--drift", default="3.0,2.0", help="PERCENT,DEG_PER_100M; 0,0: none")
    parser.add_argument("--keep", type=Path, help="folder for drives and runs")
    tables.offer(parser)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as scratch:
        found = measured(args, args.keep or Path(scratch))
    percent, deg = args.drift.split(",")
    drives = (
        f"{len(args.drives)} drives"
        if args.drives
        else f"`residential`, {tables.seeds_named(tables.numbers(args.seeds))}"
    )
    caption = (
        f"{drives}, {args.scans} scans, median / worst: ATE as Del Tufo defines it (planar, origin: first pose and "
        f"heading on the true ones), mean over the scans, m; RPE from keyframe to keyframe, m; {percent} % and {deg} deg/100 m "
        "of drift put into odometry; no loops; the start is known (`osm.hold_start`)."
    )
    kinds, systems = args.kinds.split(","), list(dict.fromkeys((which, mode) for _, which, mode in found))
    rows = []
    for which, mode in systems:
        runs = [found[kind, which, mode] for kind in kinds]
        cells = [f"{tables.spread(f.ate for f in some)}; {tables.spread((f.rpe for f in some), 3)}" for some in runs]
        rows.append([mode, which, *cells])
    tables.table("osm", caption, ["system or mode", "map", *(f"{kind}: ATE; RPE" for kind in kinds)], rows, args.write)
    with_map = [(which, mode) for which, mode in systems if which != "-"]
    caption = (
        f"The same runs ({kinds[0]}), ms per keyframe, median; the thesis: walls 464, map match 996, local match 0.8."
    )
    rows = []
    for which, mode in with_map:
        spent = np.median([f.spent for f in found[kinds[0], which, mode]], axis=0)
        rows.append([mode, which, *(f"{ms:.1f}" for ms in spent)])
    tables.table("osm-times", caption, ["system or mode", "map", *STAGES], rows, args.write)


if __name__ == "__main__":
    main()
