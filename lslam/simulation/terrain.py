"""Gently uneven ground: a slope and a sum of plane waves, so height and gradient are exact everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import portable
from lslam.core.types.arrays import Floats


@dataclass(frozen=True)
class Terrain:
    """Ground height as a sum of K plane waves `amplitude sin(wave . xy + phase)` on a plane.

    waves : (K, 2) wave vectors, rad/m; amplitudes : (K,) m; phases : (K,) rad
    tilt : gradient of the plane, m/m
    """

    waves: Floats
    amplitudes: Floats
    phases: Floats
    tilt: tuple[float, float] = (0.0, 0.0)

    def height(self, xy: NDArray[Any]) -> Floats:
        """Height at (..., 2) positions, m, shape (...)."""
        heights = portable.sin(self._phases_at(xy))
        return portable.dot(heights, self.amplitudes) + portable.dot(np.asarray(xy, np.float64), np.array(self.tilt))

    def slope(self, xy: NDArray[Any]) -> Floats:
        """Gradient of the height at (..., 2) positions, m/m, shape (..., 2)."""
        steepness = portable.cos(self._phases_at(xy)) * self.amplitudes
        return np.stack([portable.dot(steepness, self.waves[:, k]) + self.tilt[k] for k in (0, 1)], axis=-1)

    def _phases_at(self, xy: NDArray[Any]) -> Floats:
        """(..., K) of the waves, rad."""
        xy = np.asarray(xy, np.float64)
        return np.asarray(xy[..., :1] * self.waves[:, 0] + xy[..., 1:] * self.waves[:, 1] + self.phases)


def rolling(
    rng: np.random.Generator,
    relief: float = 0.35,
    unevenness: float = 0.012,
    swell: float = 100.0,
    slope: tuple[float, float] = (0.0, 0.0),
) -> Terrain:
    """Uneven ground: about `relief` m up and down over about `swell` m, bumps of about `unevenness` m over 7 to 20 m.

    slope : least and greatest slope of the whole, m/m, in a random direction
    """
    lengths = np.concatenate([rng.uniform(0.6, 1.4, 4) * swell, rng.uniform(7, 20, 5)])
    amplitudes = np.concatenate([rng.uniform(0.4, 1.0, 4) * relief, rng.uniform(0.4, 1.0, 5) * unevenness])
    heading = rng.uniform(0, 2 * np.pi, len(lengths))
    waves = (2 * np.pi / lengths)[:, None] * np.stack([portable.cos(heading), portable.sin(heading)], axis=1)
    phases = rng.uniform(0, 2 * np.pi, len(lengths))
    fall, towards = rng.uniform(*slope), rng.uniform(0, 2 * np.pi)
    return Terrain(
        waves, amplitudes, phases, (float(fall * portable.cos(towards)), float(fall * portable.sin(towards)))
    )


def flat() -> Terrain:
    """Ground at height zero everywhere."""
    return Terrain(np.zeros((1, 2)), np.zeros(1), np.zeros(1))
