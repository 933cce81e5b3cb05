"""Monitors the poses of a method by registering pairs of scans, independently of the method and its map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import se3
from lslam.core.types.imu import GRAVITY
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import PAUSE_S, STILL_M, MotionCheck, ScanResult
from lslam.core.types.state import Stateful
from lslam.odometry.integrity.pair_registration import (
    PairRegistration,
    best_of,
    empty_share,
    filled_directions,
    is_near,
    is_within,
    median_range,
)
from lslam.registration.history import UsualAgreement
from lslam.registration.preprocessing.deskew import deskew_points
from lslam.registration.preprocessing.prepare import PreparedPoints, few_of, prepare_points, small_room

# A pair of scans is so long apart, s, and the sensor moves by less than this part of the median range between them, where
# scans lie closer.
LAG_S, REACH_SHARE = 0.45, 0.75


@dataclass(frozen=True)
class ReferenceScan:
    """A scan as the monitor keeps it: when and where, and its points (S, 3) with their scatter, deskewed; median range, m."""

    position: int
    stamp_ns: int
    pose: Floats
    source: Floats
    scatter: Floats
    range_m: float

    @property
    def points(self) -> PreparedPoints:
        """For registration."""
        return PreparedPoints(np.zeros((0, 3), np.float32), self.source, self.scatter, len(self.source))


class IntegrityMonitor(Stateful):
    """Checks the claimed motions by registering pairs of scans, at its own rate and with its own settings.

    Every pair is registered from the claimed motion, and from standstill where the sensor may have come to rest since the last
    check. If the claim is standstill, fits less than usual, or is a change of motion that no vehicle makes, it is registered from
    the last conclusive motion as well, and by a search some metres around. The motion that explains most points is the result;
    another one that explains as many is its rival.

    Planes that one ring alone could make are excluded (`BREADTH`), so that the sensor's own pattern does not confirm standstill.
    Some of it remains, so that standstill is a rival of any motion along an empty motorway.

    preprocess : its minimal range and vehicle box are used, nothing else
    """

    STATE = ("checks", "_reference", "_is_broken", "_last_ns", "_motion", "_may_stand", "_stand", "_usual")

    def __init__(self, preprocess: PreprocessConfig) -> None:
        self._preprocess = PreprocessConfig(range_min=preprocess.range_min, ego_box=preprocess.ego_box)
        self._is_prepared = preprocess == self._preprocess
        self._pair = PairRegistration()
        self.checks: list[MotionCheck] = []
        self._reference: ReferenceScan | None = None
        self._is_broken = False
        self._last_ns = 0
        # The motion (4, 4) that the last conclusive check found, and the seconds it took.
        self._motion: tuple[Floats, float] | None = None
        # Where the poses stand, if they do, and the directions that were filled then.
        self._stand: tuple[Floats, Longs] | None = None
        # Whether no motion was its rival.
        self._may_stand = False
        self._usual = UsualAgreement(0.0)

    def see(self, position: int, scan: Scan | None, prepared: object, result: ScanResult, sweep: MotionPrior) -> None:
        """Check the next scan of the run, None when it could not be read.

        prepared : the method's prepared points, used if the settings agree; sweep : the motion within the scan
        """
        stamp_ns, is_ok = result.stamp_ns, result.status == "ok"
        step_s = (stamp_ns - self._last_ns) * 1e-9
        self._last_ns = stamp_ns
        self._is_broken |= (position > 0 and step_s > PAUSE_S) or not is_ok
        if scan is None or not is_ok or not self._is_due(position, scan, result, step_s):
            return
        now = self._view(position, scan, prepared, result, sweep)
        if self._reference is not None:
            self._compare(self._reference, now, self._empty_share(self._reference, now, scan))
        self._reference, self._is_broken = now, False

    def warm_up(self) -> None:
        """Compile or load the kernels with a small room."""
        trial = IntegrityMonitor(self._preprocess)
        for k in range(2):
            at, scan = k + 1, Scan(small_room(), round(1e9 * k), k)
            trial.see(at, scan, None, ScanResult(k, scan.stamp_ns, np.eye(4)), MotionPrior.at_once(np.eye(4)))

    def _is_due(self, position: int, scan: Scan, result: ScanResult, step_s: float) -> bool:
        """Whether to check this scan: after a break or an inconclusive check, after `LAG_S`, or before overlap gets too small."""
        first = self._reference
        if first is None:
            # The motion within the first scan is not known yet.
            return position > 0 or scan.span.seconds == 0
        if self._is_broken or not self.checks or not self.checks[-1].is_conclusive:
            return True
        seconds = (result.stamp_ns - first.stamp_ns) * 1e-9
        claimed = float(np.linalg.norm(se3.relative(first.pose, result.T_world_lidar)[:3, 3])) / max(seconds, 1e-3)
        # By the next scan the sensor is too far away, whichever of both motions is right.
        is_far = max(self._speed, claimed) * (seconds + step_s) > REACH_SHARE * first.range_m
        return seconds >= LAG_S or is_far

    @property
    def _speed(self) -> float:
        """m/s; of the last conclusive check."""
        return 0.0 if self._motion is None else float(np.linalg.norm(self._motion[0][:3, 3])) / self._motion[1]

    def _extrapolate(self, seconds: float) -> Floats | None:
        """The motion (4, 4) over `seconds` at constant velocity; None where that is unknown."""
        if self._motion is None or seconds > PAUSE_S:
            return None
        motion, before = self._motion
        return np.asarray(se3.exp(seconds / before * se3.log(motion)))

    def _view(
        self, position: int, scan: Scan, prepared: object, result: ScanResult, sweep: MotionPrior
    ) -> ReferenceScan:
        """The scan as reference: its deskewed source points, with pose and median range."""
        if not (self._is_prepared and isinstance(prepared, PreparedPoints)):
            prepared = prepare_points(scan.points, self._preprocess, scan.index, scan.times)
        source = deskew_points(prepared.source, prepared.source_times, sweep)
        return ReferenceScan(
            position, result.stamp_ns, result.T_world_lidar, source, prepared.scatter, median_range(source)
        )

    def _empty_share(self, first: ReferenceScan, last: ReferenceScan, scan: Scan) -> float:
        """Share of the viewing directions that had points when the poses stopped moving, and have none now, still at rest.

        0 where the poses move.
        """
        if self._stand is not None and is_still(se3.relative(self._stand[0], last.pose)):
            return empty_share(self._stand[1], filled_directions(scan.points))
        stands = is_still(se3.relative(first.pose, last.pose))
        self._stand = (last.pose, filled_directions(scan.points)) if stands else None
        return 0.0

    def _compare(self, first: ReferenceScan, last: ReferenceScan, emptied_share: float) -> None:
        """Append the check of the motion claimed between two scans to `checks`, if a hypothesis has enough points to be judged.

        emptied_share : as of `_empty_share`, stored with the check
        """
        claimed = se3.relative(first.pose, last.pose)
        seconds = (last.stamp_ns - first.stamp_ns) * 1e-9
        pair = self._pair
        pair.begin(first.source, few_of(last.points))
        near_claim = pair.near(claimed)
        hypotheses = [near_claim]
        is_odd = is_still(claimed) or self._usual.is_less(near_claim.agreement)
        # No vehicle comes to rest faster than by gravity, or its tyres do not hold.
        if not is_still(claimed) and (self._may_stand or self._speed < GRAVITY * seconds):
            hypotheses.append(pair.at(np.eye(4)))
        if self._motion is None:
            hypotheses.append(pair.far(np.eye(4)))
        elif (expected := self._extrapolate(seconds)) is not None:
            change = float(np.linalg.norm(expected[:3, 3] - claimed[:3, 3])) / seconds**2
            if (is_odd or change > GRAVITY) and not is_near(near_claim.motion, expected):
                hypotheses.append(pair.near(expected))
        if is_odd and (is_still(claimed) or self._usual.is_less(max(h.agreement for h in hypotheses))):
            hypotheses.append(pair.far(claimed))
        best, rival = best_of(hypotheses)
        if best.sigma is None:
            return
        usual = self._usual.usual
        self._usual.observe(best.agreement)
        is_as_claimed = is_still(se3.relative(claimed, near_claim.motion))
        as_claimed = near_claim if is_as_claimed else pair.at(claimed)
        check = MotionCheck(
            first.position,
            last.position,
            seconds,
            claimed,
            best.motion,
            best.sigma,
            best.agreement,
            as_claimed.agreement,
            usual,
            self._is_broken,
            None if rival is None else rival.motion,
            emptied_share,
        )
        self.checks.append(check)
        if check.is_conclusive and seconds > 0:
            self._motion = best.motion, seconds
            self._may_stand = rival is not None and is_still(rival.motion)


def is_still(motion: Floats) -> bool:
    """Whether the motion (4, 4) is none."""
    return is_within(motion, STILL_M)
