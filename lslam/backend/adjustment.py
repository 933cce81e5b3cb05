"""Plane adjustment: all poses of drives are corrected at once, so that what many scans saw of a plane lies on one plane.

The cost is the variance of points about the planes of adaptive voxels, as in BALM2 (Liu et al. 2023). Planes are
eliminated, and the reduced system is solved by conjugate gradients, since a plane joins all scans that saw it. Corrections vary
linearly from one pose to the next, so that the motion within a sweep is corrected as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from lslam.backend.graph.marginals import PosePrior
from lslam.backend.kernels import plane_adjustment
from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.geometry import noise, se3, so3
from lslam.core.stopping import checking

# m, edges of voxels: what is no plane in one is looked at in the next.
EDGES_M = (2.0, 1.0, 0.5)
# Least points of a plane, least scans that see it, and its least breadth as a part of the edge.
LEAST_POINTS, LEAST_SCANS, LEAST_BREADTH = 20, 4, 0.1
FLOOR_M = 0.005  # m, no surface is flatter
LEVER_M = 10.0  # m, at which a rotation counts as much as the translation


@dataclass(frozen=True)
class AdjustmentLevel:
    """One level of the adjustment, from coarse to fine.

    scans : between two knots, of which the corrections are unknowns; those between are interpolated
    flatness : largest variance across a plane as a part of that along its narrower side
    step_m : sigma of the difference of two successive corrections, which holds what no plane does
    is_free : of the corrections of one round alone, so that they may add up to any size
    rounds : at most; settled_m : rms of the corrections after which the next level begins
    """

    scans: int
    flatness: float
    step_m: float
    is_free: bool
    rounds: int
    settled_m: float


# Walls that lie apart are brought together first, by knots so few that nothing else is changed; then every pose.
LEVELS = (AdjustmentLevel(10, 0.02, 0.02, True, 8, 5e-3), AdjustmentLevel(1, 0.005, 1.5e-3, False, 4, 5e-4))
NO_NUMBERS: Longs = np.zeros(0, np.int64)
NO_POINTS: Floats = np.zeros((0, 3))
ONE_DRIVE: Longs = np.zeros(1, np.int64)
# Conjugate gradients: steps at most, and the part of the first residual that ends them.
STEPS, ACCURACY = 300, 1e-4


@dataclass(frozen=True)
class SweptPoints:
    """Points of all scans in the order in which they were measured.

    points : (N, 3) m, world; poses : (N,) number of the last pose before each, or the first one
    shares : (N,) 0..1 of the way from that pose to the next
    """

    points: Floats
    poses: Longs
    shares: Floats

    def select(self, mask: Bools) -> SweptPoints:
        """The points that the mask (N,) selects."""
        return SweptPoints(self.points[mask], self.poses[mask], self.shares[mask])

    @classmethod
    def at_times(cls, points: Floats, times: Floats, stamps: Floats) -> SweptPoints:
        """Points (N, 3) measured at `times` (N,), s, by a sensor whose poses have the ascending `stamps` (K,), s."""
        order = np.argsort(times, kind="stable")
        points, times = points[order], times[order]
        return cls(points, *plane_adjustment.place_between(times, stamps))

    @classmethod
    def chain(cls, parts: Iterable[SweptPoints], firsts: Longs) -> SweptPoints:
        """Points of several drives, one behind the other; firsts : (S,) number of the first pose of each."""
        own = [replace(part, poses=part.poses + first) for part, first in zip(parts, firsts.tolist(), strict=True)]
        if len(own) == 1:
            return own[0]
        return cls(*(np.concatenate([getattr(part, name) for part in own]) for name in ("points", "poses", "shares")))

    def on_knots(self, knots: Longs) -> SweptPoints:
        """The points referred to the poses with numbers `knots` (M,) alone: `poses` and `shares` count between these.

        The first and the last pose must be knots.
        """
        places = plane_adjustment.place_between(self.poses + self.shares, knots.astype(np.float64))
        return SweptPoints(self.points, *places)

    def move(self, poses: Floats, corrections: Floats) -> None:
        """Move the points (N, 3), in place, by `corrections` (K, 6) of the `poses` (K, 4, 4)."""
        origins, turns = np.ascontiguousarray(poses[:, :3, 3]), so3.exp(corrections[:, 3:])
        plane_adjustment.move(self.points, self.poses, self.shares, origins, turns, corrections[:, :3].copy())


@dataclass(frozen=True)
class Adjustment:
    """poses : (K, 4, 4); rounds : how often planes were looked for."""

    poses: Floats
    rounds: int


def adjust(
    poses: Floats,
    sweep: SweptPoints,
    mask: Bools,
    prior: PosePrior | None = None,
    numbers: Longs = NO_NUMBERS,
    firsts: Longs = ONE_DRIVE,
) -> Adjustment:
    """Correct the `poses` (K, 4, 4) so that points on common planes get thinner; only points of the `mask` (N,) are used.

    prior : information about some poses; numbers : (K,) their indices in it, -1 for poses without
    firsts : (S,) index of the first pose of each drive, which no motion joins to the pose before
    All points of `sweep` are moved with the poses, in place. Without a prior that fixes the poses as a whole, the mean
    correction is about zero.
    """
    rounds, ends = 0, np.append(firsts[1:], len(poses))
    for level in LEVELS:
        knots = np.unique(
            np.concatenate([np.append(np.arange(a, b, level.scans), b - 1) for a, b in zip(firsts, ends, strict=True)])
        )
        is_step = ~np.isin(knots[1:], firsts)
        places = SweptPoints(NO_POINTS, np.arange(len(poses)), np.zeros(len(poses))).on_knots(knots)
        total = np.zeros((len(knots), 6))
        for _ in checking(range(level.rounds)):
            on_knots = None if prior is None else _knot_prior(prior, numbers, poses, places, poses[knots])
            sightings = _sightings(sweep.select(mask).on_knots(knots), level.flatness)
            if sightings is None:
                break
            corrections = _corrections(poses[knots], sightings, level, total, is_step, on_knots)
            if not level.is_free:
                total += corrections
            sweep.on_knots(knots).move(poses[knots], corrections)
            poses = _move_poses(poses, places, poses[knots], corrections)
            rounds += 1
            if float(np.sqrt(np.mean(np.sum(corrections[:, :3] ** 2, axis=1)))) < level.settled_m:
                break
    return Adjustment(poses, rounds)


def _move_poses(poses: Floats, places: SweptPoints, knots: Floats, corrections: Floats) -> Floats:
    """The `poses` (K, 4, 4) at `places` after `corrections` (M, 6) of the poses `knots` (M, 4, 4)."""
    after, share = np.minimum(places.poses + 1, len(knots) - 1), places.shares[:, None]
    turns = (1.0 - share) * corrections[places.poses, 3:] + share * corrections[after, 3:]
    positions = poses[:, :3, 3].copy()
    replace(places, points=positions).move(knots, corrections)
    return se3.normalise(se3.make(so3.exp(turns) @ poses[:, :3, :3], positions))


@dataclass(frozen=True)
class _KnotPrior:
    """A pose prior in terms of the corrections of the two knots about each pose.

    knots : (2, K) their indices, J : (2, K, 6, 6) effect of their corrections; changes : (K, 6) of the poses so far
    which : (K,) indices of these poses among those of `of_poses`
    """

    of_poses: PosePrior
    which: Longs
    knots: Longs
    J: Floats
    changes: Floats

    def product(self, x: Floats) -> Floats:
        """Information matrix of the prior times corrections x (M, 6) of all knots."""
        return self._back(np.einsum("skij,skj->ki", self.J, x[self.knots]), len(x))

    def gradient(self, count: int) -> Floats:
        """Gradient (count, 6) of the prior with respect to the knots' corrections, by the poses' changes so far."""
        return self._back(self.changes, count)

    def blocks(self, count: int) -> Floats:
        """Diagonal blocks (count, 6, 6) of the prior's information on the knots, before unknowns are eliminated."""
        out = np.zeros((count, 6, 6))
        np.add.at(out, self.knots, np.swapaxes(self.J, -1, -2) @ self.of_poses.blocks[self.which] @ self.J)
        return out

    def _back(self, changes: Floats, count: int) -> Floats:
        """Gradient (count, 6) at the knots for pose `changes` (K, 6), through the prior's information and J transposed."""
        everywhere = np.zeros((len(self.of_poses.poses), 6))
        everywhere[self.which] = changes
        force = self.of_poses.product(everywhere)[self.which]
        out = np.zeros((count, 6))
        np.add.at(out, self.knots, np.einsum("skji,kj->ski", self.J, force))
        return out


def _knot_prior(prior: PosePrior, numbers: Longs, poses: Floats, places: SweptPoints, knots: Floats) -> _KnotPrior:
    """The prior on the poses with `numbers` >= 0, at `places`, as a prior on the corrections of the `knots` (M, 4, 4)."""
    which = np.flatnonzero(numbers >= 0)
    own = numbers[which]
    at = np.stack([places.poses[own], np.minimum(places.poses[own] + 1, len(knots) - 1)])
    shares = np.stack([1.0 - places.shares[own], places.shares[own]])
    J = np.zeros((2, len(own), 6, 6))
    J[:] = np.eye(6)
    J[..., :3, 3:] = -so3.hat(poses[own, :3, 3] - knots[at, :3, 3])
    return _KnotPrior(prior, which, at, shares[..., None, None] * J, noise.changes(prior.poses[which], poses[own]))


@dataclass(frozen=True)
class _Sightings:
    """Points of each plane that each scan saw, summarised, plane after plane.

    starts : (V + 1,) first sighting of each plane; poses, shares : (C,) mean of those of the swept points
    means, covariances : (C, 3), (C, 3, 3) of the sightings' points, m and m2, world
    """

    starts: Longs
    poses: Longs
    shares: Floats
    means: Floats
    covariances: Floats


def _sightings(sweep: SweptPoints, flatness: float) -> _Sightings | None:
    """Sightings of the planes that the points of `sweep` lie on; None when there is no plane.

    flatness : as of `find_planes`
    """
    planes = find_planes(sweep.points, sweep.poses, flatness)
    order = np.flatnonzero(planes >= 0)
    if not len(order):
        return None
    order = order[np.argsort(planes[order], kind="stable")]
    planes, at = planes[order], sweep.poses[order]
    is_first = np.append(True, (np.diff(planes) != 0) | (np.diff(at) != 0))
    sighting = np.cumsum(is_first) - 1
    numbers, means, covariances = plane_adjustment.sums(sighting, int(sighting[-1]) + 1, sweep.points[order])
    shares = np.bincount(sighting, sweep.shares[order]) / numbers
    seen = planes[is_first]
    return _Sightings(np.searchsorted(seen, np.arange(int(seen[-1]) + 2)), at[is_first], shares, means, covariances)


def _corrections(
    poses: Floats, seen: _Sightings, level: AdjustmentLevel, total: Floats, is_step: Bools, prior: _KnotPrior | None
) -> Floats:
    """(K, 6) corrections of one Gauss-Newton step, solved by conjugate gradients.

    total : (K, 6) corrections so far, for the smoothness term; is_step : (K - 1,) whether motion joins a pose to the next
    prior : information about some poses
    """
    origins = np.ascontiguousarray(poses[:, :3, 3])
    sightings = seen.starts, seen.poses, seen.shares, seen.means
    H, beside, g, normals, planes, slopes = plane_adjustment.equations(
        *sightings, seen.covariances, origins, FLOOR_M**2
    )

    stiff = np.repeat([level.step_m**-2, (level.step_m / LEVER_M) ** -2], 3)
    stiffness = np.where(is_step[:, None], stiff, 0.0)

    def product(x: Floats) -> Floats:
        out = np.empty_like(x)
        plane_adjustment.product(x, H, beside, *sightings, origins, normals, planes, slopes, stiffness, out)
        return out if prior is None else out + prior.product(x)

    diagonal = H + np.diag(2.0 * stiff) + (0.0 if prior is None else prior.blocks(len(H)))
    preconditioner = plane_adjustment.inverses(diagonal)
    force = stiffness * np.diff(total, axis=0)
    pull = np.zeros_like(g)
    pull[1:] += force
    pull[:-1] -= force
    if prior is not None:
        pull += prior.gradient(len(g))
    return _conjugate_gradients(product, -g - pull, preconditioner)


def _conjugate_gradients(product: Callable[[Floats], Floats], right: Floats, preconditioner: Floats) -> Floats:
    """x (K, 6) with product(x) close to `right` (K, 6), in `STEPS` at most; preconditioner : (K, 6, 6) inverse blocks."""
    x, rest = np.zeros_like(right), right.copy()
    z = np.einsum("kij,kj->ki", preconditioner, rest)
    way, size = z.copy(), float(np.sum(rest * z))
    enough = ACCURACY**2 * size
    for _ in checking(range(STEPS)):
        if size <= enough:
            break
        pushed = product(way)
        step = size / float(np.sum(way * pushed))
        x += step * way
        rest -= step * pushed
        z = np.einsum("kij,kj->ki", preconditioner, rest)
        before, size = size, float(np.sum(rest * z))
        way = z + size / before * way
    return x


def find_planes(points: Floats, poses: Longs, flatness: float) -> Longs:
    """(N,) index of the plane that each point (N, 3) lies on, -1 for none; poses : (N,) ascending numbers of their scans.

    A plane is the largest voxel whose points are flat, seen by several scans, and spread in two directions.
    flatness : largest ratio of the smallest to the middle eigenvalue of their covariance
    """
    planes, count = np.full(len(points), -1, np.int64), 0
    left = np.arange(len(points))
    for edge in EDGES_M:
        some = points[left]
        cells, scans = plane_adjustment.number_cells(some, poses[left], edge)
        is_plane = (np.bincount(cells) >= LEAST_POINTS) & (scans >= LEAST_SCANS)
        # Of most cells nothing more is needed.
        places = np.where(is_plane, np.cumsum(is_plane) - 1, -1)
        _, _, covariances = plane_adjustment.sums(places[cells], int(is_plane.sum()), some)
        thin, narrow, _ = plane_adjustment.spectra(covariances).T
        is_plane[is_plane] = (thin < flatness * narrow) & (narrow > (LEAST_BREADTH * edge) ** 2)
        planes[left] = np.where(is_plane, count + np.cumsum(is_plane) - 1, -1)[cells]
        count += int(is_plane.sum())
        left = left[planes[left] < 0]
    return planes
