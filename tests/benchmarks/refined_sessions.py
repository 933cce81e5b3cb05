"""`--refine` of merged drives, and of a drive located in the map of another, beside the same without it.

    python tests/benchmarks/refined_sessions.py [--seeds 321-325] [--folder DIR] [--write docs/results.md]

Two drives of a VLP-16 through one town, with other traffic and noise, the second from a shifted start. `+ drift` is odometry that
was made to drift by 1 % and 1 deg/100 m. The error of merged drives is that of all their poses, aligned once (se3); that of a
located drive the one in the frame of the map, which is aligned to the town by the poses of its run.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from pathlib import Path

import numpy as np
import tables
from localising import driven
from numpy.typing import NDArray
from sessions import ate

import lslam
from lslam.core.config import load_config
from lslam.core.geometry import se3
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.pipeline.merged_folder import merge_into
from lslam.pipeline.watch import Watch
from lslam.simulation.routes import FIRST_VISIT, Visit

Floats = NDArray[np.float64]
DRIFT = ("debug.drift=true", "debug.drift_percent=1", "debug.drift_deg_per_100m=1")
# Scenario, second visit, scans of both, and settings of their runs; a map that drifted is no frame of truth.
TOWNS: dict[str, tuple[str, Visit, tuple[int, int], tuple[str, ...]]] = {
    "block, reversed": ("block", Visit(1, is_reversed=True, shift=40.0), (120, 100), ()),
    "residential": ("residential", Visit(1, shift=40.0), (150, 120), ()),
    "residential + drift": ("residential", Visit(1, shift=40.0), (150, 120), DRIFT),
}
Row = tuple[float, float, float, bool]


def positions(path: Path) -> Floats:
    """(N, 3) m of a trajectory."""
    return read_trajectory(path, "tum").positions


def one_town(root: Path, name: str, seed: int) -> dict[str, Row]:
    """ATE without and with it, m, share by which planes are thinner, %, and whether it was taken: merged, and located."""
    scenario, visit, counts, settings = TOWNS[name]
    sessions = []
    for number, (one, count) in enumerate(zip((FIRST_VISIT, visit), counts, strict=True)):
        folder, town = driven(root / f"{scenario}-{seed}-{number}", scenario, seed, "vlp16", one, count)
        run = folder / f"run-{len(settings)}-{number}"
        config = load_config(None, ["report.html=false", *settings], {})
        lslam.run(folder, config, out=run, overwrite=True)
        sessions.append((folder, run, town))
    (_, map_run, map_town), (new, _, new_town) = sessions
    merged, located = [], []
    for refine in ("false", "true"):
        config = load_config(None, ["map.write=false", f"graph.refine={refine}"], {})
        facts = merge_into([run for _, run, _ in sessions], root / "merged", config, Watch(), overwrite=True)
        est = [positions(root / "merged" / "sessions" / f"{run.name}.tum") for _, run, _ in sessions]
        merged.append(ate(est, [town[: len(e), :3, 3] for e, (_, _, town) in zip(est, sessions, strict=True)]))
    found = {f"{name}, merged": _row(merged, facts["refinement"])}
    if settings:
        return found
    frame = positions(map_run / "trajectory.tum")
    T_town_map, _, _ = se3.umeyama(frame, map_town[: len(frame), :3, 3])
    for refine in ("false", "true"):
        words = [f'localize.map="{map_run}"', "loops.use=false", "map.write=false", f"graph.refine={refine}"]
        record = lslam.run(new, load_config(None, ["report.html=false", *words], {})).record
        away = se3.apply(T_town_map, record.trajectory.positions) - new_town[: len(record.results), :3, 3]
        located.append(float(np.sqrt(np.mean(np.sum(away**2, axis=1)))))
    return {**found, f"{name}, located": _row(located, record.manifest["refinement"])}


def _row(errors: list[float], facts: dict[str, float | bool]) -> Row:
    return errors[0], errors[1], float(facts.get("thinner_percent", 0.0)), bool(facts["is_taken"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="keeps recordings and runs; default: a temporary one")
    parser.add_argument("--towns", default=";".join(TOWNS), help="separated by semicolons")
    tables.offer(parser, "321-325")
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.CRITICAL)
    seeds, found = tables.numbers(args.seeds), dict[str, list[Row]]()
    with tempfile.TemporaryDirectory() as temporary:
        for name in args.towns.split(";"):
            for seed in seeds:
                for row, values in one_town(args.folder or Path(temporary), name, seed).items():
                    found.setdefault(row, []).append(values)
                    print(row, seed, *values, flush=True)
    rows = []
    for name, runs in found.items():
        before, after, thinner, taken = zip(*runs, strict=True)
        ratio = [b / a for a, b in zip(before, after, strict=True)]
        rows.append([
            name, tables.spread(before, 4), tables.spread(after, 4), tables.spread(ratio), f"{np.median(thinner):.0f}",
            f"{sum(taken)} of {len(taken)}",
        ])  # fmt: skip
    caption = (
        f"`icp`, {tables.seeds_named(seeds)}, median / worst: ATE, m, of all poses of two merged drives, aligned once (se3), and "
        "of the second drive in the map of the first, in the map's frame, without and with `--refine`, their ratio, by how much "
        "planes of the points kept out are thinner, %, and in how many runs it was taken."
    )
    heads = ["drives", "ATE", "ATE refined", "ratio", "thinner", "taken"]
    tables.table("refined-sessions", caption, heads, rows, args.write)


if __name__ == "__main__":
    main()
