"""Real runs with a part of their loops replaced by wrong ones: what the result loses.

    python tests/benchmarks/wrong_loops.py SEQUENCE... [--share 0.3] [--seeds 3] [--set KEY=VALUE]

Odometry is run once per sequence; per seed it drifts (debug.drift), its loops are found anew, and `share` of them are put
metres away. ATE is that of the keyframes, se3: of odometry, with all right loops, with those that the replaced ones leave and
nothing wrong, and with the wrong ones among them; `ratio` is the last over the second, `fair` over the third, which knows no
more. `kept` counts wrong loops that were believed, `lost` right ones that were not.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

import numpy as np
from scores import ate

from lslam.backend import added_drift
from lslam.backend.loops.find_loops import find_loops
from lslam.backend.optimise import run_back_end
from lslam.backend.outcome import BackEnd
from lslam.core.config import Config, load_config
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.associate import associate
from lslam.odometry.frontend.register_scans import to_trajectory
from lslam.pipeline.job import prepare
from lslam.pipeline.odometry_pass import estimate_poses
from lslam.pipeline.watch import Watch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from false_loops import with_false_loops


def error(results: list[ScanResult], truth: Trajectory) -> float:
    matches = associate(to_trajectory(results, ""), truth, 0.01, 0)
    return ate(matches.estimate, matches.truth)


def believed(done: BackEnd) -> set[tuple[int, int]]:
    return {(c.a, c.b) for c in done.candidates if c.verdict == "accepted"}


def measure(path: str, config: Config, share: float, seeds: int) -> None:
    job = prepare(path, config, None, "", Watch())
    sequence, truth, store = job.sequence, job.truth, job.store
    if truth is None:
        sys.exit(f"{path} has no ground truth")
    record = estimate_poses(job)
    print(f"{path}: {len(record.results)} scans, {len(store)} keyframes")
    for seed in range(seeds):
        results = added_drift.with_drift(record.results, config.debug.model_copy(update={"drift_seed": seed}))
        store.keyframes = added_drift.moved_keyframes(store.keyframes, results)
        candidates = find_loops(store, config.loops, config.registration, config.keyframes.submap_size)
        right = run_back_end(sequence, results, store, config, candidates)
        mixed, wrong = with_false_loops(candidates, share, np.random.default_rng(seed))
        fewer = [c for c in candidates if (c.a, c.b) not in wrong]
        rest, done = (run_back_end(sequence, results, store, config, some) for some in (fewer, mixed))
        before, best, bare, after = (error(r, truth) for r in (results, right.results, rest.results, done.results))
        kept, lost = believed(done) & wrong, believed(right) - believed(done) - wrong
        print(
            f"{seed:4} {before:9.3f} {best:9.4f} {bare:9.4f} {after:9.4f} {after / best:6.2f} {after / bare:6.2f} "
            f"{len(believed(right)):6} {len(wrong):6} {len(kept):5} {len(lost):5}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--share", type=float, default=0.3)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--set", action="append", default=[], dest="settings")
    args = parser.parse_args()
    logging.getLogger("lslam").setLevel(logging.ERROR)
    print(
        f"{'seed':>4} {'odometry':>9} {'right':>9} {'fewer':>9} {'mixed':>9} {'ratio':>6} {'fair':>6} {'loops':>6} {'wrong':>6} "
        f"{'kept':>5} {'lost':>5}"
    )
    for path in args.sequences:
        measure(path, load_config(None, args.settings, {}), args.share, args.seeds)


if __name__ == "__main__":
    main()
