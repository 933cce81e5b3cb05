"""Where in a whole map a submap may lie: bird's-eye views correlated over all positions and headings.

Scan Context looks the same from the same side only: what an old drive saw of a street hides other things than what a new one
sees from the other lane. A correlation over the cells that both observed needs no viewpoint, so that a cloud of another sensor,
or one that nobody knows the drive of, serves as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.backend.localization.prior_map import PriorMap
from lslam.backend.loops.bev_correlation import CELL_M, BevGrid, Image, Spectrum, blurred, correlate, spectrum
from lslam.backend.loops.level_submap import LevelSubmap, make_level_submap
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats

# m about the sensor that is compared, and rad between two headings: a cell's width at half of it.
WINDOW_M, TURN_STEP = 60.0, np.deg2rad(3.0)
# Least share of the submap's structure that must lie where the map was observed.
SHARED_SHARE = 0.5
# m between two guesses, and how many there are at most.
GUESSES_APART_M, GUESSES = 6.0, 10


@dataclass(frozen=True)
class Region:
    """What is known of a position beforehand: about `centre` (2,) within `radius`, m; heading within `turn` of `yaw`, rad."""

    centre: Floats
    radius: float
    yaw: float = 0.0
    turn: float = float(np.pi)


class PlaceSearch:
    """The whole map as one image, and as Gaussian voxels for the verification of what is found in it."""

    def __init__(self, prior_map: PriorMap, config: RegistrationConfig) -> None:
        from scipy import fft

        self.whole = make_level_submap(prior_map.points, config)
        reach = float(np.abs(prior_map.points[:, :2]).max()) + WINDOW_M
        self.grid = BevGrid(int(fft.next_fast_len(int(np.ceil(2 * reach / CELL_M)), real=True)))
        seen = self.grid.cover(self.whole.non_ground, self.whole.ground)
        image = _centred(blurred(self.grid.heights(self.whole.non_ground)), seen)
        self._image, self._squares, self._seen = spectrum(image), spectrum(image**2), spectrum(seen)
        self._lowest = self.grid.lowest(self.whole.ground)
        self.is_seen = seen.ravel() > 0

    def is_near(self, position: Floats, radius: float) -> bool:
        """Whether the map was observed anywhere within `radius` m of a position (2,), level axes."""
        at = (np.arange(self.grid.size) - self.grid.size // 2 + 0.5) * CELL_M
        away2 = (at[:, None] - position[0]) ** 2 + (at[None, :] - position[1]) ** 2
        return bool(self.is_seen.reshape(away2.shape)[away2 <= max(radius, CELL_M) ** 2].any())

    def guesses(self, query: LevelSubmap, region: Region | None = None) -> list[Floats]:
        """T_level_query (4, 4), level axes of both, of the best correlations, best first; empty without upright structure.

        Zero-mean normalised cross-correlation over the cells that both observed: free ground against a wall counts as much as
        a wall against free ground.
        """
        near, floor = (p[(p[:, :2] ** 2).sum(axis=1) < WINDOW_M**2] for p in (query.non_ground, query.ground))
        if not len(near):
            return []
        yaws = np.arange(0.0, 2 * np.pi - 1e-9, TURN_STEP)
        if region is not None:
            count = int(np.ceil(min(region.turn, np.pi) / TURN_STEP))
            yaws = region.yaw + TURN_STEP * np.arange(-count, count + 1)
        best = np.zeros((self.grid.size, self.grid.size), np.float32)
        turn = np.zeros_like(best)
        for yaw in yaws:
            score = self._scores(near, floor, float(yaw))
            better = score > best
            best, turn = np.where(better, score, best), np.where(better, np.float32(yaw), turn)
        return [self._pose(query, shift, yaw) for shift, yaw in self._peaks(best, turn, region)]

    def _scores(self, near: Floats, floor: Floats, yaw: float) -> Image:
        """Correlation of the submap, turned by `yaw`, at all shifts."""
        size = self.grid.size
        R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        cover = self.grid.cover(near, floor, R=R)
        turned = _centred(self.grid.heights(near, R), cover)
        structure: Spectrum = spectrum(turned**2)
        own = correlate(self._seen, structure, size)
        other = correlate(self._squares, spectrum(cover), size)
        score = correlate(self._image, spectrum(turned), size) / np.sqrt(np.maximum(own * other, 1.0))
        score[own < SHARED_SHARE * max(float((turned**2).sum()), 1.0)] = 0.0
        return np.asarray(score)

    def _peaks(self, score: Image, turn: Image, region: Region | None) -> list[tuple[Floats, float]]:
        """Shift (2,) m and yaw of the best cells in the region, none near another."""
        shifts = self.grid.shifts()
        rest = score.copy()
        if region is not None:
            x, y = region.centre[:2]
            rest[(shifts[:, None] - x) ** 2 + (shifts[None, :] - y) ** 2 > max(region.radius, CELL_M) ** 2] = 0.0
        peaks: list[tuple[Floats, float]] = []
        while len(peaks) < GUESSES and rest.max() > 0:
            r, c = np.unravel_index(int(rest.argmax()), rest.shape)
            peaks.append((np.array([shifts[r], shifts[c]]), float(turn[r, c])))
            rest[np.ix_(np.abs(shifts - shifts[r]) < GUESSES_APART_M, np.abs(shifts - shifts[c]) < GUESSES_APART_M)] = (
                0.0
            )
        return peaks

    def _pose(self, query: LevelSubmap, shift: Floats, yaw: float) -> Floats:
        """(4, 4) with the median height difference of the ground in common."""
        R = so3.exp(np.array([0.0, 0.0, yaw]))
        turned = query.ground @ R.T + np.array([*shift, 0.0])
        cells, inside = self.grid.cells_of(turned)
        climb = self._lowest[cells] - turned[:, 2]
        both = inside & np.isfinite(climb)
        return se3.make(R, np.array([*shift, float(np.median(climb[both])) if both.any() else 0.0]))


def _centred(image: Image, cover: Image) -> Image:
    """The image less its mean over the observed cells; 0 elsewhere."""
    observed = cover > 0
    mean = image[observed].mean() if observed.any() else np.float32(0)
    return np.where(observed, image - mean, np.float32(0))
