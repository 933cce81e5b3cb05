"""Export of a run as a rerun recording (.rrd), for viewing in three dimensions. The only file that imports rerun."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import OutputError, cause
from lslam.core.extras import importing, install_hint
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.trajectory import Trajectory

MOST_POINTS = 2_000_000  # what a viewer turns smoothly
_ESTIMATE, _ODOMETRY = (31, 119, 180), (214, 39, 40)


@dataclass(frozen=True)
class ViewedRun:
    """Data for the recording, all in the run's world, m.

    odometry : the trajectory before the pose graph, where there was one
    """

    name: str
    trajectory: Trajectory
    cloud: ArrayCloud | None = None
    odometry: Trajectory | None = None


def require_rerun() -> Any:
    """The rerun module. Raises InputError with instructions when it is missing."""
    with importing("rerun", install_hint("view")):
        import rerun
    return rerun


def write_recording(path: Path, run: ViewedRun) -> None:
    """Write trajectories, the map coloured by height, and the LiDAR's pose over time; atomically.

    Raises InputError when rerun is missing, OutputError when the file cannot be written.
    """
    rr = require_rerun()
    part = path.with_name(path.name + ".part")
    try:
        part.open("wb").close()
        stream = rr.RecordingStream("lslam", recording_id=run.name)
        stream.save(part)
        _log(rr, stream, run)
        stream.flush()
        stream.disconnect()
        os.replace(part, path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {cause(error)}") from None
    finally:
        if path.parent.is_dir():
            part.unlink(missing_ok=True)


def _log(rr: Any, stream: Any, run: ViewedRun) -> None:
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    ways = {"trajectory": (run.trajectory, _ESTIMATE), "odometry": (run.odometry, _ODOMETRY)}
    for name, (way, colour) in ways.items():
        if way is not None and len(way) > 1:
            stream.log(
                f"world/{name}", rr.LineStrips3D([way.positions.astype(np.float32)], colors=[colour]), static=True
            )
    if run.cloud is not None and len(run.cloud):
        step = -(-len(run.cloud) // MOST_POINTS)
        points = run.cloud.points[::step].astype(np.float32)
        stream.log("world/map", rr.Points3D(points, colors=by_height(points[:, 2]), radii=0.05), static=True)
    for stamp_ns, T in zip(run.trajectory.stamps_ns, run.trajectory.poses, strict=True):
        stream.set_time("stamp", timestamp=np.datetime64(int(stamp_ns), "ns"))
        stream.log("world/lidar", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    stream.log("world/lidar", rr.TransformAxes3D(2.0), static=True)


def by_height(z: NDArray[Any]) -> NDArray[np.uint8]:
    """(N, 3) colours from blue at the 2nd to yellow at the 98th percentile of heights (N,), m."""
    low, high = np.percentile(z, [2, 98]) if len(z) else (0.0, 1.0)
    share = np.clip((z - low) / max(high - low, 1e-6), 0, 1)[:, None]
    return np.asarray(np.rint((1 - share) * (40, 60, 160) + share * (250, 220, 60)), np.uint8)
