"""What classes of points bring to the matching with buildings, in a town of trees, hedges and parked cars: osm.labels.

    python tests/benchmarks/osm_labels.py [--seeds 300-304] [--scans 150] [--modes prior,rigid,non-rigid,two-level,baseline]
        [--choices all,building,geometry] [--keep FOLDER] [--write docs/results.md]

Drives of `urban-hard` with the true class of every point. Odometry is run once per drive, with drift that wanders; the graph is
made again for every mode, map and choice of points. Scored as tests/benchmarks/osm.py does: ATE planar from the true start,
and the buildings held from two sides.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import osm
import tables

import lslam
from lslam.core.config.config import load_config
from lslam.pipeline.again import open_again, read_for_graph
from lslam.pipeline.run import run
from lslam.simulation.record import record
from lslam.simulation.scenarios import simulate

CHOICES = {"all": ("[]", "recording"), "building": ("building", "recording"), "geometry": ("building", "geometry")}


def drive_of(seed: int, scans: int, parent: Path) -> Path:
    """The drive with its labels; made now unless it is there already."""
    folder = parent / f"urban-hard-{seed}"
    if not (folder / "sequences" / "00" / "manifest.json").is_file():
        record(simulate("urban-hard", seed=seed, count=scans), folder, resume=True, has_labels=True)
    return folder / "sequences" / "00"


def settings_of(args: argparse.Namespace, drive: Path, mode: str, which: str, choice: str) -> Iterator[str]:
    """What differs between the graphs of one drive."""
    is_baseline = mode == "baseline"
    config = osm.configured(drive, args, "two-level" if is_baseline else mode, which, "wandering", 0).osm
    yield f"osm.matcher={'baseline' if is_baseline else 'walls'}"
    yield from (f"osm.{key}={getattr(config, key)}" for key in ("extract", "mode", "heading_deg", "start_radius"))
    yield from (f"osm.origin={list(config.origin or ())}", "osm.start_heading_deg=5.0", "osm.hold_start=true")
    yield from (f"osm.labels={CHOICES[choice][0]}", f"osm.label_source={CHOICES[choice][1]}")


def odometry_of(args: argparse.Namespace, drive: Path, seed: int, out: Path) -> Path:
    """A run that the graphs take their odometry from; made now unless it is there already."""
    if not (out / "timing.csv").is_file():
        settings = [f"input.count={args.scans}", "loops.use=false", "map.write=false", "report.html=false",
                    "debug.drift=true", "debug.drift_percent=3.0", "debug.drift_deg_per_100m=2.0", "debug.drift_memory=20",
                    f"debug.drift_seed={seed}", *settings_of(args, drive, "two-level", "exact", "building")]  # fmt: skip
        lslam.run(str(drive), load_config(settings=settings), out=out, overwrite=True)
    return out


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=150)
    parser.add_argument("--modes", default="prior,rigid,non-rigid,two-level,baseline")
    parser.add_argument("--maps", default="exact,perturbed")
    parser.add_argument("--choices", default=",".join(CHOICES))
    parser.add_argument("--keep", type=Path, help="folder for drives and runs")
    tables.offer(parser)
    args = parser.parse_args()
    args.drift = "3.0,2.0"
    logging.getLogger("lslam").setLevel(logging.ERROR)
    cases = list(product(args.maps.split(","), args.modes.split(","), args.choices.split(",")))
    found: dict[tuple[str, str, str], list[osm.Found]] = {case: [] for case in cases}
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.keep or Path(scratch)
        for seed in tables.numbers(args.seeds):
            drive = drive_of(seed, args.scans, folder)
            earlier = odometry_of(args, drive, seed, folder / f"odometry-{seed}")
            for which, mode, choice in cases:
                out = folder / f"graph-{seed}-{which}-{mode}-{choice}"
                if not (out / "timing.csv").is_file():
                    known = read_for_graph(earlier, list(settings_of(args, drive, mode, which, choice)))
                    run(open_again(known), known.config, out=out, overwrite=True, earlier=known)
                found[which, mode, choice].append(osm.found_by(out, drive, which))
                print(found[which, mode, choice][-1].row(f"{seed} {which} {mode} {choice}"), flush=True)
    rows = []
    for which, mode in dict.fromkeys((which, mode) for which, mode, _ in cases):
        cells = []
        for choice in args.choices.split(","):
            some = found[which, mode, choice]
            houses = [float(np.median([e.after for e in f.two])) for f in some if f.two]
            cells.append(f"{tables.spread(f.ate for f in some)}; {tables.spread(houses) if houses else '-'}")
        rows.append([mode, which, *cells])
    caption = (
        f"`urban-hard` with true classes, {tables.seeds_named(tables.numbers(args.seeds))}, {args.scans} scans, 3 % and "
        "2 deg/100 m of drift that wanders, no loops, the start known, median / worst: ATE (planar, origin), m; error of "
        "buildings held from two sides, m. Walls are made of all points, of the class `building`, or of what geometry takes "
        "for walls."
    )
    tables.table("osm-labels", caption, ["mode", "map", *args.choices.split(",")], rows, args.write)


if __name__ == "__main__":
    main()
