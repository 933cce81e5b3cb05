"""The map that a drive is located in: its points, its vertical, and the part of it round the sensor as Gaussian voxels.

Where in the whole map a submap may lie is searched by bird's-eye views, correlated over all positions and headings. Scan Context
looks the same from the same side only: what an old drive saw of a street hides other things than what a new one sees from the
other lane. A correlation over the cells that both observed needs no viewpoint, so that a cloud of another sensor, or one that
nobody knows the drive of, serves as well.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lslam.backend.kernels import bev
from lslam.backend.loops.level_submap import (
    CELL_M,
    BestShifts,
    BevGrid,
    Image,
    LevelSubmap,
    Spectrum,
    VisibleCells,
    blur,
    correlate,
    find_up,
    level_rotation,
    make_level_submap,
    move_points,
    peaks,
    spectra,
)
from lslam.core.arrays import Floats, Longs, Points
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se2, se3, so3
from lslam.core.types.gnss import Georeference
from lslam.registration.alignment import MapAlignment
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import LocalMap
from lslam.registration.preprocessing.ground import Z

# m, edge of the blocks that points are sorted into; the local map is made anew where the sensor enters another.
BLOCK_M = 32.0
# Local maps kept: a drive along the border of two blocks needs both.
CACHE_ALIGNMENTS = 3
# Points that the vertical is estimated from, at most, and that one insertion takes.
LOOKED_AT, AT_ONCE = 400_000, 1 << 17
# On a map of another day no earlier scan tells how many points can agree: the shares of a scan that the map has, and that agree.
MAP_MIN_OVERLAP = 0.2
MAP_MIN_INLIERS = 0.3


@dataclass
class PriorMap:
    """A cloud in level axes, z up, about an origin near its middle.

    points : (N, 3) float32, m, sorted by block; T_map_level : (4, 4) from these axes into the map's own coordinates
    georeference : of the map's own coordinates, None when unknown; source : for messages
    origin : (3,) m, subtracted from the coordinates of its file
    """

    points: Points
    T_map_level: Floats
    georeference: Georeference | None = None
    source: str = ""
    origin: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        blocks = np.floor(self.points[:, :2] / BLOCK_M).astype(np.int64)
        self._low = blocks.min(axis=0)
        self._shape = blocks.max(axis=0) - self._low + 1
        numbers = (blocks[:, 0] - self._low[0]) * self._shape[1] + blocks[:, 1] - self._low[1]
        order = np.argsort(numbers, kind="stable")
        self.points = np.ascontiguousarray(self.points[order])
        self._begins = np.searchsorted(numbers[order], np.arange(int(self._shape.prod()) + 1))

    def __len__(self) -> int:
        return len(self.points)

    def around(self, centre: Floats, reach: float) -> Points:
        """Points (M, 3), m, of the blocks within `reach` m of `centre` (2,) or (3,), level axes."""
        low, high = (np.floor((centre[:2] + s * reach) / BLOCK_M).astype(np.int64) - self._low for s in (-1, 1))
        low, high = np.maximum(low, 0), np.minimum(high, self._shape - 1)
        if (low > high).any():
            return np.zeros((0, 3), np.float32)
        rows = np.arange(low[0], high[0] + 1) * self._shape[1]
        parts = [self.points[self._begins[row + low[1]] : self._begins[row + high[1] + 1]] for row in rows]
        return np.concatenate(parts)

    def along(self, positions: Floats, reach: float) -> Points:
        """Points (M, 3), m, within `reach` m horizontally of the blocks that positions (N, 3) lie in, level axes."""
        entered = np.unique(np.floor(positions[:, :2] / BLOCK_M).astype(np.int64), axis=0)
        steps = np.arange(-int(np.ceil(reach / BLOCK_M)), int(np.ceil(reach / BLOCK_M)) + 1)
        near = entered[:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) - self._low
        near = near[((near >= 0) & (near < self._shape)).all(axis=-1)]
        parts = [self.points[self._begins[n] : self._begins[n + 1]] for n in np.unique(near @ [self._shape[1], 1])]
        return np.concatenate([self.points[:0], *parts])


def make_prior_map(
    points: Floats,
    config: RegistrationConfig,
    georeference: Georeference | None = None,
    source: str = "",
    origin: Floats | None = None,
    up: Floats = Z,
) -> PriorMap:
    """Level a cloud (N, 3), m, of the map's coordinates, which may be as large as those of a projection.

    origin : (3,) m, to subtract from the coordinates of the file; up : (3,) unit vector in them, initial guess of the vertical
    Raises InputError for a cloud without finite points.
    """
    origin = np.zeros(3) if origin is None else origin
    points = points[np.isfinite(points).all(axis=1)] - origin
    if not len(points):
        raise InputError(f"{source} has no finite point: it is no map")
    middle = np.round(np.median(points, axis=0))
    local = (points - middle).astype(np.float32)
    planes = GaussianMap(config.voxel_size, reach=np.inf)
    insert_all(planes, local[:: max(len(local) // LOOKED_AT, 1)])
    T = se3.make(level_rotation(find_up([planes], up)).T, middle)
    level = move_points(local, se3.make(T[:3, :3].T, np.zeros(3)))
    return PriorMap(level, T, georeference, source, origin)


def insert_all(target: GaussianMap | LocalMap, points: Points) -> None:
    """Enter points (N, 3), m, level axes, in parts, so that the room for them grows with the voxels and not with the points."""
    for first in range(0, len(points), AT_ONCE):
        part = points[first : first + AT_ONCE]
        if isinstance(target, LocalMap):
            target.insert(part, part.astype(np.float64), np.eye(4))
        else:
            target.insert(part, np.eye(4))


class LocalView:
    """The map round the sensor in the form that registration needs, a function of the block that the sensor is in.

    reach : m, how far points are needed
    """

    def __init__(self, prior_map: PriorMap, config: RegistrationConfig, reach: float) -> None:
        self._map, self._config, self._reach = prior_map, config, reach
        self._alignments: OrderedDict[tuple[int, int], MapAlignment] = OrderedDict()

    def at(self, position: Floats) -> MapAlignment:
        """Alignment with the map round a position (3,), m, level axes; made for its block, and cached."""
        block = (int(np.floor(position[0] / BLOCK_M)), int(np.floor(position[1] / BLOCK_M)))
        if block not in self._alignments:
            self._alignments[block] = self._make(block)
        self._alignments.move_to_end(block)
        while len(self._alignments) > CACHE_ALIGNMENTS:
            self._alignments.popitem(last=False)
        return self._alignments[block]

    def _make(self, block: Sequence[int]) -> MapAlignment:
        """Alignment with the map's points within reach of block (i, j), as a local map."""
        c = self._config
        centre = (np.array(block) + 0.5) * BLOCK_M
        # Nobody knows which beams saw a point of a finished map.
        target = LocalMap(c.voxel_size, reach=np.inf, breadth=0.0)
        insert_all(target, self._map.around(centre, self._reach + BLOCK_M / 2))
        return MapAlignment(target, c)


# m about the sensor that is compared, and the cells that it and those round them take.
WINDOW_M, WINDOW = 60.0, BevGrid(124)
# Headings between two quarters of the circle; a step of 3 deg is a cell's width at half of the window.
QUARTER = 30
# Cells along a side, and headings, that are one where the whole map is searched.
COARSE = 2
# Least share of the submap's structure that must lie where the map was observed.
SHARED_SHARE = 0.5
# m between two guesses; how many of the coarse search are looked at closely, and how many of these are registered.
GUESSES_APART_M, CLOSE_LOOKS, GUESSES = 6.0, 40, 10


@dataclass(frozen=True)
class Region:
    """Prior of a position: about `centre` (2,) within `radius`, m; heading within `turn` of `yaw`, rad."""

    centre: Floats
    radius: float
    yaw: float = 0.0
    turn: float = float(np.pi)


class PlaceSearch:
    """The whole map as coarse and fine images, and as Gaussian voxels for the verification of candidates."""

    def __init__(self, prior_map: PriorMap, config: RegistrationConfig) -> None:
        from scipy import fft

        self.whole = make_level_submap(prior_map.points, config)
        reach = float(np.abs(prior_map.points[:, :2]).max()) + WINDOW_M
        half = int(fft.next_fast_len(int(np.ceil(reach / (COARSE * CELL_M))), real=True))
        self.coarse, self.grid = BevGrid(2 * half, COARSE * CELL_M), BevGrid(2 * half * COARSE)
        heights, _, seen = self.grid.view(self.whole.non_ground, self.whole.ground)
        # NaN where the map was not observed.
        self._image = np.where(seen > 0, _centre(blur(heights), seen), np.float32(np.nan))
        images = _coarse(heights, seen)[[0, 2, 1]]
        # Turned by quarters the other way: a quarter turn of the submap takes no new image of it.
        self._quarters = [spectra(np.rot90(images, -k, (1, 2))) for k in range(4)]
        self._turned_cells = [_turned_back(np.arange(self.coarse.size**2), k, self.coarse.size) for k in range(1, 4)]
        self._lowest = self.grid.lowest(self.whole.ground)
        self.cells = VisibleCells(self.grid, seen.ravel() > 0, SHARED_SHARE)

    def is_near(self, position: Floats, radius: float) -> bool:
        """Whether the map was observed anywhere within `radius` m of a position (2,), level axes."""
        at = (np.arange(self.grid.size) - self.grid.size // 2 + 0.5) * CELL_M
        distances2 = (at[:, None] - position[0]) ** 2 + (at[None, :] - position[1]) ** 2
        return bool(self.cells.visible.reshape(distances2.shape)[distances2 <= max(radius, CELL_M) ** 2].any())

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
            for k in peaks(coarse, best[0].score, GUESSES_APART_M, CLOSE_LOOKS)
        ]
        fine, score = np.array([shift for shift, _, _ in looked]).reshape(-1, 2), np.array([s for _, _, s in looked])
        return [
            self._pose(query, fine[k], turned.yaw(looked[k][1])) for k in peaks(fine, score, GUESSES_APART_M, GUESSES)
        ]

    def _look(self, views: TurnedViews, shift: Floats, heading: int) -> tuple[Floats, int, float]:
        """Refine a coarse match: shift (2,), m, heading and score of the fine cell and heading nearby that fit best."""
        corner = np.round(shift / CELL_M).astype(np.int64) + (self.grid.size - WINDOW.size) // 2
        best = shift, heading, 0.0
        for n in range(heading - COARSE // 2, heading + COARSE // 2 + 1):
            cells, structure, least = views.fine(n)
            score, row, column = bev.fit(
                self._image, cells, structure, least, int(corner[0]), int(corner[1]), COARSE // 2
            )
            if score > best[2]:
                best = shift + CELL_M * np.array([row, column]), n, score
        return best

    def _pose(self, query: LevelSubmap, shift: Floats, yaw: float) -> Floats:
        """Pose (4, 4) of the query by `shift` (2,), m, and `yaw`, rad; height: the median difference of the common ground."""
        R = so3.exp(np.array([0.0, 0.0, yaw]))
        turned = query.ground @ R.T + np.array([*shift, 0.0])
        cells, inside = self.grid.cells_of(turned)
        climb = self._lowest[cells] - turned[:, 2]
        both = inside & np.isfinite(climb)
        return se3.make(R, np.array([*shift, float(np.median(climb[both])) if both.any() else 0.0]))


class TurnedViews:
    """The window about a submap, seen from above at numbered headings, `QUARTER` of them in a quarter of the circle.

    query : the submap, of which points within WINDOW_M are used; first : rad, yaw of heading 0
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
        view = WINDOW.view(self._near, self._floor, se2.rotation(self.yaw(heading)))
        return view[0], view[2]


def _coarse(heights: Image, visible: Image) -> Image:
    """(3, size, size) structure in coarse cells, less its mean over those observed; its square; visibility."""
    half = len(visible) // COARSE
    blocks = (half, COARSE, half, COARSE)
    cover = visible.reshape(blocks).max(axis=(1, 3))
    structure = _centre(heights.reshape(blocks).mean(axis=(1, 3)), cover)
    return np.stack([structure, structure**2, cover])


def _least(squares: Image) -> float:
    """The sum of squares of a structure that a map must have observed, as a part of the whole."""
    return SHARED_SHARE * float(squares.sum())


def _centre(image: Image, cover: Image) -> Image:
    """The image less its mean over the observed cells; 0 elsewhere."""
    observed = cover > 0
    mean = image[observed].mean() if observed.any() else np.float32(0)
    return np.where(observed, image - mean, np.float32(0))


def _turned_back(cells: Longs, quarters: int, size: int) -> Longs:
    """Flat cells of a correlation with the shifts of `cells` rotated back by `quarters` of a circle."""
    r, c = np.divmod(cells, size)
    r, c = ((r, c), (c, -r), (-r, -c), (-c, r))[quarters]
    return np.asarray((r % size) * size + c % size)
