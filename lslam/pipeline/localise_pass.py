"""Second pass in an existing map: the start of the drive, every scan on the map, with odometry as the prior, and what differs."""

from __future__ import annotations

import hashlib
import logging
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lslam.backend.graph.drift import drift_covariance
from lslam.backend.graph.odometry_constraints import correct_scans
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.localization.locate import MapFollower, PlaceFinder, Start, StartPrior, mark_doubts
from lslam.backend.localization.prior_map import LocalView, PlaceSearch, PriorMap
from lslam.backend.loops.verify import LEAST_SIGMA_DEG, LEAST_SIGMA_M
from lslam.core.arrays import Bools, Floats
from lslam.core.config import Config
from lslam.core.errors import InterruptedRunError, RunFailedError
from lslam.core.geometry import noise, se3
from lslam.core.geometry.geodesy import to_local
from lslam.core.stopping import asking
from lslam.core.types.cloud import ArrayCloud, thin_out
from lslam.core.types.constraint import MapFix
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.trajectory import Keyframe
from lslam.io.formats.state_files import Records
from lslam.maps.changes import MapChange, differences, points_in
from lslam.maps.floor_plan import pixel_size, top_view
from lslam.maps.occupancy import Evidence, OccupancyMapper
from lslam.odometry.frontend.register_scans import read_ahead, to_trajectory
from lslam.pipeline.job import PreparedRun
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.map_pass import SAMPLE, begin_pass, course_of, map_checkpoints, motion_within, posed_scans
from lslam.pipeline.map_tiles import read_prior_map
from lslam.pipeline.refinement import refine_run
from lslam.pipeline.watch import Watch
from lslam.registration.preprocessing.deskew import deskew
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points

log = logging.getLogger("lslam")
# Sentences of reasons in a message, at most.
MOST_REASONS = 3
# m that the antenna may be away from the LiDAR.
ANTENNA_M = 3.0
WORDS = {"changed": "where it has changed", "beyond": "beyond its end", "unread": "without points"}
MOST_DIFFERING = SAMPLE // 4  # points of what is gone, and of what is not in the map
# Scans nearer to each other see the same; so many of them make cells certain.
SPACING_M, LEAST_SCANS = 1.0, 100
COMPARISON = "comparison with the map"
INTERRUPTED = "interrupted while the drive was compared with the map"


def localise_poses(job: PreparedRun, record: RunRecord) -> None:
    """Localise the run in the prior map: poses in the map's frame, and the status of each scan, go to `record`.

    A run that was interrupted, or whose odometry is lost, is unchanged. Raises RunFailedError when the drive is not found in
    the map.
    """
    config, manifest = job.config, job.manifest
    if manifest.outcome in ("interrupted", "diverged"):
        return
    with manifest.time("localise_s"):
        prior_map = read_prior_map(Path(config.localize.map), config.registration)
        try:
            search = PlaceFinder(PlaceSearch(prior_map, config.registration), job.store, config)
            fixes, start = _follow(job, record.results, prior_map, search)
        except InterruptedRunError as error:
            manifest.interrupt(str(error))
            return
    _deliver(job, record, prior_map, fixes)
    _tell(record, prior_map, start, config, manifest)
    if job.folder is None or not config.report.html or manifest.outcome == "interrupted":
        return
    with manifest.time("differences_s"):
        try:
            view_prior_map(job, record, prior_map)
        except InterruptedRunError as error:
            manifest.interrupt(str(error))


def _follow(
    job: PreparedRun, results: list[ScanResult], prior_map: PriorMap, search: PlaceFinder
) -> tuple[list[MapFix], dict[str, Any]]:
    """Register every scan on the map from a start that is searched; level axes. InterruptedRunError when stopped."""
    sequence, config, watch, checkpoints = job.sequence, job.config, job.watch, job.checkpoints_of("localise")
    earlier = None if checkpoints is None else checkpoints.latest()
    poses = np.stack([r.T_world_lidar for r in results])
    of_map = hashlib.sha256(prior_map.points.tobytes()).hexdigest()
    if earlier is not None and not (np.array_equal(earlier["poses"], poses) and earlier["map"] == of_map):
        earlier = None
    view = LocalView(prior_map, config.registration, 1.2 * config.preprocess.range_max)
    reanchor = Reanchoring(search, results)
    if earlier is None:
        watch.on_start("search", 0)
        start = _find_start(sequence, prior_map, search, config, watch)
        follower = MapFollower(view, *_at_first_scan(start, search.store, results, config), config, reanchor)
        fixes: list[MapFix] = []
        about = {
            "votes": start.votes,
            "tried": start.tried,
            "scan": search.store.keyframes[start.vote.keyframe].scan,
            "support": round(start.vote.support, 3),
        }
    else:
        follower = MapFollower(view, np.eye(4), np.eye(6), config, reanchor)
        follower.restore(earlier["follower"])
        fixes, about = earlier["fixes"], earlier["start"]
        log.info("localisation: going on after %d scans", len(fixes))
    watch.on_start("localise", len(results) - len(fixes))
    course = course_of(results)

    def prepare(scan: Scan) -> PreparedPoints:
        times = scan.times if config.preprocess.deskew else None
        prepared = prepare_points(scan.points, config.preprocess, scan.index, times)
        return deskew(prepared, motion_within(scan, course))

    first = len(fixes)
    for k, loaded in enumerate(read_ahead(sequence, prepare, config.input.workers, first=first), first):
        if k == len(results):
            break
        is_last = watch.should_stop()
        if checkpoints is not None and k and (is_last or checkpoints.schedule.is_due):
            checkpoints.write(
                k,
                lambda: {
                    "poses": poses,
                    "map": of_map,
                    "fixes": Records(fixes),
                    "start": about,
                    "follower": follower.state(),
                },
            )
        if is_last:
            raise InterruptedRunError(f"interrupted during localisation, at scan {k} of {len(results)}")
        if k:
            follower.predict(results[k - 1], results[k])
        fixes.append(follower.correct(k, loaded.prepared))
        watch.on_step()
    return fixes, about


class Reanchoring:
    """Search for a keyframe in the map by its submap, after odometry has drifted too far. It keeps no state."""

    def __init__(self, search: PlaceFinder, results: list[ScanResult]) -> None:
        self._search, self._results = search, results
        self._keyframe_of = {k.scan: k.number for k in search.store.keyframes}

    def __call__(self, position: int, T: Floats, radius: float) -> Floats | None:
        """Pose (4, 4), level axes, of the scan at `position`, searched within `radius` m of T (4, 4).

        None if the scan is of no keyframe, or is far from the map.
        """
        b = self._keyframe_of.get(position)
        if b is None or not self._search.search.is_near(T[:2, 3], radius):
            return None
        vote = self._search.vote(b, self._search.region_about(b, T, radius))
        return None if vote is None else vote.T_level_odometry @ self._results[position].T_world_lidar


def _find_start(sequence: Sequence, prior_map: PriorMap, search: PlaceFinder, config: Config, watch: Watch) -> Start:
    """Find the start of the drive in the map. Raises RunFailedError when there is none, InterruptedRunError on a stop."""
    prior, where = _prior_of(sequence, prior_map, config)
    if config.localize.start is not None and prior is not None:
        off_m = float(np.linalg.norm(prior_map.points[:, :2] - prior.position, axis=1).min())
        if off_m > prior.radius:
            x, y, _ = config.localize.start
            raise RunFailedError(
                f"--start {x:g},{y:g} lies {off_m:.0f} m off the map {prior_map.source}: name a place in it"
            )
    log.info("searching the drive in the map, %s", where)
    start = search.find(prior, watch.should_stop)
    if watch.should_stop():
        raise InterruptedRunError("interrupted before the drive was found in the map")
    if start is None:
        counts = Counter(reason.split(",")[0] for reason in search.reasons).most_common(MOST_REASONS)
        why = "; ".join(f"{reason} ({count} x)" for reason, count in counts) or "keyframes do not agree"
        way_out = "Say where it begins with" if config.localize.start is None else "It may begin elsewhere: correct"
        raise RunFailedError(
            f"the drive was not found in {prior_map.source}, {where}: {why}. {way_out} --start X,Y,HEADING"
        )
    log.info(
        "found in the map by %d of %d keyframes tried, %.0f %% of the upright points fit",
        start.votes,
        start.tried,
        100 * start.vote.support,
    )
    return start


def _prior_of(sequence: Sequence, prior_map: PriorMap, config: Config) -> tuple[StartPrior | None, str]:
    """Prior of the start in level axes of the map, by configuration or satellite fix, or None; and the region in words."""
    section = config.localize
    into_level = se3.inverse(prior_map.T_map_level)
    if section.start is not None:
        x, y, heading = section.start
        height = float(prior_map.T_map_level[2, 3])
        position = se3.apply(into_level, np.array([[x, y, height]]) - prior_map.origin * [1, 1, 0])[0]
        forward = into_level[:3, :3] @ [np.cos(np.deg2rad(heading)), np.sin(np.deg2rad(heading)), 0.0]
        yaw = float(np.arctan2(forward[1], forward[0]))
        turn = float(np.deg2rad(section.start_turn_deg))
        return StartPrior(position[:2], yaw, section.start_radius, turn), f"about {x:g}, {y:g}"
    fixes, place = sequence.gnss, prior_map.georeference
    if config.gnss.mode == "off" or fixes is None or place is None or not fixes.is_place.any():
        return None, "anywhere in it"
    k = int(np.flatnonzero(fixes.is_place)[np.abs(fixes.stamps_ns[fixes.is_place] - sequence.stamps_ns[0]).argmin()])
    enu = to_local(fixes.lat_lon_alt[k : k + 1], place.origin)
    position = se3.apply(into_level @ se3.inverse(place.T_enu_world), enu)[0]
    sigma = config.gnss.sigma or float(fixes.sigma[k])
    return StartPrior(position[:2], None, 3.0 * sigma + ANTENNA_M), "about its first satellite fix"


def _at_first_scan(
    start: Start, store: KeyframeStore, results: list[ScanResult], config: Config
) -> tuple[Floats, Floats]:
    """Pose (4, 4) of the first scan, level axes, and its covariance, transported by odometry from the located keyframe."""
    keyframe = store.keyframes[start.vote.keyframe]
    T = start.vote.T_level_odometry @ results[0].T_world_lidar
    at = start.vote.T_level_odometry @ keyframe.T_world_lidar
    C = noise.transport(start.vote.covariance, T[:3, 3] - at[:3, 3])
    c, way = config.loops, keyframe.distance
    move, turn_deg = 0.01 * c.drift_percent * way + LEAST_SIGMA_M, c.drift_deg * way / 100 + LEAST_SIGMA_DEG
    systematic = np.diag(np.repeat([move**2, np.deg2rad(turn_deg) ** 2], 3))
    return T, np.asarray(C + drift_covariance(way, config.graph) + systematic)


def _deliver(job: PreparedRun, record: RunRecord, prior_map: PriorMap, fixes: list[MapFix]) -> None:
    """Put the trajectory into the record, map frame, odometry bent between registered scans; RunFailedError without any.

    With `graph.refine` all poses are then refined by the planes of the scans and of the map.
    """
    T, config = prior_map.T_map_level, job.config
    results = record.results[: len(fixes)]
    into_map = [
        replace(f, T_map_lidar=T @ f.T_map_lidar, covariance=noise.rotate(f.covariance, T[:3, :3]))
        for f in mark_doubts(fixes)
    ]
    numbers = [k for k, fix in enumerate(into_map) if fix.is_binding]
    if not numbers:
        raise RunFailedError(f"no scan agrees with {prior_map.source} where the drive was found: {fixes[0].reason}")
    first = numbers[0]
    record.T_final_odometry = into_map[first].T_map_lidar @ se3.inverse(results[first].T_world_lidar)
    anchors = [Keyframe(n, k, results[k].stamp_ns, results[k].T_world_lidar) for n, k in enumerate(numbers)]
    poses = np.stack([into_map[k].T_map_lidar for k in numbers])
    covariances = np.stack([into_map[k].covariance for k in numbers])
    record.odometry = record.trajectory
    record.results = correct_scans(results, anchors, poses, covariances, 1.0, config.graph)
    record.trajectory = to_trajectory(record.results, record.method)
    if config.graph.refine:
        near = prior_map.along(se3.apply(se3.inverse(T), record.trajectory.positions), config.map.range_max)
        refine_run(job, record, prior_map=se3.apply(T, near.astype(np.float64)))
    record.georeference = prior_map.georeference
    record.map_fixes = [replace(f, T_map_lidar=r.T_world_lidar) for f, r in zip(into_map, record.results, strict=True)]
    at = "" if not prior_map.origin.any() else f" less {prior_map.origin.tolist()}"
    record.world = f"that of the map {prior_map.source}{at}"
    record.map_origin = prior_map.origin


def _tell(record: RunRecord, prior_map: PriorMap, start: dict[str, Any], config: Config, manifest: Manifest) -> None:
    """Write the counts and problems of localisation into the manifest.

    start : facts about the located start
    """
    fixes = record.map_fixes
    counts = Counter[str](fix.status for fix in fixes)
    doubtful = sum(fix.is_doubtful for fix in fixes)
    shares = [fix.inlier_share for fix in fixes if fix.is_binding]
    manifest.world = record.world
    manifest.localization = {
        "map": config.localize.map,
        "points": len(prior_map),
        "start": start,
        **dict(sorted(counts.items())),
        "doubted": doubtful,
        "inlier_share": round(float(np.median(shares)), 4),
    }
    others = ", ".join(f"{counts[status]} {where}" for status, where in WORDS.items() if counts[status])
    if others:
        manifest.problems.append(
            f"the map does not hold {len(fixes) - counts['held']} of {len(fixes)} scans ({others}): odometry carries them"
        )
    if doubtful:
        manifest.problems.append(
            f"{doubtful} of {len(fixes)} scans agree less with the map than the others: something there has changed, "
            "localization.csv says where"
        )


def view_prior_map(job: PreparedRun, record: RunRecord, prior_map: PriorMap) -> None:
    """Put the map about the drive into the record, with the column `change`: -1 gone, 0 unchanged, 1 not in the map.

    Only scans registered on the map are used, about one a metre. Raises InterruptedRunError when the run is to stop.
    """
    section, results = job.config.map, record.results
    positions = se3.apply(se3.inverse(prior_map.T_map_level), record.trajectory.positions)
    near = se3.apply(prior_map.T_map_level, prior_map.along(positions, section.occupancy_range).astype(np.float64))
    apart = spread_out(record.trajectory.path_lengths)
    some = [
        r if fix.is_binding and is_far else replace(r, status="bridged")
        for r, fix, is_far in zip(results, record.map_fixes, apart, strict=True)
    ]
    evidence = _observe(job, some)
    changes = differences(evidence, near)
    kinds = {kind: [change for change in changes if change.kind == kind] for kind in ("appeared", "vanished")}
    is_absent = points_in(near, kinds["vanished"], evidence)
    new = np.concatenate([np.zeros((0, 3)), *(_fill(change) for change in kinds["appeared"])])
    differing = [thin_out(ArrayCloud(part), MOST_DIFFERING).points for part in (near[is_absent], new)]
    same = thin_out(ArrayCloud(near[~is_absent]), SAMPLE - sum(map(len, differing))).points
    parts = [same, *differing]
    change = np.repeat([0, -1, 1], [len(part) for part in parts])
    record.map_sample = ArrayCloud(np.concatenate(parts), columns={"change": change.astype(np.int8)})
    view = top_view(ArrayCloud(near), pixel_size(section.voxel))
    record.map_image, record.map_heights, record.map_extent = view.image, view.heights, view.extent
    job.manifest.localization["differences"] = {
        "voxel_m": evidence.voxel,
        "gone": len(kinds["vanished"]),
        "not_in_the_map": len(kinds["appeared"]),
    }
    log.info("against the map: %d things gone, %d not in it", len(kinds["vanished"]), len(kinds["appeared"]))


def spread_out(way: Floats) -> Bools:
    """Scans to compare with the map, by path length (N,), m: the first of each metre, or more of a drive of few metres."""
    spacing = max(min(SPACING_M, float(way[-1]) / LEAST_SCANS), 1e-9)
    return np.asarray(np.diff(np.floor(way / spacing), prepend=-1.0) > 0)


def _observe(job: PreparedRun, results: list[ScanResult]) -> Evidence:
    """Cells that the registered scans of the drive hit or pass; a resumed run continues from its checkpoint."""
    section, watch, poses = job.config.map, job.watch, np.stack([r.T_world_lidar for r in results])
    assert job.folder is not None
    folder = job.folder

    def make(keep: Path | None) -> OccupancyMapper:
        return OccupancyMapper(
            section.occupancy_voxel,
            section.range_min,
            section.occupancy_range,
            spool=folder.path,
            keep=None if keep is None else keep / "differences",
            origin=np.floor(poses[0, :3, 3] / section.occupancy_voxel).astype(np.int64),
        )

    mapper, count, offer = begin_pass(map_checkpoints(folder, job.config, COMPARISON), make, poses)
    watch.on_start("differences", len(results))
    numbers = range(count, len(results))
    for _, scan in posed_scans(job.sequence, results, job.config, watch, INTERRUPTED, numbers, count, offer):
        if scan is not None:
            mapper.add(scan.points, scan.T_world_lidar)
    with asking(watch.should_stop, INTERRUPTED):
        return mapper.evidence()


def _fill(change: MapChange) -> Floats:
    """(8 K, 3) m, points in the cells of a change, as dense as those of a map with voxels of half a cell."""
    corners = np.stack(np.meshgrid(*[(-0.25, 0.25)] * 3), axis=-1).reshape(-1, 3) * change.voxel
    return np.asarray((change.centres[:, None] + corners).reshape(-1, 3))
