"""The map that a drive was located in, as the page shows it: the part along the drive, and what differs there."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial

import numpy as np

from lslam.backend.localization.prior_map import PriorMap
from lslam.core.geometry import se3
from lslam.core.stopping import asking
from lslam.core.types.arrays import Bools, Floats
from lslam.core.types.cloud import ArrayCloud, thin_out
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult
from lslam.maps.changes import MapChange, differences, points_in
from lslam.maps.floor_plan import pixel_size, top_view
from lslam.maps.occupancy import Evidence, OccupancyMapper
from lslam.pipeline.job import PreparedRun
from lslam.pipeline.map_pass import SAMPLE, map_checkpoints, scan_poser, scans_again

log = logging.getLogger("lslam")
MOST_DIFFERING = SAMPLE // 4  # points of what is gone, and of what is not in the map
# Scans nearer to each other see the same; so many of them make cells certain.
SPACING_M, LEAST_SCANS = 1.0, 100
COMPARISON = "comparison with the map"
INTERRUPTED = "interrupted while the drive was compared with the map"


def view_prior_map(job: PreparedRun, record: RunRecord, prior_map: PriorMap) -> None:
    """Put the map near the drive into the record, with the column `change`: -1 gone, 0 as it was, 1 not in the map.

    Only scans that the map holds tell what differs, about one a metre. Raises InterruptedRunError when the run is to stop.
    """
    section, results = job.config.map, record.results
    positions = se3.apply(se3.inverse(prior_map.T_map_level), record.trajectory.positions)
    near = se3.apply(prior_map.T_map_level, prior_map.along(positions, section.occupancy_range).astype(np.float64))
    apart = spread_out(record.trajectory.path_lengths)
    looked_at = [f.is_binding and far for f, far in zip(record.map_fixes, apart, strict=True)]
    held = [r if looked else replace(r, status="bridged") for r, looked in zip(results, looked_at, strict=True)]
    found = _observed(job, held)
    changes = differences(found, near)
    kinds = {kind: [change for change in changes if change.kind == kind] for kind in ("appeared", "vanished")}
    is_gone = points_in(near, kinds["vanished"], found)
    new = np.concatenate([np.zeros((0, 3)), *(_filled(change) for change in kinds["appeared"])])
    differing = [thin_out(ArrayCloud(part), MOST_DIFFERING).points for part in (near[is_gone], new)]
    same = thin_out(ArrayCloud(near[~is_gone]), SAMPLE - sum(map(len, differing))).points
    parts = [same, *differing]
    change = np.repeat([0, -1, 1], [len(part) for part in parts])
    record.map_sample = ArrayCloud(np.concatenate(parts), columns={"change": change.astype(np.int8)})
    view = top_view(ArrayCloud(near), pixel_size(section.voxel))
    record.map_image, record.map_heights, record.map_extent = view.image, view.heights, view.extent
    job.manifest.localization["differences"] = {
        "voxel_m": found.voxel,
        "gone": len(kinds["vanished"]),
        "not_in_the_map": len(kinds["appeared"]),
    }
    log.info("against the map: %d things gone, %d not in it", len(kinds["vanished"]), len(kinds["appeared"]))


def spread_out(way: Floats) -> Bools:
    """Scans that tell what differs, by the way (N,) travelled, m: the first of each metre, or more of a drive of few metres."""
    spacing = max(min(SPACING_M, float(way[-1]) / LEAST_SCANS), 1e-9)
    return np.asarray(np.diff(np.floor(way / spacing), prepend=-1.0) > 0)


def _observed(job: PreparedRun, results: list[ScanResult]) -> Evidence:
    """Cells that the registered scans of the drive hit or pass; a stopped run goes on from its checkpoint."""
    section, stop, poses = job.config.map, job.watch.should_stop, np.stack([r.T_world_lidar for r in results])
    assert job.folder is not None
    checkpoints = map_checkpoints(job.folder, job.config, COMPARISON)
    make = partial(
        OccupancyMapper,
        section.occupancy_voxel,
        section.range_min,
        section.occupancy_range,
        spool=job.folder.path,
        keep=None if checkpoints is None else checkpoints.folder / "differences",
        origin=np.floor(poses[0, :3, 3] / section.occupancy_voxel).astype(np.int64),
    )
    mapper, done = (make(), 0) if checkpoints is None else checkpoints.begin(make, poses)
    offer = None if checkpoints is None else partial(checkpoints.offer, mapper)
    poser, numbers = scan_poser(results, job.config), range(done, len(results))
    job.watch.on_start("differences", len(results))
    for _, loaded in scans_again(
        job.sequence, poser, numbers, job.config, job.watch.on_step, stop, INTERRUPTED, done, offer
    ):
        if loaded.prepared is not None:
            mapper.add(loaded.prepared.points, loaded.prepared.T_world_lidar)
    with asking(stop, INTERRUPTED):
        return mapper.evidence()


def _filled(change: MapChange) -> Floats:
    """(8 K, 3) m, points in the cells of a change, as dense as those of a map with voxels of half a cell."""
    corners = np.stack(np.meshgrid(*[(-0.25, 0.25)] * 3), axis=-1).reshape(-1, 3) * change.voxel
    return np.asarray((change.centres[:, None] + corners).reshape(-1, 3))
