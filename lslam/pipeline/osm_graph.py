"""The pose graph in the frame of a map: held by its walls, and without the drift that they reveal."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lslam.config import Config
from lslam.graph.problem import PoseGraph
from lslam.graph.steady_drift import find_steady_drift, without_drift
from lslam.pipeline.osm_pass import Located
from lslam.priors.osm_prior import likeness

log = logging.getLogger("lslam")


def on_map(graph: PoseGraph, located: Located, config: Config) -> PoseGraph:
    """The graph in the frame of the map, held by its walls, and by its fixes where it has some."""
    return replace(
        graph,
        poses=graph.poses if graph.fixes else located.T_enu_odometry @ graph.poses,
        map_priors=located.priors,
        shift_sigma=config.osm.shift_sigma,
        map_sigma=config.osm.map_sigma,
        world_up=np.array([0.0, 0.0, 1.0]),
        start_sigma=None if graph.fixes else located.start_sigma,
        is_rigid=config.osm.trust_poses and config.odometry.method == "poses",
    )


def straightened(graph: PoseGraph, located: Located, config: Config) -> PoseGraph:
    """The graph without the steady drift that the map reveals."""
    sigma = np.array([config.osm.map_sigma, config.osm.map_sigma, np.radians(config.osm.map_sigma_deg)])
    rates = find_steady_drift(graph, likeness(located.accepted, located.osm.owners), sigma, config.graph)
    if rates is None:
        return graph
    percent, degrees = 100 * np.linalg.norm(rates[:, :2], axis=1), np.degrees(rates[:, 2]) * 100
    log.info(
        "OSM: odometry drifts steadily by %.1f %% and %.1f deg/100 m, and is set straight",
        percent.mean(), -degrees.mean(),
    )  # fmt: skip
    return without_drift(graph, rates)
