"""Pass over the raw scans that refines the final poses: plane adjustment, of which a part of the points judges the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lslam.backend.adjustment import SweptPoints, adjust
from lslam.backend.control_points import control_facts, control_residuals
from lslam.backend.graph.marginals import PosePrior
from lslam.backend.graph.odometry_constraints import bend_scans
from lslam.backend.outcome import BackEnd
from lslam.core.config import Config
from lslam.core.errors import InterruptedRunError
from lslam.core.geometry import se3
from lslam.core.stopping import asking
from lslam.core.types.arrays import Bools, Floats, Longs
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe
from lslam.maps.crispness import plane_variances
from lslam.odometry.frontend.register_scans import to_trajectory
from lslam.pipeline.job import PreparedRun
from lslam.pipeline.map_pass import course_of, motion_within, scans_again, without_box
from lslam.registration.preprocessing.deskew import deskew_points

# Points of a scan at most, and of all scans: about 300 bytes each while planes are adjusted. Odometry averages over all points,
# which fewer single ones do not beat.
OF_A_SCAN, OF_ALL = 10_000, 6_000_000
CELL_M = 2.0  # m, edge of the cells of which every second one is kept out of the adjustment
JUDGES = 20_000  # points, at most, about which the thickness is looked at
# Scans that are judged together, least cells by which they are, and sigmas by which their planes must be thinner.
WINDOW, LEAST_CELLS, SIGMAS = 50, 10, 3.0
INTERRUPTED = "interrupted while the poses were refined"


def refine_poses(job: PreparedRun, record: RunRecord, done: BackEnd) -> BackEnd:
    """Refine the poses of `record` where planes of the points that were kept out become thinner; the manifest says by how much.

    Where fixes, control points or buildings hold the run, its graph says how firmly. Returns the back end with what is left of
    the control points.
    """
    config, manifest, watch = job.config, job.manifest, job.watch
    if not config.graph.refine or manifest.outcome in ("interrupted", "diverged"):
        return done
    results = [result.at_stamp for result in record.results]
    nodes = np.array([k for k, r in enumerate(results) if r.status == "ok" and not r.frame], np.int64)
    if len(nodes) < 2:
        manifest.refinement = {"is_taken": False, "why": "fewer than two scans are registered"}
        return done
    watch.on_start("refinement", len(results))
    with manifest.timed("refine_s"):
        try:
            swept = read_points(job, results, nodes)
            if not len(swept.points):
                manifest.refinement = {"is_taken": False, "why": "no point lies within the range of the map"}
                return done
            prior = None if done.solution is None else done.solution.pose_prior
            with asking(watch.should_stop, INTERRUPTED):
                manifest.refinement, adjustment = _adjustment(results, nodes, swept, prior, record.keyframe_scans)
        except InterruptedRunError as error:
            manifest.interrupt(str(error))
            return done
    if adjustment is None:
        return done
    record.results = adjustment
    record.trajectory = to_trajectory(record.results, record.method)
    if not done.control or record.georeference is None:
        return done
    points = [residual.point for residual in done.control]
    control = control_residuals(points, record.results, record.georeference, config.gnss.geoid)
    manifest.graph["control_points"] |= control_facts(control)
    return replace(done, control=control)


def read_points(job: PreparedRun, results: list[ScanResult], nodes: Longs) -> SweptPoints:
    """Points of the scans `nodes` (K,) in the world, each between the two poses round the instant it was measured."""
    config, watch, registered = job.config, job.watch, [results[k] for k in nodes]
    prepare = _poser(config, registered, max(1, min(OF_A_SCAN, OF_ALL // len(nodes))))
    parts: list[tuple[Floats, Floats]] = []
    numbers = range(len(results))
    for _, loaded in scans_again(job.sequence, prepare, numbers, config, watch.on_step, watch.should_stop, INTERRUPTED):
        if loaded.prepared is not None:
            parts.append(loaded.prepared)
    if not parts:
        return SweptPoints(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))
    points, times = (np.concatenate(of) for of in zip(*parts, strict=True))
    stamps = np.array([result.stamp_ns for result in registered], np.int64)
    return SweptPoints.at_times(points, times, 1e-9 * (stamps - stamps[0]))


def _poser(config: Config, registered: list[ScanResult], count: int) -> Callable[[Scan], tuple[Floats, Floats] | None]:
    """Function of a scan: `count` of its points (N, 3) in the world, and s from the first registered scan (N,)."""
    box = config.map.ego_box or config.preprocess.ego_box
    course, by_index = course_of(registered), {result.index: result for result in registered}

    def posed(scan: Scan) -> tuple[Floats, Floats] | None:
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
        seconds = 1e-9 * (scan.stamp_ns - registered[0].stamp_ns)
        return se3.apply(result.T_world_lidar, points.astype(np.float64)), times + seconds

    return posed


def _adjustment(
    results: list[ScanResult], nodes: Longs, swept: SweptPoints, prior: PosePrior | None, keyframes: Longs
) -> tuple[dict[str, Any], list[ScanResult] | None]:
    """What the manifest says, and the results with refined poses; None where these are not better.

    keyframes : numbers of the scans of which the `prior` tells
    """
    before = np.stack([results[k].T_world_lidar for k in nodes])
    is_used = np.floor(swept.points / CELL_M).astype(np.int64).sum(axis=1) % 2 == 0
    places = np.full(len(results), -1, np.int64)
    places[nodes] = np.arange(len(nodes))
    found = adjust(before, swept, is_used, prior, places[keyframes])
    kept_out = swept.select(~is_used)
    step = max(1, -(-len(kept_out.points) // JUDGES))
    queries = slice(0, None, step)
    thick = [plane_variances(np.ascontiguousarray(p), queries) for p in (kept_out.points, found.points[~is_used])]
    gain = 0.5 * np.log(np.maximum(thick[1], 1e-12) / np.maximum(thick[0], 1e-12))
    cells = np.floor(kept_out.points[queries] / CELL_M).astype(np.int64)
    is_taken = thinner_windows(gain, kept_out.poses[queries], cells, len(nodes))
    is_judge = np.isfinite(gain) & is_taken[kept_out.poses[queries]]
    facts: dict[str, Any] = {"is_taken": bool(is_taken.any()), "scans": int(is_taken.sum()), "rounds": found.rounds}
    if not is_taken.any():
        return {**facts, "why": "planes of the points kept out do not get thinner"}, None
    # The world begins at the first pose, unless it is the Earth's.
    after = found.poses if prior is not None else se3.normalise(before[0] @ se3.inverse(found.poses[0]) @ found.poses)
    anchors = [
        Keyframe(number, int(k), results[k].stamp_ns, before[i])
        for number, (i, k) in enumerate((i, nodes[i]) for i in np.flatnonzero(is_taken).tolist())
    ]
    # Poses in frames of their own know nothing of these.
    moved = [
        b if not a.frame else a for a, b in zip(results, bend_scans(results, anchors, after[is_taken]), strict=True)
    ]
    away = np.linalg.norm(after[is_taken, :3, 3] - before[is_taken, :3, 3], axis=1)
    facts |= {
        "thickness_before_mm": _thickness_mm(thick[0][is_judge]),
        "thickness_mm": _thickness_mm(thick[1][is_judge]),
        "thinner_percent": round(100.0 * (1.0 - float(np.exp(gain[is_judge].mean()))), 1),
        "moved_rms_m": round(float(np.sqrt(np.mean(away**2))), 4),
        "moved_most_m": round(float(away.max()), 4),
    }
    return facts, moved


def thinner_windows(gain: Floats, scans: Longs, cells: Longs, count: int) -> Bools:
    """(K,) whether each of `count` scans lies in a window whose planes became significantly thinner.

    gain : (N,) of the logarithm of the thickness about points of `scans` (N,) in `cells` (N, 3), which are one measurement each
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
    """The geometric mean of the thickness."""
    return round(1e3 * float(np.exp(0.5 * np.log(np.maximum(variances, 1e-12)).mean())), 1)
