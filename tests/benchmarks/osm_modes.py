"""Each mode of the map on maps that are exact, off as a whole, or wrong house by house.

    python tests/benchmarks/osm_modes.py [--drifts 100-104] [--write docs/theses.md]

The runs of tests/osm/wrong_maps.py: sample_data under a random walk, without loops.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from pathlib import Path

import numpy as np
import tables

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "osm"))

from wrong_maps import DRAWN, MODES, OFF, SHIFT, on


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drifts", default=tables.SEEDS)
    tables.offer(parser, None)
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    drifts = tables.numbers(args.drifts)
    maps = {
        f"exact, the start given {np.hypot(*OFF):.1f} m off": ("exact", OFF, 1.0),
        f"{np.hypot(*SHIFT):.1f} m off as a whole, the start known": ("shifted", (0.0, 0.0), 0.3),
        f"each house {DRAWN:g} m off, the start known": ("houses", (0.0, 0.0), 0.3),
    }
    rows = []
    for name, (kind, off, radius) in maps.items():
        with tempfile.TemporaryDirectory() as folder:
            found = on(Path(folder), kind, off, radius, drifts)
        cells = [
            f"{tables.spread(f.trajectory for f in found[mode])}; {tables.spread(f.buildings for f in found[mode])}"
            for mode in MODES
        ]
        rows.append([name, *cells])
        print(rows[-1], flush=True)
    caption = (
        f"Mean error on the Earth, m, and median error of the buildings, m, each median / worst of {tables.seeds_named(drifts)} "
        "of the drift (a random walk, 1 % and 0.5 deg/100 m), sample_data (95 scans, 114 m), no loops, `osm.hold_start`."
    )
    tables.table("osm-modes", caption, ["map", *MODES], rows, args.write)


if __name__ == "__main__":
    main()
