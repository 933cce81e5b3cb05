"""How well scans agree under a candidate clock of their points: odometry over a few of them, judged by points kept out of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RecoveryConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.odometry import create_odometry
from lslam.odometry.frontend.tracker import ScanInput, Tracker
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.prepare import gate_points
from lslam.registration.preprocessing.sweep_clock import SweepClock

# Scans of a window. The speed is not known before the second scan: those before are not judged.
SCANS, SKIPPED, FEWEST_SCANS = 13, 3, 8
# Points of a scan that odometry has, that the surfaces are made of, and that are kept out to be laid on them.
_REGISTERED, _SURFACE, _KEPT_OUT = 9000, 4000, 800
_SHARE_KEPT_OUT = 0.15
_SOURCE = 2000, 3500
# A step that differs by more than this share of it, m, and the largest rotation in a sweep on a lever of so many m, from that
# without a clock is another one.
_ASTRAY, _ASTRAY_M, _LEVER_M = 0.15, 0.2, 2.0
# With the speed of the start known, nothing is searched far from where it leads: rings on flat ground lure to a standstill.
_NO_SEARCH = RecoveryConfig(start_search=False, coarse_to_fine=False)
# Neighbours that make a surface, within m, and the fewest of other scans among them.
_NEIGHBOURS, _RADIUS_M, _FEWEST = 16, 1.0, 6
# m; distances from a surface count by d^2 / (d^2 + _SCALE_M^2): thickness counts, what is no surface does not.
_SCALE_M = 0.05
# The score where nothing is to compare.
_WORST_SCORE = 1.0
# A window that moves by less in a sweep, m and rad, decides nothing.
STILL_M, STILL_RAD = 0.03, float(np.deg2rad(0.4))
# Student's t of paired differences, the share of scans with the same sign and the relative difference of a clear decision.
_T, _SAME_SIGN, _RELATIVE = 4.0, 0.75, 0.02
# Likewise of a likely one.
_LIKELY_T, _LIKELY_SIGN = 2.5, 0.6


class ClockComparison(NamedTuple):
    """Two clocks over the same scans: Student's t and the sign of the paired differences, and the relative difference."""

    t: float
    same_sign: float
    relative: float

    @property
    def is_clear(self) -> bool:
        """Whether the first clock is better beyond doubt."""
        return self.t >= _T and self.same_sign >= _SAME_SIGN and self.relative >= _RELATIVE

    @property
    def is_likely(self) -> bool:
        """Whether the first clock is better, where other evidence speaks for it as well."""
        return self.t >= _LIKELY_T and self.same_sign >= _LIKELY_SIGN and self.relative >= _RELATIVE


class _KnownSteps(ConstantVelocity):
    """Motion model that predicts each scan by the known motion between scans, estimated before without point times."""

    def __init__(self, stamps_ns: list[int], steps: list[Floats]) -> None:
        super().__init__()
        self._steps = [(se3.log(step), 1e-9 * (b - a)) for step, (a, b) in zip(steps, pairwise(stamps_ns), strict=True)]
        self._next = 0
        # As if the scan before the first had moved as the first did.
        self._twist, self._step_s = self._steps[0]
        self._instant_ns, self._pose = 2 * stamps_ns[0] - stamps_ns[1], se3.inverse(steps[0])

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update by the pose (4, 4), and take the next of the known motions as the velocity."""
        super().correct(stamp_ns, pose, prior, has_registration)
        self._twist, self._step_s = self._steps[min(self._next, len(self._steps) - 1)]
        self._next += 1


@dataclass(frozen=True)
class _ScanAtPose:
    """A scan where odometry has it, deskewed: its pose, points for surfaces (N, 3) and points that were kept out (M, 3), m."""

    pose: Floats
    surface: Floats
    kept_out: Floats


class ClockWindow:
    """Consecutive scans on which candidate clocks are scored; scores are cached.

    The motion is estimated once, without a clock. For each clock, and without one, odometry then predicts each scan by
    that motion, without a wide search.
    """

    def __init__(self, scans: list[Scan], preprocess: PreprocessConfig) -> None:
        gate = preprocess.model_dump(include={"range_min", "range_max", "range_shape", "ego_box"})
        few = {"source_points_min": _SOURCE[0], "source_points_max": _SOURCE[1]}
        self._whole = Config.model_validate({"preprocess": gate})
        self._config = Config.model_validate({"preprocess": gate | few})
        self.scans = [scan for scan in scans if len(scan) > 0]
        self._masks = [self._divide(scan) for scan in self.scans]
        self._scores: dict[SweepClock | None, Floats] = {}

    @cached_property
    def _steps(self) -> list[Floats]:
        """Motions (4, 4) between successive scans, registered without point times."""
        poses = [at_poses.pose for at_poses in self._place(None, self._whole, None)]
        return [se3.relative(a, b) for a, b in pairwise(poses)]

    @property
    def is_moving(self) -> bool:
        """Whether the sensor moves so that a clock can make a difference."""
        moved = float(np.median([np.linalg.norm(step[:3, 3]) for step in self._steps]))
        return moved > STILL_M or float(np.median([so3.angle(step[:3, :3]) for step in self._steps])) > STILL_RAD

    def scores(self, clock: SweepClock | None) -> Floats:
        """(S,) for each scan, the mean bounded distance (0 to 1) of its held-out points from the surfaces of the other scans."""
        if clock not in self._scores:
            config = self._config.model_copy(update={"recovery": _NO_SEARCH})
            motion = _KnownSteps([scan.stamp_ns for scan in self.scans], self._steps)
            at_poses = self._place(clock, config, motion)[SKIPPED - 1 :]
            is_judged = self._is_same_motion(at_poses)
            # Rings on flat ground agree best with themselves where the motion is lost: that is no evidence.
            self._scores[clock] = _distances(at_poses)[1:] if is_judged else np.full(len(at_poses) - 1, _WORST_SCORE)
        return self._scores[clock]

    def is_astray(self, clock: SweepClock | None) -> bool:
        """Whether odometry under the clock found another motion than without, so that the scores cannot be compared."""
        return bool((self.scores(clock) >= _WORST_SCORE).all())

    def _place(self, clock: SweepClock | None, config: Config, motion: ConstantVelocity | None) -> list[_ScanAtPose]:
        """Register the scans with the times of the clock; each with pose, surface points and held-out points in the world."""
        odometry = create_odometry(config)
        tracker = Tracker(odometry, motion=motion)
        at_poses = []
        for number, (scan, (used, unused)) in enumerate(zip(self.scans, self._masks, strict=True)):
            timed = replace(scan, times=None if clock is None else clock.times_of(scan.points)[0])
            registered, kept_out = timed.select(used), timed.select(unused)
            entry = ScanInput(number, scan.stamp_ns, registered, odometry.prepare(registered))
            pose = tracker.track(entry).T_world_lidar
            surface = registered.select(_thin(len(registered), _SURFACE))
            both = (se3.apply(pose, _deskew(part, tracker.sweep)) for part in (surface, kept_out))
            at_poses.append(_ScanAtPose(pose, *both))
        return at_poses

    def _is_same_motion(self, at_poses: list[_ScanAtPose]) -> bool:
        """Whether the scans move as they do without a clock, within bounds that grow with distance and rotation."""
        turn = max(float(so3.angle(step[:3, :3])) for step in self._steps)
        for a, b, step in zip(at_poses[:-1], at_poses[1:], self._steps[SKIPPED - 1 :], strict=True):
            expected, moved = step[:3, 3], se3.relative(a.pose, b.pose)[:3, 3]
            allowed = _ASTRAY * float(np.linalg.norm(expected)) + _ASTRAY_M + _LEVER_M * turn
            if float(np.linalg.norm(moved - expected)) > allowed:
                return False
        return True

    def _divide(self, scan: Scan) -> tuple[Longs, Longs]:
        """Indices of the points for odometry and of those that are kept out, in their order, by chance."""
        usable = gate_points(np.ascontiguousarray(scan.points, np.float32), self._config.preprocess)
        order = np.random.default_rng((len(usable), scan.index)).permutation(usable)
        first = round(_SHARE_KEPT_OUT * len(order))
        return np.sort(order[first : first + _REGISTERED]), np.sort(order[: min(first, _KEPT_OUT)])


def read_window(sequence: Sequence, first: int, preprocess: PreprocessConfig) -> ClockWindow | None:
    """A window of the scans from `first` on; None where fewer than `FEWEST_SCANS` of them can be read."""
    scans = []
    for index in range(first, min(first + SCANS, len(sequence))):
        try:
            scans.append(sequence.scan(index))
        except InputError:
            continue
    window = ClockWindow(scans, preprocess)
    return window if len(window.scans) >= FEWEST_SCANS else None


def compare_clocks(windows: list[ClockWindow], better: SweepClock | None, worse: SweepClock | None) -> ClockComparison:
    """Paired comparison of two clocks over all scans: t statistic, share of scans that prefer `better`, relative difference."""
    good, bad = (np.concatenate([window.scores(clock) for window in windows]) for clock in (better, worse))
    difference = bad - good
    spread = float(difference.std(ddof=1)) / np.sqrt(len(difference))
    return ClockComparison(
        float(difference.mean()) / max(spread, 1e-12),
        float((difference > 0).mean()),
        float(difference.sum()) / max(float(good.sum()), 1e-12),
    )


def mean_score(windows: list[ClockWindow], clock: SweepClock | None) -> float:
    """The mean of the scores of all windows."""
    return float(np.concatenate([window.scores(clock) for window in windows]).mean())


def _deskew(scan: Scan, sweep: MotionPrior) -> Floats:
    """Points (N, 3), m, of a scan, deskewed to its stamp."""
    return np.asarray(deskew_points(scan.points, scan.times, sweep), np.float64)


def _thin(count: int, most: int) -> Longs:
    """Indices of at most `most` of `count` points, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _distances(scans: list[_ScanAtPose]) -> Floats:
    """(S,) mean bounded squared distance (0 to 1) of each scan's kept-out points from the surfaces that the other scans make."""
    from scipy.spatial import cKDTree

    cloud = np.concatenate([scan.surface for scan in scans])
    owner = np.repeat(np.arange(len(scans)), [len(scan.surface) for scan in scans])
    tree = cKDTree(cloud)
    return np.array([_distance(tree, cloud, owner, number, scan.kept_out) for number, scan in enumerate(scans)])


def _distance(tree: Any, cloud: Floats, owner: Longs, number: int, points: Floats) -> float:
    """Mean bounded squared distance (0 to 1) of points (N, 3) from planes through neighbours in `cloud` of scans but `number`."""
    away, near = tree.query(points, k=_NEIGHBOURS, distance_upper_bound=_RADIUS_M)
    is_there = np.isfinite(away)
    near = np.where(is_there, near, 0)
    weight = (is_there & (owner[near] != number)).astype(np.float64)
    count = weight.sum(axis=1)
    is_usable = count >= _FEWEST
    if not is_usable.any():
        return _WORST_SCORE
    points, near, weight, count = points[is_usable], near[is_usable], weight[is_usable], count[is_usable, None]
    neighbours = cloud[near]
    middle = np.einsum("nk,nki->ni", weight, neighbours) / count
    apart = (neighbours - middle[:, None]) * weight[..., None]
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]
    squares = np.einsum("ni,ni->n", points - middle, normal) ** 2
    return float((squares / (squares + _SCALE_M**2)).mean())
