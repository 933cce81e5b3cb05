"""A comparison made of nothing but numbers, for reports to be written from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from point_writers import write_points

from lslam.core.types.comparison import (
    Comparison,
    Difference,
    Drawing,
    DrawnRun,
    Metric,
    PairedComparison,
    RunScore,
    SeedStatistics,
    SummaryRow,
)

METRICS = (
    Metric("ate.se3", "ATE se3", "m", "error", "alignment se3"),
    Metric("drift", "drift", "%", "error", "KITTI"),
    Metric("time.read.mean", "read", "ms", "time", "", ""),
    Metric("time.mean", "mean", "ms", "time"),
    Metric("factor", "real time", "x", "time", "recorded over processing", "high"),
    Metric("bridged", "bridged", "scans", "health", "", ""),
    Metric("memory", "memory", "MB", "health", is_main=False),
)


def walls(shift: float = 0.0) -> NDArray[np.float64]:
    """Flat ground of 100 x 60 m and a house of 8 x 6 m at (30, 10), moved by `shift` m along x."""
    x, y = np.meshgrid(np.arange(0, 100, 0.5), np.arange(-30, 30, 0.5))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    edge = np.arange(0, 8, 0.1)
    sides = ((26 + edge, 7 + 0 * edge), (26 + edge, 13 + 0 * edge), (26 + 0 * edge, 7 + 0.75 * edge))
    outline = np.concatenate([np.stack(side, 1) for side in sides])
    house = np.concatenate([np.column_stack([outline, np.full(len(outline), z)]) for z in np.arange(0.1, 6, 0.2)])
    return np.concatenate([ground, house]) + np.array([shift, 0, 0])


def drawing(folder: Path, methods: tuple[str, ...] = ("icp", "kiss-icp"), has_truth: bool = True) -> Drawing:
    along = np.linspace(0, 60, 50)
    truth = np.stack([along, np.sin(along / 10), 0 * along], 1)
    runs = []
    for k, method in enumerate(methods):
        file = folder / f"{method}.ply"
        write_points(file, walls(-5.0 * k))
        errors = 0.01 * (k + 1) * along
        T = np.eye(4)
        T[0, 3] = 5.0 * k
        runs.append(
            DrawnRun(
                method,
                truth + np.array([0, k, 0]),
                along if has_truth else None,
                errors if has_truth else None,
                T,
                file,
            )
        )
    return Drawing("drive", 0, truth if has_truth else None, tuple(runs), "moved onto the ground truth")


def row(sequence: str, method: str, values: dict[str, SeedStatistics], **more: Any) -> SummaryRow:
    kept = {"runs": 2, "failed": 0, "note": "", "is_timed_alone": True, "degraded": 0} | more
    return SummaryRow(
        sequence, method, kept["runs"], kept["failed"], values, kept["note"], kept["is_timed_alone"], kept["degraded"]
    )


def comparison(folder: Path, **changes: Any) -> Comparison:
    """Two methods, two seeds on `drive`, one failed run on `dark`, which has no ground truth."""
    times = {"time.read.mean": 1.0, "time.mean": 12.0, "time.p95": 12.0, "factor": 9.0, "bridged": 0.0}
    done, bad = times | {"ate.se3": 0.1}, times | {"ate.se3": 0.3, "time.mean": 40.0}
    stages = {"read": 0.002, "register": 0.01}
    runs = [
        RunScore("drive", "icp", 0, folder / "a", "done", "", done, stages, 0.1, machine={"numpy": "2"}),
        RunScore("drive", "kiss-icp", 0, folder / "b", "degraded", "1 scan <bridged>", bad, {"read": 0.04}, 0.1),
        RunScore("dark", "icp", 0, folder / "c", "done", values=times, note="no ground truth"),
        RunScore("dark", "kiss-icp", 0, folder / "d", "crashed", "killed & gone_by 100%"),
    ]
    two = {
        "ate.se3": SeedStatistics(0.1, 0.02, 2),
        "time.mean": SeedStatistics(12.0, 1.0, 2),
        "factor": SeedStatistics(9.0, 0.1, 2),
        "bridged": SeedStatistics(0.0, 0.0, 2),
    }
    worse = two | {
        "ate.se3": SeedStatistics(0.3, 0.1, 2),
        "time.mean": SeedStatistics(40.0, 1.0, 2),
        "bridged": SeedStatistics(1.5, 0.1, 2),
    }
    none = float("nan")
    values: dict[str, Any] = {
        "command": "lslam compare drive dark --methods icp,kiss-icp",
        "methods": ("icp", "kiss-icp"),
        "sequences": ("drive", "dark"),
        "metrics": METRICS,
        "runs": tuple(runs),
        "rows": (
            row("drive", "icp", two),
            row("drive", "kiss-icp", worse, degraded=1),
            row("dark", "icp", {"time.mean": SeedStatistics(12.0, none, 1)}, runs=1, note="no ground truth"),
            row("dark", "kiss-icp", {}, runs=1, failed=1),
        ),
        "pairs": (PairedComparison("kiss-icp", "icp", 1, 3.0, 0, 0, 2, none, "n too small"),),
        "differences": (Difference("dark", "kiss-icp", "icp", 0, 1.5, 0.5),),
        "notes": ("others were using the machine",),
        "configs": {m: {"odometry": {"method": m}, "map": {"voxel": 0.2}} for m in ("icp", "kiss-icp")},
        "tie": 0.01,
    }
    return Comparison(**(values | changes))
