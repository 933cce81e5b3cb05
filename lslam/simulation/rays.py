"""Rays of one scan and what they meet, as arrays: what casting, foliage and returns hand on to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Rays:
    """Rays in the city: origins and unit directions (N, 3), m, and when each is fired (N,), s."""

    origins: NDArray[np.float32]
    directions: NDArray[np.float32]
    fired: NDArray[np.float64]

    def __getitem__(self, which: NDArray[np.intp]) -> Rays:
        return Rays(self.origins[which], self.directions[which], self.fired[which])

    def with_more(self, others: Rays) -> Rays:
        """These rays, then `others`."""
        return Rays(
            np.concatenate([self.origins, others.origins]),
            np.concatenate([self.directions, others.directions]),
            np.concatenate([self.fired, others.fired]),
        )

    def after(self, distance: NDArray[np.float32]) -> Rays:
        """The same rays from `distance` (N,), m, on."""
        return Rays(self.origins + distance[:, None] * self.directions, self.directions, self.fired)


@dataclass(frozen=True)
class Hits:
    """What rays meet first: distance (N,), m, inf for nothing; cosine of incidence (N,); surface (N,).

    face : (N,) of the scene that stands, -1 for nothing, a leaf, or what moves
    """

    distance: NDArray[np.float32]
    cosine: NDArray[np.float32]
    surface: NDArray[np.uint8]
    face: NDArray[np.int32]
