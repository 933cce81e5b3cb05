"""Body frames of trajectories: tells camera from LiDAR poses by the motion, and transforms both into one frame.

A vehicle's camera advances along its own +z, its LiDAR along +x. Scoring one against the other ruins every number but the
aligned positions, so it is detected, reported, and undone when the extrinsics are known.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.geometry import se3, so3

# Camera axes (x right, y down, z forward) to body axes (x forward, y left, z up): signed ones, so turning is exact.
R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
STEADY = 0.8  # of the mean direction, from which a body counts as moving along one of its axes
SAME_DEG = 30.0
# Motions that are compared, at most, and how long they are at least: noise of poses counts less over more way.
MOST, LEAST_M, LEAST_RAD = 300, 5.0, np.deg2rad(15.0)
FEWEST = 6
# One sigma of what odometry and truth disagree by in direction without any calibration to blame: drift to one side of a
# percent of the way.
DRIFT_RAD = 0.01
ROUNDS, SCALE = 30, 1.345


@dataclass
class CommonFrame:
    """Both trajectories, (N, 4, 4), in one body frame, notes, and faults: reasons why their frames disagree."""

    estimate: Floats
    truth: Floats
    notes: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def carry(poses: Floats, T_lidar_body: Floats, is_world_of_body: bool = False) -> Floats:
    """Poses (N, 4, 4) of a body at `T_lidar_body` from those of the LiDAR: T_world_body = T_world_lidar T_lidar_body.

    is_world_of_body : the world is the body at the start, as in KITTI's files; it changes with the body (Del Tufo, 4.1)
    """
    moved = poses @ T_lidar_body
    return se3.inverse(T_lidar_body) @ moved if is_world_of_body else moved


def reconcile(
    estimate: Floats,
    truth: Floats,
    frames: tuple[str, str],
    T_cam0_lidar: Floats | None,
    has_transform: bool = False,
    wants_lidar: bool = False,
) -> CommonFrame:
    """Bring matched poses (N, 4, 4) into one body frame.

    frames : the frames the files state (estimate, ground truth); the motion outranks them where it is clear
    T_cam0_lidar : (4, 4) or None when unknown
    has_transform : the user stated the transform between the bodies: nothing is converted, a remaining difference is said
    wants_lidar : poses of the camera in both are converted to the LiDAR, where `T_cam0_lidar` is known
    """
    camera = [_is_camera(poses, frame) for poses, frame in zip((estimate, truth), frames, strict=True)]
    out = CommonFrame(estimate, truth)
    if has_transform:
        addition = " (it is the pose of the truth's body in the estimate's body; the one given may be the inverse)"
        _say_difference(out, "check", addition)
        return out
    for who, frame, poses in (("estimate", frames[0], estimate), ("ground truth", frames[1], truth)):
        if frame == "cam0" and main_axis(poses) == "+x":
            out.notes.append(
                f"{who} is a KITTI file (camera 0 by convention) but advances along +x: taken as LiDAR poses"
            )
    if wants_lidar and all(camera) and T_cam0_lidar is not None:
        out.estimate, out.truth = (se3.inverse(T_cam0_lidar) @ poses @ T_cam0_lidar for poses in (estimate, truth))
        _say_difference(out)
        return out
    if camera[0] is None or camera[1] is None or camera[0] == camera[1]:
        _say_difference(out)
        if camera[0] and camera[1] and "cam0" in frames and not (out.notes or out.faults):
            # One rigid relabelling of both: no norm changes, and up is z again.
            out.estimate, out.truth = _turn(estimate), _turn(truth)
        return out
    which, other = ("estimate", "ground truth") if camera[0] else ("ground truth", "estimate")
    fact = f"{which} is in the camera frame (advances along +z), {other} in the LiDAR frame (advances along +x)"
    if T_cam0_lidar is None:
        out.faults.append(
            f"WRONG FRAMES: {fact}; without calibration (--calib) they are compared as they are: "
            "origin-aligned, rotational, KITTI drift and per-axis numbers mean nothing"
        )
        return out
    moved = se3.inverse(T_cam0_lidar) @ (estimate if camera[0] else truth) @ T_cam0_lidar
    if camera[0]:
        out.estimate = moved
    else:
        out.truth = moved
    out.notes.append(f"{fact}: {which} converted to the LiDAR with T_cam0_lidar")
    _say_difference(out)
    return out


def main_axis(poses: Floats) -> str | None:
    """Body axis along which poses (N, 4, 4) advance, `+x` .. `-z`; None when there is no dominant one."""
    direction = _mean_direction(poses)
    if direction is None:
        return None
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) < STEADY:
        return None
    return f"{'+' if direction[k] > 0 else '-'}{'xyz'[k]}"


def _is_camera(poses: Floats, frame: str) -> bool | None:
    """True for camera poses, False for LiDAR poses, by the motion or the `frame` of the file; None when neither is clear."""
    axis = main_axis(poses)
    if axis in ("+z", "-z") and frame != "lidar":
        return True
    if axis in ("+x", "-x"):
        return False
    return {"cam0": True, "lidar": False}.get(frame)


def _mean_direction(poses: Floats) -> Floats | None:
    """Mean direction of motion in the body frame, weighted by length; shorter than 1 where it varies. None below 1 m of path."""
    steps = _steps(poses)
    travelled = float(np.linalg.norm(steps, axis=1).sum())
    if travelled < 1.0:
        return None
    return np.asarray(steps.sum(axis=0) / travelled)


def _steps(poses: Floats, stride: int = 1) -> Floats:
    """(M, 3) motions in the body frame at their start, m."""
    d = poses[stride::stride, :3, 3] - poses[:-stride:stride, :3, 3][: len(poses[stride::stride])]
    R = poses[:-stride:stride, :3, :3][: len(d)]
    return np.asarray(np.einsum("nji,nj->ni", R, d))


def body_rotation(estimate: Floats, truth: Floats) -> Floats | None:
    """Rotation (3, 3) that takes directions of the truth's body into the estimate's, from the motions of both.

    None when motion does not determine it: standing, straight without turns, or an estimate unlike the truth.
    """
    stride = max(1, len(truth) // 300)
    t_est, t_gt = _steps(estimate, stride), _steps(truth, stride)
    w_est, w_gt = _turns(estimate, stride), _turns(truth, stride)
    B = np.zeros((3, 3))
    total = 0.0
    for a, b, least in ((t_est, t_gt, 1.0), (w_est, w_gt, 0.3)):
        size = float(np.sum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)))
        if min(np.linalg.norm(a, axis=1).sum(), np.linalg.norm(b, axis=1).sum()) < least or size == 0:
            continue
        B += a.T @ b / size
        total += 1.0
    if total == 0:
        return None
    u, d, vt = np.linalg.svd(B)
    R = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
    is_determined = d[1] > 0.2 * d[0] and float(np.trace(R.T @ B)) > 0.75 * total
    return np.asarray(R) if is_determined else None


def _turns(poses: Floats, stride: int) -> Floats:
    """(M, 3) rotation vectors, rad, of the motions from each pose to the one `stride` later."""
    R = so3.normalise(poses[::stride, :3, :3])
    return so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:])


def _say_difference(out: CommonFrame, way_out: str = "give", addition: str = "") -> None:
    """Add a fault if the motion shows that one body frame is rotated against the other."""
    R = body_rotation(out.estimate, out.truth)
    if R is None or np.rad2deg(so3.angle(R)) < SAME_DEG:
        return
    rpy = ", ".join(f"{v:.0f}" for v in np.rad2deg(so3.euler_rpy(R)))
    out.faults.append(
        f"WRONG FRAMES: the ground truth's body is turned against the estimate's by about roll, pitch, yaw = {rpy} deg: "
        f"{way_out} the transform between the bodies with --T-est-gt{addition}"
    )


def _turn(poses: Floats) -> Floats:
    """Poses of a camera (N, 4, 4) in the axes of a vehicle, of body and world: x forward, z up."""
    C = se3.make(R_BODY_CAMERA, np.zeros(3))
    return np.asarray(C @ poses @ C.T)


@dataclass(frozen=True)
class BodyTurn:
    """Rotation between two body frames, from their motions.

    rotation : (3,) rotation vector that takes directions of the truth's body into the estimate's, rad; 0 about unobservable
    axes

    covariance : (3, 3) of it, rad2
    """

    rotation: Floats
    covariance: Floats

    @property
    def angle(self) -> float:
        """Angle of the rotation, rad."""
        return float(np.linalg.norm(self.rotation))

    @property
    def sigma(self) -> float:
        """One standard deviation of the rotation angle, rad."""
        axis = self.rotation / max(self.angle, 1e-12)
        return float(np.sqrt(axis @ self.covariance @ axis))

    @property
    def mahalanobis2(self) -> float:
        """Squared Mahalanobis length of the rotation; without a rotation it is chi-square of three degrees of freedom."""
        return float(self.rotation @ np.linalg.solve(self.covariance, self.rotation))


def body_turn(estimate: Floats, truth: Floats) -> BodyTurn | None:
    """Rotation between the bodies of matched poses (N, 4, 4), None where there is too little motion.

    Motions from one pose to a later one, A of the estimate and B of the truth, fulfil A X = X B for the transform X between
    the bodies. Rotation and lever arm are fitted by robust least squares; their residuals give the sigmas, to which drift is
    added.
    """
    pairs = _pairs(truth)
    if len(pairs) < FEWEST:
        return None
    A, B = (se3.relative(poses[pairs[:, 0]], poses[pairs[:, 1]]) for poses in (estimate, truth))
    R, x = np.eye(3), np.zeros(6)
    # A weak prior at no rotation and no lever arm, for unobservable directions.
    hold = np.diag(np.repeat([1.0, 1e-2], 3))
    for _ in range(ROUNDS):
        r, J = _linearise(A, B, R, x[3:])
        sizes = np.linalg.norm(r.reshape(len(r), 2, 3), axis=2)
        scales = np.maximum(1.4826 * np.median(sizes, axis=0) / 1.538, (1e-6, 1e-6))
        weights = np.minimum(SCALE * np.sqrt(3) * scales / np.maximum(sizes, 1e-12), 1.0) / scales**2
        w = np.repeat(weights, 3, axis=1)
        information = np.einsum("nij,ni,nik->jk", J, w, J)
        step = -np.linalg.solve(information + hold, np.einsum("nij,ni,ni->j", J, w, r) + hold @ _state(R, x))
        R, x = so3.exp(step[:3]) @ R, x + np.concatenate([np.zeros(3), step[3:]])
        if np.linalg.norm(step) < 1e-9:
            break
    covariance = np.linalg.inv(information + hold)[:3, :3] + DRIFT_RAD**2 * np.eye(3)
    return BodyTurn(np.asarray(so3.log(R)), covariance)


def _state(R: Floats, x: Floats) -> Floats:
    """The estimate (6,) as a rotation vector, rad, and a lever arm, m; x : the last update of both."""
    return np.concatenate([so3.log(R), x[3:]])


def _pairs(truth: Floats) -> NDArray[np.intp]:
    """(K, 2) first and last pose of consecutive motions, each the shortest that is long enough."""
    steps = se3.relative(truth[:-1], truth[1:])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps[:, :3, 3], axis=1))])
    turn = np.concatenate([[0.0], np.cumsum(so3.angle(steps[:, :3, :3]))])
    pairs, first = [], 0
    for k in range(1, len(truth)):
        if way[k] - way[first] >= LEAST_M or turn[k] - turn[first] >= LEAST_RAD:
            pairs.append((first, k))
            first = k
    return np.array(pairs[:: 1 + len(pairs) // MOST], np.intp).reshape(-1, 2)


def _linearise(A: Floats, B: Floats, R: Floats, t: Floats) -> tuple[Floats, Floats]:
    """(K, 6) residuals of rotations and translations, and (K, 6, 6) Jacobians by a left rotation of R and the lever arm `t`."""
    turn_a, turn_b = so3.log(A[:, :3, :3]), so3.log(B[:, :3, :3]) @ R.T
    way_b = B[:, :3, 3] @ R.T
    arm = A[:, :3, :3] - np.eye(3)
    r = np.concatenate([turn_a - turn_b, A[:, :3, 3] + arm @ t - way_b], axis=1)
    J = np.zeros((len(A), 6, 6))
    J[:, :3, :3], J[:, 3:, :3] = so3.hat(turn_b), so3.hat(way_b)
    J[:, 3:, 3:] = arm
    return r, J
