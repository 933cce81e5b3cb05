"""What the script of a run's page knows: every scan, and some points of the map. Numbers are base64 of little-endian arrays."""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Trajectory
from lslam.reports.plots import first_available
from lslam.reports.png import VIRIDIS, usual_range

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation


STATUSES = ("registered", "standing", "bridged", "skipped", "not known")
FLAGS = {"degenerate": 8, "lost": 16}  # beside the status in one byte
MOST_TRUTH = 5000  # points of ground truth under the map
LONGEST_REASON = 160  # characters
QUANTA = 65535  # of a coordinate over the extent of the cloud


def scan_data(record: RunRecord, evaluation: Evaluation | None) -> dict[str, Any] | None:
    """Every pose of a run with what became of its scan; None of a run without poses.

    index, stamps (ns after `first_stamp_ns`), positions (m), angles (roll, pitch, yaw, deg), status and `way` (m travelled)
    are of each pose. With ground truth also `error` (m, by `alignment`) and `truth_way` (m along it), NaN where none matches;
    `aligned` (3, 4) takes positions to where the page draws them against ground truth, and `truth` is that in the run's world.
    """
    trajectory = record.trajectory
    if not len(trajectory):
        return None
    results = _by_pose(trajectory, record.results)
    posers = [None if r is None else r.poser(record.method) for r in results]
    names = list(dict.fromkeys(who for who in posers if who))
    data: dict[str, Any] = {
        "count": len(trajectory),
        "first_stamp_ns": str(int(trajectory.stamps_ns[0])),
        "stamps": packed(trajectory.stamps_ns - trajectory.stamps_ns[0], "<f8"),
        "index": packed(np.array([-1 if r is None else r.index for r in results]), "<i4"),
        "positions": packed(trajectory.positions, "<f4"),
        "angles": packed(_angles_deg(trajectory.poses), "<f4"),
        "way": packed(trajectory.path_lengths, "<f4"),
        "status": packed(np.array([_status(r) for r in results]), "u1"),
        "statuses": STATUSES,
        "flags": FLAGS,
        "posed_by": packed(np.array([names.index(who) if who else len(names) for who in posers]), "u1"),
        "posers": names,
        "reasons": {
            str(k): r.reason[:LONGEST_REASON] for k, r in enumerate(results) if r is not None and r.status != "ok"
        },
        "loops": [record.keyframe_scans[[c.a, c.b]].tolist() for c in record.loops if c.is_accepted],
    }
    return data if evaluation is None else data | _truth(trajectory, evaluation)


def _truth(trajectory: Trajectory, evaluation: Evaluation) -> dict[str, Any]:
    absolute = first_available(evaluation)
    if absolute is None:
        return {}
    at = _matched(trajectory, evaluation)
    error, way = np.full((2, len(trajectory)), np.nan)
    error[at], way[at] = np.linalg.norm(absolute.errors, axis=1), evaluation.distance
    T = absolute.T_gt_est
    some = evaluation.gt_positions[:: -(-len(evaluation.gt_positions) // MOST_TRUTH)]
    return {
        "alignment": absolute.alignment,
        "error": packed(error, "<f4"),
        "truth_way": packed(way, "<f4"),
        "aligned": np.column_stack([absolute.scale * T[:3, :3], T[:3, 3]]).tolist(),
        "truth": packed(se3.apply(se3.inverse(T), some) / absolute.scale, "<f4"),
    }


def cloud_data(cloud: ArrayCloud | None, trajectory: Trajectory | None = None) -> dict[str, Any] | None:
    """Some points of the map for the script; None without any.

    points : (M, 3) int16 q, where a coordinate is `low` + `step` (q + 32768), m; nearest : (M,) the nearest pose
    height, values : range of colours; intensity : (M,) 0 to 255 over their usual range, when the map has them
    """
    if cloud is None:
        return None
    finite = np.isfinite(cloud.points).all(1)
    points = cloud.points[finite]
    if not len(points):
        return None
    low = points.min(0)
    step = np.maximum((points.max(0) - low) / QUANTA, 1e-6)
    quanta = np.rint((points - low) / step) - (QUANTA + 1) // 2
    data: dict[str, Any] = {
        "count": len(points),
        "points": packed(quanta, "<i2"),
        "low": low.tolist(),
        "step": step.tolist(),
        "height": usual_range(points[:, 2]),
        "colours": VIRIDIS,
    }
    if cloud.intensity is not None and np.ptp(cloud.intensity[finite]) > 0:
        values = cloud.intensity[finite].astype(np.float64)
        least, most = usual_range(values)
        data["intensity"] = packed(np.rint(255 * np.clip((values - least) / (most - least), 0, 1)), "u1")
        data["values"] = [least, most]
    if trajectory is not None and len(trajectory):
        data["nearest"] = packed(_nearest(points, trajectory.positions), "<u2" if len(trajectory) <= QUANTA else "<u4")
    return data


def _nearest(points: Floats, positions: Floats) -> NDArray[np.intp]:
    """(M,) the position nearest to each point, among those that are finite; 0 where none is."""
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(positions).all(1))
    if not len(known):
        return np.zeros(len(points), np.intp)
    _, found = cKDTree(positions[known]).query(points)
    return np.asarray(known[found])


def _by_pose(trajectory: Trajectory, results: list[ScanResult]) -> list[ScanResult | None]:
    """The result of each pose's scan."""
    at = {r.stamp_ns: r for r in results}
    return [at.get(stamp) for stamp in trajectory.stamps_ns.tolist()]


def _matched(trajectory: Trajectory, evaluation: Evaluation) -> NDArray[np.intp]:
    """(N,) which pose of the trajectory each matched one of the evaluation is."""
    if evaluation.matched == len(trajectory):
        return np.arange(len(trajectory))
    stamps = evaluation.stamps_ns - round(evaluation.time_offset * 1e9)
    after = np.clip(np.searchsorted(trajectory.stamps_ns, stamps), 1, len(trajectory) - 1)
    before = stamps - trajectory.stamps_ns[after - 1] < trajectory.stamps_ns[after] - stamps
    return np.asarray(after - before)


def _status(result: ScanResult | None) -> int:
    if result is None:
        return STATUSES.index("not known")
    word = "standing" if result.is_stationary else "registered" if result.status == "ok" else result.status
    degenerate, lost = FLAGS["degenerate"] * bool(len(result.degenerate)), FLAGS["lost"] * result.is_lost
    return STATUSES.index(word) + degenerate + lost


def _angles_deg(poses: Floats) -> Floats:
    """(N, 3) roll, pitch, yaw; NaN of poses that are not finite."""
    angles = np.full((len(poses), 3), np.nan)
    good = np.isfinite(poses).all((1, 2))
    angles[good] = np.degrees(so3.euler_rpy(poses[good, :3, :3]))
    return angles


def packed(values: NDArray[Any], kind: str) -> str:
    """Base64 of an array in one of numpy's little-endian kinds."""
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode("ascii")
