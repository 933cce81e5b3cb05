"""Monitors the poses of a method by registering pairs of scans, independently of the method and its map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.config.registration import RegistrationConfig
from lslam.geometry import se3, so3
from lslam.preprocessing.deskew import deskew_points
from lslam.preprocessing.prepare import PreparedPoints, prepare_points, thin
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import BREADTH, WIDE
from lslam.registration.robust import Annealing, UsualAgreement
from lslam.registration.solver import RegistrationResult, solve
from lslam.types.motion_check import MotionCheck
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult
from lslam.types.state import Stateful

Floats = NDArray[np.float64]

# A scan is compared with the one so many scans and seconds before; with fewer scans between where these are far apart in time.
EVERY, LAG_S = 5, 0.45
FEWEST, LONGEST_S = 2, 0.9
# Points that make the planes of the first scan, and of the last scan those that are laid on them.
PLANE_POINTS, LAID_POINTS = 5000, 1200
# m and rad; poses that move by less state no motion, which is tested against a motion of metres.
STILL_M, STILL_RAD = 0.05, float(np.deg2rad(0.3))
# Another motion than the one found first must explain so many times more points.
MORE = 1.1
# s; a longer pause between two scans is a break.
PAUSE_S = 1.0


@dataclass(frozen=True)
class Seen:
    """A scan as the monitor keeps it: when and where, and its points (S, 3) with their scatter, deskewed."""

    position: int
    stamp_ns: int
    pose: Floats
    source: Floats
    scatter: Floats

    @property
    def points(self) -> PreparedPoints:
        """For registration."""
        return PreparedPoints(np.zeros((0, 3), np.float32), self.source, self.scatter, len(self.source))


class IntegrityMonitor(Stateful):
    """Registers every fifth scan on the planes of the scan half a second before, and keeps these checks of the claims.

    Planes that one ring could make by itself are left out (`BREADTH`), so that a sensor's own pattern does not confirm
    standing still. Of a claim of no motion, and where a scan fits less than usual, two more are weighed: the motion of the
    last conclusive check, and what is found from metres away.
    """

    STATE = ("checks", "_reference", "_is_broken", "_last_ns", "_motion", "_usual")

    def __init__(self, preprocess: PreprocessConfig, registration: RegistrationConfig) -> None:
        self._preprocess = preprocess
        self._config = registration.model_copy(update={"blob_weight": 0.0})
        # One scan has no fine planes.
        self._planes = tuple(
            GaussianMap(
                registration.voxel_size * registration.coarse_factor * wider, min_points=registration.min_points,
                planarity=registration.planarity, count_cap=registration.count_cap, reach=1.2 * preprocess.range_max,
                capacity=1 << 13, breadth=BREADTH,
            )
            for wider in (1, *WIDE)
        )  # fmt: skip
        self.checks: list[MotionCheck] = []
        self._reference: Seen | None = None
        self._is_broken = False
        self._last_ns = 0
        # What the last conclusive check found, per second.
        self._motion: Floats | None = None
        self._usual = UsualAgreement(registration.min_agreement)

    def see(self, position: int, scan: Scan | None, prepared: object, result: ScanResult, sweep: MotionPrior) -> None:
        """The next scan of the run, None when it could not be read, and its result.

        prepared : what its method made of it, taken where it fits; sweep : the motion within the scan
        """
        stamp_ns, is_ok = result.stamp_ns, result.status == "ok"
        is_paused = position > 0 and (stamp_ns - self._last_ns) * 1e-9 > PAUSE_S
        self._last_ns = stamp_ns
        self._is_broken |= is_paused or not is_ok
        # The first scan may have been taken at a speed that nobody knew yet.
        if scan is None or not is_ok or not self._is_due(position, stamp_ns):
            return
        now = self._seen(position, scan, prepared, result, sweep)
        if self._reference is not None:
            self._compare(self._reference, now)
        self._reference, self._is_broken = now, False

    def warm_up(self) -> None:
        """Compile or load the kernels with a small room."""
        room = np.random.default_rng(0).uniform(-8, 8, (3000, 3)).astype(np.float32)
        room[:, 2] = np.where(room[:, 2] > 0, 8.0, -8.0)
        trial = IntegrityMonitor(self._preprocess, self._config)
        for k in range(2):
            at, scan = k * EVERY + 1, Scan(room, round(1e9 * k), k)
            trial.see(at, scan, None, ScanResult(k, scan.stamp_ns, np.eye(4)), MotionPrior.at_once(np.eye(4)))

    def _is_due(self, position: int, stamp_ns: int) -> bool:
        if self._reference is None:
            return position > 0
        if self._is_broken:
            return True
        scans, seconds = position - self._reference.position, (stamp_ns - self._reference.stamp_ns) * 1e-9
        return (scans >= EVERY and seconds >= LAG_S) or (scans >= FEWEST and seconds >= LONGEST_S)

    def _seen(self, position: int, scan: Scan, prepared: object, result: ScanResult, sweep: MotionPrior) -> Seen:
        if not isinstance(prepared, PreparedPoints):
            prepared = prepare_points(scan.points, self._preprocess, scan.index, scan.times)
        points = thin(prepared, 1 + len(prepared.source) // PLANE_POINTS)
        source = deskew_points(points.source, points.source_times, sweep)
        return Seen(position, result.stamp_ns, result.T_world_lidar, source, points.scatter)

    def _compare(self, first: Seen, last: Seen) -> None:
        """Test the motion of the poses between two scans."""
        claimed = se3.relative(first.pose, last.pose)
        seconds = (last.stamp_ns - first.stamp_ns) * 1e-9
        for level in self._planes:
            level.clear()
            level.insert(first.source.astype(np.float32), np.eye(4))
        points = thin(last.points, 1 + len(last.source) // LAID_POINTS)
        found = self._lay(points, claimed, self._quick())
        usual = self._usual.usual
        if is_still(claimed) or self._usual.is_less(found.agreement):
            starts = [(claimed, self._slow())]
            if self._motion is not None and seconds < LONGEST_S + LAG_S:
                starts.append((se3.exp(seconds * self._motion), self._quick()))
            others = [self._lay(points, start, annealing) for start, annealing in starts]
            best = max(others, key=lambda other: other.inliers)
            found = best if best.inliers > MORE * found.inliers else found
        if found.covariance is None:
            return
        as_claimed = self._lay(points, claimed, self._at_once())
        self._usual.observe(found.agreement)
        self.checks.append(
            MotionCheck(
                first.position, last.position, seconds, claimed, found.T_world_lidar,
                np.sqrt(np.diag(found.covariance)), found.agreement, as_claimed.agreement, usual, self._is_broken,
            )
        )  # fmt: skip
        if self.checks[-1].is_conclusive and seconds > 0:
            self._motion = se3.log(found.T_world_lidar) / seconds

    def _lay(self, points: PreparedPoints, start: Floats, annealing: Annealing) -> RegistrationResult:
        return solve(self._planes, points, start, annealing, self._config)

    def _quick(self) -> Annealing:
        c = self._config
        return Annealing(c.kernel_max, c.kernel_min, c.kernel_decay, c.max_iterations)

    def _slow(self) -> Annealing:
        c = self._config
        return Annealing(c.coarse_kernel, c.kernel_min, c.coarse_decay, c.start_iterations)

    def _at_once(self) -> Annealing:
        c = self._config
        return Annealing(c.kernel_min, c.kernel_min, c.kernel_decay, 1)


def is_still(motion: Floats) -> bool:
    """Whether the motion (4, 4) is none."""
    return bool(np.linalg.norm(motion[:3, 3]) < STILL_M and so3.angle(motion[:3, :3]) < STILL_RAD)
