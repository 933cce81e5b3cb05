"""The recovery policies that a configuration switches on, in the order in which they are tried.

The search for the start is one: at the first steps nothing is known yet of how fast the sensor moves.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lslam.core.arrays import Bools, Floats, Points
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RecoveryConfig, RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.scan_result import OPEN_RAD
from lslam.registration.alignment import solve, upright_directions, voxel_terms
from lslam.registration.attempt import RECOVER_M, Attempt, Policy
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.history import is_more
from lslam.registration.optimiser import (
    START_ITERATIONS,
    Annealing,
    Correspondences,
    normal_equations,
    optimise,
)
from lslam.registration.preprocessing.ground import Ground, Z, above_ground, ground_of, up_of
from lslam.registration.preprocessing.prepare import PreparedPoints, few_of, subset
from lslam.registration.residuals import MEANS
from lslam.registration.result import RegistrationResult

# m; points this near belong together. Poles and leaves make no planes: their voxels are as large, one point is enough,
# and none of them passes for a plane.
NEAR_M = 0.4
ALL_ALIKE = RegistrationConfig(sigma=NEAR_M, weak_share=0.0)
# m above the ground: crash barriers are lower, along which a sensor's rings match best where nothing moved.
HIGH_M = 1.2
# m; from so far away they find each other: starts that far apart leave no gap, not even between piers of a facade.
START_STEP_M = 1.0
# rad; a hand-held sensor turns at 100 deg/s, by nearly 30 deg at every third scan; so far apart that 20 m away a step is left.
START_TURNS = OPEN_RAD * np.delete(np.arange(-10, 11), 10)
# Along a bare wall the rings repeat best where nothing moved, by five percent: a start elsewhere must have more, and twice
# as much where planes, the prior or both say otherwise.
CLEAR_RATIO = 1.05
MUCH_RATIO = 2 * CLEAR_RATIO - 1


class NonGroundPoints:
    """Non-ground points of a few scans: points (N, 3), LiDAR frame, and pose (4, 4) of each.

    Ground, guard rails and walls are self-similar, and a sensor's own rings match best at zero motion. The pattern of posts,
    trees, signs and ends of walls is unique.
    """

    def __init__(self, scans: Iterable[tuple[Points, Floats]], preprocess: PreprocessConfig) -> None:
        self._cells = GaussianMap(NEAR_M, min_points=1, planarity=np.inf, reach=np.inf, capacity=1 << 12)
        self._up = up_of(preprocess)
        for points, T_world_lidar in scans:
            index = above_ground(points, self._up)
            self._cells.insert(points[index], T_world_lidar)

    def agreeing(self, high: PreparedPoints, T_world_lidar: Floats) -> Bools:
        """Mask (S,) of the points `high` of another scan that have one of these near by, placed at `T_world_lidar` (4, 4)."""
        matches = Correspondences(len(high.source))
        terms = voxel_terms(MEANS, MEANS.points(high, NEAR_M), (self._cells,), matches, NEAR_M)
        normal_equations(terms, T_world_lidar, NEAR_M, matches)
        return (matches.distance2 >= 0) & (matches.distance2 < NEAR_M**2)

    def share(self, high: PreparedPoints, T_world_lidar: Floats) -> float:
        """Share of the points `high` that `agreeing` marks, 0 to 1."""
        return np.count_nonzero(self.agreeing(high, T_world_lidar)) / max(len(high.source), 1)

    def align(self, high: PreparedPoints, T_start: Floats) -> RegistrationResult:
        """Register the points `high` on these, point to point, in x, y and yaw only, starting less than `START_STEP_M` away.

        At the wrong height, or tilted by a degree, rings agree with those of another scan that hit something else.
        """
        level = np.eye(6) - upright_directions(T_start, self._up)
        annealing = Annealing(START_STEP_M, 20, NEAR_M / 2, 0.7)
        return solve((self._cells,), high, T_start, annealing, ALL_ALIKE, residual=MEANS, directions=level)


def ground_under(points: PreparedPoints, preprocess: PreprocessConfig) -> Ground:
    """The ground under a scan."""
    return ground_of(points.map_points, up_of(preprocess))


def high_points(points: PreparedPoints, ground: Ground) -> PreparedPoints:
    """The points of a scan that are high above its ground, to be compared with `NonGroundPoints`."""
    above = points.map_points[ground.above(points.map_points, HIGH_M)]
    return PreparedPoints(above, above.astype(np.float64), np.zeros((len(above), 6)), len(above))


def on_ground(points: PreparedPoints, ground: Ground) -> PreparedPoints:
    """The source points that lie on the ground."""
    is_ground = np.ones(len(points.source), bool)
    is_ground[ground.above(points.source.astype(np.float32))] = False
    return subset(points, is_ground)


class StartSearch:
    """Tries several places along the sensor's axis; the non-ground points of the last scans decide between them.

    Posts and crash barriers repeat every few metres, so the nearest agreement of planes may be a false one.
    """

    name = "start search"

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Search several starts if the result failed or the map is made of the first scans; else return `result`.

        The second scan may lie anywhere in reach.
        """
        is_settled = result.ok and not attempt.history.is_young
        if attempt.config.start_reach == 0 or is_settled:
            return result
        better = best_by_non_ground(attempt, result, may_be_anywhere=attempt.history.inserted == 1)
        return attempt.credit(better, self.name) if better is not result and better.ok else better


def best_by_non_ground(
    attempt: Attempt, result: RegistrationResult, *, may_be_anywhere: bool = False
) -> RegistrationResult:
    """The result, unless significantly more non-ground points of the last scans are inliers elsewhere.

    may_be_anywhere : whether the sensor may be anywhere within `start_reach`, as after a failed registration
    """
    target, c, points, T_prior = attempt.target, attempt.config, attempt.points, attempt.T_prior
    ground = ground_under(points, target.preprocess)
    non_ground, high = NonGroundPoints(attempt.history.recent, target.preprocess), high_points(points, ground)
    if may_be_anywhere:
        result = _best_start(attempt, result, non_ground, high)
    coarser = target.coarse_maps(points, T_prior)
    flat = on_ground(points, ground)

    def place_upright(start: Floats) -> RegistrationResult:
        """Height and tilt by the ground, the rest by non-ground points, in turn as in LeGO-LOAM (Shan and Englot 2018)."""
        aligned = non_ground.align(high, upright(start))
        return aligned.with_pose(upright(aligned.T_world_lidar), aligned.covariance)

    def upright(pose: Floats) -> Floats:
        directions = upright_directions(pose, up_of(target.preprocess))
        problem = target.problem(flat, pose, RECOVER_M, START_ITERATIONS, coarser, directions)
        return optimise(problem).T_world_lidar

    def agreeing(at: RegistrationResult) -> Bools:
        return non_ground.agreeing(high, at.T_world_lidar)

    starts = [T_prior]
    if may_be_anywhere or not result.ok:
        starts.append(_likeliest(non_ground, high, T_prior, c.start_reach, up_of(target.preprocess)))
    aligned = max(map(place_upright, starts), key=lambda at: np.count_nonzero(agreeing(at)))
    place, most = aligned.T_world_lidar, agreeing(aligned)
    last = attempt.history.recent[-1][1]
    is_drawn = result.ok and is_at_rest(place, last)
    # What rings draw there is no evidence that it is there.
    margin = CLEAR_RATIO if is_at_rest(result.T_world_lidar, last) else MUCH_RATIO
    if is_drawn or not is_much_more(most, agreeing(result), margin):
        return result
    near = optimise(target.problem(points, place, RECOVER_M, START_ITERATIONS, target.coarse_maps(points, place)))
    judged = attempt.judge(near, place)
    if not judged.ok and not result.ok:
        return result
    if not judged.ok or len(judged.degenerate) or is_much_more(most, agreeing(judged)):
        judged = near.with_pose(place, aligned.covariance)
    return replace(judged, iterations=result.iterations + near.iterations)


def _best_start(
    attempt: Attempt, best: RegistrationResult, non_ground: NonGroundPoints, high: PreparedPoints
) -> RegistrationResult:
    """The result from the best of several starts, if it is clearly better than `best`.

    Every start is tried with a few points on the coarse map; the one with most agreement gets a whole registration.
    """
    target, count = attempt.target, len(high.source)
    coarse_map, few = target.coarse_maps(attempt.points, attempt.T_prior)[0], few_of(attempt.points)
    slow = Annealing.slow(2 * START_STEP_M)
    trials = [
        solve((coarse_map,), few, attempt.T_prior @ se3.make(np.eye(3), offset), slow, attempt.config)
        for offset in start_offsets(attempt.config.start_reach, START_STEP_M, up_of(target.preprocess))
    ]
    # Without non-ground points, as in hills, the ground decides.
    start = min(trials, key=lambda at: (-non_ground.share(high, at.T_world_lidar), -at.inliers)).T_world_lidar
    # Once more as wide as from an unknown start, what was found right could be drawn to the false place again.
    result = attempt.judge(target.coarse_to_fine(attempt.points, start, 2 * START_STEP_M), start)
    share, usual = (non_ground.share(high, at.T_world_lidar) for at in (result, best))
    if count == 0:
        share, usual = result.agreement, best.agreement
    # A failed one has the prior's pose: fewer inliers than there are no improvement.
    return result if result.ok and (share > CLEAR_RATIO * usual if best.ok else share >= usual) else best


def _likeliest(non_ground: NonGroundPoints, high: PreparedPoints, T_prior: Floats, reach: float, up: Floats) -> Floats:
    """The pose (4, 4) at which most points `high` agree with `non_ground`, of shifts and rotations of the prior.

    reach : m, of the shifts; up : (3,) axis of the rotations, LiDAR frame
    """
    moved = [T_prior @ se3.make(np.eye(3), offset) for offset in start_offsets(reach, NEAR_M, up)]
    turned = [T_prior @ se3.make(so3.exp(turn * up), np.zeros(3)) for turn in START_TURNS]
    return max([*moved, *turned], key=lambda start: non_ground.share(high, start))


def is_at_rest(pose: Floats, last: Floats) -> bool:
    """Whether the pose (4, 4) is so near to the last scan's that the sensor's own rings, on roofs or walls, explain it."""
    move, turn = se3.magnitude(se3.relative(last, pose))
    return bool(move < 2 * NEAR_M and turn < OPEN_RAD)


def is_much_more(ours: Bools, others: Bools, margin: float = MUCH_RATIO) -> bool:
    """Whether `margin` times as many points agree at one pose as at the other, and not by chance: flags (S,) of the same.

    McNemar's test of paired shares at two sigma, on the points that agree at one of the poses only.
    """
    won, lost = np.count_nonzero(ours & ~others), np.count_nonzero(others & ~ours)
    return bool(np.count_nonzero(ours) > margin * np.count_nonzero(others) and is_more(int(won), int(lost)))


def start_offsets(reach: float, step: float, up: Floats = Z) -> Floats:
    """(N, 3) m in the LiDAR frame, nearest first: level, ahead and back up to `reach`, sideways one step at most."""
    count = int(np.ceil(reach / step - 1e-9))
    ahead = [sign * min(k * step, reach) for k in range(1, count + 1) for sign in (1, -1)]
    sideways = [sign * min(step, reach) for sign in (1, -1)] if count else []
    offsets = np.array([(x, 0.0, 0.0) for x in ahead] + [(0.0, y, 0.0) for y in sideways]).reshape(-1, 3)
    return offsets[np.argsort(np.linalg.norm(offsets, axis=1), kind="stable")] @ so3.level_frame(up)


@dataclass(frozen=True)
class CoarseToFine:
    """Aligns with the coarse planes, annealed slowly, then with the fine ones; of two results the larger consensus is taken.

    Fine registration alone loses a start above 0.7 m per scan: its kernel opens no wider than its voxels.

    of_features : features are few: their share says nothing, and at the start neither does their number
    """

    of_features: bool = False
    name = "coarse-to-fine"

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Align coarse to fine if the speed is unknown, or the result failed, corrects its prior by much or has few inliers.

        Returns the alignment with more inliers; otherwise `result`.
        """
        usual, is_started = attempt.history.agreement, attempt.history.starting == 0
        is_certain = result.ok and attempt.is_small(result) and is_started
        if is_certain and (self.of_features or not usual.is_less(result.agreement)):
            return result
        coarse: RegistrationResult = attempt.target.capture(attempt)
        iterations = result.iterations + coarse.iterations
        # Forty steps that lead nowhere are no consensus; the ten of a usual scan may end a millimetre short of it. Where all
        # points began the coarse alignment, they know more than features: rings repeat best where the sensor stands.
        is_telling = not attempt.target.begins_by_points(attempt) if self.of_features else result.converged
        is_consensus = result.ok and (is_started or is_telling)
        is_better = coarse.ok and (not is_consensus or coarse.inliers > result.inliers)
        if is_certain:
            # What hides part of the map, as a crowd does, hides it from both.
            is_better = is_better and not usual.is_less(coarse.agreement)
        if not is_better:
            return replace(result, iterations=iterations)
        # The features go on from there: the method itself found the pose.
        pose_source = coarse.pose_source if self.of_features else self.name
        return replace(coarse, iterations=iterations, pose_source=pose_source)


class AtRest:
    """Keeps a sensor at rest where it stood, unless more objects must have moved for that than if the sensor moved.

    At traffic lights most points lie on vehicles. Where these drive off together, their points outnumber those of the street,
    all of which must have come along if the sensor moved.
    """

    name = "at rest"

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """The pose where the sensor stood, if the result leaves that spot and fewer objects moved if the sensor still stands.

        Otherwise `result`.
        """
        rest, T_registered = attempt.history.rest, result.T_world_lidar
        is_standing = rest.scans >= attempt.config.start_scans
        if not (result.ok and is_standing) or rest.is_here(T_registered, result.lever_arm):
            return result
        if not rest.votes(attempt.target.cloud(attempt.points), T_registered).is_standing:
            return result
        return attempt.credit(result.with_pose(rest.T_world_lidar.copy(), result.covariance), self.name)


def policies_of(config: RecoveryConfig) -> tuple[Policy, ...]:
    """Policies of points that are switched on, nearest first: each sees what those before it found."""
    switches: tuple[tuple[bool, Policy], ...] = (
        (config.coarse_to_fine, CoarseToFine()),
        (config.start_search, StartSearch()),
        (config.at_rest, AtRest()),
    )
    return tuple(policy for is_on, policy in switches if is_on)
