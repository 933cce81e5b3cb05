"""Clouds of analytic scenes: boxes, ground, clutter, with the walls that can be seen known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def upright(a: tuple[float, float], b: tuple[float, float], low: float, high: float, step: float = 0.2) -> Floats:
    """Points on the wall from a to b, m, between two heights."""
    p, q = np.array(a), np.array(b)
    along = np.linspace(0, 1, max(int(np.linalg.norm(q - p) / step), 1) + 1)
    heights = np.arange(low, high, step)
    s, z = np.meshgrid(along, heights)
    return np.column_stack([p + s.reshape(-1, 1) * (q - p), z.reshape(-1)])


def block(corners: list[tuple[float, float]], low: float, high: float) -> Floats:
    """All walls of an outline."""
    return np.concatenate([upright(a, b, low, high) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)])


def box_at(x: float, y: float, width: float, depth: float) -> list[tuple[float, float]]:
    """Counter-clockwise corners."""
    return [(x, y), (x + width, y), (x + width, y + depth), (x, y + depth)]


def plain(half: float = 40.0, step: float = 1.0) -> Floats:
    """Level ground about the origin."""
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def noisy(points: Floats, sigma: float = 0.02, seed: int = 0) -> NDArray[np.float32]:
    return (points + np.random.default_rng(seed).normal(0, sigma, points.shape)).astype(np.float32)


def turned(segments: Floats, pose: tuple[float, float, float]) -> Floats:
    """Segments (S, 2, 2) or points (..., 2) moved by x, y, yaw."""
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(segments @ np.array([[c, s], [-s, c]]) + [x, y])


def misfit(found: Floats, truth: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    """Of each segment (S, 2, 2) against the nearest of `truth` (T, 2, 2): largest distance of an end from its line and
    how far it reaches beyond its ends, m, the angle in deg with the direction counted, and which it is."""
    d = truth[:, 1] - truth[:, 0]
    length = np.linalg.norm(d, axis=1)
    u = d / length[:, None]
    n = np.column_stack([-u[:, 1], u[:, 0]])
    away = found[:, None] - truth[None, :, :1]
    off = np.abs((away * n[None, :, None]).sum(-1)).max(2)
    along = (away * u[None, :, None]).sum(-1)
    beyond = np.maximum(np.maximum(-along.min(2), along.max(2) - length), 0)
    v = found[:, 1] - found[:, 0]
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(v @ u.T, -1, 1)))
    which = (off + beyond + 0.1 * angle).argmin(axis=1)
    rows = np.arange(len(found))
    return off[rows, which], beyond[rows, which], angle[rows, which], which
