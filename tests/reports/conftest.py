"""Runs made of nothing but numbers, for reports to be written from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import browser

from lslam.core.geometry import se3, so3
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory

__all__ = ["browser"]

MakeRecord = Callable[..., RunRecord]


@pytest.fixture
def make_record(tmp_path: Path) -> MakeRecord:
    """A drive along an arc, 1.5 m per scan; the estimate drifts. `bad` maps scan -> (status, reason)."""

    def make(
        scans: int = 60,
        *,
        bad: dict[int, tuple[str, str]] | None = None,
        with_truth: bool = True,
        with_details: bool = True,
        with_map: bool = True,
        **changes: Any,
    ) -> RunRecord:
        rng = np.random.default_rng(scans)
        step = se3.make(so3.exp(np.array([0.0, 0.0, 0.02])), np.array([1.5, 0.0, 0.01]))
        truth, estimate = [np.eye(4)], [np.eye(4)]
        for _ in range(scans - 1):
            truth.append(truth[-1] @ step)
            estimate.append(estimate[-1] @ step @ se3.exp(rng.normal(0, 1, 6) * [0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3]))
        stamps = 100_000_000 * np.arange(scans, dtype=np.int64)
        poses = se3.normalise(np.array(estimate))
        results = []
        for i in range(scans):
            status, reason = (bad or {}).get(i, ("ok", ""))
            details: dict[str, Any] = {}
            if with_details:
                details = {
                    "covariance": np.diag([1e-4, 4e-4, 9e-4, 1e-6, 1e-6, 4e-6]),
                    "iterations": 6, "source_points": 3000, "inliers": 2000 + i, "rmse": 0.05, "overlap": 0.9,
                }  # fmt: skip
            stages = {"read": 0.002, "preprocess": 0.003, "register": 0.005 + 1e-5 * i}
            results.append(
                ScanResult(i, int(stamps[i]), poses[i], status, reason, stages=stages, **details)  # type: ignore[arg-type]
            )
        image = rng.poisson(1.0, (40, 70)).astype(np.float32) if with_map else None
        points = rng.uniform((-10, -5, 0), (60, 35, 8), (3000, 3))
        values: dict[str, Any] = {
            "name": "drive",
            "method": "icp",
            "folder": tmp_path,
            "results": results,
            "trajectory": Trajectory(stamps, poses, source="icp"),
            "ground_truth": Trajectory(stamps, np.array(truth), source="truth.txt") if with_truth else None,
            "real_time_limit": 0.1,
            "manifest": {"status": "done", "command": "lslam run drive", "sequence": {"format": "kitti-odometry"}},
            "map_image": image,
            "map_heights": None if image is None else rng.uniform(0, 8, image.shape).astype(np.float32),
            "map_sample": ArrayCloud.of(points, points[:, 2] / 8) if with_map else None,
            "map_extent": (-10.0, 60.0, -5.0, 35.0),
        }
        return RunRecord(**(values | changes))

    return make
