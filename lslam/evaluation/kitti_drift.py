"""KITTI's odometry metric, by the formula of its development kit (Geiger, Lenz, Urtasun 2012)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.evaluation.results import KittiDrift

Floats = NDArray[np.float64]
LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)
START_EVERY = 10


def kitti_drift(estimate: Floats, truth: Floats) -> KittiDrift:
    """Drift of matched poses (N, 4, 4), consecutive scans, in % and deg/100 m; not available under 100 m.

    The kit's general inverse and arc cosine of the trace are kept: on poses printed with six digits they differ from
    the transpose and the logarithm, and published numbers are the kit's.
    """
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    firsts = np.arange(0, len(truth), START_EVERY)
    by_length: dict[int, tuple[float, float, int]] = {}
    every: list[Floats] = []
    for length in LENGTHS:
        lasts = np.searchsorted(distance, distance[firsts] + length, side="right")
        inside = lasts < len(truth)
        if not inside.any():
            continue
        errors = _segment_errors(estimate, truth, firsts[inside], lasts[inside]) / length
        by_length[length] = (
            float(100 * errors[:, 0].mean()),
            float(np.rad2deg(errors[:, 1].mean()) * 100),
            len(errors),
        )
        every.append(errors)
    if not every:
        nan = float("nan")
        return KittiDrift(False, f"n/a (no segment of 100 m: the path is {distance[-1]:.0f} m)", nan, nan, 0, {})
    mean = np.concatenate(every).mean(axis=0)
    return KittiDrift(
        True, "", float(100 * mean[0]), float(np.rad2deg(mean[1]) * 100), sum(len(e) for e in every), by_length
    )


def _segment_errors(estimate: Floats, truth: Floats, first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
    """(M, 2) translation m and rotation rad of inv(estimated motion) @ true motion."""
    true_motion = np.linalg.inv(truth[first]) @ truth[last]
    motion = np.linalg.inv(estimate[first]) @ estimate[last]
    E = np.linalg.inv(motion) @ true_motion
    cosine = 0.5 * (np.trace(E[:, :3, :3], axis1=1, axis2=2) - 1.0)
    return np.stack([np.linalg.norm(E[:, :3, 3], axis=1), np.arccos(np.clip(cosine, -1.0, 1.0))], axis=1)
