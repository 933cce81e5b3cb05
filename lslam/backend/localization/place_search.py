"""Where in a whole map a submap may lie: bird's-eye views correlated over all positions and headings.

Scan Context looks the same from the same side only: what an old drive saw of a street hides other things than what a new one
sees from the other lane. A correlation over the cells that both observed needs no viewpoint, so that a cloud of another sensor,
or one that nobody knows the drive of, serves as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.backend.kernels import bev
from lslam.backend.localization.prior_map import PriorMap
from lslam.backend.loops.bev_correlation import (
    CELL_M,
    BestShifts,
    BevGrid,
    Image,
    Spectrum,
    blurred,
    correlate,
    peaks,
    spectra,
    turning,
)
from lslam.backend.loops.level_submap import LevelSubmap, make_level_submap
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats, Longs

# m about the sensor that is compared, and the cells that it and those round them take.
WINDOW_M, WINDOW = 60.0, BevGrid(124)
# Headings between two quarters of the circle; a step of 3 deg is a cell's width at half of the window.
QUARTER = 30
# Cells along a side, and headings, that are one where the whole map is searched.
COARSE = 2
# Least share of the submap's structure that must lie where the map was observed.
SHARED_SHARE = 0.5
# m between two guesses; how many of the coarse search are looked at closely, and how many of these are registered.
GUESSES_APART_M, LOOKED_AT, GUESSES = 6.0, 40, 10


@dataclass(frozen=True)
class Region:
    """What is known of a position beforehand: about `centre` (2,) within `radius`, m; heading within `turn` of `yaw`, rad."""

    centre: Floats
    radius: float
    yaw: float = 0.0
    turn: float = float(np.pi)


class PlaceSearch:
    """The whole map as coarse and fine images, and as Gaussian voxels for the verification of what is found in it."""

    def __init__(self, prior_map: PriorMap, config: RegistrationConfig) -> None:
        from scipy import fft

        self.whole = make_level_submap(prior_map.points, config)
        reach = float(np.abs(prior_map.points[:, :2]).max()) + WINDOW_M
        half = int(fft.next_fast_len(int(np.ceil(reach / (COARSE * CELL_M))), real=True))
        self.coarse, self.grid = BevGrid(2 * half, COARSE * CELL_M), BevGrid(2 * half * COARSE)
        heights, _, seen = self.grid.view(self.whole.non_ground, self.whole.ground)
        # NaN where the map was not observed.
        self._image = np.where(seen > 0, _centred(blurred(heights), seen), np.float32(np.nan))
        images = _coarse(heights, seen)[[0, 2, 1]]
        # Turned by quarters the other way: a quarter turn of the submap takes no new image of it.
        self._quarters = [spectra(np.rot90(images, -k, (1, 2))) for k in range(4)]
        self._turned_cells = [_turned_back(np.arange(self.coarse.size**2), k, self.coarse.size) for k in range(1, 4)]
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
        a wall against free ground. In coarse cells everywhere, then in fine ones where these fit best.
        """
        turned = TurnedViews(query, 0.0 if region is None else region.yaw)
        if turned.is_flat:
            return []
        cells, headings, quarters = np.arange(self.coarse.size**2), range(0, QUARTER, COARSE), 4
        if region is not None:
            count = int(np.ceil(min(region.turn, np.pi) / turned.step))
            cells = self.coarse.within(region.centre, region.radius)
            headings, quarters = range(-count, count + 1, COARSE), 1
        best = [BestShifts(cells) for _ in range(quarters)]
        for n in headings:
            view, least = turned.coarse(n, self.coarse.size)
            for k, shifts in enumerate(best):
                shifts.observe(correlate(self._quarters[k], view), least, n + k * QUARTER)
        for shifts, turned_cells in zip(best[1:], self._turned_cells, strict=False):
            best[0].merge(shifts, turned_cells)
        coarse = self.coarse.shifts(cells)
        looked = [
            self._look(turned, coarse[k], int(best[0].heading[k]))
            for k in peaks(coarse, best[0].score, GUESSES_APART_M, LOOKED_AT)
        ]
        fine, score = np.array([shift for shift, _, _ in looked]).reshape(-1, 2), np.array([s for _, _, s in looked])
        return [
            self._pose(query, fine[k], turned.yaw(looked[k][1])) for k in peaks(fine, score, GUESSES_APART_M, GUESSES)
        ]

    def _look(self, turned: TurnedViews, shift: Floats, heading: int) -> tuple[Floats, int, float]:
        """Shift (2,) m, heading and score of the fine cell and heading that fit best about coarse ones."""
        corner = np.round(shift / CELL_M).astype(np.int64) + (self.grid.size - WINDOW.size) // 2
        best = shift, heading, 0.0
        for n in range(heading - COARSE // 2, heading + COARSE // 2 + 1):
            cells, structure, least = turned.fine(n)
            score, row, column = bev.fit(
                self._image, cells, structure, least, int(corner[0]), int(corner[1]), COARSE // 2
            )
            if score > best[2]:
                best = shift + CELL_M * np.array([row, column]), n, score
        return best

    def _pose(self, query: LevelSubmap, shift: Floats, yaw: float) -> Floats:
        """(4, 4) with the median height difference of the ground in common."""
        R = so3.exp(np.array([0.0, 0.0, yaw]))
        turned = query.ground @ R.T + np.array([*shift, 0.0])
        cells, inside = self.grid.cells_of(turned)
        climb = self._lowest[cells] - turned[:, 2]
        both = inside & np.isfinite(climb)
        return se3.make(R, np.array([*shift, float(np.median(climb[both])) if both.any() else 0.0]))


class TurnedViews:
    """The window about a submap, seen from above at numbered headings, `QUARTER` of them in a quarter of the circle.

    first : rad, yaw of heading 0
    step : rad, from one heading to the next
    """

    step = float(np.pi / 2 / QUARTER)

    def __init__(self, query: LevelSubmap, first: float) -> None:
        self._first = first
        self._near, self._floor = (
            p[(p[:, :2] ** 2).sum(axis=1) < WINDOW_M**2] for p in (query.non_ground, query.ground)
        )
        self._views: dict[int, tuple[Longs, Image, float]] = {}

    @property
    def is_flat(self) -> bool:
        """Whether nothing stands up there."""
        return not len(self._near)

    def yaw(self, heading: int) -> float:
        """Yaw of a heading, rad."""
        return self._first + heading * self.step

    def coarse(self, heading: int, size: int) -> tuple[Spectrum, float]:
        """Spectra of `_coarse` among (size, size) cells, and the sum of squares that the map must have observed."""
        images = _coarse(*self._view(heading))
        padded = np.zeros((3, size, size), np.float32)
        first = (size - images.shape[1]) // 2
        within = slice(first, first + images.shape[1])
        padded[:, within, within] = images
        return spectra(padded), _least(images[1])

    def fine(self, heading: int) -> tuple[Longs, Image, float]:
        """Observed cells (K, 2), the structure (K,) there, and the sum of its squares that the map must have observed."""
        heading %= 4 * QUARTER
        if heading not in self._views:
            heights, seen = self._view(heading)
            cells = np.argwhere(seen > 0)
            structure = heights[seen > 0]
            structure -= structure.mean()
            self._views[heading] = cells, structure, _least(structure**2)
        return self._views[heading]

    def _view(self, heading: int) -> tuple[Image, Image]:
        """Occupied voxels and visibility of the cells of the window."""
        view = WINDOW.view(self._near, self._floor, turning(self.yaw(heading)))
        return view[0], view[2]


def _coarse(heights: Image, seen: Image) -> Image:
    """(3, size, size) structure in coarse cells, less its mean over those observed; its square; visibility."""
    half = len(seen) // COARSE
    blocks = (half, COARSE, half, COARSE)
    cover = seen.reshape(blocks).max(axis=(1, 3))
    structure = _centred(heights.reshape(blocks).mean(axis=(1, 3)), cover)
    return np.stack([structure, structure**2, cover])


def _least(squares: Image) -> float:
    """Sum of the squares of a structure of which a map must have observed so much."""
    return SHARED_SHARE * float(squares.sum())


def _centred(image: Image, cover: Image) -> Image:
    """The image less its mean over the observed cells; 0 elsewhere."""
    observed = cover > 0
    mean = image[observed].mean() if observed.any() else np.float32(0)
    return np.where(observed, image - mean, np.float32(0))


def _turned_back(cells: Longs, quarters: int, size: int) -> Longs:
    """Flat cells of a correlation with the shifts of `cells` turned back by so many quarters of a circle."""
    r, c = np.divmod(cells, size)
    r, c = ((r, c), (c, -r), (-r, -c), (-c, r))[quarters]
    return np.asarray((r % size) * size + c % size)
