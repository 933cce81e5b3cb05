"""What is said about a set of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A path this short, m, is the rounding of poses that do not move.
STANDS_M = 1e-3


@dataclass(frozen=True)
class Statistics:
    """Seven numbers and the count, in the unit of the errors (`sse` in its square). `std` divides by n (ddof 0)."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float
    n: int


def describe(errors: NDArray[Any]) -> Statistics | None:
    """Statistics of errors (N,), None when there are none."""
    e = np.asarray(errors, np.float64)
    if len(e) == 0:
        return None
    squares = np.power(e, 2)
    return Statistics(
        rmse=float(np.sqrt(np.mean(squares))),
        mean=float(np.mean(e)),
        median=float(np.median(e)),
        std=float(np.std(e)),
        min=float(np.min(e)),
        max=float(np.max(e)),
        sse=float(np.sum(squares)),
        n=len(e),
    )


def percent_of_length(rmse: float, truth: NDArray[np.float64]) -> float:
    """An error, m, in % of the path of the poses `truth` (N, 4, 4); NaN for a sensor that stood still."""
    length = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    return 100 * rmse / length if length > STANDS_M else float("nan")
