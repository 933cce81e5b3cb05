"""The presets of the theses against what these print, key by key, typed from their text with its place."""

from __future__ import annotations

from typing import Any

import pytest

from lslam.core.config import Config, load_config
from lslam.odometry.frontend.inertial_start import with_imu_settings

ICP, LOAM, MAP = "thesis-icp", "thesis-loam", "thesis-loam-map"
HDL, BASELINE, IMPROVED = "hdl", "thesis-baseline", "thesis-improved"
GIROLIMETTO, DEL_TUFO = (ICP, LOAM, MAP), (HDL, BASELINE, IMPROVED)

# Place in the text; key; what the presets have, in the order of GIROLIMETTO; None: it is not of that method.
FIRST: list[tuple[str, str, tuple[Any, Any, Any]]] = [
    ("tables 4.1, 4.11: skipFrames", "input.skip_frames", (4, 4, 4)),
    ("listings 4.3, 4.9: findPointsInCylinder", "preprocess.range_shape", ("cylinder",) * 3),
    ("tables 4.1, 4.11: R from", "preprocess.range_min", (2, 2, 2)),
    ("tables 4.1, 4.11: R to", "preprocess.range_max", (70, 50, 50)),
    ("listing 4.3, line 9", "preprocess.downsample", ("random", None, None)),
    ("table 4.1: downsamplePercent", "preprocess.random_share", (0.3, None, None)),
    ("listings 4.3, 4.9: no filter", "preprocess.least_line", (0, 0, 0)),
    ("listing 4.4: planeToPlane; listing 4.10", "odometry.method", ("gicp", "loam-odom", "loam")),
    ("listing 4.5, line 33: ptCloudPrev = ptCloud_DS", "registration.target", ("sample", None, None)),
    ("table 4.1: inlierRatio", "registration.inlier_ratio", (0.2, None, None)),
    ("listing 4.4: no limit of distance", "registration.inlier_distance", (None, None, None)),
    ("section 4.2.1: regions", "loam.regions", (None, 6, 6)),
    ("table 4.11: maxPlanarSurfacePoints", "loam.max_planar_points", (None, 8, 8)),
    ("table 4.11: gridStep", "loam.grid_step", (None, 1.5, 1.5)),
    ("listing 4.10: MatchingMethod", "loam.matching", (None, "one-to-many", "one-to-many")),
    ("table 4.11: voxelSize", "loam.feature_map_voxel", (None, None, 1.5)),
    ("listing 4.4: one registration", "recovery.coarse_to_fine", (False,) * 3),
    ("listing 4.4: one registration", "recovery.start_search", (False,) * 3),
    ("listing 4.4: one registration", "recovery.at_rest", (False,) * 3),
    ("listing 4.10: one registration", "recovery.less_planar", (False,) * 3),
    ("listing 4.4: one registration", "recovery.fallback", ("none",) * 3),
    ("listing 4.4: taken as it is", "registration.min_agreement", (0, 0, 0)),
    ("listing 4.4: taken as it is", "registration.min_overlap", (0, 0, 0)),
    ("listing 4.4: taken as it is", "registration.weak_share", (0, 0, 0)),
    ("tables 4.1, 4.11: Rloop", "loops.radius", (8, 5, 3)),
    ("tables 4.1, 4.11: maxTolerableRMSE", "loops.max_rmse", (0.8, 0.9, 0.6)),
    ("tables 4.1, 4.11: MaxIter", "loops.max_iterations", (50, 50, 50)),
    ("listing 4.5, line 22: the rmse alone", "loops.min_overlap", (0, 0, 0)),
    ("listing 4.5, line 22: the rmse alone", "loops.max_ambiguity", (1, 1, 1)),
    ("listing 4.5, line 5: at each view", "loops.spacing", (0, 0, 0)),
    ("listing 4.6", "graph.optimizer", ("lm", "lm", "lm")),
    ("listing 4.5, line 26: eye(6)", "graph.information", ("identity",) * 3),
    ("listing 4.6: nothing judged", "graph.robust", ("none",) * 3),
    ("listing 4.6: nothing judged", "graph.is_pairwise", (False,) * 3),
    ("listing 4.6: nothing set straight", "graph.steady_drift", (False,) * 3),
    ("listing 4.6: no other edge", "graph.gravity_deg", (0,) * 3),
    ("listing 4.6: no other edge", "graph.imu_orientation_deg", (0,) * 3),
    ("listing 4.6: no other edge", "graph.floor", (False,) * 3),
    ("listing 5.1, lines 13 to 17", "imu.velocity", ("along-x",) * 3),
    ("section 5.1: first guess alone", "imu.weigh", (False,) * 3),
    ("table 5.1: inlierDist", "imu.inlier_distance", (0.4, None, None)),
    ("table 5.1: bg", "imu.gyro_bias", ((0.0873,) * 3,) * 3),
    ("table 5.1: ba", "imu.accel_bias", ((0.4905,) * 3,) * 3),
    ("listing 4.7: mapGridSize", "map.voxel", (0.2, 0.2, 0.2)),
]

# Likewise, in the order of DEL_TUFO. Where it prints no number, the place is that of its program.
SECOND: list[tuple[str, str, tuple[Any, Any, Any]]] = [
    ("section 2.4: 2 m", "keyframes.distance", (2, 2, 2)),
    ("section 2.4: 115 deg", "keyframes.angle_deg", (115, 115, 115)),
    ("section 2.4: by the mean distance of two clouds", "graph.information", ("fitness",) * 3),
    ("section 2.3: the baseline has no floor", "graph.floor", (True, False, False)),
    ("equation 2.1, section 3.4: SE(2)", "graph.planar", (False, True, True)),
    ("hdl_graph_slam: loop_closure_edge_robust_kernel", "graph.robust", ("huber",) * 3),
    ("hdl_graph_slam: no other test", "graph.is_pairwise", (False,) * 3),
    ("hdl_graph_slam: nothing set straight", "graph.steady_drift", (False,) * 3),
    ("hdl_graph_slam: distance_thresh", "loops.radius", (15, 15, 15)),
    ("hdl_graph_slam: accum_distance_thresh", "loops.min_travel", (25, 25, 25)),
    ("section 2.5, section 3.3", "osm.matcher", (None, "baseline", "walls")),
    ("section 3.4", "osm.mode", (None, None, "two-level")),
    ("section 3.1: 120 m", "osm.fetch_radius", (None, None, 120)),
    ("section 3.1: 60 m", "osm.renew_radius", (None, None, 60)),
    ("section 3.1: 35 m", "osm.use_radius", (None, None, 35)),
    ("section 3.2: walls of one scan", "keyframes.submap_size", (None, None, 1)),
    ("section 3.4: the first robot node is fixed", "osm.hold_start", (None, None, True)),
    ("delta_graph_slam: A, B, C of the global match", "osm.weights", (None, None, (1.5, 0.5, 0.5))),
    ("delta_graph_slam: MaxAvgDistance", "osm.max_distance", (None, None, 3.5)),
    ("delta_graph_slam: A, B, C of the local match", "osm.building_weights", (None, None, (1.5, 1.5, 0.1))),
    ("delta_graph_slam: MaxAvgDistance of it", "osm.building_max_distance", (None, None, 1.0)),
    ("chapter 4: ATE and RPE", "eval.metrics", (None, ("thesis",), ("thesis",))),
]


def resolved(preset: str, *settings: str) -> Config:
    return load_config(None, [f"odometry.preset={preset}", *settings], {})


def value(config: Config, key: str) -> Any:
    section, _, name = key.partition(".")
    found = getattr(getattr(config, section), name)
    return tuple(found) if isinstance(found, list) else found


@pytest.mark.parametrize(
    ("place", "key", "preset", "printed"),
    [
        (place, key, preset, printed)
        for presets, table in ((GIROLIMETTO, FIRST), (DEL_TUFO, SECOND))
        for place, key, row in table
        for preset, printed in zip(presets, row, strict=True)
        if printed is not None
    ],
)
def test_a_preset_has_what_its_thesis_prints(place: str, key: str, preset: str, printed: Any) -> None:
    assert value(resolved(preset), key) == printed, place


@pytest.mark.parametrize("preset", GIROLIMETTO)
def test_every_scan_that_is_registered_is_a_view_of_the_graph(preset: str) -> None:
    """Listing 4.4, line 7; a step of the slowest flight is 2 m."""
    assert resolved(preset).keyframes.distance < 0.01


def test_with_the_imu_the_distance_stands_in_place_of_the_ratio() -> None:
    """Listing 5.1, line 12."""
    used = with_imu_settings(resolved(ICP, "imu.use=true")).registration
    assert (used.inlier_distance, used.inlier_ratio) == (0.4, 1.0)
    alone = with_imu_settings(resolved(ICP)).registration
    assert (alone.inlier_distance, alone.inlier_ratio) == (None, 0.2)
    # Where no distance is asked for, nothing changes.
    ratio = with_imu_settings(load_config(None, ["imu.use=true", "registration.inlier_ratio=0.7"], {})).registration
    assert ratio.inlier_ratio == 0.7
