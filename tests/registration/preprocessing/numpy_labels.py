"""LOAM's features written down plainly, one point at a time: the reference the kernels must agree with."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lslam.core.config.odometry import LoamConfig
from lslam.registration.preprocessing import features

Ring = np.ndarray[Any, np.dtype[np.float64]]


def curvature_at(ring: Ring, i: int) -> float:
    """Equation 2.21 at point i of a ring (n, 3): five neighbours on each side, N_s counts the point as well."""
    around = ring[i - 5 : i + 6]
    return float(np.linalg.norm((ring[i] - around).sum(axis=0)) / (11 * np.linalg.norm(ring[i])))


def bend_at(ring: Ring, i: int) -> float:
    """The part of the curvature that is across the chord from the first to the last neighbour."""
    total = (ring[i] - ring[i - 5 : i + 6]).sum(axis=0)
    chord = (ring[i + 5] - ring[i - 5]) / np.linalg.norm(ring[i + 5] - ring[i - 5])
    return float(np.linalg.norm(total - (total @ chord) * chord) / (11 * np.linalg.norm(ring[i])))


def reference_labels(rings: list[Ring], step: float, config: LoamConfig) -> list[list[int]]:
    """Labels of each ring's points. `step` is the angle between beams, rad."""
    slope = math.tan(math.radians(features.PARALLEL_DEG))
    ranges = [np.linalg.norm(ring, axis=1) for ring in rings]
    flat = np.concatenate(ranges)
    bends = [abs(flat[i] - 2 * flat[i + 1] + flat[i + 2]) for i in range(0, len(flat) - 2, 4)]
    noise = 1.4826 * float(np.median(bends)) / math.sqrt(6) * math.sqrt(110) / 11 if bends else 0.0
    return [_one_ring(ring, r, step, slope, noise, config) for ring, r in zip(rings, ranges, strict=True)]


def _one_ring(ring: Ring, r: Any, step: float, slope: float, noise: float, config: LoamConfig) -> list[int]:
    n = len(ring)
    u = ring / r[:, None]
    angle = [float(np.linalg.norm(u[i + 1] - u[i])) for i in range(n - 1)]
    gap = [a > 2.5 * step for a in angle]
    jump = [
        not gap[i] and abs(r[i + 1] - r[i]) > max(features.OCCLUSION_M, slope * step * min(r[i], r[i + 1]))
        for i in range(n - 1)
    ]
    hidden = set()
    for i in range(n - 1):
        if jump[i]:
            hidden |= set(range(i + 1, i + 7)) if r[i + 1] > r[i] else set(range(i - 5, i + 1))
    c: dict[int, float] = {}
    bend: dict[int, float] = {}
    for i in range(5, n - 5):
        if i in hidden or any(gap[i - 5 : i + 5]):
            continue
        before, after = r[i] - r[i - 1], r[i + 1] - r[i]
        steep = abs(before) > slope * r[i] * angle[i - 1] and abs(after) > slope * r[i] * angle[i]
        if steep and before * after > 0:
            continue
        c[i] = curvature_at(ring, i)
        bend[i] = c[i] if any(jump[i - 5 : i + 5]) else bend_at(ring, i)
    labels = [0] * n
    taken: set[int] = set()

    def suppress(i: int) -> None:
        taken.add(i)
        for side in (range(i, min(i + 5, n - 1)), range(i - 1, max(i - 6, -1), -1)):
            for j in side:
                if gap[j] or jump[j]:
                    break
                taken.add(j + 1 if j >= i else j)

    for region in range(config.regions):
        part = range(n * region // config.regions, n * (region + 1) // config.regions)
        sharp = [
            i
            for i in part
            if i in c and bend[i] > features.EDGE_CURVATURE * step and bend[i] * r[i] > features.RARE_SIGMAS * noise
        ]
        picked = 0
        for i in sorted(sharp, key=lambda i: (-c[i], i)):
            if i not in taken and picked < config.max_less_edge_points:
                labels[i] = 2 if picked < config.max_edge_points else 1
                picked += 1
                suppress(i)
        smooth = [
            i
            for i in part
            if i in c and labels[i] == 0 and (c[i] < features.PLANAR_CURVATURE * step or c[i] * r[i] < 2 * noise)
        ]
        for i in smooth:
            labels[i] = -1
        picked = 0
        for i in sorted(smooth, key=lambda i: (c[i], i)):
            if i not in taken and picked < config.max_planar_points:
                labels[i] = -2
                picked += 1
                suppress(i)
    return labels
