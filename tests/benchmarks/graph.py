"""Time of the pose graph: `python tests/benchmarks/graph.py [KEYFRAMES] [LOOPS]`, a table over the share of wrong loops."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from graph_builders import ate, graph_of, truth

from lslam.backend.graph.pose_graph import optimise
from lslam.core.config.backend import GraphConfig

LAPS = 10


def main(keyframes: int = 5000, loops: int = 2000) -> None:
    real = truth(keyframes, LAPS, radius=0.04 * keyframes)
    optimise(graph_of(real[:50], 0, 0, np.random.default_rng(0), 2), GraphConfig())  # imports
    print(f"{keyframes} keyframes, {loops} loops; s of the process, ATE in m")
    print("wrong  robust   seconds  before   after  wrong kept  right lost")
    for share in (0.0, 0.1, 0.3):
        for robust in ("gnc", "cauchy", "huber"):
            wrong = round(share * loops)
            graph = graph_of(real, loops, wrong, np.random.default_rng(1), LAPS)
            began = time.process_time()
            solution = optimise(graph, GraphConfig.model_validate({"robust": robust}))
            seconds = time.process_time() - began
            out = np.array([bool(reason) for reason in solution.loop_reasons])
            print(
                f"{share:4.0%}   {robust:7} {seconds:8.2f} {ate(graph.poses, real):7.2f} {ate(solution.poses, real):7.3f} "
                f"{int((~out[loops - wrong :]).sum()):11d} {int(out[: loops - wrong].sum()):11d}"
            )


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]))
