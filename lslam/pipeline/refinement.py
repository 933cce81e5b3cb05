"""Plane adjustment of the raw scans of one drive or of several; the points that were kept out decide what is taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lslam.backend.adjustment import NO_NUMBERS, SweptPoints, adjust
from lslam.backend.graph.marginals import PosePrior
from lslam.backend.graph.odometry_constraints import bend_scans
from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config import Config
from lslam.core.errors import InterruptedRunError
from lslam.core.geometry import se3
from lslam.core.stopping import asking
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence as Recording
from lslam.core.types.trajectory import Keyframe
from lslam.maps.crispness import plane_variances
from lslam.odometry.frontend.register_scans import to_trajectory
from lslam.pipeline.job import PreparedRun
from lslam.pipeline.map_pass import course_of, motion_within, scans_again, without_box
from lslam.pipeline.watch import Watch
from lslam.registration.preprocessing.deskew import deskew_points

# Points of a scan at most, and of all scans: about 150 bytes each while planes are adjusted. Odometry averages over all points,
# which fewer single ones do not beat.
OF_A_SCAN, OF_ALL = 10_000, 6_000_000
CELL_M = 2.0  # m, edge of the cells of which every second one is kept out of the adjustment
JUDGES = 20_000  # points, at most, about which the thickness is looked at
# Scans that are judged together, least cells by which they are, and sigmas by which their planes must be thinner.
WINDOW, LEAST_CELLS, SIGMAS = 50, 10, 3.0
MAP_INFORMATION = 1e12  # 1/m2 and 1/rad2, of the pose of a map, which stays where it is
INTERRUPTED = "interrupted while the poses were refined"


@dataclass(frozen=True)
class PosedDrive:
    """A recording, its scans at poses in the world of all drives, and how they are read."""

    sequence: Recording
    results: list[ScanResult]
    config: Config

    @property
    def nodes(self) -> Longs:
        """(K,) numbers of the scans whose poses are corrected: the others follow."""
        return np.array([k for k, r in enumerate(self.results) if r.status == "ok" and not r.frame], np.int64)


def refine_run(
    job: PreparedRun, record: RunRecord, prior: PosePrior | None = None, prior_map: Floats | None = None
) -> bool:
    """Refine the poses of `record`, if the configuration asks for it; the manifest says by how much planes became thinner.

    prior, prior_map : as of `refine`, the prior of keyframes
    Returns whether the poses are others.
    """
    manifest, watch = job.manifest, job.watch
    if not job.config.graph.refine or manifest.outcome in ("interrupted", "diverged"):
        return False
    watch.on_start("refinement", len(record.results))
    drive = PosedDrive(job.sequence, [result.at_stamp for result in record.results], job.config)
    with manifest.time("refine_s"):
        try:
            manifest.refinement, results = refine([drive], watch, prior, record.keyframe_scans, prior_map)
        except InterruptedRunError as error:
            manifest.interrupt(str(error))
            return False
    if results is None:
        return False
    record.results = results[0]
    record.trajectory = to_trajectory(record.results, record.method)
    return True


def refine(
    drives: Sequence[PosedDrive],
    watch: Watch,
    prior: PosePrior | None = None,
    keyframes: Longs = NO_NUMBERS,
    prior_map: Floats | None = None,
) -> tuple[dict[str, Any], list[list[ScanResult]] | None]:
    """Refine the poses of all drives together by plane adjustment.

    prior : information about the poses of `keyframes`, numbers of scans, of a single drive
    prior_map : (M, 3) m, points of a map that stays, in the world of the poses

    Returns facts for the manifest, and the results of all drives with refined poses; None where planes do not get thinner.
    Raises InterruptedRunError when `watch` says so.
    """
    nodes = [drive.nodes for drive in drives]
    if min(map(len, nodes)) < 2:
        return {"is_taken": False, "why": "fewer than two scans are registered"}, None
    of_a_scan = max(1, min(OF_A_SCAN, OF_ALL // sum(map(len, nodes))))
    firsts = np.cumsum([0, *map(len, nodes)])
    parts = (_read_points(drive, own, of_a_scan, watch) for drive, own in zip(drives, nodes, strict=True))
    cloud = SweptPoints.chain(parts, firsts[:-1])
    if not len(cloud.points):
        return {"is_taken": False, "why": "no point lies within the range of the map"}, None
    with asking(watch.should_stop, INTERRUPTED):
        return _adjustment(drives, cloud, prior, keyframes, prior_map)


def _read_points(drive: PosedDrive, nodes: Longs, of_a_scan: int, watch: Watch) -> SweptPoints:
    """Points of the scans `nodes` (K,) in the world, each between the two poses before and after its instant."""
    own = [drive.results[k] for k in nodes]
    prepare, numbers = _poser(drive.config, own, of_a_scan), range(len(drive.results))
    # Filled in place: joined from parts, they would be in memory twice.
    points, times, count = np.empty((len(own) * of_a_scan, 3)), np.empty(len(own) * of_a_scan), 0
    for _, loaded in scans_again(drive.sequence, prepare, numbers, drive.config, watch, INTERRUPTED):
        if loaded.prepared is not None:
            after = count + len(loaded.prepared[1])
            points[count:after], times[count:after] = loaded.prepared
            count = after
    stamps = np.array([result.stamp_ns for result in own], np.int64)
    return SweptPoints.at_times(points[:count], times[:count], 1e-9 * (stamps - stamps[0]))


def _poser(config: Config, results: list[ScanResult], count: int) -> Callable[[Scan], tuple[Floats, Floats] | None]:
    """Function of a scan: `count` points (N, 3), world, and s since the first scan (N,); None if it has no pose."""
    box = config.map.ego_box or config.preprocess.ego_box
    course, by_index = course_of(results), {result.index: result for result in results}

    def pose_points(scan: Scan) -> tuple[Floats, Floats] | None:
        result = by_index.get(scan.index)
        if result is None:
            return None
        scan = scan if box is None else without_box(scan, box)
        away = np.linalg.norm(scan.points, axis=1)
        near = np.flatnonzero((away >= config.map.range_min) & (away <= config.map.range_max))
        # Points in a fixed step would be of the same rings in each scan.
        scan = scan.select(np.sort(np.random.default_rng(scan.index).permutation(near)[:count]))
        points = deskew_points(scan.points, scan.times, motion_within(scan, course))
        times = np.zeros(len(points)) if scan.times is None else np.asarray(scan.times, np.float64)
        seconds = 1e-9 * (scan.stamp_ns - results[0].stamp_ns)
        return se3.apply(result.T_world_lidar, points.astype(np.float64)), times + seconds

    return pose_points


def _adjustment(
    drives: Sequence[PosedDrive],
    cloud: SweptPoints,
    prior: PosePrior | None,
    keyframes: Longs,
    prior_map: Floats | None,
) -> tuple[dict[str, Any], list[list[ScanResult]] | None]:
    """As `refine`, from points that were read already; the points of `cloud` are moved."""
    nodes = [drive.nodes for drive in drives]
    firsts = np.cumsum([0, *map(len, nodes)])
    count = int(firsts[-1])
    before = np.stack([drive.results[k].T_world_lidar for drive, own in zip(drives, nodes, strict=True) for k in own])
    poses, numbers = before, NO_NUMBERS
    if prior is not None:
        places = np.full(len(drives[0].results), -1, np.int64)
        places[nodes[0]] = np.arange(len(nodes[0]))
        numbers = places[keyframes]
    if prior_map is not None:
        # One more scan, whose pose is known.
        poses = np.concatenate([before, se3.make(np.eye(3), prior_map.mean(axis=0))[None]])
        as_scan = SweptPoints(prior_map, np.zeros(len(prior_map), np.int64), np.zeros(len(prior_map)))
        cloud = SweptPoints.chain([cloud, as_scan], np.array([0, count]))
        prior, numbers = (
            PosePrior(poses[-1:], lambda x: MAP_INFORMATION * x, MAP_INFORMATION * np.eye(6)[None]),
            np.array([count]),
        )
    begins = firsts[: len(drives) + (prior_map is not None)]
    is_kept_out = _checkerboard(cloud.points)
    judges = np.flatnonzero(is_kept_out & (cloud.poses < count))
    judges = judges[:: max(1, -(-len(judges) // JUDGES))]
    scans, cells = cloud.poses[judges], np.floor(cloud.points[judges] / CELL_M).astype(np.int64)
    thick = [plane_variances(cloud.points[is_kept_out], cloud.points[judges])]
    result = adjust(poses, cloud, ~is_kept_out, prior, numbers, begins)
    thick.append(plane_variances(cloud.points[is_kept_out], cloud.points[judges]))
    gain = 0.5 * np.log(np.maximum(thick[1], 1e-12) / np.maximum(thick[0], 1e-12))
    is_better = thinner_windows(gain, scans, cells, count)
    is_judge = np.isfinite(gain) & is_better[scans]
    facts: dict[str, Any] = {"is_taken": bool(is_better.any()), "scans": int(is_better.sum()), "rounds": result.rounds}
    if not is_better.any():
        return {**facts, "why": "planes of the points kept out do not get thinner"}, None
    after = result.poses[:count]
    if prior is None:  # the world begins at the first pose, unless something else holds it
        after = se3.normalise(before[0] @ se3.inverse(after[0]) @ after)
    away = np.linalg.norm(after[is_better, :3, 3] - before[is_better, :3, 3], axis=1)
    facts |= {
        "thickness_before_mm": _thickness_mm(thick[0][is_judge]),
        "thickness_mm": _thickness_mm(thick[1][is_judge]),
        "thinner_percent": round(100.0 * (1.0 - float(np.exp(gain[is_judge].mean()))), 1),
        "moved_rms_m": round(float(np.sqrt(np.mean(away**2))), 4),
        "moved_most_m": round(float(away.max()), 4),
    }
    if prior_map is not None:  # that holds each pose by itself: what is not taken does not follow its neighbours
        after, is_better = np.where(is_better[:, None, None], after, before), np.ones(count, bool)
    parts = zip(drives, nodes, *(np.split(array, firsts[1:-1]) for array in (is_better, after)), strict=True)
    return facts, [_bend(drive.results, own[taken], refined[taken]) for drive, own, taken, refined in parts]


def _checkerboard(points: Floats) -> Bools:
    """Mask (N,) of the points (N, 3), m, in every second cell of a grid, like the black fields of a checkerboard."""
    total = np.zeros(len(points), np.int64)
    for axis in range(3):
        total += np.floor(points[:, axis] / CELL_M).astype(np.int64)
    return np.asarray(total % 2 == 1)


def _bend(results: list[ScanResult], numbers: Longs, poses: Floats) -> list[ScanResult]:
    """The results of a drive with the refined `poses` (K, 4, 4) of the scans `numbers` (K,): the others follow."""
    if not len(numbers):
        return results
    anchors = [
        Keyframe(number, k, results[k].stamp_ns, results[k].T_world_lidar) for number, k in enumerate(numbers.tolist())
    ]
    # Poses in frames of their own know nothing of these.
    return [b if not a.frame else a for a, b in zip(results, bend_scans(results, anchors, poses), strict=True)]


def thinner_windows(gain: Floats, scans: Longs, cells: Longs, count: int) -> Bools:
    """(K,) whether each of `count` scans lies in a window whose planes became significantly thinner.

    gain : (N,) change of the logarithm of the thickness about points of `scans` (N,); points in one of the `cells` (N, 3) count
        as one measurement
    """
    windows = np.minimum(np.arange(count) // WINDOW, max(count // WINDOW - 1, 0))
    is_thinner = np.zeros(int(windows[-1]) + 1, bool)
    for window in range(len(is_thinner)):
        inside = np.isfinite(gain) & (windows[scans] == window)
        _, cell = np.unique(cells[inside], axis=0, return_inverse=True)
        means = np.bincount(cell.ravel(), gain[inside]) / np.bincount(cell.ravel())
        if len(means) >= LEAST_CELLS:
            is_thinner[window] = means.mean() < -SIGMAS * means.std() / np.sqrt(len(means))
    return np.asarray(is_thinner[windows])


def _thickness_mm(variances: Floats) -> float:
    """Geometric mean of the thickness of planes, mm, from their variances, m2."""
    return round(1e3 * float(np.exp(0.5 * np.log(np.maximum(variances, 1e-12)).mean())), 1)
