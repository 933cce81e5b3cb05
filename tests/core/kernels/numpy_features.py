"""What the feature kernels should compute, written again in plain NumPy: counterparts, residuals, normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.kernels import linearisation as at

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Match:
    """Residual A (R s + t - p) of a source point s, of one variance.

    waver : rad2, of the normal of a plane through three points with that noise
    """

    s: Floats
    p: Floats
    A: Floats
    variance: float
    waver: float = 0.0

    def residual(self, R: Floats, t: Floats) -> Floats:
        return np.asarray(self.A @ (R @ self.s + t - self.p))

    def cost(self, R: Floats, t: Floats, c: float) -> float:
        r2 = float(self.residual(R, t) @ self.residual(R, t))
        return 0.5 * c * c * r2 / (c * c + r2) / self.variance

    def robust(self, R: Floats, t: Floats, c: float) -> float:
        r2 = float(self.residual(R, t) @ self.residual(R, t))
        return (c * c / (c * c + r2)) ** 2


def normal_equations(found: list[Match], R: Floats, t: Floats, c: float) -> tuple[Floats, Floats, Floats]:
    """H (6, 6), g (6,) and facts as a `linearise` gives them."""
    H, g, facts = np.zeros((6, 6)), np.zeros(6), np.zeros(at.COUNT)
    for m in found:
        r, rotated = m.residual(R, t), R @ m.s
        J = m.A @ np.hstack([np.eye(3), -so3.hat(rotated)])
        w = m.robust(R, t, c) / m.variance
        H += w * J.T @ J
        g += w * J.T @ r
        rank = round(float(np.trace(m.A @ m.A.T)))
        facts[at.INFORMATION] += rank * w
        facts[at.SQUARED] += m.robust(R, t, c) * float(r @ r)
        facts[at.INLIERS] += float(r @ r) < c * c
        facts[at.MATCHED] += 1.0
        facts[at.LEVER] += rank * w * float(rotated @ rotated)
        facts[at.ROBUST] += m.robust(R, t, c)
    return H, g, facts


def gradient(found: list[Match], R: Floats, t: Floats, c: float, h: float = 1e-5) -> Floats:
    """(6,) of the robust cost, by central differences; counterparts and variances stay."""
    out = np.empty(6)
    for k in range(6):
        d = np.zeros(6)
        d[k] = h
        ahead = sum(m.cost(so3.exp(d[3:]) @ R, t + d[:3], c) for m in found)
        behind = sum(m.cost(so3.exp(-d[3:]) @ R, t - d[:3], c) for m in found)
        out[k] = (ahead - behind) / (2 * h)
    return out


def nearest(x: Floats, points: Floats, allowed: NDArray[np.bool_], limit: float) -> int:
    """Index of the nearest of the `allowed` points (N, 3) within `limit`, or -1."""
    d = np.where(allowed, np.linalg.norm(points - x, axis=1), np.inf)
    return int(d.argmin()) if len(d) and d.min() < limit else -1


def match_edge(s: Floats, x: Floats, points: Floats, rings: NDArray[np.int64], limit: float, v: float) -> Match | None:
    """Point to the line through the two nearest points of different rings, at most two apart."""
    j = nearest(x, points, np.ones(len(points), bool), limit)
    if j < 0:
        return None
    away = np.abs(rings - rings[j])
    k = nearest(x, points, (away > 0) & (away <= 2), limit)
    if k < 0:
        return None
    p, q = points[j], points[k]
    u = (q - p) / np.linalg.norm(q - p)
    share = float((x - p) @ u) / float(np.linalg.norm(q - p))
    return Match(s, p, np.eye(3) - np.outer(u, u), v * (1 + share**2 + (1 - share) ** 2))


def match_plane(s: Floats, x: Floats, points: Floats, rings: NDArray[np.int64], limit: float, v: float) -> Match | None:
    """Point to the plane through the three nearest points, two of one ring and one of another, at most two away."""
    j = nearest(x, points, np.ones(len(points), bool), limit)
    if j < 0:
        return None
    away = np.abs(rings - rings[j])
    k = nearest(x, points, (away == 0) & (np.arange(len(points)) != j), limit)
    m = nearest(x, points, (away > 0) & (away <= 2), limit)
    if k < 0 or m < 0:
        return None
    corners = points[[j, k, m]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    sides = np.linalg.norm(corners[1:] - corners[0], axis=1)
    if np.linalg.norm(normal) < 0.1 * sides[0] * sides[1]:
        return None
    normal /= np.linalg.norm(normal)
    foot = x - normal * float(normal @ (x - corners[0]))
    weights = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), np.append(foot, 1.0), rcond=None)[0]
    # How the heights of the corners over their plane tilt it: in its own two axes.
    across = np.cross(normal, corners[1] - corners[0])
    axes = np.stack([corners[1] - corners[0], across])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    tilt = np.linalg.inv(np.column_stack([corners @ axes.T, np.ones(3)]))[:2]
    return Match(s, corners[0], normal[None], v * (1 + float(weights @ weights)), v * float(np.sum(tilt**2)))


def match_point(s: Floats, x: Floats, points: Floats, limit: float, v: float) -> Match | None:
    """Point to the nearest point."""
    j = nearest(x, points, np.ones(len(points), bool), limit)
    return None if j < 0 else Match(s, points[j], np.eye(3), v)
