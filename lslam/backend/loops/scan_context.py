"""Scan Context: a place as a polar image of heights, found again whatever the heading (Kim and Kim 2018)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.backend.kernels.bev import polar_image
from lslam.backend.loops import PlaceMatch
from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config.backend import LoopsConfig

Images = NDArray[np.float32]

# m added to all heights, so that bare ground differs from nothing seen, as in the authors' implementation.
LIFT = 2.0
# Share of the cells below which the ground lies: a few see a pit, or reflections from below.
GROUND_SHARE = 0.05
# So many keyframes, nearest by their ring keys, are compared in full.
COMPARED = 25
# Rings, sectors and radius, m, of the polar image (Kim and Kim 2018).
RINGS, SECTORS, REACH_M = 20, 60, 80.0


def describe(points: NDArray[np.float32], rings: int, sectors: int, reach: float) -> Images:
    """(rings, sectors) float32 heights over the ground, m, of points (N, 3) round the sensor, z up; 0 in empty cells.

    The ground is the lowest of the cells' heights, not the sensor's height, so that vehicles, drones and tilted sensors
    all get the same image of a place. reach : horizontal radius of the image, m
    """
    image = polar_image(np.ascontiguousarray(points, np.float32), rings, sectors, reach)
    is_seen = np.isfinite(image)
    if not is_seen.any():
        return np.zeros_like(image)
    ground = np.quantile(image[is_seen], GROUND_SHARE)
    return np.where(is_seen, np.maximum(image - ground, 0) + LIFT, 0).astype(np.float32)


def distances(query: Images, images: Images) -> Floats:
    """(C, S) distance of a query (R, S) to images (C, R, S) at each of S column shifts: mean of 1 - cos over the columns.

    Shift n compares column j of the query with column j + n (equations 2.36 and 2.37 of Girolimetto). Columns that
    are empty in both are ignored; those empty in only one count as different.
    """
    count = query.shape[1]
    q, q_seen = _unit_columns(query[None])
    c, c_seen = _unit_columns(images)
    columns = np.arange(count)
    pairs = (columns[:, None], (columns[:, None] + columns[None, :]) % count)
    cosines = np.matmul(q.transpose(0, 2, 1), c)[:, *pairs].sum(axis=1, dtype=np.float64)
    both = (q_seen[:, :, None] & c_seen[:, None, :])[:, *pairs].sum(axis=1)
    either = q_seen.sum(axis=1)[:, None] + c_seen.sum(axis=1)[:, None] - both
    return np.where(either > 0, 1 - cosines / np.maximum(either, 1), 1.0)


def _unit_columns(images: Images) -> tuple[Images, Bools]:
    """Columns of images (C, R, S) at length 1, and which (C, S) hold anything."""
    norms = np.linalg.norm(images, axis=1)
    return images / np.maximum(norms, 1e-12)[:, None, :], norms > 0


def create(config: LoopsConfig) -> PlaceIndex:
    """An empty index of Scan Context descriptors, as configured."""
    return PlaceIndex()


class PlaceIndex:
    """The places seen so far, by keyframe number; rings, sectors, reach : as for `describe`."""

    def __init__(self, rings: int = RINGS, sectors: int = SECTORS, reach: float = REACH_M) -> None:
        self.rings, self.sectors, self.reach = rings, sectors, reach
        self.yaw_error = np.pi / sectors
        self._rows: dict[int, int] = {}
        self._images = np.zeros((64, rings, sectors), np.float32)
        self._keys = np.zeros((64, rings), np.float32)

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, number: int, points: NDArray[np.float32]) -> None:
        """Describe the cloud (N, 3), m, round keyframe `number`, level with z up."""
        row = self._rows.setdefault(number, len(self._rows))
        if row == len(self._images):
            self._images = np.concatenate([self._images, np.zeros_like(self._images)])
            self._keys = np.concatenate([self._keys, np.zeros_like(self._keys)])
        self._images[row] = describe(points, self.rings, self.sectors, self.reach)
        # The mean of a ring does not change when the cloud is turned; unlike its occupancy (equation 2.38) it still
        # tells places apart when a submap fills every cell.
        self._keys[row] = self._images[row].mean(axis=1)

    def nearest(self, number: int, others: Longs, turn: float = np.pi) -> list[PlaceMatch]:
        """Those of the keyframes `others` that are most similar to keyframe `number`, best first; all must have been added.

        turn : rad, largest difference of heading
        """
        rows = np.array([self._rows[int(k)] for k in others], np.int64)
        if len(rows) == 0:
            return []
        me = self._rows[number]
        if len(rows) > COMPARED:
            away = ((self._keys[rows] - self._keys[me]) ** 2).sum(axis=1)
            kept = np.sort(np.argsort(away, kind="stable")[:COMPARED])
            rows, others = rows[kept], others[kept]
        found = distances(self._images[me], self._images[rows])
        width = 2 * np.pi / self.sectors
        yaws = (np.arange(self.sectors) * width + np.pi) % (2 * np.pi) - np.pi
        found[:, np.abs(yaws) > turn + width / 2] = np.inf
        shifts = found.argmin(axis=1)
        best = found[np.arange(len(rows)), shifts]
        order = np.argsort(best, kind="stable")
        return [PlaceMatch(int(others[k]), float(best[k]), float(yaws[shifts[k]])) for k in order]
