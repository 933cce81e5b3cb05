"""Elastic registration: the poses at the begin and at the end of a sweep in one estimate (CT-ICP).

Dellenbach et al. 2022, sections III-A to III-C. A sweep is held to the last one by location consistency and constant velocity,
each as surely as it lately held. A spinning sensor sees every direction at the same share of each sweep. A map that was begun
with wrong motion within the sweep is skewed from direction to direction, and all sweeps registered on it agree with that error:
it is one more unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import se3, so3
from lslam.core.geometry.noise import changes
from lslam.core.kernels import linearisation as at
from lslam.core.kernels.gauss_newton import UNSEEN_SHARE
from lslam.core.types.motion_prior import MotionPrior
from lslam.registration.alignment import voxel_terms
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import STEP_M, STEP_RAD, Annealing, Correspondences, Term
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.prepare import PreparedPoints, subset
from lslam.registration.residuals import find_residual
from lslam.registration.result import RegistrationResult


@dataclass(frozen=True)
class ElasticSweep:
    """Poses (4, 4) at the begin and the end of a sweep, translation linear and rotation along the geodesic between them.

    times : (K,) s from the stamp; bend : (K, 4, 4) by which the motion departs from that, in the sensor's axes at each time:
    what an IMU felt; None: nothing
    """

    begin: Floats
    end: Floats
    times: Floats
    bend: Floats | None = None

    @classmethod
    def of(cls, prior: MotionPrior) -> ElasticSweep:
        """Sweep from the first to the last pose of the prior; if an IMU measured it, the motion in between is kept (`bend`)."""
        straight = cls(prior.poses[0], prior.poses[-1], prior.times)
        if not prior.is_bent:
            return straight
        return cls(straight.begin, straight.end, prior.times, se3.relative(straight.poses, prior.poses))

    @property
    def shares(self) -> Floats:
        """(K,) of the sweep, 0 to 1."""
        return np.asarray((self.times - self.times[0]) / (self.times[-1] - self.times[0]))

    @property
    def poses(self) -> Floats:
        """(K, 4, 4) T_world_lidar at `times`."""
        shares = self.shares[:, None]
        turn = so3.log(self.begin[:3, :3].T @ self.end[:3, :3])
        t = (1.0 - shares) * self.begin[:3, 3] + shares * self.end[:3, 3]
        straight = se3.make(self.begin[:3, :3] @ so3.exp(shares * turn), t)
        return straight if self.bend is None else straight @ self.bend

    @property
    def prior(self) -> MotionPrior:
        """The same as a motion over the sweep."""
        return MotionPrior(self.times, self.poses)

    def move(self, d: Floats) -> ElasticSweep:
        """The sweep with both end poses updated by d (2, 6): t' = t + d[:3], R' = exp(d[3:]) R."""
        begin, end = (
            se3.make(so3.exp(step[3:]) @ pose[:3, :3], pose[:3, 3] + step[:3])
            for step, pose in zip(d, (self.begin, self.end), strict=True)
        )
        return ElasticSweep(se3.normalise(begin), se3.normalise(end), self.times, self.bend)


# m and rad, what registration cannot tell from none of the map's skew, the mean of many scans.
LEAST_SKEW = 1e-4
NOTHING: Floats = np.zeros((6, 6))


@dataclass(frozen=True)
class ElasticConstraints:
    """Prior information about a sweep, independent of its points; information matrices (6, 6) in world axes.

    expected, location : its predicted begin, and the information on that; velocity : information that the velocity within
        it equals that since the middle of the last one; since : the sweep's part of the time since then
    skew, skew_information : (6,) motion from begin to end that the map's sweeps lack, and the information on that
    """

    expected: ElasticSweep
    location: Floats
    velocity: Floats
    since: float
    skew: Floats
    skew_information: Floats

    @classmethod
    def of_course(cls, prior: MotionPrior) -> ElasticConstraints:
        """Constraints of a sweep whose prior is smoothed with later scans: its motion is fixed, and the map has no skew."""
        assert prior.change is not None
        fixed = np.eye(6) / LEAST_SKEW**2
        return cls(ElasticSweep.of(prior), NOTHING, inverse(prior.change), 0.0, np.zeros(6), fixed)

    def add_to(self, A: Floats, b: Floats, sweep: ElasticSweep) -> None:
        """Add all constraints to the normal equations (18, 18), (18,) of begin, end and skew, in place.

        Location consistency and constant velocity: Dellenbach et al. 2022, section III-B.
        """
        begin, end = changes(self.expected.begin, sweep.begin), changes(self.expected.end, sweep.end)
        # The middle is half of both ends.
        steady = (-1.0 - self.since / 2, 1.0 - self.since / 2, 0.0)
        for W, signs in (
            (self.location, (1.0, 0.0, 0.0)),
            (self.velocity, steady),
            (self.skew_information, (0.0, 0.0, 1.0)),
        ):
            b += np.kron(signs, W @ (signs[0] * begin + signs[1] * end - signs[2] * self.skew))
            A += np.kron(np.outer(signs, signs), W)


def inverse(covariance: Floats) -> Floats:
    """Inverse of a covariance or of an information matrix (N, N)."""
    return np.asarray(np.linalg.inv(covariance), np.float64)


# Parts of a sweep whose points are linearised together. Within an eighth, what a point tells of begin and end differs from
# the mean of its part by 1/28 rms: of the information 2 % are lost, and nothing is biased.
SWEEP_PARTS = 8


@dataclass(frozen=True)
class ElasticResult:
    """The sweep and the map's skew (6,) that were found, and the pose at the stamp as any registration's.

    covariance : (18, 18) of begin, end and skew, world axes
    """

    sweep: ElasticSweep
    skew: Floats
    covariance: Floats
    result: RegistrationResult


class SweepPoints:
    """Source points sorted by time, in `SWEEP_PARTS` parts that share the map's levels but have correspondences of their own.

    sigma : standard deviation of a point, m
    """

    def __init__(self, points: PreparedPoints, levels: Sequence[GaussianMap], sigma: float) -> None:
        assert points.source_times is not None
        order = np.argsort(points.source_times, kind="stable").astype(np.int64)
        self.times = points.source_times[order]
        self.points = subset(points, order)
        self._moved = np.empty_like(self.points.source)
        bounds = np.linspace(0, len(order), SWEEP_PARTS + 1).round().astype(int)
        self.parts = [slice(a, b) for a, b in pairwise(bounds.tolist())]
        self.matches = [Correspondences(part.stop - part.start) for part in self.parts]
        kind = find_residual("plane")
        self._terms: list[list[Term]] = [
            voxel_terms(kind, (self._moved[part], self.points.scatter[part]), levels, matches, sigma)
            for part, matches in zip(self.parts, self.matches, strict=True)
        ]

    def shares(self, sweep: ElasticSweep) -> Floats:
        """(SWEEP_PARTS,) mean share of the sweep that is over when a part was measured."""
        begin, end = sweep.times[0], sweep.times[-1]
        return np.array([(self.times[part].mean(dtype=np.float64) - begin) / (end - begin) for part in self.parts])

    def linearise(self, prior: MotionPrior, width: tuple[float, float, float]) -> tuple[Floats, Floats, Floats]:
        """H (SWEEP_PARTS, 6, 6), g (SWEEP_PARTS, 6) about the pose at the stamp, and facts of the points placed by `prior`."""
        self._moved[:] = deskew_points(self.points.source, self.times, prior)
        T = prior.pose
        pose = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        H, g, facts, unused = (
            np.zeros((SWEEP_PARTS, 6, 6)),
            np.zeros((SWEEP_PARTS, 6)),
            np.zeros(at.COUNT),
            np.zeros((6, 6)),
        )
        for k, (terms, matches) in enumerate(zip(self._terms, self.matches, strict=True)):
            matches.clear()
            for term in terms:
                term.linearise(
                    term.points, term.target, term.settings, term.search, pose, width, (H[k], unused, g[k], facts)
                )
        return np.triu(H) + np.swapaxes(np.triu(H, 1), 1, 2), g, facts


def register_elastic(
    points: SweepPoints, start: ElasticSweep, constraints: ElasticConstraints, annealing: Annealing, weak_share: float
) -> ElasticResult:
    """Both poses of a sweep by annealed Gauss-Newton; each step places the points anew at their own times.

    The pose at the stamp is interpolated between both ends. Degenerate directions are those of the sweep as a rigid whole.
    Fewer matches than a pose has unknowns end the iteration: the result is then not ok. `weak_share` as in
    `solve_guarded_step`.
    """
    scale, iterations, converged, d, skew = annealing.start, 0, False, np.zeros((2, 6)), np.zeros((1, 6))
    sweep, shares = start, points.shares(start)
    passed = float(-start.times[0] / (start.times[-1] - start.times[0]))
    A, facts = np.zeros((18, 18)), np.zeros(at.COUNT)
    weak = np.zeros((0, 6))
    while iterations < annealing.steps and not converged:
        iterations += 1
        prior = sweep.prior
        H, g, facts = points.linearise(prior, (scale, annealing.end, np.inf))
        if facts[at.MATCHED] < d.shape[1]:
            break
        H, g = _about_sensor(H, g, sweep, shares, prior.pose[:3, 3])
        A, b = _to_ends_and_skew(H, g, shares)
        lever = np.sqrt(max(facts[at.LEVER] / max(facts[at.INFORMATION], 1e-300), 1e-6))
        weak = _weak(H.sum(0), lever, weak_share * facts[at.INFORMATION])
        constraints.add_to(A, b, sweep)
        d, skew = np.split(_step(A, b, lever, UNSEEN_SHARE * weak_share * facts[at.INFORMATION]).reshape(3, 6), [2])
        if not np.isfinite(d).all():
            break
        move, turn = (float(np.linalg.norm(d[:, part], axis=1).max()) for part in (slice(0, 3), slice(3, 6)))
        d *= min(1.0, 2.0 * max(scale, 0.5) / max(move, 1e-12))
        sweep = sweep.move(d)
        converged = scale <= annealing.end and move < STEP_M and turn < STEP_RAD
        scale = max(scale * annealing.decay, annealing.end)
    at_stamp = np.hstack([(1.0 - passed) * np.eye(6), passed * np.eye(6)])
    covariance = np.asarray(np.linalg.pinv(A, hermitian=True), np.float64)
    information = np.asarray(np.linalg.pinv(at_stamp @ covariance[:12, :12] @ at_stamp.T, hermitian=True), np.float64)
    pose = sweep.prior.pose
    result = RegistrationResult.of(
        pose,
        information,
        facts,
        start.prior.pose,
        step=at_stamp @ d.ravel(),
        weak=weak,
        source_points=len(points.times),
        iterations=iterations,
        converged=converged,
    )
    return ElasticResult(sweep, skew[0], covariance, result)


def _about_sensor(H: Floats, g: Floats, sweep: ElasticSweep, shares: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """Equations H (K, 6, 6), g (K, 6) of the parts of a sweep, with rotations about the sensor's position in each part.

    The given ones rotate about `centre` (3,); shares : (K,) of the sweep that is over when a part was measured.
    """
    places = (1.0 - shares)[:, None] * sweep.begin[:3, 3] + shares[:, None] * sweep.end[:3, 3]
    G = np.tile(np.eye(6), (len(shares), 1, 1))
    G[:, :3, 3:] = so3.hat(places - centre)
    transposed = np.swapaxes(G, 1, 2)
    return transposed @ H @ G, (transposed @ g[..., None])[..., 0]


def _to_ends_and_skew(H: Floats, g: Floats, shares: Floats) -> tuple[Floats, Floats]:
    """Normal equations (18, 18), (18,) of begin pose, end pose and map skew, from the sums by parts H, g.

    A part at `share` of the sweep moves with `1 - share` of the begin and `share` of the end. A map made of sweeps that lack the
    motion `skew` from begin to end shows that part too near by `share - 1/2` of it.
    """
    weights = np.stack([1.0 - shares, shares, 0.5 - shares], axis=1)
    A = np.einsum("ka,kb,kij->aibj", weights, weights, H).reshape(18, 18)
    return A, np.einsum("ka,ki->ai", weights, g).ravel()


def _scale(lever: float) -> Floats:
    """Factors (6,) on a twist that make its rotations comparable with translations at a lever arm, m."""
    return np.array([1.0, 1.0, 1.0, 1.0 / lever, 1.0 / lever, 1.0 / lever])


def _weak(H: Floats, lever: float, least: float) -> Floats:
    """(K, 6) directions of a sweep about which H (6, 6) has less information than `least`, rotations scaled by `lever`, m."""
    scale = _scale(lever)
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    return np.ascontiguousarray(vectors.T[values <= least])


def _step(A: Floats, b: Floats, lever: float, least: float) -> Floats:
    """Gauss-Newton step -inv(A) b (18,), zero in eigenvectors of A (18, 18) with less information than `least`.

    Rotations are scaled by `lever`, m.
    """
    scale = np.tile(_scale(lever), 3)
    values, vectors = np.linalg.eigh(A * np.outer(scale, scale))
    along = vectors.T @ (scale * b)
    followed = values > max(least, 1e-12 * float(values[-1]))
    return np.asarray(-scale * (vectors @ np.where(followed, along / np.where(followed, values, 1.0), 0.0)))
