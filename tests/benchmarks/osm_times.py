"""What a keyframe costs a run on a map: wall extraction, global match, local match (issue 7: 20, 50 and 1 ms at most).

    lslam simulate residential --seed 0 --out drives/residential-0
    python tests/benchmarks/osm_times.py drives/residential-0/sequences/00 [--keyframes 40] [--submap 5]

Keyframes stand at their true poses, the prior of each global match is off by a sigma, and every building within reach has a local
match. Milliseconds of this thread's CPU time, so that others at work on the machine hardly count: median, 95 %, largest.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import thread_time

import numpy as np
from osm import SPACING, true_poses

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.config import Config
from lslam.core.config.backend import OsmConfig
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se2
from lslam.core.types.building import KeyframeMatch
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.trajectory import Keyframe
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.readers import open_sequence
from lslam.odometry.frontend.keyframing import keyframe_cloud
from lslam.osm.location import LevelRun
from lslam.osm.wall_match import match_buildings, match_keyframe, warm_up
from lslam.osm.walls import OsmMap

SIGMA = np.array([0.7, 0.7, np.radians(1.5)])
LIMITS = {"wall extraction": 20.0, "global match": 50.0, "local match": 1.0}


def measured(drive: Path, count: int, size: int) -> dict[str, list[float]]:
    """Milliseconds of each stage, keyframe by keyframe."""
    poses, origin = true_poses(drive)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    scans = np.unique(np.searchsorted(way, SPACING * np.arange(count)).clip(max=len(poses) - 1))
    sequence, store = open_sequence(drive), KeyframeStore()
    for k, scan in enumerate(scans.tolist()):
        still = MotionPrior.at_once(poses[scan])
        cloud = keyframe_cloud(sequence.scan(scan), still, PreprocessConfig())
        store.add(Keyframe(k, scan, scan, poses[scan], None, float(way[scan])), cloud)
    config, osm = OsmConfig(), OsmMap(read_buildings(drive / "map.osm", origin)[1].buildings)
    warm_up()
    rng, found = np.random.default_rng(0), {name: list[float]() for name in LIMITS}
    for k in range(len(store)):
        at = se2.of_se3(poses[scans[k]])
        store.points(k)
        begin = thread_time()
        seen = LevelRun(store, poses[scans], Config(osm=config)).see_walls(k, size)
        walls = thread_time()
        prior = at + SIGMA * rng.standard_normal(3)
        view = match_keyframe(KeyframeMatch(k, *seen, prior, SIGMA, prior, np.zeros((3, 3))), osm, config)
        whole = thread_time()
        match_buildings(view, at, np.zeros(2), osm, config)
        local = (thread_time() - whole) / max(len(osm.near(at[:2], config.use_radius)), 1)
        for name, spent in zip(LIMITS, (walls - begin, whole - walls, local), strict=True):
            found[name].append(1e3 * spent)
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", type=Path, help="folders of simulated sequences, with map.osm in them")
    parser.add_argument("--keyframes", type=int, default=40)
    parser.add_argument("--submap", type=int, default=5, help="keyframes in the submap walls are seen in")
    args = parser.parse_args()
    print(f"{'ms per keyframe; local: per building':44s} {'median':>8s} {'95 %':>8s} {'largest':>8s} {'limit':>8s}")
    for drive in args.drives:
        for name, times in measured(drive, args.keyframes, args.submap).items():
            row = (np.median(times), np.percentile(times, 95), max(times), LIMITS[name])
            label = f"{drive.parent.parent.name}, {name}"
            print(f"{label:44s} " + " ".join(f"{value:8.2f}" for value in row), flush=True)


if __name__ == "__main__":
    main()
