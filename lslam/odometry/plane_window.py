"""A fixed-lag smoother over the states of the newest scans and the planes that they saw (after Geneva et al. 2018).

Planes of a scan are associated with landmarks by normal, distance, extent and a chi-square gate.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.geometry import se3
from lslam.core.kernels import linalg
from lslam.core.types.imu import MotionState, PreintegratedStep
from lslam.odometry.inertial.filter import Normal
from lslam.odometry.plane_factors import (
    ORDER,
    PLANE_SIZE,
    SHARED,
    STATE_SIZE,
    Sightings,
    WindowPrior,
    WindowValues,
    normal_equations,
    sighting_residuals,
    step_residual,
)
from lslam.odometry.plane_segmentation import Planes, boxes_in, to_hesse, transform_planes

# States in the window: a second of most sensors.
LAG_SCANS = 10
# Scans after which a plane that none of them saw is marginalised too.
UNSEEN_SCANS = 10
# Gauss-Newton steps, and the step, in sigmas of the newest pose, below which they end.
MOST_STEPS, SMALL = 5, 0.02


@dataclass(frozen=True)
class Landmarks:
    """Attributes of the planes besides their closest points.

    anchors : (M, 4, 4) T_world_anchor, fixed frames of LiDARs that saw the planes first
    lows, highs : (M, 3) corners of the boxes round their seen parts, world, m; unseen : (M,) scans since
    """

    anchors: Floats = field(default_factory=lambda: np.zeros((0, 4, 4)))
    lows: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    highs: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    unseen: Longs = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.unseen)

    def only(self, which: Bools) -> Landmarks:
        """The landmarks that the mask `which` (M,) selects."""
        return Landmarks(self.anchors[which], self.lows[which], self.highs[which], self.unseen[which])

    def observe(self, which: Longs, lows: Floats, highs: Floats) -> Landmarks:
        """The landmarks after a scan saw those with indices `which` (K,), and missed all others.

        lows, highs : (K, 3) corners, m, world, to which their boxes grow
        """
        low, high, unseen = self.lows.copy(), self.highs.copy(), self.unseen + 1
        np.minimum.at(low, which, lows)
        np.maximum.at(high, which, highs)
        unseen[which] = 0
        return replace(self, lows=low, highs=high, unseen=unseen)

    def join(self, anchor: Floats, lows: Floats, highs: Floats) -> Landmarks:
        """The landmarks and K new ones with a common anchor (4, 4); lows, highs : (K, 3) corners of their boxes, m, world."""
        return Landmarks(
            np.concatenate([self.anchors, np.broadcast_to(anchor, (len(lows), 4, 4))]),
            np.concatenate([self.lows, lows]),
            np.concatenate([self.highs, highs]),
            np.concatenate([self.unseen, np.zeros(len(lows), np.int64)]),
        )


@dataclass(frozen=True)
class PlaneWindow:
    """States, planes and the factors among them; every method returns a new window.

    values : of `LAG_SCANS` states at most; steps : between them; sightings : planes in them; T_imu_lidar : (4, 4)
    """

    T_imu_lidar: Floats
    values: WindowValues
    prior: WindowPrior
    landmarks: Landmarks = field(default_factory=Landmarks)
    steps: tuple[PreintegratedStep, ...] = ()
    sightings: Sightings = field(default_factory=Sightings.none)

    @classmethod
    def begin(cls, state: MotionState, T_imu_lidar: Floats) -> PlaneWindow:
        """A window of one state, with the motion model's covariance as its prior, and no planes."""
        values = WindowValues.begin(state)
        C = state.covariance[np.ix_(ORDER, ORDER)]
        information = linalg.inverse(C)
        return cls(T_imu_lidar, values, WindowPrior(information, np.zeros(len(C)), values))

    @property
    def T_world_lidar(self) -> Floats:
        """(4, 4) of the newest state."""
        return np.asarray(se3.normalise(self.values.poses[-1] @ self.T_imu_lidar))

    def extend(self, step: PreintegratedStep) -> PlaneWindow:
        """The window with one more state, predicted by `step` from the newest one."""
        v = self.values
        doubled = replace(
            v,
            poses=np.concatenate([v.poses, v.poses[-1:]]),
            velocities=np.concatenate([v.velocities, v.velocities[-1:]]),
            accel_biases=np.concatenate([v.accel_biases, v.accel_biases[-1:]]),
            gyro_biases=np.concatenate([v.gyro_biases, v.gyro_biases[-1:]]),
        )
        r, _ = step_residual(doubled, v.states - 1, step)
        update = np.zeros(doubled.size)
        update[doubled.first_plane - STATE_SIZE : doubled.first_plane] = -r
        return replace(self, values=doubled.retract(update), steps=(*self.steps, step))

    def normal(self) -> Normal:
        """The normal equations of all factors."""
        return normal_equations(
            self.values, self.prior, self.steps, self.sightings, self.landmarks.anchors, self.T_imu_lidar
        )

    def with_sightings(
        self, planes: Longs, cp: Floats, information: Floats, lows: Floats, highs: Floats
    ) -> PlaneWindow:
        """The window in which the newest state saw the known planes with indices `planes` (K,).

        cp, information : closest points (K, 3), m, LiDAR frame, and (K, 3, 3); lows, highs : (K, 3) corners of their boxes, world
        """
        more = Sightings(np.full(len(planes), self.values.states - 1), planes, cp, information)
        return replace(self, sightings=self.sightings.join(more), landmarks=self.landmarks.observe(planes, lows, highs))

    def with_planes(self, cp: Floats, information: Floats, lows: Floats, highs: Floats) -> PlaneWindow:
        """The window with K new planes of the newest state, whose LiDAR is their anchor: cp (K, 3), its information, boxes."""
        count, old = len(cp), len(self.landmarks)
        pad = np.zeros((len(self.prior.gradient) + PLANE_SIZE * count,) * 2)
        n = len(self.prior.gradient)
        pad[:n, :n] = self.prior.information
        at = replace(self.prior.at, planes=np.concatenate([self.prior.at.planes, cp]))
        prior = WindowPrior(pad, np.concatenate([self.prior.gradient, np.zeros(PLANE_SIZE * count)]), at)
        values = replace(self.values, planes=np.concatenate([self.values.planes, cp]))
        more = Sightings(np.full(count, values.states - 1), old + np.arange(count), cp, information)
        landmarks = self.landmarks.join(self.T_world_lidar, lows, highs)
        return replace(self, values=values, prior=prior, sightings=self.sightings.join(more), landmarks=landmarks)

    def solve(self) -> tuple[PlaneWindow | None, int]:
        """Window at the minimum of all factors, and number of Gauss-Newton steps; None where H is not positive definite."""
        window, count = self, 0
        pose = np.arange(6) + self.values.first_plane - STATE_SIZE
        while count < MOST_STEPS:
            count += 1
            normal = window.normal()
            update = normal.step()
            if not np.isfinite(update).all():
                return None, count
            window = replace(window, values=window.values.retract(update))
            far = update[pose]
            if float(far @ normal.H[np.ix_(pose, pose)] @ far) < SMALL**2:
                break
        return window, count

    def joint_covariance(self) -> Floats:
        """(27 + 3 M) square: the shared part, the newest state and the planes."""
        return linalg.inverse(self.normal().without(self._older).H)

    def covariance_on_planes(self) -> Floats:
        """(6, 6) of the newest pose, were the planes known exactly."""
        first = self.values.first_plane
        H = np.ascontiguousarray(self.normal().H[:first, :first])
        rest = Normal(H, np.zeros(first)).without(self._older[:first])
        return linalg.inverse(rest.H)[SHARED : SHARED + 6, SHARED : SHARED + 6]

    @property
    def _older(self) -> Bools:
        """Mask (N,) of the variables of all states but the newest."""
        out = np.zeros(self.values.size, bool)
        out[SHARED : self.values.first_plane - STATE_SIZE] = True
        return out

    def marginalise(self) -> PlaneWindow:
        """The window without its oldest state if it has more than `LAG_SCANS`, and without planes not seen for long."""
        window = self
        while window.values.states > LAG_SCANS:
            window = window._without_oldest()
        return window._without_planes(window.landmarks.unseen >= UNSEEN_SCANS)

    def _without_oldest(self) -> PlaneWindow:
        """The window with its oldest state and its sightings marginalised into the prior."""
        v, of_first = self.values, self.sightings.states == 0
        few = replace(self, values=v.select(slice(2)), steps=self.steps[:1], sightings=self.sightings.only(of_first))
        out = np.zeros(few.values.size, bool)
        out[SHARED : SHARED + STATE_SIZE] = True
        left = few.normal().without(out)
        rest = self.sightings.only(~of_first)
        values = v.select(slice(1, None))
        return replace(
            self,
            values=values,
            prior=WindowPrior(left.H, left.g, values.select(slice(1))),
            steps=self.steps[1:],
            sightings=replace(rest, states=rest.states - 1),
        )

    def _without_planes(self, is_old: Bools) -> PlaneWindow:
        """The window with the planes `is_old` (M,) marginalised, unless a state of it still sees them."""
        is_old = is_old & ~np.isin(np.arange(len(is_old)), self.sightings.planes)
        if not is_old.any():
            return self
        out = np.concatenate([np.zeros(SHARED + STATE_SIZE, bool), np.repeat(is_old, PLANE_SIZE)])
        # At the present planes, not where they were: the prior moves with its gradient.
        at = self.prior.at
        rest = Normal(self.prior.information, self.prior.gradient).without(out)
        number = np.cumsum(~is_old) - 1
        return replace(
            self,
            values=self.values.select(slice(None), ~is_old),
            prior=WindowPrior(rest.H, rest.g, at.select(slice(None), ~is_old)),
            landmarks=self.landmarks.only(~is_old),
            sightings=replace(self.sightings, planes=number[self.sightings.planes]),
        )


# Cosine of 10 deg between normals, and m between planes, along the normal at what the scan saw.
ALIKE, CLOSE = 0.985, 0.5
# m, by which boxes of one plane may miss each other.
BOXES_APART_M = 3.0
# 99.9 % quantile of chi-square with three degrees of freedom.
GATE_CHI2 = 16.27


def associate(window: PlaneWindow, planes: Planes, covariance: Floats) -> Longs:
    """(K,) landmark of each plane by Mahalanobis distance, -1 where none matches.

    window : its newest state predicted; covariance : (27 + 3 M) square of that, from `joint_covariance`
    """
    matches = np.full(len(planes), -1)
    which, landmark = _candidates(window, planes)
    if len(which) == 0:
        return matches
    states, covariances = np.full(len(which), window.values.states - 1), planes.covariance[which]
    sightings = Sightings(states, landmark, planes.cp[which], np.asarray(np.linalg.inv(covariances), np.float64))
    r, by_pose, by_plane = sighting_residuals(window.values, sightings, window.landmarks.anchors, window.T_imu_lidar)
    J = np.concatenate([by_pose, by_plane], axis=2)
    at = np.concatenate(
        [
            np.broadcast_to(SHARED + np.arange(6), (len(which), 6)),
            SHARED + STATE_SIZE + PLANE_SIZE * landmark[:, None] + np.arange(PLANE_SIZE),
        ],
        axis=1,
    )
    S = J @ covariance[at[:, :, None], at[:, None, :]] @ np.swapaxes(J, 1, 2) + covariances
    squares = np.einsum("ki,ki->k", r, np.linalg.solve(S, r[:, :, None])[:, :, 0])
    # The nearest landmark of each plane: the last one written is the smallest.
    for k in np.argsort(-squares, kind="stable"):
        if squares[k] < GATE_CHI2:
            matches[which[k]] = landmark[k]
    return matches


def _candidates(window: PlaneWindow, planes: Planes) -> tuple[Longs, Longs]:
    """Indices of planes and of landmarks, in pairs, with similar normal and offset whose boxes overlap."""
    marks, T = window.landmarks, window.T_world_lidar
    expected = transform_planes(window.values.planes, np.linalg.inv(marks.anchors) @ T)
    n, _ = to_hesse(planes.cp)
    m, e = to_hesse(expected)
    # Of a landmark on whose other side the sensor is meant to be, the normal points the other way.
    cosine = n @ m.T
    off = np.abs(planes.means @ m.T - e)
    lows, highs = boxes_in(planes, T)
    is_near = (
        (lows[:, None] - BOXES_APART_M < marks.highs[None]) & (highs[:, None] + BOXES_APART_M > marks.lows[None])
    ).all(axis=2)
    which, landmark = np.nonzero((cosine > ALIKE) & (off < CLOSE) & is_near)
    return which, landmark
