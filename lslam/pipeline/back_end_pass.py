"""Passes that make the trajectory consistent: the pose graph, over keyframes, and plane adjustment, over the raw scans."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lslam.backend import added_drift
from lslam.backend.control_points import control_facts, control_residuals, doubts, place_keyframes
from lslam.backend.keyframes.store import KeyframeStore, mounted_up
from lslam.backend.levelling import find_level, level_results
from lslam.backend.loops.find_loops import find_loops, verify_pairs
from lslam.backend.manual import KeyframePairs, keyframe_pairs, write_control
from lslam.backend.optimise import run_back_end
from lslam.backend.outcome import BackEnd
from lslam.core import __version__
from lslam.core.config import Config
from lslam.core.errors import InterruptedRunError
from lslam.core.geometry import se2, se3
from lslam.core.stopping import asking
from lslam.core.types.constraint import LoopCandidate
from lslam.core.types.gnss import Georeference
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import KeyframeClocks, ScanResult
from lslam.core.types.sequence import Sequence
from lslam.io.formats.state_files import Records
from lslam.io.formats.trajectory_lines import write_g2o, write_tum
from lslam.odometry.frontend.register_scans import to_trajectory
from lslam.osm.hold import hold_by_buildings
from lslam.pipeline.job import PreparedRun
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.outputs import write_loops, write_osm_matches
from lslam.pipeline.refinement import refine_run
from lslam.pipeline.segments import raise_final_alerts

log = logging.getLogger("lslam")


def optimise_poses(job: PreparedRun, record: RunRecord) -> BackEnd:
    """Put the final poses into `record`, and the results of the graph into the manifest.

    A run that was interrupted, or whose odometry is lost, keeps its poses. `should_stop` is called between keyframes, before
    the graph, and in the loops of the optimiser.
    """
    config, manifest, store, manual = job.config, job.manifest, job.store, job.manual
    if config.debug.drift:
        manifest.problems.append(added_drift.describe(config.debug))
        log.warning("%s", manifest.problems[-1])
        record.results = added_drift.with_drift(record.results, config.debug)
        store.keyframes = added_drift.moved_keyframes(store.keyframes, record.results)
        record.trajectory = to_trajectory(record.results, record.method)
    if manifest.outcome in ("interrupted", "diverged"):
        return BackEnd(record.results)
    clocks = KeyframeClocks()
    hold = None if job.osm is None else partial(hold_by_buildings, job.osm)
    with manifest.time("back_end_s"):
        candidates: list[LoopCandidate] = []
        try:
            if config.loops.use or manual.pairs:
                job.watch.on_start("loops", 0)
                with manifest.time("loops_s"):
                    pairs = keyframe_pairs(manual.pairs, record.results, store.keyframes)
                    candidates, said = _loops(job, record.results, pairs, clocks)
                    manifest.problems += [*pairs.problems, *said]
            if job.watch.should_stop():
                raise InterruptedRunError("interrupted before the pose graph")
            job.watch.on_start("pose graph", 0)
            with asking(job.watch.should_stop, "interrupted before the pose graph was solved"):
                done = run_back_end(
                    job.sequence,
                    record.results,
                    store,
                    config,
                    candidates,
                    record.turns,
                    hold,
                    clocks,
                    record.inertial,
                    manual.points,
                )
        except InterruptedRunError as error:
            manifest.interrupt(str(error))
            return BackEnd(record.results)
    record.back_end_seconds = {store.keyframes[k].scan: clock.seconds for k, clock in sorted(clocks.items())}
    manifest.timings |= {
        f"{name.replace(' ', '_')}_s": seconds for name, seconds in clocks.totals().items() if name != "loops"
    }
    record.odometry = record.trajectory
    if done.is_optimised:
        causes = "the pose graph" if done.osm is None else "the pose graph and buildings"
        record.results = raise_final_alerts(done.results, record.checks, manifest, causes)
        record.trajectory = to_trajectory(record.results, record.method)
    record.loops, record.keyframe_scans = done.candidates, np.array([k.scan for k in store.keyframes], np.int64)
    record.georeference, record.T_final_odometry = done.georeference, done.T_final_odometry
    record.osm, record.buildings = done.osm, done.buildings
    manifest.problems += done.problems
    manifest.graph = dict(done.facts)
    return done


def _loops(
    job: PreparedRun, results: list[ScanResult], pairs: KeyframePairs, clocks: KeyframeClocks
) -> tuple[list[LoopCandidate], list[str]]:
    """Loop candidates of the keyframes at their present poses; those of an earlier run are reused if poses are equal.

    Known pairs come first: the search for others starts from the poses after applying these and control points. The second
    result lists doubts about the known pairs.
    """
    store, config, checkpoints, should_stop = job.store, job.config, job.checkpoints_of("loops"), job.watch.should_stop
    poses = np.array([k.T_world_lidar for k in store.keyframes]).reshape(-1, 4, 4)
    known = None if checkpoints is None else checkpoints.latest()
    if known is not None and np.array_equal(known["poses"], poses):
        candidates: list[LoopCandidate] = known["candidates"]
        return candidates, doubts(store.keyframes, candidates[: len(pairs.known)], pairs.known, results, config)
    submap_size, up = config.keyframes.submap_size, mounted_up(store, poses, config.preprocess)
    candidates = verify_pairs(store, pairs.known, config.loops, config.registration, submap_size, should_stop, up)
    said = doubts(store.keyframes, candidates, pairs.known, results, config)
    if config.loops.use:
        taken = {(c.a, c.b) for c in candidates}
        found = find_loops(
            store,
            config.loops,
            config.registration,
            submap_size,
            clocks,
            should_stop,
            config.input.workers,
            place_keyframes(store.keyframes, candidates, job.manual.points, results, config),
            pairs.forbidden,
            up,
        )
        candidates += [c for c in found if (c.a, c.b) not in taken]
    if checkpoints is not None:
        checkpoints.write(len(poses), lambda: {"poses": poses, "candidates": Records(candidates)})
    return candidates, said


def level_world(record: RunRecord, sequence: Sequence, config: Config, manifest: Manifest) -> None:
    """Make the world level, unless it is east, north, up already; the georeference refers to the final world.

    It is the last step that moves poses; keyframes on disk keep the poses of odometry.
    """
    place = record.georeference
    if place is not None and place.is_in_graph:
        record.world = "east, north, up from the origin of the georeference"
    else:
        level = find_level(sequence, record.results, config)
        T = se3.make(level.R, np.zeros(3))
        was_odometry = record.odometry is record.trajectory
        record.results = level_results(record.results, level)
        record.trajectory = to_trajectory(record.results, record.method)
        if was_odometry:
            record.odometry = record.trajectory
        elif record.odometry is not None and level.is_turned:
            record.odometry = replace(record.odometry, poses=se3.normalise(T @ record.odometry.poses), covariances=None)
        if place is not None:
            record.georeference = replace(place, T_enu_world=place.T_enu_world @ se3.inverse(T))
        if level.problem:
            manifest.problems.append(level.problem)
            log.warning("%s", level.problem)
        record.world = level.world
    manifest.world = record.world
    if record.georeference is not None:
        manifest.georeference = describe(record.georeference)


def write_back_end(folder: Path, record: RunRecord, store: KeyframeStore, done: BackEnd) -> None:
    """Write trajectory_odometry.tum, loops.csv and, if there are any, osm_matches.csv and graph.g2o."""
    if record.odometry is None:
        return
    write_tum(
        folder / "trajectory_odometry.tum",
        record.odometry,
        comment=f"lslam {__version__}, {record.method}: T_world_lidar of odometry, in a world of its own\n"
        f"pose_time: {record.pose_time}",
    )
    numbers = [record.results[k.scan].index for k in store.keyframes]
    if done.osm is not None:
        write_osm_matches(folder / "osm_matches.csv", done.osm, numbers, se2.of_se3(done.keyframes))
    if not record.map_fixes:
        write_loops(folder / "loops.csv", done.candidates, numbers)
    if done.control:
        write_control(folder / "control.csv", done.control)
    if done.is_optimised:
        write_g2o(folder / "graph.g2o", done.keyframes, done.constraints)


def describe(georeference: Georeference) -> dict[str, Any]:
    """The georeference as plain values for the manifest, distances in m, rounded; unknown values are omitted."""
    plain = asdict(georeference)
    plain["origin_lat_lon_height"] = [float(v) for v in plain.pop("origin")]
    plain["T_enu_world"] = georeference.T_enu_world.tolist()
    plain["projection"] = "transverse Mercator at the origin, scale 1, WGS84"
    for name in ("height_epsg", "geoid"):
        if not plain[name]:
            del plain[name]
    known = {k: v for k, v in plain.items() if not (isinstance(v, float) and np.isnan(v))}
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in known.items()}


def refine_poses(job: PreparedRun, record: RunRecord, back_end: BackEnd) -> BackEnd:
    """Refine the poses of `record` by plane adjustment where planes of held-out points get thinner; the manifest has the gain.

    Where fixes, control points or buildings constrain the run, its graph gives their prior. Returns the back end with the new
    residuals of the control points.
    """
    prior = None if back_end.solution is None else back_end.solution.pose_prior
    if not refine_run(job, record, prior) or not back_end.control or record.georeference is None:
        return back_end
    points = [residual.point for residual in back_end.control]
    control = control_residuals(points, record.results, record.georeference, job.config.gnss.geoid)
    job.manifest.graph["control_points"] |= control_facts(control)
    return replace(back_end, control=control)
