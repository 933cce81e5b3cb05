"""Loop detection: time of a Scan Context query by the number of places, and recall and accuracy on simulated drives.

    python tests/benchmarks/loops.py [--places 5000] [--drives urban:850,small-eight:620] [--drift 1.0] [--turn 0.5]

A query compares one place with all others, none excluded by odometry. The drives are traced at their keyframes only, at
true poses; the odometry given to the detector has the drift of `--drift` (% of the distance) and `--turn` (deg per 100 m).
Recall counts the keyframes tried that lie within 8 m of one passed earlier; a closure is false when it is off by 0.5 m.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.loops.find_loops import find_loops
from lslam.backend.loops.scan_context import PlaceIndex
from lslam.core.config.backend import KeyframesConfig, LoopsConfig
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.trajectory import Keyframe
from lslam.odometry.frontend.keyframing import keyframe_cloud
from lslam.simulation.scenarios import simulate

Floats = NDArray[np.float64]


def seconds(call: Callable[[], object], rounds: int = 20) -> float:
    """Median over the rounds, after one that is not counted."""
    call()
    taken = []
    for _ in range(rounds):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return float(np.median(taken))


def time_queries(places: int) -> None:
    rng = np.random.default_rng(0)
    index = PlaceIndex()
    print(f"{'places':>8} {'query ms':>9}")
    wanted = [n for n in (100, 1000) if n < places] + [places]
    for k in range(places + 2):
        if k - 1 in wanted:
            others = np.arange(k - 1)
            print(f"{k - 1:8} {1e3 * seconds(lambda others=others, k=k: index.nearest(k - 1, others)):9.2f}")
        index.add(k, rng.uniform([-70, -70, -2], [70, 70, 8], (3000, 3)).astype(np.float32))


def drive(name: str, scans: int, seed: int, scale: float, turn: float) -> tuple[KeyframeStore, Floats]:
    """Keyframes of a simulated drive with drifted odometry, and their true poses (K, 4, 4)."""
    sequence = simulate(name, seed=seed, count=scans, motion_compensated=True)
    assert sequence.ground_truth is not None
    poses = sequence.ground_truth.poses
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    store, config = KeyframeStore(), KeyframesConfig()
    chosen: list[int] = []
    odometry = poses[0]
    for i in range(len(poses)):
        if chosen:
            step = se3.relative(poses[chosen[-1]], poses[i])
            if np.linalg.norm(step[:3, 3]) < config.distance and so3.angle(step[:3, :3]) < np.deg2rad(config.angle_deg):
                continue
            length = travelled[i] - travelled[chosen[-1]]
            bend = np.deg2rad(turn) * length / 100
            step[:3, 3] *= 1 + scale / 100
            odometry = odometry @ step @ se3.make(so3.exp(np.array([0.0, 0.0, bend])), np.zeros(3))
        still = MotionPrior.at_once(np.eye(4))
        cloud = keyframe_cloud(sequence.scan(i), still, PreprocessConfig())
        stamp = int(sequence.stamps_ns[i])
        store.add(Keyframe(len(chosen), i, stamp, odometry, None, float(travelled[i])), cloud)
        chosen.append(i)
    return store, poses[chosen]


def measure(name: str, scans: int, seed: int, scale: float, turn: float) -> None:
    store, true = drive(name, scans, seed, scale, turn)
    config = LoopsConfig()
    find_loops(store, config, RegistrationConfig())
    began = time.perf_counter()
    candidates = find_loops(store, config, RegistrationConfig())
    taken = time.perf_counter() - began
    distance = np.array([k.distance for k in store.keyframes])

    def is_revisit(b: int) -> bool:
        older = np.flatnonzero(distance[b] - distance >= config.min_travel)
        return bool((np.linalg.norm(true[older, :3, 3] - true[b, :3, 3], axis=1) < 8).any())

    revisits = {c.b for c in candidates if c.stage != "thinned" and is_revisit(c.b)}
    closures = [c.constraint for c in candidates if c.verdict == "accepted" and c.constraint is not None]
    wrong = [se3.relative(se3.relative(true[c.a], true[c.b]), c.T_a_b) for c in closures]
    metres = np.array([np.linalg.norm(T[:3, 3]) for T in wrong])
    degrees = np.array([np.rad2deg(so3.angle(T[:3, :3])) for T in wrong])
    recall = len(revisits & {c.b for c in closures}) / max(len(revisits), 1)
    spread = f"{np.median(metres):8.3f} {metres.max():7.3f} {np.median(degrees):8.3f}" if len(metres) else " none"
    print(
        f"{name:14} {seed:4} {len(store):9} {distance[-1]:7.0f} {len(revisits):8} {recall:7.2f} {len(closures):8} "
        f"{(metres > 0.5).sum():5} {spread} {1e3 * taken / len(store):10.1f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=5000)
    parser.add_argument("--drives", default="small-eight:620,urban:850,residential:1150,closed:850,identical:300")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--drift", type=float, default=1.0)
    parser.add_argument("--turn", type=float, default=0.5)
    args = parser.parse_args()
    time_queries(args.places)
    print(
        f"{'drive':14} {'seed':>4} {'keyframes':>9} {'m':>7} {'revisits':>8} {'recall':>7} {'closures':>8} {'false':>5} "
        f"{'median m':>8} {'max m':>7} {'med deg':>8} {'ms/keyframe':>10}"
    )
    for item in filter(None, args.drives.split(",")):
        name, _, scans = item.partition(":")
        for seed in range(args.seeds):
            measure(name, int(scans or 850), seed, args.drift, args.turn)


if __name__ == "__main__":
    main()
