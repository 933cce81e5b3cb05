"""Right loops turned into wrong ones, as places that look alike would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from graph_builders import measured

from lslam.core.types.constraint import LoopCandidate

# m and rad, how wrong: another car park, another heading; too little to stand out against odometry that drifted.
WRONG = np.array([3.0, 3.0, 0.5, 0.02, 0.02, 0.2])


def with_false_loops(
    candidates: list[LoopCandidate], share: float, rng: np.random.Generator
) -> tuple[list[LoopCandidate], set[tuple[int, int]]]:
    """The candidates with `share` of the accepted ones put elsewhere, each by an error of its own; which ones."""
    accepted = [i for i, c in enumerate(candidates) if c.verdict == "accepted"]
    chosen = rng.choice(accepted, round(share * len(accepted)), replace=False)
    out = list(candidates)
    for i in chosen:
        constraint = candidates[i].constraint
        assert constraint is not None
        out[i] = replace(out[i], constraint=replace(constraint, T_a_b=measured(constraint.T_a_b, WRONG, rng)))
    return out, {(candidates[i].a, candidates[i].b) for i in chosen}
