"""The outcome of one scan: its pose, what its points say of it, the check by pairs of scans, and how long each stage took."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import noise, portable, se3, so3
from lslam.core.types.imu import ImuDiagnostics
from lslam.core.types.scan import LEVER_M


class StageClock:
    """Seconds per stage of one scan, by name, in the order they ran; a stage that runs twice adds up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time that the block takes to the stage `name`."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


def sum_stages(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Seconds per stage of several scans, in the order in which the stages come first."""
    found: dict[str, float] = {}
    for row in rows:
        for name, seconds in row.items():
            found[name] = found.get(name, 0.0) + seconds
    return found


class KeyframeClocks(defaultdict[int, StageClock]):
    """A clock for each keyframe, by number: of what is done after odometry."""

    def __init__(self) -> None:
        super().__init__(StageClock)

    def totals(self) -> dict[str, float]:
        """Seconds per stage of all keyframes."""
        return sum_stages(self[number].seconds for number in sorted(self))


@dataclass(frozen=True)
class ScanEquations:
    """Normal equations of a scan on a map: the cost grows by g d + d H d / 2 as its pose moves by d.

    T_world_lidar : (4, 4) at the scan's stamp, where H (6, 6) and g (6,) hold; t' = t + d[:3], R' = exp(d[3:]) R in world
        axes, 1/m2 and 1/rad2
    """

    stamp_ns: int
    T_world_lidar: Floats
    H: Floats
    g: Floats


# m/s, and of turns what that is at `LEVER_M`: trains and small aircraft are slower.
FASTEST_M_S = 150.0
FASTEST_RAD_S = FASTEST_M_S / LEVER_M
# m/s2, twice gravity: a faster change is an error of registration.
MOST_ACCELERATION_M_S2 = 20.0
# s; over a longer pause no motion is extrapolated, and no two scans are neighbours.
PAUSE_S = 1.0
# What explains less than this part of what is usual is rejected.
USUAL = 0.7
# m, and of turns what that is at `LEVER_M`; what is known no better is open: a motion of which scans say no more, a pose that
# no scan supports.
OPEN_M = 0.5
OPEN_RAD = OPEN_M / LEVER_M
# m, of a point at `LEVER_M`: two motions of a pair of scans that differ by less are one.
SAME_M = 0.2
# m, likewise: poses that move by less stand. Registration errs by no more, and all that drives moves more in half a second.
STILL_M = 0.05


@dataclass(frozen=True)
class MotionCheck:
    """One comparison of a claimed motion with the scans at its ends; m and rad, axes of the sensor at its begin.

    first, last : positions of the scans in the run; seconds : between them
    claimed_motion, found_motion : (4, 4) poses of the last scan seen from the first
    sigma : (6,) standard deviation of what was found, about a metre along directions that the scans do not hold
    agreement : share of the points that lie on surfaces of the first scan as found; claimed_agreement : as claimed
    usual : what the agreement lately was; is_after_break : whether scans are missing or failed just before the last
    rival : (4, 4) another motion that explains the last scan about as well as the one found
    emptied_share : share of the directions that held points since the poses stand, and hold none now
    """

    first: int
    last: int
    seconds: float
    claimed_motion: Floats
    found_motion: Floats
    sigma: Floats
    agreement: float
    claimed_agreement: float
    usual: float
    is_after_break: bool = False
    rival: Floats | None = None
    emptied_share: float = 0.0

    @property
    def is_conclusive(self) -> bool:
        """Whether enough points are inliers, and the rotation is constrained well enough, to accept it."""
        return self.agreement >= USUAL * self.usual and LEVER_M * float(np.max(self.sigma[3:])) < SAME_M

    @property
    def is_open(self) -> bool:
        """True when the scans observe the motion not at all, or only along some directions."""
        return not self.is_conclusive or float(np.max(self.sigma[:3])) > OPEN_M

    @property
    def apart(self) -> Floats:
        """(6,) by how much the scans say the motion was more than claimed."""
        return motion_apart(self.claimed_motion, self.found_motion)


def motion_apart(a: Floats, b: Floats) -> Floats:
    """(6,) difference of the motion `b` (4, 4) from the motion `a` (4, 4): m, then rad, in the axes where both begin."""
    turn = so3.log(portable.product(b[:3, :3], a[:3, :3].T))
    return np.concatenate([b[:3, 3] - a[:3, 3], turn])


Status = Literal["ok", "bridged", "skipped"]

MOTION_PRIOR, STATIONARY = "motion prior", "standing"


@dataclass(frozen=True)
class ScanResult:
    """The result of odometry for one scan.

    status : `ok` registered; `bridged` registration failed; `skipped` the scan could not be read or was empty. In both the
        motion prior stands in, after the run what is interpolated between the scans before and after
    T_world_lidar : (4, 4) pose at the scan's stamp
    covariance : (6, 6) of the pose in the world, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2; grows with
        the distance travelled. None when the method has none
    registration_covariance : likewise, but relative to the local map the scan was registered on
    points_covariance : as `covariance`, of the local map by the points of all scans alone, where `covariance` knows of an IMU
        that a pose graph may get beside; None elsewhere
    map_age : how many scans ago that local map was taken, on the mean; 1 from scan to scan
    is_stationary : the sensor had not moved since the scan before
    repeats_pose : for that reason the scan was not registered and has the pose of the one before
    posed_by : what within a method found the pose in its place, as a recovery policy or all points in place of features;
        empty: the method itself
    segment : number of the local map it was registered on; frame : of the coordinates that its pose is in, 0 for those of the
        trajectory
    may_be_elsewhere : the scans round it say that it may be elsewhere, which a problem of the run says in words
    degenerate : (K, 6) unit twists along which the scan says nothing and the motion prior was kept
    prior_error : (translation m, rotation rad) between motion prior and result
    prior_norm : 2-norm of inv(prior) pose - I, of the prior before the scan was looked at (Girolimetto, equation 5.1)
    imu : its diagnostics
    stamp_offset : (4, 4) pose at the stamp as the next scan tells it, seen from `T_world_lidar`; None where it tells none
    fault : what was wrong with the scan though it was of use; empty: nothing
    stages : seconds per stage, by name, in the order they ran
    """

    index: int
    stamp_ns: int
    T_world_lidar: Floats
    status: Status = "ok"
    reason: str = ""
    covariance: Floats | None = None
    registration_covariance: Floats | None = None
    points_covariance: Floats | None = None
    map_age: float = 1.0
    converged: bool = True
    iterations: int = 0
    source_points: int = 0
    inliers: int = 0
    rmse: float = 0.0
    overlap: float = 0.0
    is_stationary: bool = False
    repeats_pose: bool = False
    posed_by: str = ""
    segment: int = 0
    frame: int = 0
    may_be_elsewhere: bool = False
    degenerate: Floats = field(default_factory=lambda: np.zeros((0, 6)))
    prior_error: tuple[float, float] = (0.0, 0.0)
    prior_norm: float = 0.0
    imu: ImuDiagnostics = field(default_factory=ImuDiagnostics)
    stamp_offset: Floats | None = None
    fault: str = ""
    stages: dict[str, float] = field(default_factory=dict)

    @property
    def at_stamp(self) -> ScanResult:
        """The result with the pose corrected by `stamp_offset`; for uses without points deskewed at `T_world_lidar`."""
        if self.stamp_offset is None:
            return self
        return replace(self, T_world_lidar=self.T_world_lidar @ self.stamp_offset, stamp_offset=None)

    def in_world(self, T: Floats) -> ScanResult:
        """The result transformed by `T` (4, 4) into another world: pose, covariances and degenerate directions."""
        R = T[:3, :3]

        def rotate(covariance: Floats | None) -> Floats | None:
            return None if covariance is None else noise.rotate(covariance, R)

        return replace(
            self,
            T_world_lidar=se3.normalise(T @ self.T_world_lidar),
            covariance=rotate(self.covariance),
            points_covariance=rotate(self.points_covariance),
            registration_covariance=rotate(self.registration_covariance),
            degenerate=self.degenerate @ np.kron(np.eye(2), R).T,
        )

    @property
    def by_points(self) -> ScanResult:
        """The result with `points_covariance` as its covariance, without the IMU's part; itself without such a covariance."""
        if self.points_covariance is None:
            return self
        return replace(self, covariance=self.points_covariance, registration_covariance=None)

    def poser(self, method: str) -> str:
        """Name of what determined the pose: the `method`, its fallback, the motion prior, or the pose of the scan before."""
        if self.repeats_pose:
            return STATIONARY
        return (self.posed_by or method) if self.status == "ok" else MOTION_PRIOR
