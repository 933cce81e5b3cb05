"""Changes between two drives through one place, by free and occupied cells: an unobserved cell is no change."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.errors import ConfigError
from lslam.core.stopping import check_stop
from lslam.maps.occupancy import MODEL, Evidence

Keys = NDArray[np.int64]
Kind = Literal["appeared", "vanished"]

# Cells in a thing, at most, that noise explains: what is smaller than a cell lies in up to eight of them.
NOISE_CELLS = 8
# Cells along an edge of the squares, seen from above, in which a finished map must have a point for it to be known there.
KNOWN_CELLS = 5


@dataclass(frozen=True)
class MapChange:
    """Object that only one drive observed while beams of the other passed: cells (K, 3) of edge `voxel`, m."""

    kind: Kind
    cells: Longs
    voxel: float

    @property
    def centres(self) -> Floats:
        """(K, 3) middles of the cells, m."""
        return np.asarray((self.cells + 0.5) * self.voxel)

    @property
    def base(self) -> float:
        """Height of the lower edge, m."""
        return float(self.cells[:, 2].min() * self.voxel)

    @property
    def height(self) -> float:
        """Height from the lower to the upper edge, m."""
        return float((np.ptp(self.cells[:, 2]) + 1) * self.voxel)

    @property
    def volume(self) -> float:
        """Volume of the cells, m3; these are on the surface only, since no beam sees the inside."""
        return float(len(self.cells) * self.voxel**3)

    @property
    def outline(self) -> Floats:
        """(C, 2) convex hull of the cells seen from above, counter-clockwise, m."""
        from scipy.spatial import ConvexHull

        columns = np.unique(self.cells[:, :2], axis=0)
        corners = np.unique(np.concatenate([columns + np.array([x, y]) for x in (0, 1) for y in (0, 1)]), axis=0)
        return np.asarray(corners[ConvexHull(corners).vertices] * self.voxel)

    @property
    def extent(self) -> tuple[float, float]:
        """Length and width, m, of the smallest rectangle around the outline, which has a side on a side of the hull."""
        hull = self.outline
        sides = np.roll(hull, -1, axis=0) - hull
        along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
        across = np.column_stack([-along[:, 1], along[:, 0]])
        sizes = np.column_stack([np.ptp(along @ hull.T, axis=1), np.ptp(across @ hull.T, axis=1)])
        width, length = np.sort(sizes[sizes.prod(axis=1).argmin()])
        return float(length), float(width)


@dataclass(frozen=True)
class ChangedCells:
    """Result of comparing two drives.

    changes : what appeared, then what vanished, the largest first; same : (S, 3) occupied cells of the new drive that the
        old one found occupied, too, there or in a cell beside it
    occupied_new, occupied_old : occupied cells of each; unseen_new, unseen_old : those of them that the other drive never saw
    """

    changes: tuple[MapChange, ...]
    same: Longs
    voxel: float
    occupied_new: int
    occupied_old: int
    unseen_new: int
    unseen_old: int

    def of(self, kind: Kind) -> list[MapChange]:
        """Changes of one kind."""
        return [change for change in self.changes if change.kind == kind]


@dataclass(frozen=True)
class _Drive:
    """Sorted keys of one drive's cells, by state.

    seen : observed; occupied : in the end state and in the sum; certain : of these, those beyond doubt
    free : free beyond doubt; solid : occupied in the end state or in the sum
    """

    seen: Keys
    occupied: Keys
    certain: Keys
    free: Keys
    solid: Keys


def changed_cells(new: Evidence, old: Evidence) -> ChangedCells:
    """Objects of cells occupied in one drive and free in the other; cells that the other never observed are neither.

    A cell is free when its log-odds lie at their lower clamp, where OctoMap calls it stable, with and without clamps: one in
    which something came or went during the drive is neither free nor occupied. A thing needs a cell that is occupied as
    surely. A surface may lie in a cell beside its own, by its noise and that of the poses: cells with an occupied neighbour
    in the other drive have not changed, nor have those with an unseen one beyond a face, where that drive's surface may be,
    as ground that beams graze; unless they border on cells that have.

    Raises ConfigError when the cells of the two are no common ones; InterruptedRunError within `asking`.
    """
    if new.voxel != old.voxel or not np.array_equal(new.origin, old.origin):
        raise ConfigError(
            f"drives in cells of {new.voxel:g} m and {old.voxel:g} m, or of other origins: make them alike"
        )
    after, before = _drive(new), _drive(old)
    changes = [
        *_things("appeared", after, before, new),
        *_things("vanished", before, after, new),
    ]
    same = after.occupied[_beside(after.occupied, before.solid)]
    return ChangedCells(
        tuple(changes),
        _cells(same, new),
        new.voxel,
        len(after.occupied),
        len(before.occupied),
        int((~_among(after.occupied, before.seen)).sum()),
        int((~_among(before.occupied, after.seen)).sum()),
    )


def differences(evidence: Evidence, cloud: Floats) -> tuple[MapChange, ...]:
    """Objects by which a drive differs from a finished map (N, 3), m, in the world of the drive.

    A map tells where surfaces are, not where nothing is. So what `vanished` stood where beams of the drive passed and none
    ended, and what `appeared` is new, or was hidden when the map was made; only squares in which the map has points count.
    """
    cells = np.floor(cloud / evidence.voxel).astype(np.int64)
    known, none = np.unique(_keys(cells, evidence.origin)), np.zeros(0, np.int64)
    drive = _drive(evidence)
    drive = replace(drive, solid=evidence.keys[evidence.has_hits])
    gone = _things("vanished", _Drive(known, known, known, none, known), drive, evidence)
    new = drive.occupied[~_beside(drive.occupied, known)]
    new = new[np.isin(_squares(_cells(new, evidence)), np.unique(_squares(cells)))]
    return (*_objects("appeared", new, _among(new, drive.certain), evidence), *gone)


def _squares(cells: Longs) -> Longs:
    """Number (M,) of the square in the x-y plane that each cell (M, 3) lies in; one square holds many cells."""
    x, y = (cells[:, :2] // KNOWN_CELLS).T
    return np.asarray((x << 32) + y)


def points_in(cloud: Floats, changes: Iterable[MapChange], evidence: Evidence) -> Bools:
    """(N,) which points (N, 3), m, lie in cells of the changes."""
    parts = [change.cells for change in changes]
    if not parts:
        return np.zeros(len(cloud), np.bool_)
    cells = np.floor(cloud / evidence.voxel).astype(np.int64)
    return _among(_keys(cells, evidence.origin), np.sort(_keys(np.concatenate(parts), evidence.origin)))


def _keys(cells: Longs, origin: Longs) -> Keys:
    """Key of each cell (M, 3), -1 beyond the range of keys."""
    from lslam.maps.kernels.cells import AXIS_BITS, HALF

    places = cells - origin + HALF
    is_inside = ((places >= 0) & (places < 2 * HALF)).all(axis=1)
    x, y, z = places.T
    return np.where(is_inside, (x << 2 * AXIS_BITS) | (y << AXIS_BITS) | z, -1)


def _drive(evidence: Evidence) -> _Drive:
    """Sorted keys of the drive's cells: observed, occupied, certain, free, possibly occupied; by the end state and the sum."""
    lowest, highest = int(MODEL[2]), int(MODEL[3])
    in_the_end, in_the_sum = evidence.log_odds, evidence.sums
    return _Drive(
        evidence.keys,
        evidence.keys[(in_the_end > 0) & (in_the_sum > 0)],
        evidence.keys[(in_the_end >= highest) & (in_the_sum >= highest)],
        evidence.keys[(in_the_end <= lowest) & (in_the_sum <= lowest)],
        evidence.keys[(in_the_end > 0) | (in_the_sum > 0)],
    )


def _things(kind: Kind, here: _Drive, there: _Drive, evidence: Evidence) -> list[MapChange]:
    """Connected cells that are occupied in the drive `here` and free in the drive `there`, as objects, the largest first."""
    passed = here.occupied[_among(here.occupied, there.free)]
    alone = passed[~_beside(passed, there.solid) & _open(passed, there.seen)]
    cells = passed[_beside(passed, alone)]
    return _objects(kind, cells, _among(cells, here.certain) & _among(cells, alone), evidence)


def _objects(kind: Kind, cells: Keys, certain: Bools, evidence: Evidence) -> list[MapChange]:
    """Connected cells, of which at least one is `certain`, and more of them than noise makes; the largest first."""
    if not len(cells):
        return []
    labels = _components(cells)
    sizes = np.bincount(labels)
    is_certain = np.bincount(labels, certain) > 0
    kept = np.flatnonzero((sizes > NOISE_CELLS) & is_certain)
    kept = kept[np.argsort(-sizes[kept], kind="stable")]
    return [MapChange(kind, _cells(cells[labels == label], evidence), evidence.voxel) for label in kept]


def _components(keys: Keys) -> Longs:
    """Component number of each of the sorted keys; cells are connected by faces, edges and corners."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    first, second = [], []
    for step in _steps()[14:]:  # those forward: backward are the same pairs
        at = _indices_of(keys + step, keys)
        first.append(np.flatnonzero(at >= 0))
        second.append(at[at >= 0])
    rows, columns = np.concatenate(first), np.concatenate(second)
    pairs = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(len(keys), len(keys)))
    return np.asarray(connected_components(pairs, directed=False)[1], np.int64)


def _beside(keys: Keys, others: Keys) -> Bools:
    """Whether a cell or one of its 26 neighbours is among `others`, which are sorted."""
    near = np.zeros(len(keys), np.bool_)
    for step in _steps():
        check_stop()
        near |= _among(keys + step, others)
    return near


def _open(keys: Keys, seen: Keys) -> Bools:
    """Whether all six face neighbours of a cell are among `seen`, which are sorted."""
    steps = _steps()
    return np.asarray(np.all([_among(keys + steps[k], seen) for k in (4, 10, 12, 14, 16, 22)], axis=0))


def _steps() -> list[int]:
    """Differences of keys to the 27 cells around one, sorted; the cell itself is in the middle."""
    from lslam.maps.kernels.cells import AXIS_BITS

    return [(x << 2 * AXIS_BITS) + (y << AXIS_BITS) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]


def _among(keys: Keys, others: Keys) -> Bools:
    """Mask of the keys that are among `others`, which are sorted."""
    return np.asarray(_indices_of(keys, others) >= 0)


def _indices_of(keys: Keys, others: Keys) -> Longs:
    """Index of each key in `others`, which are sorted; -1 where it is missing."""
    if not len(others):
        return np.full(len(keys), -1, np.int64)
    at = np.minimum(np.searchsorted(others, keys), len(others) - 1)
    return np.where(others[at] == keys, at, -1)


def _cells(keys: Keys, evidence: Evidence) -> Longs:
    """Cell indices (M, 3) of keys (M,)."""
    from lslam.maps.kernels.cells import unpack_cells

    return unpack_cells(keys, evidence.origin)
