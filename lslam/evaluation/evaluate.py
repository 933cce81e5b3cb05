"""Evaluation of one estimate against one ground truth: associate, transform to one frame, measure."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.printable import metres
from lslam.core.types.sequence import LIDAR_FRAME, Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.absolute import AbsoluteTrajectoryError, absolute_error
from lslam.evaluation.associate import Matches, associate, estimate_offset
from lslam.evaluation.frames import CommonFrame, body_turn, carry, reconcile
from lslam.evaluation.kitti_drift import KittiOdometry
from lslam.evaluation.metric import Evaluation, MatchedPoses, TrajectoryMetric
from lslam.evaluation.relative import RelativePoseError
from lslam.evaluation.thesis import DelTufo, Girolimetto
from lslam.evaluation.time_offset import fit_offset

METRICS: tuple[TrajectoryMetric[Any], ...] = (
    AbsoluteTrajectoryError(),
    RelativePoseError(),
    KittiOdometry(),
    Girolimetto(),
    DelTufo(),
)
__all__ = ["Evaluation", "evaluate"]
log = logging.getLogger("lslam")
STRAIGHT_SHARE = 0.01
# Spread of the truth's positions per metre of the estimate's, and the unit that they then seem to have. What is left of a path in
# km may be the motion of a lever arm.
UNITS = ((1 / 0.33, 1 / 0.28, "feet"), (67.0, 150.0, "cm"), (670.0, 1500.0, "mm"), (0.0, 0.03, "km"))
# An ATE that grows so much at another offset speaks against it; drift alone makes it grow or shrink a little.
WORSE_RATIO = 1.25
# m; a spread below is noise.
LEAST_SPREAD_M = 5.0
# Chi-square of three degrees of freedom that chance exceeds once in a million times.
UNLIKELY = 30.7


def shown_metrics(evaluation: Evaluation) -> list[TrajectoryMetric[Any]]:
    """Metrics that are always shown, and those named in `eval.metrics`."""
    return [metric for metric in METRICS if not metric.word or metric.word in evaluation.words]


def evaluate(
    estimate: Trajectory,
    ground_truth: Trajectory,
    config: EvalConfig | None = None,
    *,
    T_est_gt: Floats | None = None,
    calibration: Calibration | None = None,
) -> Evaluation:
    """Score `estimate` against `ground_truth`.

    Parameters
    ----------
    config : alignments, RPE distances, association; defaults when None
    T_est_gt : (4, 4) pose of the truth's body in the estimate's body, m; carries the truth to the estimate's body
    calibration : its `T_cam0_lidar` converts when one trajectory is the camera's and the other the LiDAR's; it says where
        `config.frame` sits

    Raises
    ------
    InputError when fewer than 3 poses match, poses are not finite, stamps do not increase, or nobody knows where `config.frame`
    sits.

    Notes
    -----
    Definitions: docs/conventions.md, "Metrics". Every part of the result carries its recipe.
    """
    config = config or EvalConfig()
    calibration = calibration or Calibration()
    calibration.T_lidar(config.frame)  # known, or an error before all others
    for which, trajectory in (("estimate", estimate), ("ground truth", ground_truth)):
        _check(which, trajectory)
    offset_ns, notes = _offset(estimate, ground_truth, config)
    matches = associate(estimate, ground_truth, config.max_diff, offset_ns)
    notes += _better_offset(estimate, ground_truth, matches, config)
    if len(matches.stamps_ns) < matches.possible:
        notes.append(f"{matches.possible - len(matches.stamps_ns)} of {matches.possible} poses found no partner")
    notes += [
        f"{which}: {note}" for which, t in (("estimate", estimate), ("ground truth", ground_truth)) for note in t.notes
    ]
    has_rotations = estimate.has_rotations and ground_truth.has_rotations
    if has_rotations:
        same, units = _in_one_frame(estimate, ground_truth, matches, config, T_est_gt, calibration)
    elif config.frame != LIDAR_FRAME:
        raise InputError(f"poses of {config.frame} need rotations of both trajectories: one has positions alone")
    else:
        same, units = _at_one_place(estimate, ground_truth, matches, T_est_gt)
    P, Q, faults = same.estimate, same.truth, (*units, *same.faults)
    notes = [*units, *notes, *same.notes, *same.faults, *_nearly_straight(Q, config)]
    for note in notes:
        log.log(logging.WARNING if note in faults else logging.INFO, "%s: %s", estimate.source or "estimate", note)
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(Q[:, :3, 3], axis=0), axis=1))])
    poses = MatchedPoses(P, Q, matches.seconds, has_rotations)
    return Evaluation(
        estimate=estimate.source or "estimate",
        ground_truth=ground_truth.source or "ground truth",
        matched=len(P),
        possible=matches.possible,
        stamps_ns=matches.stamps_ns,
        distance=distance,
        gt_positions=Q[:, :3, 3],
        path_length=float(distance[-1]),
        scores={metric.key: metric.measure(poses, config) for metric in METRICS},
        time_offset=offset_ns / 1e9,
        association=matches.recipe,
        notes=notes,
        faults=faults,
        words=config.metrics,
    )


def _in_one_frame(
    estimate: Trajectory,
    ground_truth: Trajectory,
    matches: Matches,
    config: EvalConfig,
    T_est_gt: Floats | None,
    calibration: Calibration,
) -> tuple[CommonFrame, list[str]]:
    """Matched poses in the body frame `config.frame`, and notes about their unit of length."""
    T_lidar_body = calibration.T_lidar(config.frame)
    is_carried = config.frame != LIDAR_FRAME
    truth, notes = matches.truth, []
    if T_est_gt is not None:
        truth = truth @ se3.inverse(T_est_gt)
        if ground_truth.frame == "cam0":
            # KITTI's world is the body at the start: it follows the body, and z is up again.
            truth = T_est_gt @ truth
        notes.append("ground truth carried to the estimate's body by the transform given (T_est_gt)")
    same = reconcile(
        matches.estimate,
        truth,
        (estimate.frame, ground_truth.frame),
        calibration.T_cam0_lidar,
        has_transform=T_est_gt is not None,
        wants_lidar=is_carried,
    )
    units = _other_unit(same.estimate, same.truth)
    # Whose body it is shows in motions, which are wrong then.
    same.faults = [] if units else same.faults or _rotation_note(same.estimate, same.truth)
    same.notes = notes + same.notes
    if is_carried:
        if estimate.frame == ground_truth.frame == "imu":
            T_lidar_body = se3.inverse(calibration.T_lidar("imu")) @ T_lidar_body
        is_world_of_body = ground_truth.frame == "cam0" or np.allclose(ground_truth.poses[0], np.eye(4), atol=1e-6)
        same.estimate = carry(same.estimate, T_lidar_body)
        same.truth = carry(same.truth, T_lidar_body, is_world_of_body)
        same.notes.append(f"poses of {config.frame}, {np.linalg.norm(T_lidar_body[:3, 3]):.3f} m from the sensor")
    return same, units


def _at_one_place(
    estimate: Trajectory, ground_truth: Trajectory, matches: Matches, T_est_gt: Floats | None
) -> tuple[CommonFrame, list[str]]:
    """As `_in_one_frame`, for two trajectories of which one has positions alone.

    A prism or an antenna is off the LiDAR, so the trajectory with rotations is moved to its place by `T_est_gt`.
    """
    bare = [name for name, t in (("estimate", estimate), ("ground truth", ground_truth)) if not t.has_rotations]
    have = "have" if len(bare) == 2 else "has"
    notes = [
        f"{' and '.join(bare)} {have} positions without rotations: ATE by positions is scored; rotation errors, origin "
        "alignment, RPE and KITTI drift are not available"
    ]
    P, Q = matches.estimate, matches.truth
    if T_est_gt is not None and len(bare) == 2:
        raise InputError("--T-est-gt needs rotations of the estimate or of the ground truth: both have positions alone")
    if T_est_gt is not None:
        P, Q = (P @ T_est_gt, Q) if estimate.has_rotations else (P, Q @ se3.inverse(T_est_gt))
        other = "estimate" if estimate.has_rotations else "ground truth"
        notes.append(f"{other} carried to the place of the {bare[0]} by the transform given (T_est_gt)")
    return CommonFrame(P, Q, notes), _other_unit(P, Q)


def _other_unit(estimate: Floats, truth: Floats) -> list[str]:
    """Notes, if the spreads of poses (N, 4, 4) differ by the ratio of two units of length."""
    own, real = (float(np.linalg.norm(poses[:, :3, 3].std(axis=0))) for poses in (estimate, truth))
    if max(own, real) < LEAST_SPREAD_M or own <= 0:
        return []
    return [
        f"WRONG UNIT: the ground truth's positions spread over {real:.4g} m and the estimate's over {own:.4g} m (standard "
        f"deviations), {real / own:.4g} times as far: they seem to be in {unit}, convert them to m"
        for low, high, unit in UNITS
        if low < real / own < high
    ]


def _rotation_note(estimate: Floats, truth: Floats) -> list[str]:
    """Note if motions of poses (N, 4, 4) show body frames rotated against each other, beyond what drift explains."""
    turn = body_turn(estimate, truth)
    if turn is None or turn.mahalanobis2 < UNLIKELY:
        return []
    rpy = ", ".join(f"{v:.1f}" for v in np.rad2deg(so3.euler_rpy(so3.exp(turn.rotation))))
    return [
        f"WRONG FRAMES: by the motions of both the ground truth's body is turned by {np.rad2deg(turn.angle):.1f} deg (sigma "
        f"{np.rad2deg(turn.sigma):.1f}) against the estimate's, roll, pitch, yaw = {rpy} deg: correct the rotation of the "
        "extrinsics that carry one to the other, or give the transform between the bodies with --T-est-gt"
    ]


def _nearly_straight(truth: Floats, config: EvalConfig) -> list[str]:
    """Note, in a list, where positions hardly constrain rotation about the path: aligned rotation errors are then unreliable."""
    centred = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(truth))
    if not {"se3", "sim3"} & set(config.align) or not 1e-4 * spread[0] < spread[1] <= STRAIGHT_SHARE * spread[0]:
        return []
    return [
        f"the path is nearly straight ({spread[1]:.2g} m sideways, {spread[0]:.3g} m along, standard deviations): "
        "se3 and sim3 hardly determine the rotation about it; read rotation errors under origin"
    ]


def _check(which: str, trajectory: Trajectory) -> None:
    """Raise InputError for poses that are not finite, or stamps that do not increase."""
    name = trajectory.source or "without a name"
    if not np.isfinite(trajectory.poses).all():
        bad = int(np.flatnonzero(~np.isfinite(trajectory.poses).all(axis=(1, 2)))[0])
        raise InputError(f"{which} {name}: pose {bad} holds NaN or infinity")
    if trajectory.has_stamps and (np.diff(trajectory.stamps_ns) <= 0).any():
        bad = int(np.flatnonzero(np.diff(trajectory.stamps_ns) <= 0)[0]) + 1
        raise InputError(f"{which} {name}: the stamp of pose {bad} is not after the one before")


def _offset(estimate: Trajectory, truth: Trajectory, config: EvalConfig) -> tuple[int, list[str]]:
    """Time offset, ns, to add to the estimate's stamps, configured or estimated (`auto`), and notes on it.

    Raises InputError without stamps, or where no offset can be estimated.
    """
    if config.time_offset != "auto":
        offset = round(float(config.time_offset) * 1e9)
        if offset and not (estimate.has_stamps and truth.has_stamps):
            raise InputError("a time offset needs stamps in both trajectories: give --times for the KITTI file")
        return offset, [f"time offset {config.time_offset:g} s added to the estimate"] if offset else []
    try:
        offset, score = estimate_offset(estimate, truth)
        how = f"correlation of motion {score:.3f}"
    except InputError:
        fit = fit_offset(estimate, truth)
        if fit is None or not fit.is_clearly_off():
            raise
        offset = 0
    fit = fit_offset(estimate, truth, offset)
    if fit is not None and fit.is_clearly_off(offset):
        offset, how = fit.offset_ns, f"ways and turns of both, one sigma {fit.sigma_ns / 1e9:.4f} s"
    return offset, [f"time offset auto: {offset / 1e9:.6f} s added to the estimate ({how})"]


def _better_offset(estimate: Trajectory, truth: Trajectory, matches: Matches, config: EvalConfig) -> list[str]:
    """Note, in a list, when the estimate clearly fits the truth better at another instant of the sweep than the stamps state."""
    fit = fit_offset(estimate, truth) if config.time_offset == 0 else None
    if fit is None or not fit.is_clearly_off():
        return []
    moved = associate(estimate, truth, config.max_diff, fit.offset_ns)
    now, then = (absolute_error(m.estimate, m.truth, "se3").translation for m in (matches, moved))
    if now is None or then is None or then.rmse > WORSE_RATIO * now.rmse:
        return []
    gain = f": ATE se3 {metres(then.rmse)} m, {metres(now.rmse)} m as they are" if then.rmse < now.rmse else ""
    return [
        f"the estimate fits best with {fit.offset_ns / 1e9:+.3f} s added to its stamps (one sigma {fit.sigma_ns / 1e9:.3f} s)"
        f"{gain}; the two may name other instants of the sweep: --time-offset auto takes it"
    ]
