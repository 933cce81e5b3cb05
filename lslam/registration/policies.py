"""The recovery policies that a configuration switches on, in the order in which they are tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lslam.core.config.odometry import RecoveryConfig
from lslam.registration.attempt import Attempt, Policy
from lslam.registration.result import RegistrationResult
from lslam.registration.robust import is_more
from lslam.registration.start_search import StartSearch


@dataclass(frozen=True)
class CoarseToFine:
    """Aligns with the coarse planes, annealed slowly, then with the fine ones; of two results the larger consensus is taken.

    Fine registration alone loses a start above 0.7 m per scan: its kernel opens no wider than its voxels.

    of_features : features are few: their share says nothing, and at the start they need a consensus that is larger by two sigma
    """

    of_features: bool = False
    name = "coarse-to-fine"

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Acts while the speed is unknown, and on results that fail, correct their prior by much or agree less than usual."""
        usual, is_started = attempt.history.agreement, attempt.history.starting == 0
        is_certain = result.ok and attempt.is_small(result) and is_started
        if is_certain and (self.of_features or not usual.is_less(result.agreement)):
            return result
        coarse: RegistrationResult = attempt.target.capture(attempt)
        iterations = result.iterations + coarse.iterations
        # Forty steps that lead nowhere are no consensus; the ten of a usual scan may end a millimetre short of it.
        is_consensus = result.ok and (self.of_features or result.converged or is_started)
        is_larger = coarse.inliers > result.inliers
        if self.of_features and not is_started:
            is_larger = not is_more(result.inliers, coarse.inliers)
        is_better = coarse.ok and (not is_consensus or is_larger)
        if is_certain:
            # What hides part of the map, as a crowd does, hides it from both.
            is_better = is_better and not usual.is_less(coarse.agreement)
        if not is_better:
            return replace(result, iterations=iterations)
        # The features go on from there: the method itself found the pose.
        pose_source = coarse.pose_source if self.of_features else self.name
        return replace(coarse, iterations=iterations, pose_source=pose_source)


class AtRest:
    """Holds a sensor where it stood, as long as fewer things must have moved for that than for its own motion.

    At the lights the surfaces of vehicles hold a sensor best. Where they drive off together, their points outnumber those of
    the street, all of which must have come along if the sensor moved.
    """

    name = "at rest"

    def recover(self, attempt: Attempt, result: RegistrationResult) -> RegistrationResult:
        """Acts on results that leave the spot on which the sensor stood."""
        rest, T_registered = attempt.history.rest, result.T_world_lidar
        is_standing = rest.scans >= attempt.config.start_scans
        if not (result.ok and is_standing) or rest.is_here(T_registered, result.lever_arm):
            return result
        if not rest.votes(attempt.target.cloud(attempt.points), T_registered).is_standing:
            return result
        return attempt.credit(result.moved(rest.T_world_lidar.copy(), result.covariance), self.name)


def policies_of(config: RecoveryConfig, of_features: Sequence[Policy] | None = None) -> tuple[Policy, ...]:
    """Nearest first: a policy sees what those before it found.

    of_features : what features have in place of the search for the start; None: for points
    """
    is_of_points = of_features is None
    return (
        *([CoarseToFine(not is_of_points)] if config.coarse_to_fine else []),
        *([StartSearch()] if is_of_points and config.start_search else []),
        *(of_features or ()),
        *([AtRest()] if config.at_rest else []),
    )
