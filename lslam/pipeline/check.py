"""A configuration across its sections, without heavy imports: its checks, and a recording opened as it asks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lslam.backend.loops import require_descriptor
from lslam.core.config import Config
from lslam.core.config.config import read_preset
from lslam.core.config.odometry import FIXED_DEVICE, TIGHTLY_COUPLED
from lslam.core.errors import UsageError
from lslam.evaluation import check_words, parse_delta
from lslam.io.readers import open_sequence
from lslam.odometry import FEATURE_METHODS, METHODS, require_method
from lslam.osm import find_matcher
from lslam.registration.residuals import find_residual

if TYPE_CHECKING:
    from lslam.core.types.sequence import Sequence

# Methods that match a scan against Gaussian voxels, and what only some methods look at. A policy of `recovery` that is switched
# off is heeded by all: those that override it have it switched off.
ON_GAUSSIANS = tuple(name for name, (module, _) in METHODS.items() if module == METHODS["icp"][0])
ONLY_OF = {
    "registration.residual": ON_GAUSSIANS,
    "registration.target": ON_GAUSSIANS,
    "registration.keyframes": ON_GAUSSIANS,
    "registration.keyframe_m": ON_GAUSSIANS,
    "registration.keyframe_deg": ON_GAUSSIANS,
    "registration.inlier_distance": (*ON_GAUSSIANS, "dlo", "icp-svd"),
    "registration.inlier_ratio": (*ON_GAUSSIANS, "dlo", "icp-svd"),
    "recovery.fallback": tuple(name for name in FEATURE_METHODS if name not in TIGHTLY_COUPLED),
}


def check_config(config: Config) -> None:
    """Raise UsageError for unknown names, contradictions and keys without effect, before a run begins.

    Raises InputError when the map needs Open3D and it is missing.
    """
    method = config.odometry.method
    require_method(method)
    if config.loops.use:
        require_descriptor(config.loops.descriptor)
    if config.map.write_features and method not in FEATURE_METHODS:
        raise UsageError(f"method {method} has no feature map to save; these have: {', '.join(FEATURE_METHODS)}")
    if (method == "poses") != bool(config.odometry.poses):
        raise UsageError(
            f"odometry.poses = {config.odometry.poses!r} and method {method} do not go together: --poses FILE sets both"
        )
    if method == "poses" and config.imu.use:
        raise UsageError("--imu does nothing with --poses, whose motion is given: drop one of them")
    _check_imu(config)
    if config.wheels.source and (config.imu.use or method == "poses"):
        other = "--poses" if method == "poses" else f"the IMU of {method}" if method in TIGHTLY_COUPLED else "--imu"
        raise UsageError(
            f"--wheels and {other} both predict the motion and are not weighed together yet: drop one of them"
        )
    if config.map.write and (config.map.denoise or config.map.mesh):
        from lslam.maps.mesh import require_open3d

        require_open3d()
    if config.registration.residual is not None:
        find_residual(config.registration.residual)
    _check_effect(config)
    find_matcher(config.osm.matcher)
    if not config.osm.extract and (config.osm.origin is not None or config.osm.heading_deg is not None):
        raise UsageError("--origin and --heading do nothing without --osm FILE: give it, or drop them")
    _check_places(config)
    for delta in config.eval.delta:
        parse_delta(delta)
    check_words(config.eval.metrics)


def _check_places(config: Config) -> None:
    """Raise UsageError for keys of georeference or localisation that have no effect or contradict each other."""
    flag = "--crs" if config.gnss.crs or config.gnss.height_crs else "--geoid" if config.gnss.geoid else ""
    if flag and config.gnss.mode == "off" and not (config.osm.extract or config.graph.control):
        raise UsageError(
            f"{flag} does nothing without --gnss, --georeference, --osm or --control, which tell where on the Earth the run "
            "lies: give one of them, or drop it"
        )
    if config.localize.map and config.osm.extract:
        raise UsageError("--osm holds a drive by buildings and a map by its surfaces: drop one of them")
    if config.localize.map and (config.loops.file or config.graph.control):
        raise UsageError(
            "a map takes the place of the pose graph: --loops-file and --control do nothing there, drop them"
        )


def _check_imu(config: Config) -> None:
    """Raise UsageError for keys of the IMU that contradict a tightly coupled method."""
    method = config.odometry.method
    if method in TIGHTLY_COUPLED and (config.imu.velocity != "registration" or not config.imu.weigh):
        raise UsageError(
            f"imu.velocity and imu.weigh are of the loosely coupled IMU, {method} weighs points and IMU together: drop them"
        )
    if method == "lio-sam" and config.lio_sam.graph_imu and config.graph.imu_orientation_deg > 0:
        raise UsageError(
            "graph.imu_orientation_deg and lio_sam.graph_imu both bring the gyroscope's turns into the pose graph: drop the "
            "former, or set lio_sam.graph_imu to false"
        )
    if method == "lio-sam" and config.lio_sam.graph_imu and config.graph.gravity_deg == 0:
        raise UsageError(
            "graph.gravity_deg = 0 leaves gravity out of the pose graph, lio_sam.graph_imu brings it in: drop the former, or set "
            "lio_sam.graph_imu to false"
        )
    if (config.imu.estimate_offset or config.imu.estimate_extrinsics) and config.imu.velocity != "registration":
        raise UsageError(
            f"imu.estimate_offset and imu.estimate_extrinsics learn from registered turns, of which imu.velocity = "
            f"{config.imu.velocity!r} takes none: drop them, or imu.velocity"
        )
    if (config.imu.estimate_offset or config.imu.estimate_extrinsics) and method in FIXED_DEVICE:
        raise UsageError(
            f"imu.estimate_offset and imu.estimate_extrinsics are states of a filter, which {method} does not have: drop them, "
            "or take --method fast-lio2"
        )


def _check_effect(config: Config) -> None:
    """Raise UsageError for a changed key that the method would silently ignore."""
    method = config.odometry.method
    if method not in METHODS:
        return  # of another package: it knows what it takes
    for name, methods in ONLY_OF.items():
        part, _, key = name.partition(".")
        section = getattr(config, part)
        value, default = getattr(section, key), type(section).model_fields[key].default
        is_so_anyway = key == "target" and value in ("scan", "sample") and method == "icp-svd"
        if value != default and method not in methods and not is_so_anyway:
            preset = config.odometry.preset
            if preset and read_preset(preset).get(part, {}).get(key) == value:
                raise UsageError(
                    f"preset {preset} sets {name} = {value!r}, which does nothing with method {method}: leave out --method, or "
                    "the preset"
                )
            raise UsageError(
                f"{name} = {value!r} does nothing with method {method}: drop it, or use one that heeds it "
                f"({', '.join(methods)})"
            )


def open_recording(place: str | Path, config: Config, **reading: Any) -> Sequence:
    """Open a recording with the streams that the configuration needs; reading : further options of `open_sequence`."""
    return open_sequence(
        place,
        vertical_correction_deg=config.input.vertical_correction_deg,
        imu=config.imu.use,
        gnss=config.gnss.mode != "off",
        **reading,
    )
