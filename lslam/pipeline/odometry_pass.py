"""First pass over the scans: odometry, and the keyframes it passes."""

from __future__ import annotations

import logging
from contextlib import suppress
from pathlib import Path

from lslam.config import Config
from lslam.errors import InputError
from lslam.kernels import jit
from lslam.keyframes.store import KeyframeStore
from lslam.maps import crispness, merge
from lslam.odometry.base import Odometry
from lslam.odometry.given import GivenPoses
from lslam.pipeline import inertial_start
from lslam.pipeline.front_end import estimate, is_diverged, to_trajectory
from lslam.pipeline.inertial_start import Inertial, begin_inertial, close_inertial
from lslam.pipeline.keyframing import Keyframing
from lslam.pipeline.manifest import Manifest
from lslam.pipeline.watch import Watch
from lslam.registration.standing import Standing
from lslam.types.run_record import RunRecord
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")


def estimate_poses(
    sequence: Sequence, odometry: Odometry, config: Config, manifest: Manifest, folder: Path, truth: Trajectory | None,
    watch: Watch, store: KeyframeStore,
) -> RunRecord:  # fmt: skip
    """Odometry over all scans, judged; its keyframes go to `store`. Raises InputError when no scan can be used."""
    standing = Standing(config.preprocess, config.registration) if config.preprocess.skip_standing else None
    _warm_up(sequence, odometry, standing, config, manifest)

    def seen(result: ScanResult) -> None:
        if result.status != "ok":
            log.warning("scan %d %s: %s", result.index, result.status, result.reason)
        watch.on_step()

    watch.on_start("odometry", len(sequence))
    limit = config.odometry.max_failures
    inertial = _begin_imu(sequence, odometry, config, manifest)
    motion = odometry.motion if isinstance(odometry, GivenPoses) else inertial.motion
    with manifest.timed("odometry_s"), Keyframing(store, config) as keyframing:
        results = estimate(
            sequence, odometry, threads=config.input.threads, max_failures=limit, standing=standing,
            motion=motion, should_stop=watch.should_stop, on_scan=seen, keyframing=keyframing,
        )  # fmt: skip
        keyframing.settle()
    manifest.keyframes = {"count": len(store), "bytes": store.size}
    if all(r.status == "skipped" for r in results):
        raise InputError(f"{sequence.path}: none of {len(results)} scans can be used, the first: {results[0].reason}")
    if config.imu.use:
        manifest.imu = close_inertial(inertial, results)
        manifest.problems += inertial.problems
    manifest.judge(results, len(sequence), is_diverged(results, limit))
    return RunRecord(
        name=sequence.name,
        method=config.odometry.method,
        folder=folder,
        results=results,
        trajectory=to_trajectory(results, config.odometry.method),
        ground_truth=truth,
        real_time_limit=config.input.skip_frames / sequence.rate_hz,
    )


def _warm_up(
    sequence: Sequence, odometry: Odometry, standing: Standing | None, config: Config, manifest: Manifest
) -> None:
    """Compile or load what the scans would otherwise wait for."""
    with manifest.timed("compile_s"), jit.announced(log), jit.compile_lock():
        odometry.warm_up()
        if standing is not None:
            standing.warm_up()
        if config.map.write:
            merge.warm_up()
            crispness.warm_up()
        if config.imu.use:
            inertial_start.warm_up()
        with suppress(InputError):
            sequence.scan(0)  # the reader's kernels; what is wrong with the scan is said in its turn


def _begin_imu(sequence: Sequence, odometry: Odometry, config: Config, manifest: Manifest) -> Inertial:
    """The IMU's part, empty without one."""
    if not config.imu.use:
        return Inertial(None)
    with manifest.timed("imu_start_s"):
        inertial = begin_inertial(sequence, config)
    if getattr(odometry, "ignores_prior", False):
        inertial.problems.append(f"{config.odometry.method} predicts by itself: the IMU only bridges scans that fail")
    return inertial
