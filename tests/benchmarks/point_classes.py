"""How well geometry tells the classes of points, against the surfaces that simulated rays met: `osm.label_source`.

    python tests/benchmarks/point_classes.py [--seeds 300-304] [--scenario urban-hard] [--lidar NAME] [--places 6]
        [--write docs/results.md]

Submaps of five scans 2 m apart at the true poses, thinned as keyframes are. Fences, people and what else stands about have no
class of their own and are left out of the figures. IoU is what both call so over what either does.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import tables
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "osm"))

from point_truth import NAMES, confusion, scores


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="urban-hard")
    parser.add_argument("--lidar")
    parser.add_argument("--places", type=int, default=6)
    tables.offer(parser)
    args = parser.parse_args()
    seeds = tables.numbers(args.seeds)
    figures: list[NDArray[np.float64]] = []
    for seed in seeds:
        counts = confusion(args.scenario, seed, args.lidar, args.places)
        figures.append(scores(counts))
        print(seed, np.round(figures[-1], 2).tolist(), counts.astype(int).tolist(), flush=True)
    rows = [
        [name, *(f"{np.median(column):.2f} / {np.min(column):.2f}" for column in np.array(figures)[:, k].T)]
        for k, name in enumerate(NAMES)
    ]
    caption = (
        f"`{args.scenario}`, {tables.seeds_named(seeds)}, {args.places} submaps each of five scans, median / worst: classes by "
        "geometry against the surfaces that the rays met, fences and people left out."
    )
    tables.table("point-classes", caption, ["class", "precision", "recall", "IoU"], rows, args.write)


if __name__ == "__main__":
    main()
