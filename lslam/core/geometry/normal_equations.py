"""Normal equations of a least-squares estimate: the step to their minimum, and what is left where variables are marginalised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels import linalg

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Normal:
    """H (N, N) and gradient g (N,) at some values; the cost decreases along -H^-1 g."""

    H: Floats
    g: Floats

    def step(self) -> Floats:
        """(N,) the update to the minimum; NaN where H is not positive definite."""
        return -linalg.solve(self.H, self.g)

    def without(self, out: NDArray[np.bool_]) -> Normal:
        """The Schur complement: the variables `out` (N,) are marginalised."""
        if not out.any():
            return self
        kept = ~out
        # The gradient rides along as one more column.
        across = np.column_stack([self.H[np.ix_(out, kept)], self.g[out]])
        n = len(across[0])
        rest = np.zeros((n, n))
        rest[:-1, :-1], rest[:-1, -1], rest[-1, :-1] = self.H[np.ix_(kept, kept)], self.g[kept], self.g[kept]
        left = linalg.complement(self.H[np.ix_(out, out)], across, rest)
        return Normal(0.5 * (left[:-1, :-1] + left[:-1, :-1].T), left[:-1, -1].copy())


def warm_up() -> None:
    """Compile or load what an estimate over a window is solved, marginalised and given a covariance with."""
    normal = Normal(np.eye(2), np.zeros(2))
    normal.step()
    normal.without(np.array([True, False]))
    linalg.inverse(normal.H)
