"""Colours of a map's points from the images of cameras, with memory for a few images and none for the map."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Ints, Longs
from lslam.core.errors import output_errors
from lslam.core.geometry import portable
from lslam.core.stopping import checking
from lslam.core.types.camera import Image, Lens
from lslam.core.types.cloud import BLOCK, ArrayCloud, Cloud, CloudBlock

GREY = 128  # of points that no image shows
CHANNELS = ("red", "green", "blue")
VIEWS = 7  # kept of a point, of which the median is taken: odd, so that a majority decides
# Points that are culled together, and those that images are compared by.
_RUN, _COMPARED = 1 << 12, 1 << 16
_NEIGHBOURHOOD, _FEWEST = 2.0, 5  # spacings about a point in which its plane lies, and points that make one
_ROUNDS = 20
_STEP = 1.0 / 255.0  # of a pixel's value: no two of them agree better than that


@dataclass(frozen=True)
class ColouredCloud:
    """A cloud (satisfies `Cloud`) with columns red, green, blue; colours : (M, 3) uint8, in the cloud's order."""

    cloud: Cloud
    colours: NDArray[np.uint8]

    @property
    def has_intensity(self) -> bool:
        """Whether the cloud has intensities."""
        return self.cloud.has_intensity

    @property
    def column_types(self) -> Mapping[str, np.dtype[Any]]:
        """Types of the columns of the cloud, and of its colours."""
        return {**self.cloud.column_types, **dict.fromkeys(CHANNELS, np.dtype(np.uint8))}

    def __len__(self) -> int:
        return len(self.cloud)

    def blocks(self) -> Iterator[CloudBlock]:
        """The blocks of the cloud with their colours."""
        at = 0
        for block in self.cloud.blocks():
            some = self.colours[at : at + len(block)]
            at += len(block)
            columns = {**block.columns, **{name: some[:, k] for k, name in enumerate(CHANNELS)}}
            yield CloudBlock(block.points, block.intensity, columns)


@dataclass(frozen=True)
class ColourCounts:
    """Numbers of a coloured map: its points, those that no image shows, images used, and images left out by reason."""

    points: int
    unseen: int
    images: int
    outside: int
    unreadable: int

    def __str__(self) -> str:
        left_out = {"without a registered scan before and after": self.outside, "unreadable": self.unreadable}
        more = "".join(f", {count} {why} left out" for why, count in left_out.items() if count)
        seen = self.points - self.unseen
        return f"{seen} of {self.points} points from {self.images} images{more}; {self.unseen} that none shows are grey"


class MapColourer:
    """Collects the colours of a map's points image by image.

    Points and their views lie in temporary files, mapped into memory: 100 bytes a point.

    cloud : the map; spacing : of its points, m; reach : farthest from a camera, m
    spool : folder beside which the files are made; None: the system's temporary one
    images : number of images so far; unseen : after `result`, points that none of them shows
    Raises OutputError: the files cannot be written.
    """

    def __init__(self, cloud: Cloud, spacing: float, reach: float, spool: Path | None = None) -> None:
        self._cloud, self._spacing, self._reach, self._spool = cloud, spacing, reach, spool
        self.images, self.unseen = 0, 0
        count = len(cloud)
        self._origin: Floats = np.zeros(3)
        self._points = self._array_on_disk(np.float32, count, 3)
        at = 0
        for block in cloud.blocks():
            if not at:
                self._origin = np.floor(block.points[0])
            self._points[at : at + len(block)] = block.points - self._origin
            at += len(block)
        first = np.arange(0, count, _RUN)
        self._runs: Longs = np.stack([first, np.minimum(first + _RUN, count)], axis=1)
        bounds = [(self._points[a:b].min(0), self._points[a:b].max(0)) for a, b in self._runs]
        self._low, self._high = (np.array([pair[k] for pair in bounds]).reshape(-1, 3) for k in (0, 1))
        self._normals = self._array_on_disk(np.int8, count, 3)
        self._estimate_normals()
        self._ranks = self._array_on_disk(np.float32, count, VIEWS)
        self._views = self._array_on_disk(np.int32, count, VIEWS)
        self._colours = self._array_on_disk(np.uint8, count, VIEWS, 3)

    def add(
        self, image: Image, lens: Lens, T_world_camera: Floats, others: Iterable[Floats] = (), weight: float = 1.0
    ) -> int:
        """Add an image (height, width, 3) by its pose (4, 4). Returns the number of points that it shows.

        others : (N, 3) each, world, m: points measured shortly before and after the image is taken. All are in the way of the
            map; a point of the map through which one of them was seen is of something that passes, and was not there
        weight : of the image among others, above 0: less for one that is blurred
        """
        from lslam.maps.kernels.views import collect, splat

        R, centre = T_world_camera[:3, :3], T_world_camera[:3, 3] - self._origin
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.T, -portable.product(R.T, centre[:, None])[:, 0]
        runs = self._runs[self._in_view(lens, centre, R[:, 2])]
        view = T, lens.parameters, self._spacing, self._reach
        depth = np.full(image.shape[:2], np.inf, np.float32)
        behind = np.full(image.shape[:2], -np.inf, np.float32)
        for points in others:
            near, own = (points - self._origin).astype(np.float32), np.full(image.shape[:2], np.inf, np.float32)
            splat(
                near, np.zeros(near.shape, np.int8), np.array([[0, len(near)]]), *view, np.full_like(own, -np.inf), own
            )
            depth = np.minimum(depth, own)
            behind = np.maximum(behind, np.where(own < np.inf, own, -np.inf))
        # What both saw through hides nothing; to be coloured, a point has to be there for both.
        splat(self._points, self._normals, runs, *view, np.where(depth < np.inf, depth, -np.inf), depth)
        shown = collect(
            self._points,
            self._normals,
            runs,
            *view,
            behind,
            depth,
            np.ascontiguousarray(image),
            self.images,
            weight,
            self._ranks,
            self._views,
            self._colours,
        )
        self.images += 1
        return int(shown)

    def result(self) -> ColouredCloud:
        """The map with the colours of all images, their exposures brought together; grey where there is none."""
        from lslam.maps.kernels.views import medians

        step = max(1, len(self._cloud) // _COMPARED)
        some = slice(None, None, step)
        gains = image_gains(self._views[some], self._colours[some], self._ranks[some] > 0, self.images)
        out = self._array_on_disk(np.uint8, len(self._cloud), 3)
        out[:] = GREY
        self.unseen = int(medians(self._ranks, self._views, self._colours, gains, out))
        return ColouredCloud(self._cloud, out)

    def _in_view(self, lens: Lens, centre: Floats, axis: Floats) -> Bools:
        """(R,) whether a run may have points within reach, and in front of a pinhole."""
        nearest = np.clip(centre, self._low, self._high) - centre
        within = (nearest**2).sum(1) <= self._reach**2
        if lens.model == "fisheye":
            return np.asarray(within)
        farthest = np.where(axis > 0, self._high, self._low) - centre
        return np.asarray(within & ((farthest * axis).sum(1) > 0))

    def _estimate_normals(self) -> None:
        """Normals of all points by their neighbourhoods, some runs at a time with those that their neighbours are in."""
        from lslam.maps.kernels.crispness import cell_keys, normals

        radius = _NEIGHBOURHOOD * self._spacing
        for begin in checking(range(0, len(self._runs), BLOCK // _RUN)):
            own = slice(begin, begin + BLOCK // _RUN)
            low, high = self._low[own, None] - radius, self._high[own, None] + radius
            near = ((low <= self._high) & (self._low <= high)).all(2).any(0)
            points = np.concatenate([self._points[a:b] for a, b in self._runs[near]]).astype(np.float64)
            corner = points.min(0)
            keys = cell_keys(points, corner, radius)
            order = np.argsort(keys, kind="stable")
            a, b = self._runs[own][0, 0], self._runs[own][-1, 1]
            queries = self._points[a:b].astype(np.float64)
            units = normals(points[order], keys[order], queries, corner, radius, _FEWEST)
            self._normals[a:b] = np.rint(127 * units)

    def _array_on_disk(self, kind: type[Any], count: int, *shape: int) -> NDArray[Any]:
        """Array (count, *shape) of zeros in a temporary file, deleted with it; its space is allocated at once."""
        row = np.dtype(kind).itemsize * int(np.prod(shape))
        if not count:
            return np.zeros((0, *shape), kind)
        place = self._spool or tempfile.gettempdir()
        with output_errors(place), tempfile.TemporaryFile(prefix=".lslam-map-", dir=self._spool) as file:
            # A hole in a file would fail when it is filled, and end the process.
            for start in range(0, count, BLOCK):
                file.write(bytes(row * min(BLOCK, count - start)))
            file.flush()
            return np.asarray(np.memmap(file, kind, "r+", shape=(count, *shape)))


def warm_up() -> None:
    """Compile or load the kernels, so that a caller can do it under the compile lock."""
    grid = np.stack(np.meshgrid(np.arange(3), np.arange(3), [5]), axis=-1).reshape(-1, 3) - [1, 1, 0]
    colourer = MapColourer(ArrayCloud.of(grid), 1.0, 10.0)
    colourer.add(np.zeros((8, 8, 3), np.uint8), Lens("pinhole", (8, 8), (8.0, 8.0, 3.5, 3.5)), np.eye(4))
    colourer.result()


def image_gains(views: Ints, colours: NDArray[np.uint8], is_view: Bools, images: int) -> Floats:
    """Gains (V, 3) of `images` images, about 1: the value of a pixel is the gain times the colour of its point.

    views, is_view : (N, K) the images that show each point, and where there is one; colours : (N, K, 3)

    Least squares of the logarithms of colours from 1 to 254, every point's colour eliminated, with Cauchy weights by the median
    deviation, since some views show what passed before the point. One observation of gain 1 for every image fixes what the
    points leave open.
    """
    unsaturated = is_view & ((colours > 0) & (colours < 255)).all(2)
    several = unsaturated.sum(1) > 1
    point, slot = np.nonzero(unsaturated[several])
    gains = np.ones((images, 3))
    if not len(point):
        return gains
    view = views[several][point, slot]
    logs = np.log(colours[several][point, slot].astype(np.float64))
    for channel in range(3):
        gains[:, channel] = np.exp(_log_gains(point, view, logs[:, channel], images))
    return gains


def _log_gains(point: NDArray[np.intp], view: Ints, logs: Floats, images: int) -> Floats:
    """Logarithms of the gains (V,) from the logarithm of each observation (M,), by its point and its view."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    points = int(point.max()) + 1
    weight, gain = np.ones(len(logs)), np.zeros(images)
    for _ in range(_ROUNDS):
        total = np.bincount(point, weight, points)
        share = sparse.csr_array((weight, (point, view)), (points, images))
        normal = sparse.diags_array(np.bincount(view, weight, images) + 1.0) - share.T @ (
            sparse.diags_array(1.0 / total) @ share
        )
        mean = np.bincount(point, weight * logs, points) / total
        before, gain = gain, spsolve(sparse.csc_array(normal), np.bincount(view, weight * (logs - mean[point]), images))
        free = np.bincount(point, weight * (logs - gain[view]), points) / total
        residual = logs - gain[view] - free[point]
        scale = max(1.4826 * float(np.median(np.abs(residual))), _STEP)
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
        if np.abs(gain - before).max() < _STEP:
            break
    return np.asarray(gain, np.float64)
